"""A check that a dataset makes sense: poses, depth, units, intrinsics, labels, and what voxels it can carry."""

from semstab.check.labels import Ordered
from semstab.check.no_depth import with_invalid_depth
from semstab.check.scene_check import (
    SCHEMA,
    SceneCheck,
    check,
    check_scene,
    quick_check,
    quick_sample,
    refuse_unsound,
    require_sound,
)
from semstab.check.verdict import Verdict
from semstab.check.voxel_size import advise, faces_in_surface, with_voxel_size

__all__ = [
    "SCHEMA",
    "Ordered",
    "SceneCheck",
    "Verdict",
    "advise",
    "check",
    "check_scene",
    "faces_in_surface",
    "quick_check",
    "quick_sample",
    "refuse_unsound",
    "require_sound",
    "with_invalid_depth",
    "with_voxel_size",
]
