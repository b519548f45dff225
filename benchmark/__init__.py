"""semstab: how stable are a segmentation model's predictions at the same physical place?"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from semstab.core.versions import VERSION

if TYPE_CHECKING:
    from semstab import backends, datasets, engine, metrics, models, statistics
    from semstab.api import run, run_study
    from semstab.compare_runs import compare
    from semstab.comparison.features import compare_features
    from semstab.config import Config
    from semstab.configure import load_config, load_study
    from semstab.data.events import Events
    from semstab.data.features import Features
    from semstab.data.frames import Frame, Intrinsics
    from semstab.data.labels import LabelSpace
    from semstab.data.records import Result
    from semstab.data.voxels import VoxelTable
    from semstab.engine.folder import load_result
    from semstab.errors import ConfigError, DataError, MissingDependencyError, SemstabError
    from semstab.exports import export
    from semstab.exports.fused_labels import Belief
    from semstab.exports.relabel import relabel
    from semstab.gating.gate import GateConfig, gate
    from semstab.online import FusedResult, TemporalStability, fuse
    from semstab.other_maps import compare_maps
    from semstab.report.saved_run import load
    from semstab.statistics.acceptance import AcceptanceThresholds
    from semstab.two_visits import compare_visits

__version__ = VERSION

__all__ = [
    "AcceptanceThresholds",
    "Belief",
    "Config",
    "ConfigError",
    "DataError",
    "Events",
    "Features",
    "Frame",
    "FusedResult",
    "GateConfig",
    "Intrinsics",
    "LabelSpace",
    "MissingDependencyError",
    "Result",
    "SemstabError",
    "TemporalStability",
    "VoxelTable",
    "backends",
    "compare",
    "compare_features",
    "compare_maps",
    "compare_visits",
    "datasets",
    "engine",
    "export",
    "fuse",
    "gate",
    "load",
    "load_config",
    "load_result",
    "load_study",
    "metrics",
    "models",
    "relabel",
    "run",
    "run_study",
    "statistics",
]  # fmt: skip

_HOMES = {
    "AcceptanceThresholds": "statistics.acceptance", "Belief": "exports.fused_labels", "Config": "config",
    "ConfigError": "errors", "DataError": "errors", "Events": "data.events", "Features": "data.features",
    "Frame": "data.frames",
    "GateConfig": "gating.gate", "Intrinsics": "data.frames", "LabelSpace": "data.labels",
    "MissingDependencyError": "errors", "Result": "data.records", "SemstabError": "errors", "VoxelTable": "data.voxels",
    "FusedResult": "online", "TemporalStability": "online", "compare": "compare_runs",
    "compare_features": "comparison.features", "compare_maps": "other_maps",
    "compare_visits": "two_visits", "fuse": "online",
    "export": "exports", "gate": "gating.gate", "load": "report.saved_run",
    "load_config": "configure", "load_result": "engine.folder", "load_study": "configure", "relabel": "exports.relabel",
    "run": "api", "run_study": "api",
}  # fmt: skip
"""The module of each public name; other public names are modules."""


def __getattr__(name: str) -> Any:
    """Import the public names when they are first used: `import semstab` stays instant."""
    if name not in __all__:
        raise AttributeError(f"module 'semstab' has no attribute '{name}'")
    module = importlib.import_module(f"semstab.{_HOMES.get(name, name)}")
    globals()[name] = value = getattr(module, name) if name in _HOMES else module
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*__all__, "__version__"])
