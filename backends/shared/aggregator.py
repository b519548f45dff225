"""Observations, one a voxel, from the pixels or points of a frame: labels and scores by tiles of the image."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from semstab.backends.shared import merge_loops, score_loops, tile_loops
from semstab.backends.shared.association import INDEX_LIMIT, back_project, check_frame, voxel_index
from semstab.backends.shared.keys import HALF, PARTITIONS, index_of_keys, out_of_reach, partitions_of
from semstab.backends.shared.observations import Observed, ObservedScores, WorkSpace
from semstab.backends.shared.pixel_keys import columns_of
from semstab.backends.shared.score_loops import LANES
from semstab.backends.shared.tile_loops import NEAR
from semstab.core.types import Float32, Float64, Int32, Int64, UInt8
from semstab.data.frames import Frame
from semstab.data.labels import fixed, flat
from semstab.data.voxels import Extent

FIRST_VOXELS = 1 << 12
"""Voxels that a band of scores has room for at first."""

SAMPLE = 1 << 10
"""Voxels, about, that tell whether a frame's voxels have evidence of most classes."""


class Words(NamedTuple):
    """The entries of bands of a frame, see `tile_loops.find_words`; each band has `room` for them."""

    word: Int64
    count: Int32
    partition: UInt8
    entries: Int64
    spread: Int64
    low: Int64
    high: Int64


