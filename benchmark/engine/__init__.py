"""The engine of runs and studies: scenes x models x backends x variations, each unit is stored when it is finished.

Examples:
    >>> result = semstab.run(config, out="jobs", executor=semstab.engine.LocalProcesses(2), report=False)
    >>> len(result.records)
    2
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semstab.engine.execution import execute
    from semstab.engine.executors import DaskCluster, Executor, InProcess, LocalProcesses
    from semstab.engine.folder import load_result
    from semstab.engine.observer import Observer

__all__ = ["DaskCluster", "Executor", "InProcess", "LocalProcesses", "Observer", "execute", "load_result"]

_HOMES = {
    "DaskCluster": "executors", "Executor": "executors", "InProcess": "executors", "LocalProcesses": "executors",
    "Observer": "observer", "execute": "execution", "load_result": "folder",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import the public names when they are first used: what reads results does not load what computes them."""
    if name not in _HOMES:
        raise AttributeError(f"module 'semstab.engine' has no attribute '{name}'")
    return getattr(importlib.import_module(f"semstab.engine.{_HOMES[name]}"), name)
