"""From the labels of a frame to its observations, by tiles of the image."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

from semstab.backends.shared.hashing import PARTITIONS
from semstab.backends.shared.observed import Observed, WorkSpace
from semstab.backends.shared.pixels.keys import HALF
from semstab.backends.shared.pixels.pixel_keys import columns_of, frame_terms
from semstab.backends.shared.pixels.run_vectors import LANES
from semstab.backends.shared.pixels.tile_loops import (
    COLUMNS,
    NEAR,
    REACH,
    ROWS,
    TABLE_BITS,
    emit_voxels,
    face_terms,
    find_words,
    merge_words,
    scatter_words,
)
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.voxels.extent import Extent

Int64 = npt.NDArray[np.int64]

FIRST_ROOM = 1 << 15
"""Entries that a band has room for at first: more than a quarter of its pixels in an image of 3840x2160."""

TABLE = 1 << TABLE_BITS


@dataclass(frozen=True, eq=False)
class _Found:
    """The entries of each band: words with counts, some of them twice; a band has `room` for them.

    word, count, partition  (bands * room,)
    entries                 (bands,) how many there are
    spread                  (bands, PARTITIONS) of them by partition
    """

    word: Int64
    count: npt.NDArray[np.int32]
    partition: npt.NDArray[np.uint8]
    room: int
    entries: Int64
    spread: Int64


class Tiles:
    """Observes labels; keeps its work space from frame to frame."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        self._band_room = FIRST_ROOM
        self._space = WorkSpace()

    def observe(self, frame: Frame, origin: Int64) -> Observed | None:
        """The observations of labels, or None where the frame reaches too far or a label is outside the classes."""
        assert frame.labels is not None
        space, (H, W), camera = self._space, frame.shape, frame.intrinsics
        ray_x = (np.arange(W) - camera.cx) / camera.fx
        ray_y = (np.arange(H) - camera.cy) / camera.fy
        corner = np.floor(frame.T_wc[:3, 3] / self.voxel_size).astype(np.int64) - origin + (HALF - NEAR)
        if corner.min() < 0 or corner.max() > 2 * (HALF - NEAR):
            return None
        rays = space.room("rays", 3, W, dtype=np.float64)
        rays[:], margin = frame_terms(ray_x, frame.T_wc, self.voxel_size, REACH)
        down = (frame.T_wc[:3, 1] * ray_y[:, None] + frame.T_wc[:3, 2]) / self.voxel_size
        half, face = face_terms(margin)
        begin = frame.T_wc[:3, 3] / self.voxel_size - origin + (REACH + half + HALF - corner)
        bands, threads = -(-H // ROWS), nb.get_num_threads()
        tables = space.room("table", threads, TABLE)
        tables[:] = -1
        while True:
            room = min(self._band_room, ROWS * W + (COLUMNS + 1) * ROWS + 2 * TABLE)
            word, count = space.room("word", bands * room), space.room("count", bands * room, dtype=np.int32)
            partition = space.room("partition", bands * room, dtype=np.uint8)
            entries, lost = np.zeros(bands, dtype=np.int64), np.zeros(bands, dtype=np.int64)
            spread = np.zeros((bands, PARTITIONS), dtype=np.int64)
            low, high = np.zeros((bands, 4), dtype=np.int64), np.full((bands, 4), -1)
            find_words(
                fixed(frame.depth), fixed(frame.labels), ray_x, ray_y, fixed(frame.T_wc), self.voxel_size, origin,
                corner, columns_of(self.within, origin), rays, down, begin, face, frame.ignore_id, room,
                space.room("stretches", threads, 4, COLUMNS + 2 * LANES), tables,
                space.room("table_count", threads, TABLE, dtype=np.int32),
                word, count, partition, entries, lost, spread, low, high,
            )  # fmt: skip
            if lost.any() or high[:, 3].max() >= self.num_classes:
                return None
            if entries.min() >= 0:
                break
            self._band_room *= 4
        found = _Found(word, count, partition, room, entries, spread)
        return self._merged(found, low[:, :3].min(axis=0), high.max(axis=0), corner)

    def _merged(self, found: _Found, low: Int64, high: Int64, corner: Int64) -> Observed:
        """Sort the entries by partition and word, and add up equal ones."""
        space, total = self._space, int(found.entries.sum())
        offset = np.zeros((PARTITIONS, len(found.entries)), dtype=np.int64)
        offset.reshape(-1)[1:] = np.cumsum(found.spread.T.reshape(-1))[:-1]
        edges = np.append(offset[:, 0], total)
        widths = [max(1, int(extent).bit_length()) for extent in (*(high[:3] - low), high[3])]
        shift = np.cumsum(widths[::-1])[-2::-1]  # of a, b and c, above the label's bits
        words = [space.room(f"words {i}", total) for i in range(2)]
        counts = [space.room(f"counts {i}", total, dtype=np.int32) for i in range(2)]
        scatter_words(
            found.word, found.count, found.partition, found.room, found.entries, offset, low, shift, words[0], counts[0]
        )
        flipped = np.zeros(PARTITIONS, dtype=np.bool_)
        voxels, kept = np.zeros(PARTITIONS, dtype=np.int64), np.zeros(PARTITIONS, dtype=np.int64)
        merge_words(
            words[0], counts[0], words[1], counts[1], edges, int(sum(widths)), widths[-1], flipped, voxels, kept
        )
        bounds, entry_bounds = (np.concatenate([[0], np.cumsum(number)]) for number in (voxels, kept))
        n, m = int(bounds[-1]), int(entry_bounds[-1])
        seen = Observed(
            key=space.room("key", n),
            pixels=space.room("pixels", n),
            start=space.room("start", n + 1),
            label=space.room("label", m, dtype=np.uint16),
            weight=space.room("weight", m, dtype=np.float64),
            bounds=bounds,
        )
        emit_voxels(
            words[0], counts[0], words[1], counts[1], edges, flipped, bounds, entry_bounds, low, shift, corner,
            seen.key, seen.pixels, seen.start, seen.label, seen.weight,
        )  # fmt: skip
        return seen
