"""Voxels where the maps of two backends differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.metrics import vss
from semstab.metrics.matching import shared_rows
from semstab.model.voxels import VoxelTable
from semstab.outputs.recording.maps.voxel_maps import thinned

ONLY_FIRST, ONLY_SECOND = (230, 159, 0), (86, 180, 233)
VSS_RANGE = (0.0, 0.5)

DIFFERENCE = {"only_first": "in the first only", "only_second": "in the second only", "changed": "|VSS difference|"}
"""The parts of a difference, and what they are called."""


def log_difference(
    stream: rr.RecordingStream,
    entity: str,
    tables: Mapping[str, VoxelTable],
    origin: npt.NDArray[np.int64],
    tolerance: float,
) -> str:
    """Log the voxels that one of two maps has only, and those whose VSS differs by more than the tolerance.

    tables  the two maps by the names of their backends

    Returns how many there are, in words. They are of the final maps, so they are logged for all times.
    """
    first, second = tables.values()
    in_first, in_second = shared_rows(first, second)
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
        stream.log(f"{entity}/{part}", rr.VoxelGridMap(cells, size, **values, **looks[part]), static=True)
    one, other = tables
    return (
        f"{len(parts['only_first']):,} voxels in {one} only, {len(parts['only_second']):,} in {other} only; of"
        f" {len(in_first):,} in both VSS differs in {int(differs.sum()):,}, by {change.max(initial=0.0):.2g} at most"
    )
