"""The log of observations that the numba backend keeps on request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.numba_parts.loops import place_observations
from semstab.backends.shared.observed import Observed
from semstab.model.evidence import Evidence
from semstab.model.voxels import Events

Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame's observations, kept: rows of the map, pixels, and their entries as in `Observed`, without empty ones."""

    frame: int
    row: npt.NDArray[np.int32]
    pixels: npt.NDArray[np.int32]
    entries: npt.NDArray[np.uint16]
    label: npt.NDArray[np.uint16]
    weight: npt.NDArray[np.float64]


class History:
    """Every observation of a map, frame after frame."""

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self._seen: list[_Seen] = []

    def append(self, seen: Observed, row: Int64, frame: int) -> None:
        """Keep a copy of the observations of the map's rows that outlives the next frame."""
        some = seen.weight > 0
        entries = (
            np.add.reduceat(some, seen.start[:-1], dtype=np.uint16) if len(seen.key) else seen.key.astype(np.uint16)
        )
        self._seen.append(
            _Seen(
                frame,
                row.astype(np.int32),
                seen.pixels.astype(np.int32),
                entries,
                seen.label[some],
                seen.weight[some],
            )
        )

    def events(self, order: npt.NDArray[np.int32], index: dict[str, Any]) -> Events:
        """The observations in order of integration within a voxel; voxels are the map's rows in that order."""
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        observations, entries = np.zeros(len(order) + 1, np.int64), np.zeros(len(order) + 1, np.int64)
        for seen in self._seen:
            voxel = rank[seen.row] + 1  # a voxel is in a frame once
            observations[voxel] += 1
            entries[voxel] += seen.entries
        place, entry = np.cumsum(observations), np.cumsum(entries)  # where each voxel's next observation goes
        voxels = np.repeat(np.arange(len(order), dtype=np.int32), observations[1:])
        frame, pixels = (np.empty(len(voxels), np.int32) for _ in range(2))
        starts = np.empty(len(voxels) + 1, np.int64)
        starts[-1] = entry[-1]
        label, weight = np.empty(entry[-1], np.uint16), np.empty(entry[-1])
        for seen in self._seen:
            place_observations(
                rank, seen.frame, seen.row, seen.pixels, seen.entries, seen.label, seen.weight,
                place, entry, frame, pixels, starts, label, weight,
            )  # fmt: skip
        return Events(
            **index,
            voxel=voxels,
            frame=frame,
            evidence=Evidence(starts, label, weight, self.num_classes),
            pixels=pixels,
            voxel_size=self.voxel_size,
        )
