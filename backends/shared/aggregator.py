"""From the pixels of a frame to its observations, one a voxel, in compiled parallel code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numba as nb
import numpy as np

from semstab.backends.shared.association import INDEX_LIMIT, check_frame, voxel_index
from semstab.backends.shared.entries import compact, find_entries, group, scatter, sort_labels
from semstab.backends.shared.keys import HALF, PARTITIONS, index_of_keys, out_of_reach
from semstab.backends.shared.observations import Observed, ObservedScores, WorkSpace
from semstab.backends.shared.pixel_keys import columns_of, frame_terms
from semstab.backends.shared.score_loops import Scores
from semstab.backends.shared.tile_loops import (
    COLUMNS,
    LANES,
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
from semstab.core.types import Int32, Int64, UInt8, UInt16
from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.model.voxels import Extent

# From the labels of a frame to its observations, by tiles of the image.

FIRST_TILE_ROOM = 1 << 15
"""Entries that a band has room for at first: more than a quarter of its pixels in an image of 3840x2160."""

TABLE = 1 << TABLE_BITS


@dataclass(frozen=True, eq=False)
class _FoundTiles:
    """The entries of each band: words with counts, some of them twice; a band has `room` for them.

    word, count, partition  (bands * room,)
    entries                 (bands,) how many there are
    spread                  (bands, PARTITIONS) of them by partition
    """

    word: Int64
    count: Int32
    partition: UInt8
    room: int
    entries: Int64
    spread: Int64


class Tiles:
    """Observes labels; keeps its work space from frame to frame."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        self._band_room = FIRST_TILE_ROOM
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
        found = _FoundTiles(word, count, partition, room, entries, spread)
        return self._merged(found, low[:, :3].min(axis=0), high.max(axis=0), corner)

    def _merged(self, found: _FoundTiles, low: Int64, high: Int64, corner: Int64) -> Observed:
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


BANDS = 64
MIN_BAND_ROWS = 8
FIRST_ROOM = 1 << 13
"""Entries that a band has room for at first: a sixteenth of its pixels in an image of 3840x2160."""


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
    label: UInt16
    count: Int32
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
