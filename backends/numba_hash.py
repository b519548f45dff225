"""Backend `numba`: an open-addressing hash map of voxels, updated in compiled parallel code.

A voxel's record holds the class that it saw first; further classes hang on it as a chain of nodes. So memory follows
the classes that were seen, not K, and a voxel on which all frames agree touches one record. Soft scores that have most
classes give it a dense row of all K. The map is cut into partitions by a hash of the voxel's key; each is updated by
one thread at a time, in the frame's order.
"""

from __future__ import annotations

import logging
import time
from functools import cache
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from semstab.backends.numba_loops import (
    DENSE,
    SLOT,
    count_chain,
    enter,
    look_up,
    make_nodes,
    most_slots,
    place_observations,
    read_chain,
    read_records,
    record_types,
    rehash,
    update,
    update_dense,
)
from semstab.backends.shared.aggregator import Aggregator
from semstab.backends.shared.association import check_depth, check_frame, check_settings
from semstab.backends.shared.keys import PARTITIONS, columns_of_keys, index_of_keys
from semstab.backends.shared.observations import BeliefChange, Change, MapTotal, Observed, ObservedScores
from semstab.backends.shared.score_loops import LANES
from semstab.core.compiled import is_cached, settings
from semstab.core.types import Float64, Int32, Int64, UInt16
from semstab.data.events import Events
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame
from semstab.data.results import Changes, FrameReport
from semstab.data.voxels import Extent, VoxelTable
from semstab.errors import ConfigError

# The log of observations that the numba backend stores on request.


class History:
    """Every observation of a map, frame after frame."""

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self._seen: list[tuple[int, Int32, Int32, UInt16, UInt16, Float64]] = []
        """The index, rows of the map, pixels, and entries as in `Observed`, without empty ones, of each frame."""

    def append(self, observed: Observed, row: Int64, frame: int) -> None:
        """Store a copy of the observations of the map's rows that outlives the next frame."""
        filled, n = observed.weight > 0, len(observed.key)
        entries = np.add.reduceat(filled, observed.start[:-1], dtype=np.uint16) if n else np.zeros(0, np.uint16)
        rows, pixels = row.astype(np.int32), observed.pixels.astype(np.int32)
        self._seen.append((frame, rows, pixels, entries, observed.label[filled], observed.weight[filled]))

    def events(self, order: Int32, index: dict[str, Any]) -> Events:
        """Return the observations in order of integration within a voxel; voxels are the map's rows in that order."""
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        observations, entries = np.zeros(len(order) + 1, np.int64), np.zeros(len(order) + 1, np.int64)
        for _, row, _, number, *_ in self._seen:
            voxel = rank[row] + 1  # a voxel is in a frame once
            observations[voxel] += 1
            entries[voxel] += number
        slot, entry = np.cumsum(observations), np.cumsum(entries)  # where each voxel's next observation goes
        voxels = np.repeat(np.arange(len(order), dtype=np.int32), observations[1:])
        frame, pixels = (np.empty(len(voxels), np.int32) for _ in range(2))
        starts = np.empty(len(voxels) + 1, np.int64)
        starts[-1] = entry[-1]
        label, weight = np.empty(entry[-1], np.uint16), np.empty(entry[-1])
        for stored in self._seen:
            place_observations(rank, *stored, slot, entry, frame, pixels, starts, label, weight)
        evidence = Evidence(starts, label, weight, self.num_classes)
        return Events(**index, voxel=voxels, frame=frame, evidence=evidence, pixels=pixels, voxel_size=self.voxel_size)


COLUMNS = ("key", "op", "pixels", "first_frame", "last_frame", "drift_sum", "self_sum", "frame_entropy_sum")
"""The columns of a record that a table has, and the key that its index follows from."""

LARGE = 1_000_000
"""Voxels of a map from which on memory counts more than the time of building its hash again: a growing map is drawn
several times."""

FULL = 0.7
"""Largest share of a partition's slots in use."""

FIRST_SLOTS = 64
"""Slots of a new partition's hash."""


