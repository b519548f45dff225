"""manifest.json: where a run's numbers come from."""

from __future__ import annotations

import importlib.metadata
import platform
import resource
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from semstab.config import Config

SCHEMA = 1
"""Version of manifest.json."""

REPORTED_PACKAGES = ("numpy", "open3d", "opencv-python-headless", "pyarrow", "rerun-sdk", "trimesh")


def manifest(
    config: Config, inputs: Mapping[str, str], seconds: Mapping[str, float], command: Sequence[str]
) -> dict[str, Any]:
    """The content of manifest.json: versions, digests of the inputs, wall-clock seconds by stage, peak memory."""
    return {
        "schema": SCHEMA,
        "semstab": _version("semstab"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in REPORTED_PACKAGES},
        "command": list(command),
        "seed": config.dataset.options.get("seed"),
        "inputs": dict(inputs),
        "seconds": dict(seconds),
        "peak_memory_bytes": _peak_memory(),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _peak_memory() -> int:
    """Peak resident memory of this process; Linux counts it in kB, macOS in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