class Aggregator:
    """A step from frames to observations, of the voxels of an extent where one is given; it reuses its work space."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        stated_origin = None if within is None else within.origin
        self.origin: Int64 | None = None if stated_origin is None else np.array(stated_origin, dtype=np.int64)
        self._voxels = FIRST_VOXELS
        self._space = WorkSpace()

    def observe(self, frame: Frame) -> Observed | ObservedScores:
        """Return the frame's observations; the first frame's camera sets the origin.

        Raises:
            DataError: For a label outside the classes, or a voxel out of reach of the packed keys.
        """
        origin = self._origin_at(frame) if self.origin is None else self.origin
        observations: Observed | ObservedScores | None
        if frame.labels is not None:
            observations = self._labels(frame, origin) or self._far_labels(frame, origin)
        else:
            observations = self._scores(frame, origin)
            if observations is None:  # a pixel out of reach: does it have a prediction?
                depth = np.where(frame.valid, frame.depth, np.float32(0))
                observations = self._scores(dataclasses.replace(frame, depth=depth), origin)
            if observations is None:
                raise out_of_reach(frame, origin, self.voxel_size)
        self.origin = origin
        return observations

    def index_of(self, key: Int64) -> Int64:
        """Return voxel indices (n, 3) of packed keys."""
        assert self.origin is not None
        return index_of_keys(key, self.origin)

    def _origin_at(self, frame: Frame) -> Int64:
        """Return the camera's voxel, from which the packed keys count."""
        origin = np.floor(frame.T_wc[:3, 3] / self.voxel_size)
        if np.abs(origin).max() > INDEX_LIMIT - 2 * HALF:
            voxel_index(frame.T_wc[:3, 3:], self.voxel_size, frame)
            raise out_of_reach(frame, origin, self.voxel_size)
        return origin.astype(np.int64)

    # --- Labels -------------------------------------------------------------------------------------------------------

    def _labels(self, frame: Frame, origin: Int64) -> Observed | None:
        """Return the observations of labels, or None if the frame reaches too far or a label is not a class."""
        assert frame.labels is not None
        corner = tile_loops.corner_of(fixed(frame.T_wc), self.voxel_size, origin)
        if min(corner.tolist()) < 0 or max(corner.tolist()) > 2 * (HALF - NEAR):
            return None
        find = self._words_of_points if frame.is_scan else self._words
        total, room, words = find(frame, origin, corner)
        return self._merged_labels(total, room, words, corner) if total >= 0 else None

    def _words(self, frame: Frame, origin: Int64, corner: Int64) -> tuple[int, int, Words]:
        """Find the entries of an image, by bands of rows; see `find_words` for their number."""
        assert frame.labels is not None
        H, W = frame.shape
        room, work, words = self._room_for_words(-(-H // tile_loops.ROWS), tile_loops.ROWS, W)
        total = tile_loops.find_words(
            fixed(frame.depth), fixed(frame.labels), *frame.rays, fixed(frame.T_wc), self.voxel_size, origin, corner,
            columns_of(self.within, origin), frame.ignore_id, self.num_classes, room,
            self._space.room("rays", 3, W, dtype=np.float64), *work, *words,
        )  # fmt: skip
        return total, room, words

    def _words_of_points(self, frame: Frame, origin: Int64, corner: Int64) -> tuple[int, int, Words]:
        """Find the entries of a scan, by bands of points, as `_words` does those of an image."""
        assert frame.labels is not None
        assert frame.points is not None
        points = fixed(frame.points).reshape(-1, 3)
        room, work, words = self._room_for_words(-(-len(points) // tile_loops.POINTS), 1, tile_loops.POINTS)
        total = tile_loops.find_words_of_points(
            points, flat(frame.depth), flat(frame.labels), fixed(frame.T_wc), self.voxel_size, origin, corner,
            columns_of(self.within, origin), fixed(frame.T_wc[:3, :3] / self.voxel_size), frame.ignore_id,
            self.num_classes, room, *work, *words,
        )  # fmt: skip
        return total, room, words

    def _room_for_words(self, bands: int, rows: int, width: int) -> tuple[int, tuple[Any, Any, Any], Words]:
        """Return the room of a band of `rows` rows, work space for the threads, and the room of all bands."""
        space, threads = self._space, nb.get_num_threads()
        columns, table = tile_loops.COLUMNS, 1 << tile_loops.TABLE_BITS
        tables = space.room("table", threads, table)
        tables[:] = -1
        room = rows * width + (columns + 1) * rows + 2 * table  # memory that is not written to is not taken
        stretches = space.room("stretches", threads, 4, columns + 2 * tile_loops.LANES)
        words = Words(
            space.room("word", bands * room, gaps=True),
            space.room("count", bands * room, dtype=np.int32, gaps=True),
            space.room("partition", bands * room, dtype=np.uint8, gaps=True),
            entries=space.room("entries", bands),
            spread=space.room("spread", bands, PARTITIONS),
            low=space.room("low", bands, 4),
            high=space.room("high", bands, 4),
        )
        return room, (stretches, tables, space.room("table_count", threads, table, dtype=np.int32)), words

    def _merged_labels(self, total: int, room: int, words: Words, corner: Int64) -> Observed:
        """Sort the `total` entries of all bands by partition and word, and add up equal entries."""
        space = self._space
        pairs = [(space.room(f"words {i}", total), space.room(f"counts {i}", total, dtype=np.int32)) for i in (0, 1)]
        word, count, partition, *bands = words
        merged = merge_loops.merge_words(word, count, partition, room, *bands, *pairs[0], *pairs[1])
        _, _, bounds, entry_bounds, _, _ = merged
        n, m = int(bounds[-1]), int(entry_bounds[-1])
        observations = Observed(
            key=space.room("key", n),
            pixels=space.room("pixels", n),
            start=space.room("start", n + 1),
            label=space.room("label", m, dtype=np.uint16),
            weight=space.room("weight", m, dtype=np.float64),
            bounds=bounds,
        )
        merge_loops.emit_voxels(
            *pairs[0], *pairs[1], *merged, corner,
            observations.key, observations.pixels, observations.start, observations.label, observations.weight,
        )  # fmt: skip
        return observations

    def _far_labels(self, frame: Frame, origin: Int64) -> Observed:
        """Return the observations of a frame beyond the reach of words, associated as the reference does it."""
        assert frame.labels is not None
        valid = frame.valid
        index = voxel_index(back_project(frame, valid), self.voxel_size, frame) - origin[:, None] + HALF
        near = ((index >= 0) & (index < 2 * HALF)).all(axis=0)
        x, y, z = index[:, near]
        key, label = (x << 42) | (y << 21) | z, frame.labels[valid][near].astype(np.int64)
        if self.within is not None:
            inside = self.within.holds(index_of_keys(key, origin).T)
            key, label = key[inside], label[inside]
        if label.max(initial=0) >= self.num_classes:
            check_frame(frame, self.num_classes)
        if not near.all():
            raise out_of_reach(frame, origin, self.voxel_size)
        keys, voxel, pixels = np.unique(key, return_inverse=True, return_counts=True)
        partition = partitions_of(keys)
        order = np.argsort(partition, kind="stable")
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        entries, weight = np.unique(rank[voxel] * self.num_classes + label, return_counts=True)
        return Observed(
            key=keys[order],
            pixels=pixels[order],
            start=np.searchsorted(entries, np.arange(len(order) + 1) * self.num_classes),
            label=(entries % self.num_classes).astype(np.uint16),
            weight=weight.astype(np.float64),
            bounds=np.searchsorted(partition[order], np.arange(PARTITIONS + 1)),
        )

    # --- Scores -------------------------------------------------------------------------------------------------------

    def _scores(self, frame: Frame, origin: Int64) -> Observed | ObservedScores | None:
        """Return the observations of scores, or None if a pixel with depth is out of reach.

        The observations are dense rows if the voxels have evidence for most of the classes, else entries.

        Voxels outside the extent are left out at the end: all voxels of the frame decide how sums are rounded.
        """
        space, K = self._space, self.num_classes
        rows, columns, table = score_loops.ROWS, score_loops.COLUMNS, 1 << score_loops.TABLE_BITS
        depth, points, (ray_x, ray_y) = _by_rows(frame, columns)
        H, W = depth.shape
        bands, threads = -(-H // rows), nb.get_num_threads()
        stride = -(-K // LANES) * LANES
        scores = _flat(frame.scores)
        behind = (columns + LANES) * K
        ending = fixed(np.concatenate([scores[-behind:], np.zeros(behind, dtype=scores.dtype)]))
        while True:
            room = min(self._voxels, rows * W)
            key, count = space.room("band key", bands * room), space.room("count", bands * room, dtype=np.int32)
            sums = space.room("sums", bands * room * stride, dtype=np.float64)
            entries, lost = np.zeros(bands, dtype=np.int64), np.zeros(bands, dtype=np.int64)
            spread = np.zeros((bands, PARTITIONS), dtype=np.int64)
            score_loops.sum_scores(
                depth, points, np.zeros(W, dtype=np.uint8), scores, ending, K, ray_x, ray_y,
                fixed(frame.T_wc), self.voxel_size, origin, room,
                space.room("keys", threads, rows, W), space.room("table", threads, table),
                space.room("table_row", threads, table, dtype=np.int32),
                space.room("score stretches", threads, 3, columns + 2 * LANES),
                space.room("scale", threads, columns + LANES, dtype=np.float64), key, count, sums, entries, lost,
                spread,
            )  # fmt: skip
            if lost.any():
                return None
            if entries.min() >= 0:
                break
            self._voxels *= 4
        observations = self._merged_scores(key, count, sums, room, entries, spread)
        sample = observations.rows(slice(None, None, max(1, len(observations.key) // SAMPLE)))
        dense = 2 * np.count_nonzero(sample) >= sample.size
        if self.within is not None:
            observations = observations.only(self.within.holds(index_of_keys(observations.key, origin).T))
        return observations if dense else observations.sparse()

    def _merged_scores(
        self, key: Int64, count: Int32, sums: Float64, room: int, entries: Int64, spread: Int64
    ) -> ObservedScores:
        """Add up the entries of each voxel, band after band."""
        space, total, K = self._space, int(entries.sum()), self.num_classes
        offset, edges = merge_loops.offsets_of(spread)
        merged = [space.room(f"merged {name}", total) for name in ("key", "pixels", "row")]
        score_loops.scatter_rows(key, count, room, -(-K // LANES) * LANES, entries, offset, *merged)
        voxels = np.zeros(PARTITIONS, dtype=np.int64)
        score_loops.merge_rows(
            edges, *merged, space.room("again", total), space.room("first", total), sums, K, voxels
        )  # fmt: skip
        bounds, ends = np.concatenate([[0], np.cumsum(voxels)]), edges[:-1] + voxels
        keys, pixels, row = (space.room(name, int(bounds[-1])) for name in ("key", "pixels", "row"))
        for joined, gaps in zip((keys, pixels, row), merged, strict=True):
            np.concatenate([gaps[low:high] for low, high in zip(edges, ends, strict=False)], out=joined)
        return ObservedScores(keys, pixels, row, sums, bounds, K)


def _by_rows(frame: Frame, columns: int) -> tuple[Float32, Float32, tuple[Float64, Float64]]:
    """Return depth (H, W), points (H, W, 3) and the rays of an image, which has no points.

    The points of a scan come as rows of equal length; points without depth fill up the last row.
    """
    if frame.points is None:
        return fixed(frame.depth), fixed(np.zeros((0, 0, 3), np.float32)), frame.rays
    H = -(-frame.depth.size // columns)
    depth, points = np.zeros(H * columns, np.float32), np.zeros((H * columns, 3), np.float32)
    depth[: frame.depth.size] = frame.depth.reshape(-1)
    points[: frame.depth.size] = frame.points.reshape(-1, 3)
    rows = fixed(depth.reshape(H, columns)), fixed(points.reshape(H, columns, 3))
    return *rows, (np.zeros(columns), np.zeros(H))


def _flat(scores: Any) -> Any:
    """Return scores one after the other, half-precision ones as their bits.

    Types that compiled code does not know become float64.
    """
    kind = scores.dtype if scores.dtype in (np.float16, np.float32) else np.float64
    values = fixed(scores.astype(kind, copy=False)).reshape(-1)
    return values.view(np.uint16) if kind == np.float16 else values
