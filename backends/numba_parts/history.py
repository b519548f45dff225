"""The log of observations that the numba backend keeps on request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.keys import index_of_keys
from semstab.backends.shared.observed import Observed
from semstab.model.voxels import Events, index_columns

Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame's observations, kept: as `Observed`, with the number of entries of each voxel."""

    frame: int
    key: Int64
    pixels: Int64
    entries: Int64
    label: npt.NDArray[np.uint16]
    weight: npt.NDArray[np.float64]


class History:
    """Every observation of a map, frame after frame."""

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self._seen: list[_Seen] = []

    def append(self, seen: Observed, frame: int) -> None:
        """Keep a copy of the observations that outlives the next frame."""
        some = seen.weight > 0
        entries = np.add.reduceat(some, seen.start[:-1], dtype=np.int64) if len(seen.key) else seen.key
        kept = _Seen(frame, seen.key.copy(), seen.pixels.copy(), entries, seen.label[some], seen.weight[some])
        self._seen.append(kept)

    def events(self, origin: Int64) -> Events:
        """The observations in order of integration within a voxel; keys count from the origin."""
        seen = self._seen
        keys = _joined([frame.key for frame in seen], np.int64)
        distinct, voxel = np.unique(keys, return_inverse=True)  # packed keys sort like (ix, iy, iz)
        by_voxel = np.argsort(voxel, kind="stable")
        pixels = _joined([frame.pixels for frame in seen], np.int64)
        evidence = np.zeros((len(keys), self.num_classes))
        row = np.repeat(np.arange(len(keys)), _joined([frame.entries for frame in seen], np.int64))
        evidence[row, _joined([frame.label for frame in seen], np.uint16)] = (
            _joined([frame.weight for frame in seen], np.float64) / pixels[row]
        )
        return Events(
            **index_columns(index_of_keys(distinct, origin)),
            voxel=voxel[by_voxel],
            frame=np.repeat([frame.frame for frame in seen], [len(frame.key) for frame in seen])[by_voxel],
            evidence=evidence[by_voxel],
            pixels=pixels[by_voxel],
            voxel_size=self.voxel_size,
        )


def _joined(parts: list[npt.NDArray[Any]], dtype: Any) -> npt.NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype=dtype), *parts])
