"""From the soft scores of a frame to its observations."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from semstab.backends.shared.hashing import PARTITIONS
from semstab.backends.shared.observed import Observed, ObservedScores, WorkSpace
from semstab.backends.shared.pixels.pixel_keys import columns_of, frame_terms, keep_columns
from semstab.backends.shared.scores.loops import COLUMNS, ROWS, TABLE_BITS, merge_rows, scatter_rows, sum_scores
from semstab.backends.shared.scores.vectors import LANES
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.voxels.extent import Extent

Int64 = npt.NDArray[np.int64]

FIRST_ROOM = 1 << 12
"""Voxels that a band has room for at first."""

SAMPLE = 1 << 10
"""Voxels, about, that are looked at to tell whether a frame's voxels have most classes."""


class Scores:
    """Observes soft scores; keeps its work space from frame to frame."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        self._band_room = FIRST_ROOM
        self._space = WorkSpace()

    def observe(self, frame: Frame, origin: Int64) -> Observed | ObservedScores | None:
        """The observations of scores, or None where a pixel with depth is out of reach.

        As dense rows where the voxels have evidence for most of the classes, else by its entries.

        What is restricted is left out at the end: in which order sums are rounded hangs on all of the frame's voxels.
        """
        space, (H, W), camera, K = self._space, frame.shape, frame.intrinsics, self.num_classes
        ray_x = (np.arange(W) - camera.cx) / camera.fx
        ray_y = (np.arange(H) - camera.cy) / camera.fy
        rays, margin = frame_terms(ray_x, frame.T_wc, self.voxel_size)
        bands, threads = -(-H // ROWS), nb.get_num_threads()
        stride = -(-K // LANES) * LANES
        scores = _flat(frame.scores)
        behind = (COLUMNS + LANES) * K
        ending = fixed(np.concatenate([scores[-behind:], np.zeros(behind, dtype=scores.dtype)]))
        while True:
            room = min(self._band_room, ROWS * W)
            key, count = space.room("key", bands * room), space.room("count", bands * room, dtype=np.int32)
            sums = space.room("sums", bands * room * stride, dtype=np.float64)
            entries, lost = np.zeros(bands, dtype=np.int64), np.zeros(bands, dtype=np.int64)
            spread = np.zeros((bands, PARTITIONS), dtype=np.int64)
            sum_scores(
                fixed(frame.depth), np.zeros(W, dtype=np.uint8), scores, ending, K, ray_x, ray_y,
                fixed(frame.T_wc), self.voxel_size, origin, columns_of(None, origin), rays, margin, room,
                space.room("keys", threads, ROWS, W), space.room("table", threads, 1 << TABLE_BITS),
                space.room("table_row", threads, 1 << TABLE_BITS, dtype=np.int32),
                space.room("stretches", threads, 3, COLUMNS + 2 * LANES),
                space.room("scale", threads, COLUMNS + LANES, dtype=np.float64), key, count, sums, entries, lost,
                spread,
            )  # fmt: skip
            if lost.any():
                return None
            if entries.min() >= 0:
                break
            self._band_room *= 4
        seen = _lean(self._merged(key, count, sums, room, entries, spread))
        return seen if self.within is None else seen.only(keep_columns_of(seen.key, columns_of(self.within, origin)))

    def _merged(
        self, key: Int64, count: Any, sums: npt.NDArray[np.float64], room: int, entries: Int64, spread: Int64
    ) -> ObservedScores:
        """Add up the entries of each voxel, band after band."""
        space, total, K = self._space, int(entries.sum()), self.num_classes
        stride = -(-K // LANES) * LANES
        offset = np.zeros((PARTITIONS, len(entries)), dtype=np.int64)
        offset.reshape(-1)[1:] = np.cumsum(spread.T.reshape(-1))[:-1]
        edges = np.append(offset[:, 0], total)
        merged = [space.room(f"merged {name}", total) for name in ("key", "pixels", "row")]
        scatter_rows(key, count, room, stride, entries, offset, *merged)
        found = np.zeros(PARTITIONS, dtype=np.int64)
        merge_rows(edges, *merged, space.room("again", total), space.room("first", total), sums, K, found)
        bounds = np.concatenate([[0], np.cumsum(found)])
        ends = edges[:-1] + found
        keys, pixels, row = (space.room(name, int(bounds[-1])) for name in ("keys out", "pixels", "row"))
        for whole, gaps in zip((keys, pixels, row), merged, strict=True):
            np.concatenate([gaps[low:high] for low, high in zip(edges, ends, strict=False)], out=whole)
        return ObservedScores(keys, pixels, row, sums, bounds, K)


def keep_columns_of(key: Int64, columns: Int64) -> npt.NDArray[np.bool_]:
    """Which of the keys (n,) are within columns, see `keep_columns`."""
    kept = key.copy()
    keep_columns(kept, columns)
    inside: npt.NDArray[np.bool_] = kept >= 0
    return inside


def _lean(seen: ObservedScores) -> Observed | ObservedScores:
    """By entries where less than half of the classes of the voxels have evidence, as of scores that were cut off."""
    some = seen.rows(slice(None, None, max(1, len(seen.key) // SAMPLE)))
    return seen if 2 * np.count_nonzero(some) >= some.size else seen.sparse()


def _flat(scores: Any) -> Any:
    """Scores one after the other, half-precision ones as their bits; what compiled code does not know, in float64."""
    kind = scores.dtype if scores.dtype in (np.float16, np.float32) else np.float64
    values = fixed(scores.astype(kind, copy=False)).reshape(-1)
    return values.view(np.uint16) if kind == np.float16 else values
