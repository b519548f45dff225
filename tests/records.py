"""Records of a study from maps given voxel by voxel, for cases that are worked out by hand."""

from __future__ import annotations

import numpy as np

from semstab import Result, VoxelTable
from semstab.config import BASE
from semstab.data.records import Record, Variation
from semstab.data.results import UnitName
from semstab.metrics import summarise

CLASSES = ("a", "b", "c")


def voxels(*groups, r=0.2):
    """A map in a row along z from groups (number of voxels, op, evidence[, SBD in bits])."""
    n, op, evidence, drift = zip(*((group[0], group[1], group[2], (*group, 0.0)[3]) for group in groups), strict=True)
    total = sum(n)
    zeros = np.zeros(total)
    ops = np.repeat(op, n)
    return VoxelTable(
        zeros, zeros, np.arange(total), op=ops, evidence=np.repeat(np.array(evidence, dtype=float), n, axis=0),
        drift_sum=np.repeat(drift, n) * (ops - 1), pixels=ops, first_frame=zeros, last_frame=zeros, self_sum=zeros,
        frame_entropy_sum=zeros, voxel_size=r, classes=CLASSES,
    )  # fmt: skip


def record(table, sweep=BASE, value=None, repeat=0, scene="s", model="m", backend="numpy", **more):
    """The record of a unit that left this map."""
    unit = UnitName(scene, model, backend)
    varied = Variation(sweep, value, repeat)
    return Record(unit, "abc", 4, summarise(table), 10.0, 5.0, unit.slug, varied, **more)


def study(*records, **more):
    """A study of these records."""
    return Result("by hand", "numpy", records, **more)
