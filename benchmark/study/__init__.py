"""A study: scenes x backbones x backends x variations, each unit kept, so that a killed study goes on where it was."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semstab.study.config import StudyConfig, load_study, shipped_studies
    from semstab.study.executors import DaskCluster, InProcess, LocalProcesses
    from semstab.study.folder import load_study_result
    from semstab.study.results import StudyResult
    from semstab.study.run import StudyObserver, run_study

__all__ = [
    "DaskCluster",
    "InProcess",
    "LocalProcesses",
    "StudyConfig",
    "StudyObserver",
    "StudyResult",
    "load_study",
    "load_study_result",
    "run_study",
    "shipped_studies",
]

_HOMES = {
    "DaskCluster": "executors",
    "InProcess": "executors",
    "LocalProcesses": "executors",
    "StudyConfig": "config",
    "StudyObserver": "run",
    "StudyResult": "results",
    "load_study": "config",
    "load_study_result": "folder",
    "run_study": "run",
    "shipped_studies": "config",
}


def __getattr__(name: str) -> Any:
    """Import the public names when they are first used: what reads results does not load what computes them."""
    if name not in _HOMES:
        raise AttributeError(f"module 'semstab.study' has no attribute '{name}'")
    return getattr(importlib.import_module(f"semstab.study.{_HOMES[name]}"), name)
