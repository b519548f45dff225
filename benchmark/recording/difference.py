"""Voxels where the maps of two backends differ."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.metrics import vss
from semstab.recording.layout import DIFFERENCE
from semstab.recording.voxel_maps import thinned
from semstab.voxels import VoxelTable

ONLY_FIRST, ONLY_SECOND = (230, 159, 0), (86, 180, 233)
VSS_RANGE = (0.0, 0.5)


def log_difference(
    stream: rr.RecordingStream,
    entity: str,
    first: VoxelTable,
    second: VoxelTable,
    origin: npt.NDArray[np.int64],
    tolerance: float,
) -> str:
    """Log the voxels that one map has only, and those whose VSS differs by more than the tolerance; say how many."""
    in_first, in_second = matched(first, second)
    change = np.abs(vss(first)[in_first] - vss(second)[in_second])
    differs = change > tolerance
    parts = {
        "only_first": np.delete(first.index, in_first, axis=0),
        "only_second": np.delete(second.index, in_second, axis=0),
        "changed": first.index[in_first[differs]],
    }
    looks: dict[str, dict[str, Any]] = {
        "only_first": {"colors": ONLY_FIRST},
        "only_second": {"colors": ONLY_SECOND},
        "changed": {"colormap": rr.components.Colormap.Inferno, "value_range": VSS_RANGE},
    }
    for part in DIFFERENCE:
        index = parts[part] - origin
        factor, rows = thinned(index)
        values: dict[str, Any] = {"values": change[differs][rows].astype(np.float32)} if part == "changed" else {}
        cells = (index[rows] // factor).astype(np.int32)
        size = [first.voxel_size * factor] * 3
        stream.log(f"{entity}/{part}", rr.VoxelGridMap(cells, size, **values, **looks[part]))
    return (
        f"{len(parts['only_first']):,} voxels in the first only, {len(parts['only_second']):,} in the second only,"
        f" VSS differs in {int(differs.sum()):,} of {len(in_first):,} others"
    )


def matched(first: VoxelTable, second: VoxelTable) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows of two tables that are the same voxel, ascending in both."""
    a, b = (
        np.ascontiguousarray(table.index).view([("x", "i4"), ("y", "i4"), ("z", "i4")]).ravel()
        for table in (first, second)
    )
    _, in_first, in_second = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_first, in_second
