"""From the pixels of a frame to its observations, one a voxel, in compiled parallel code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

from semstab.backends.shared.association import INDEX_LIMIT, check_frame, voxel_index
from semstab.backends.shared.entries import find_entries
from semstab.backends.shared.hashing import PARTITIONS
from semstab.backends.shared.observed import Observed, ObservedScores, WorkSpace
from semstab.backends.shared.pixels.keys import HALF, index_of_keys, out_of_reach
from semstab.backends.shared.pixels.merging import compact, group, scatter, sort_labels
from semstab.backends.shared.pixels.pixel_keys import columns_of, frame_terms
from semstab.backends.shared.pixels.tiles import Tiles
from semstab.backends.shared.scores.observed_scores import Scores
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.voxels.extent import Extent

BANDS = 64
MIN_BAND_ROWS = 8
FIRST_ROOM = 1 << 13
"""Entries that a band has room for at first: a sixteenth of its pixels in an image of 3840x2160."""

Int64 = npt.NDArray[np.int64]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Found:
    """The entries (distinct pairs of voxel and label) of each band of `rows` rows; a band has `room` for them.

    key, label, count  (bands * room,) packed voxel, class and pixels of each
    entries            (bands,) how many there are
    spread             (bands, PARTITIONS) of them by partition
    """

    rows: int
    room: int
    key: Int64
    label: npt.NDArray[np.uint16]
    count: npt.NDArray[np.int32]
    entries: Int64
    spread: Int64


class Aggregator:
    """Turns frames into observations, of the voxels of an extent where one is given; keeps its work space."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        known = None if within is None else within.origin
        self.origin: Int64 | None = None if known is None else np.array(known, dtype=np.int64)
        self._band_room = FIRST_ROOM
        self._space = WorkSpace()
        self._tiles = Tiles(voxel_size, num_classes, within)
        self._scores = Scores(voxel_size, num_classes, within)

    def observe(self, frame: Frame) -> Observed | ObservedScores:
        """The frame's observations; the first frame's camera sets the origin.

        Raises DataError for a label outside the classes, or a voxel out of reach of the packed keys.
        """
        origin = self._origin_at(frame) if self.origin is None else self.origin
        seen = self._seen(frame, origin)
        self.origin = origin
        return seen

    def _seen(self, frame: Frame, origin: Int64) -> Observed | ObservedScores:
        if frame.labels is not None:
            seen = self._tiles.observe(frame, origin)
            return self._merged(self._found(frame, origin)) if seen is None else seen
        soft = self._scores.observe(frame, origin)
        if soft is None:  # a pixel out of reach: does it have a prediction?
            depth = np.where(frame.valid, frame.depth, np.float32(0))
            soft = self._scores.observe(dataclasses.replace(frame, depth=depth), origin)
        if soft is None:
            raise out_of_reach(frame, origin, self.voxel_size)
        return soft

    def _found(self, frame: Frame, origin: Int64) -> _Found:
        """The entries of each band of rows, with more room for them where the first attempt had too little."""
        space, (H, W) = self._space, frame.shape
        rows = max(MIN_BAND_ROWS, -(-H // BANDS))
        bands = -(-H // rows)
        camera = frame.intrinsics
        ray_x = (np.arange(W) - camera.cx) / camera.fx
        ray_y = (np.arange(H) - camera.cy) / camera.fy
        threads = nb.get_num_threads()
        rays, margin = frame_terms(ray_x, frame.T_wc, self.voxel_size)
        row_keys = space.room("row_keys", threads, 2, W)
        row_changes = space.room("row_changes", threads, W, dtype=np.uint8)
        row_runs = space.room("row_runs", threads, 4, W + 1, dtype=np.int32)
        while True:
            room = min(self._band_room, rows * W)
            key, label = space.room("key", bands * room), space.room("label", bands * room, dtype=np.uint16)
            count = space.room("count", bands * room, dtype=np.int32)
            slots = space.room("slots", threads, slots_for(room), dtype=np.int32)
            entries, lost = np.zeros(bands, dtype=np.int64), np.zeros(bands, dtype=np.int64)
            highest = np.full(bands, -1, dtype=np.int64)
            spread = np.zeros((bands, PARTITIONS), dtype=np.int64)
            find_entries(
                fixed(frame.depth), fixed(frame.labels), ray_x, ray_y, fixed(frame.T_wc), self.voxel_size, origin,
                columns_of(self.within, origin), rays, margin, frame.ignore_id, rows, room, row_keys, row_changes,
                row_runs, slots, key, label, count, entries, lost, highest, spread,
            )  # fmt: skip
            if highest.max() >= self.num_classes:
                check_frame(frame, self.num_classes)
            if lost.any():
                raise out_of_reach(frame, origin, self.voxel_size)
            if entries.min() >= 0:
                return _Found(rows, room, key, label, count, entries, spread)
            self._band_room *= 4

    def _merged(self, at: _Found) -> Observed:
        space = self._space
        total = int(at.entries.sum())
        offset = np.zeros((PARTITIONS, len(at.entries)), dtype=np.int64)
        offset.reshape(-1)[1:] = np.cumsum(at.spread.T.reshape(-1))[:-1]
        edges = np.append(offset[:, 0], total)
        order = space.room("order", total)
        scatter(at.key, at.room, at.entries, offset, order)
        voxel = space.room("voxel", total)
        merged_key = space.room("merged_key", total)
        merged_pixels = space.room("merged_pixels", total)
        merged_size = space.room("merged_size", total)
        found = np.zeros(PARTITIONS, dtype=np.int64)
        group(at.key, at.count, order, edges, voxel, merged_key, merged_pixels, merged_size, found)
        bounds = np.concatenate([[0], np.cumsum(found)])
        n = int(bounds[-1])
        keys, pixels = space.room("keys", n), space.room("pixels", n)
        out_label = space.room("out_label", total, dtype=np.uint16)
        out_weight = space.room("out_weight", total, dtype=np.float64)
        kept = np.zeros(PARTITIONS, dtype=np.int64)
        sort_labels(at.label, at.count, order, edges, voxel, merged_size, found, out_label, out_weight, kept)
        entry_bounds = np.concatenate([[0], np.cumsum(kept)])
        m = int(entry_bounds[-1])
        start = space.room("start", n + 1)
        labels, weight = space.room("labels", m, dtype=np.uint16), space.room("weight", m, dtype=np.float64)
        compact(
            edges, bounds, entry_bounds, merged_key, merged_pixels, merged_size, out_label, out_weight,
            keys, pixels, start, labels, weight,
        )  # fmt: skip
        return Observed(keys, pixels, start, labels, weight, bounds)

    def index_of(self, key: Int64) -> Int64:
        """Voxel indices (n, 3) of packed keys."""
        assert self.origin is not None
        return index_of_keys(key, self.origin)

    def _origin_at(self, frame: Frame) -> Int64:
        """The camera's voxel, from which the packed keys count."""
        origin = np.floor(frame.T_wc[:3, 3] / self.voxel_size)
        if np.abs(origin).max() > INDEX_LIMIT - 2 * HALF:
            voxel_index(frame.T_wc[:3, 3:], self.voxel_size, frame)
            raise out_of_reach(frame, origin, self.voxel_size)
        return origin.astype(np.int64)


def slots_for(entries: int) -> int:
    """Slots of a hash table that doubles whenever more than half of it is taken, the last time for its last entry."""
    return 1 << max(10, (2 * entries).bit_length())