class NumbaHash:
    """Incremental fusion in compiled code; the same numbers for any number of threads.

    A map reaches 2^20 voxels to either side of its first camera.

    Attributes:
        evidence: 'float64', or 'float32' for half the memory of the evidence.
        threads: Number of threads; all of numba's threads by default.
        history: Store every observation, for `events`; memory then grows with each.
        within: The voxels that the map is restricted to.
    """

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        evidence: str = "float64",
        threads: int | None = None,
        history: bool = False,
        within: Extent | None = None,
    ) -> None:
        self.check_options(voxel_size, num_classes, evidence, threads)
        _announce_compiling()
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.threads = threads
        self._pixels = Aggregator(voxel_size, num_classes, within)
        self._history = History(voxel_size, num_classes) if history else None
        record, node = record_types(np.dtype(evidence))
        self._total = MapTotal(num_classes)
        self._records = np.zeros(1024, dtype=record)
        self._nodes = np.zeros(1024, dtype=node)
        self._nodes_used = 0
        self._dense = np.zeros((1, -(-num_classes // LANES) * LANES), dtype=evidence)
        self._dense_used = 0
        self._slots = np.empty((PARTITIONS, 0), dtype=SLOT)
        self._used = np.zeros(PARTITIONS, dtype=np.int64)
        self._ranges = np.zeros((PARTITIONS, 4), dtype=np.int64)  # two free stretches of nodes: start, end, start, end
        self._last: tuple[Int64, BeliefChange] | None = None
        """Packed keys of the last frame's voxels, which the next frame overwrites, and their changes."""

    @staticmethod
    def check_options(
        voxel_size: float,
        num_classes: int,
        evidence: str = "float64",
        threads: int | None = None,
    ) -> None:
        """Raise ConfigError for settings that no map can have."""
        check_settings(voxel_size, num_classes)
        if evidence not in ("float64", "float32"):
            raise ConfigError(f"evidence = '{evidence}': use float64 or float32")
        if threads is not None and not 1 <= threads <= settings.NUMBA_NUM_THREADS:
            raise ConfigError(f"threads = {threads}: use 1 to {settings.NUMBA_NUM_THREADS}, the threads that numba has")

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int, soft: bool = False) -> int:
        """Return a record, its share of the nodes or a dense row of scores, and room to grow; the hash."""
        return (102 + (9 * num_classes if soft else 0)) * voxels

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame: pixels to observations, then each partition of the map."""
        if self.threads is None:
            return self._fuse(frame)
        threads = nb.get_num_threads()
        nb.set_num_threads(self.threads)
        try:
            return self._fuse(frame)
        finally:
            nb.set_num_threads(threads)

    def _fuse(self, frame: Frame) -> FrameReport:
        """Fuse one frame in the threads that numba may use now."""
        started = time.perf_counter()
        check_depth(frame)
        if frame.scores is not None:
            check_frame(frame, self.num_classes)
        observations = self._pixels.observe(frame)
        observed = time.perf_counter()
        change, row = self._add(observations, frame.index)
        if self._history is not None:
            entries = observations.sparse() if isinstance(observations, ObservedScores) else observations
            self._history.append(entries, row, frame.index)
        return self._total.add(frame.index, change, started, observed)

    def _add(self, observations: Observed | ObservedScores, frame: int) -> tuple[Change, Int64]:
        """Add a frame's observations; return the change and the rows of its voxels."""
        n, voxels = len(observations.key), len(self)
        self._make_slots(most_slots(self._used, observations.bounds))
        row, slot = np.empty(n, np.int64), np.empty(n, np.int64)
        base = look_up(observations.key, observations.bounds, self._slots, self._used, row, slot)
        new = int(base[-1])
        _grow(self._records, voxels + new)
        sums = np.zeros((PARTITIONS, 4))
        changed = BeliefChange.room(n)
        self._last = observations.key, changed
        report = sums, *changed
        if isinstance(observations, ObservedScores):
            dense_base = self._make_dense(observations, row, base)
            update_dense(
                observations.key, observations.pixels, observations.row, observations.sums, observations.bounds,
                frame, row, slot, voxels, base, dense_base, self._slots, self._records, self._nodes, self._dense,
                *report,
            )  # fmt: skip
        else:
            self._nodes_used = make_nodes(self._ranges, observations.bounds, observations.start, self._nodes_used)
            _grow(self._nodes, self._nodes_used)
            update(
                observations.key, observations.pixels, observations.start, observations.label, observations.weight,
                observations.bounds, frame, row, slot, voxels, base,
                self._slots, self._records, self._nodes, self._dense, self._ranges, *report,
            )  # fmt: skip
        vss, entropy, _, recurrent = sums.sum(axis=0)
        drift = sums[:, 2].sum()
        return Change.from_sums((observations.pixels.sum(), n, new, drift, vss, entropy, recurrent)), row

    def changes(self) -> Changes | None:
        """Return the changes by the last frame."""
        if self._last is None:
            return None
        key, changed = self._last
        return Changes(index_of_keys(key, self.origin), *changed)

    def __len__(self) -> int:
        """Return the number of voxels."""
        return self._total.voxels

    def table(self) -> VoxelTable:
        """Return the map so far.

        The hash and the spare room of the records of a large map are freed first, to make room for the table. A further
        frame allocates both again.
        """
        if len(self) >= LARGE:
            self._slots = np.empty((PARTITIONS, 0), dtype=SLOT)
            self._records.resize(len(self), refcheck=False)
        order = self._order()
        values: dict[str, Any] = {name: np.empty(len(order), self._records.dtype[name]) for name in COLUMNS}
        read_records(self._records, order, *values.values())
        index = columns_of_keys(values.pop("key"), self.origin)
        evidence = self._evidence_of(order)
        return VoxelTable(**index, **values, evidence=evidence, voxel_size=self.voxel_size)

    def _evidence_of(self, rows: Int32) -> Evidence:
        starts = np.zeros(len(rows) + 1, dtype=np.int64)
        count_chain(self._records, self._nodes, self._dense, rows, starts)
        np.cumsum(starts, out=starts)
        label, weight = np.empty(starts[-1], dtype=np.uint16), np.empty(starts[-1])
        read_chain(self._records, self._nodes, self._dense, rows, starts, label, weight)
        return Evidence(starts, label, weight, self.num_classes)

    def _order(self) -> Int32:
        """Return the voxels' rows in the order of the table; packed keys sort like (ix, iy, iz)."""
        return np.argsort(self._records["key"][: len(self)], kind="stable").astype(np.int32)

    @property
    def origin(self) -> Int64:
        """(3,) voxel index that packed keys count from: the voxel of the first camera, or 0 for an empty map."""
        return np.zeros(3, dtype=np.int64) if self._pixels.origin is None else self._pixels.origin

    def events(self) -> Events | None:
        """Return every observation, in order of integration within a voxel, or None without a `history`."""
        if self._history is None:
            return None
        order = self._order()
        return self._history.events(order, columns_of_keys(self._records["key"][order], self.origin))

    def _make_slots(self, needed: int) -> None:
        """Make room in the hash for `needed` voxels of a partition; without a hash, build it from the records."""
        now = self._slots.shape[1]
        size = max(now, FIRST_SLOTS)
        while needed > FULL * size:
            size *= 2
        if size > now:
            slots = np.empty((PARTITIONS, size), dtype=SLOT)
            slots["row"] = -1
            if now > 0:
                rehash(self._slots, slots)
            else:
                enter(self._records[: len(self)], slots)
            self._slots = slots

    def _make_dense(self, observations: ObservedScores, row: Int64, base: Int64) -> Int64:
        """Return the room for a dense row for each of the frame's voxels; where those of each partition begin."""
        if self._dense_used < len(self):  # else only the frame's new voxels have none
            without = (row < 0) | (self._records["next"][np.maximum(row, 0)] > DENSE)
            base = np.concatenate([[0], np.cumsum(without)])[observations.bounds]
        base = self._dense_used + base
        self._dense_used = int(base[-1])
        used, stride = self._dense_used, self._dense.shape[1]
        if used > len(self._dense):
            self._dense.resize((max(used, len(self._dense) + len(self._dense) // 4), stride), refcheck=False)
        return base


def _grow(rows: npt.NDArray[Any], needed: int) -> None:
    """Make room for that many rows: by quarters, and in place, since the system moves large arrays without copying."""
    if needed > len(rows):
        rows.resize(max(needed, len(rows) + len(rows) // 4), refcheck=False)


@cache
def _announce_compiling() -> None:
    """Say, once a process, that the first frame compiles: where numba has not cached the code."""
    if not is_cached(update):
        outcome = "the result is cached" if update.stats.cache_path else "no folder can be written to cache the result"
        logging.getLogger("semstab").warning("backend numba: compiling, once (half a minute); %s", outcome)
