"""The one way in which tests configure a run or a study of posed folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from semstab.config import Config
from semstab.configure import load_config, resolve


def dataset_of(root: Path, **options: Any) -> dict[str, Any]:
    """The setting `dataset` of the scene, or the scenes, in a folder."""
    return {"name": "posed_folder", "options": {"root": str(root), **options}}


def configure(root: Path, **settings: Any) -> Config:
    """Fused by the reference into voxels of 0.25 m, and checked against it, unless the settings say otherwise.

    The geometry is not checked, which takes a seventh of a small run; tests of what a run says of it ask for that.
    """
    usual = {
        "dataset": dataset_of(root), "backends": ["numpy"], "check": "numpy", "check_geometry": False,
        "voxel_size": 0.25,
    }  # fmt: skip
    return resolve(load_config(overrides={**usual, **settings}))
