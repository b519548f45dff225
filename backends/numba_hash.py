"""Backend `numba`: an open-addressing hash map of voxels, updated in compiled parallel code.

A voxel's record holds the class that it saw first; further classes hang on it as a chain of nodes. So memory follows
the classes that were seen, not K, and a voxel on which all frames agree touches one record. The map is cut into
partitions by a hash of the voxel's key; each is updated by one thread at a time, in the frame's order.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numba as nb
import numpy as np
import numpy.typing as npt

from semstab.backends.aggregator import Aggregator, Observed
from semstab.backends.association import check_frame, check_settings
from semstab.backends.kernels import PARTITIONS, mix, parallel, serial
from semstab.backends.updates import js_term, plogp
from semstab.errors import ConfigError
from semstab.frames import Frame, Intrinsics
from semstab.results import RECURRENT, FrameReport
from semstab.voxels import Events, VoxelTable, index_columns

Int64 = npt.NDArray[np.int64]

SLOT = np.dtype([("key", np.int64), ("row", np.int64)])
FULL = 0.7
"""Largest share of a partition's slots in use."""


def record_types(evidence: Any) -> tuple[np.dtype[Any], np.dtype[Any]]:
    """The types of a voxel's record and of a node of its chain, for evidence of that float type."""
    record = [
        ("key", np.int64), ("pixels", np.int64), ("drift_sum", np.float64), ("self_sum", np.float64),
        ("frame_entropy_sum", np.float64), ("value", evidence), ("next", np.int32), ("op", np.int32),
        ("first_frame", np.int32), ("last_frame", np.int32), ("label", np.uint16),
    ]  # fmt: skip
    node = [("value", evidence), ("next", np.int32), ("label", np.uint16)]
    return np.dtype(record, align=True), np.dtype(node, align=True)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame's observations, kept: as `Observed`, with the number of entries of each voxel."""

    frame: int
    key: Int64
    pixels: Int64
    entries: Int64
    label: npt.NDArray[np.uint16]
    weight: npt.NDArray[np.float64]

    @classmethod
    def of(cls, seen: Observed, frame: int) -> _Seen:
        """A copy of the observations that outlives the next frame."""
        some = seen.weight > 0
        entries = np.add.reduceat(some, seen.start[:-1], dtype=np.int64) if len(seen.key) else seen.key
        return cls(frame, seen.key.copy(), seen.pixels.copy(), entries, seen.label[some], seen.weight[some])


@dataclass(frozen=True, eq=False)
class Changes:
    """What one frame did to each of the n voxels that it saw.

    row            (n,) int64 the voxel's number: voxels are numbered from 0 in the order of their first observation
    key            (n,) int64 its index, packed, relative to the map's origin; overwritten by the next frame
    drift          (n,) float32 D_JS of its belief before and after the frame, bits; NaN where it was not seen before
    before, after  (n,) uint16 its dominant class; where it was not seen before, both are the one after
    """

    row: Int64
    key: Int64
    drift: npt.NDArray[np.float32]
    before: npt.NDArray[np.uint16]
    after: npt.NDArray[np.uint16]

    @classmethod
    def room(cls, row: Int64, key: Int64) -> Changes:
        """To be filled, for the voxels of these rows and keys."""
        n = len(row)
        return cls(row, key, np.empty(n, np.float32), np.empty(n, np.uint16), np.empty(n, np.uint16))


class NumbaReport(FrameReport):
    """The report of a frame, which also knows the map it went into; pickled, it is a report like any other."""

    fused_into: NumbaHash

    def __reduce__(self) -> tuple[Any, ...]:
        return FrameReport, tuple(getattr(self, field.name) for field in fields(FrameReport))


def _joined(parts: list[npt.NDArray[Any]], dtype: Any) -> npt.NDArray[Any]:
    return np.concatenate([np.zeros(0, dtype=dtype), *parts])


class NumbaHash:
    """Incremental fusion in compiled code; the same numbers for any number of threads.

    A map reaches 2^20 voxels to either side of its first camera.

    evidence  'float64', or 'float32' for half the memory of the evidence
    threads   how many to use; all of numba's where not given
    history   keep every observation, for `events`; memory then grows with each
    """

    _loaded: ClassVar[bool] = False

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        evidence: str = "float64",
        threads: int | None = None,
        history: bool = False,
    ) -> None:
        check_settings(voxel_size, num_classes)
        if evidence not in ("float64", "float32"):
            raise ConfigError(f"evidence = '{evidence}': use float64 or float32")
        if threads is not None and not 1 <= threads <= nb.config.NUMBA_NUM_THREADS:
            raise ConfigError(
                f"threads = {threads}: use 1 to {nb.config.NUMBA_NUM_THREADS}, the threads that numba has"
            )
        if not (NumbaHash._loaded or _is_compiled()):
            logging.getLogger("semstab").warning("backend numba: compiling, once (half a minute); the result is cached")
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.threads = threads
        self._pixels = Aggregator(voxel_size, num_classes)
        self._history: list[_Seen] | None = [] if history else None
        record, node = record_types(np.dtype(evidence))
        self._rows = 0
        self._records = np.zeros(1024, dtype=record)
        self._nodes = np.zeros(1024, dtype=node)
        self._nodes_used = 0
        self._slots = np.zeros((PARTITIONS, 64), dtype=SLOT)
        self._slots["row"] = -1
        self._used = np.zeros(PARTITIONS, dtype=np.int64)
        self._ranges = np.zeros((PARTITIONS, 4), dtype=np.int64)  # two free stretches of nodes: start, end, start, end
        self._sums = np.zeros(2)  # of VSS and of entropy in bits, over the map
        self._recurrent = 0
        self.changes = Changes.room(*np.zeros((2, 0), dtype=np.int64))
        """What the last frame did to each voxel."""
        _load_compiled()

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int) -> int:
        """A record, its share of the hash and of the nodes a voxel, and room to grow."""
        return 200 * voxels

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame: pixels to observations, then each partition of the map."""
        threads = nb.get_num_threads()
        nb.set_num_threads(self.threads or threads)
        try:
            started = time.perf_counter()
            if frame.scores is not None:
                check_frame(frame, self.num_classes)
            seen = self._pixels.observe(frame)
            observed = time.perf_counter()
            new, drift = self._add(seen, frame.index)
            if self._history is not None:
                self._history.append(_Seen.of(seen, frame.index))
            finished = time.perf_counter()
        finally:
            nb.set_num_threads(threads)
        mean = self._sums / self._rows if self._rows else np.full(2, np.nan)
        report = NumbaReport(
            frame=frame.index,
            points=int(seen.pixels.sum()),
            voxels=len(seen.key),
            new_voxels=new,
            drift_sum=drift,
            seconds=finished - started,
            map_voxels=self._rows,
            map_vss=float(mean[0]),
            map_entropy=float(mean[1]) / math.log2(self.num_classes),
            map_recurrent=self._recurrent / self._rows if self._rows else math.nan,
            association_seconds=observed - started,
            update_seconds=finished - observed,
        )
        object.__setattr__(report, "fused_into", self)
        return report

    def _add(self, seen: Observed, frame: int) -> tuple[int, float]:
        """Add a frame's observations; return the number of new voxels, and the drift caused, bits."""
        self._make_slots(int((self._used + np.diff(seen.bounds)).max()))
        row, slot = np.empty_like(seen.key), np.empty_like(seen.key)
        new = np.zeros(PARTITIONS, dtype=np.int64)
        _look_up(seen.key, seen.bounds, self._slots, row, slot, new)
        base = self._rows + np.concatenate([[0], np.cumsum(new)])
        _grow(self._records, int(base[-1]))
        self._make_nodes(np.diff(seen.start[seen.bounds]))
        sums = np.zeros((PARTITIONS, 3))
        recurrent = np.zeros(PARTITIONS, dtype=np.int64)
        self.changes = changes = Changes.room(row, seen.key)
        _update(
            seen.key, seen.pixels, seen.start, seen.label, seen.weight, seen.bounds, frame, self.num_classes,
            row, slot, base, self._slots, self._records, self._nodes, self._ranges, sums, recurrent,
            changes.drift, changes.before, changes.after,
        )  # fmt: skip
        self._rows = int(base[-1])
        self._used += new
        self._sums += sums[:, :2].sum(axis=0)
        self._recurrent += int(recurrent.sum())
        return int(new.sum()), float(sums[:, 2].sum())

    def __len__(self) -> int:
        """The number of voxels."""
        return self._rows

    def table(self) -> VoxelTable:
        """The map so far."""
        return self.table_of(np.arange(self._rows))

    def table_of(self, rows: Int64) -> VoxelTable:
        """The voxels of those numbers (n,), distinct ones, as a table; see `Changes.row`."""
        order = rows[np.argsort(self._records["key"][rows], kind="stable")]
        records = self._records[order]
        columns = ("op", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum", "frame_entropy_sum")
        values: dict[str, Any] = {name: records[name] for name in columns}
        return VoxelTable(
            **index_columns(self.index_of(order)),
            **values,
            evidence=self.evidence_of(order),
            voxel_size=self.voxel_size,
        )

    def column(self, name: str, rows: Int64 | slice = np.s_[:]) -> npt.NDArray[Any]:
        """That column of the table (n,), such as op or drift_sum, of the voxels of those numbers in their order."""
        values: npt.NDArray[Any] = self._records[name][: self._rows][rows].copy()  # the array may move as it grows
        return values

    def evidence_of(self, rows: Int64) -> npt.NDArray[np.float64]:
        """Evidence (n, K) of the voxels of those numbers."""
        evidence = np.zeros((len(rows), self.num_classes))
        _unchain(self._records, self._nodes, rows, evidence)
        return evidence

    @property
    def origin(self) -> Int64:
        """(3,) voxel index that packed keys count from: that of the first camera; of an empty map 0."""
        return np.zeros(3, dtype=np.int64) if self._pixels.origin is None else self._pixels.origin

    def index_of(self, rows: Int64) -> Int64:
        """Voxel indices (n, 3) of the voxels of those numbers."""
        return self._pixels.index_of(self._records["key"][rows]) if len(rows) else np.zeros((0, 3), dtype=np.int64)

    def events(self) -> Events | None:
        """Every observation in order of integration within a voxel, where `history` is kept; else None."""
        if self._history is None:
            return None
        seen = self._history
        keys = _joined([frame.key for frame in seen], np.int64)
        distinct, voxel = np.unique(keys, return_inverse=True)  # packed keys sort like (ix, iy, iz)
        by_voxel = np.argsort(voxel, kind="stable")
        pixels = _joined([frame.pixels for frame in seen], np.int64)
        evidence = np.zeros((len(keys), self.num_classes))
        row = np.repeat(np.arange(len(keys)), _joined([frame.entries for frame in seen], np.int64))
        evidence[row, _joined([frame.label for frame in seen], np.uint16)] = (
            _joined([frame.weight for frame in seen], np.float64) / pixels[row]
        )
        index = self._pixels.index_of(distinct) if len(distinct) else np.zeros((0, 3), dtype=np.int64)
        return Events(
            **index_columns(index),
            voxel=voxel[by_voxel],
            frame=np.repeat([frame.frame for frame in seen], [len(frame.key) for frame in seen])[by_voxel],
            evidence=evidence[by_voxel],
            pixels=pixels[by_voxel],
            voxel_size=self.voxel_size,
        )

    def _make_slots(self, needed: int) -> None:
        size = self._slots.shape[1]
        while needed > FULL * size:
            size *= 2
        if size > self._slots.shape[1]:
            slots = np.empty((PARTITIONS, size), dtype=SLOT)
            _rehash(self._slots, slots)
            self._slots = slots

    def _make_nodes(self, entries: Int64) -> None:
        """Give each partition room for a node an entry; what is left of its last stretch is used first."""
        ranges = self._ranges
        spent = ranges[:, 0] == ranges[:, 1]
        ranges[spent, :2] = ranges[spent, 2:]
        ranges[spent, 2:] = 0
        free = (ranges[:, 1] - ranges[:, 0]) + (ranges[:, 3] - ranges[:, 2])
        for p in np.flatnonzero(free < entries):
            size = max(256, 2 * int(entries[p]))
            ranges[p, 2:] = self._nodes_used, self._nodes_used + size
            self._nodes_used += size
        _grow(self._nodes, self._nodes_used)


def _grow(rows: npt.NDArray[Any], needed: int) -> None:
    """Make room for that many rows: by quarters, and in place, since the system moves large arrays without copying."""
    if needed > len(rows):
        rows.resize(max(needed, len(rows) + len(rows) // 4), refcheck=False)


def _load_compiled() -> None:
    """Load what fusing labels needs from numba's cache, or compile it, once a process: no frame waits for it then."""
    if NumbaHash._loaded:
        return
    NumbaHash._loaded = True
    scratch = NumbaHash(voxel_size=1.0, num_classes=2)
    labels = np.arange(64, dtype=np.uint8).reshape(8, 8) % 2
    depth = np.ones((8, 8), dtype=np.float32)
    scratch.integrate(Frame(index=0, depth=depth, labels=labels, intrinsics=Intrinsics(8, 8, 4, 4), T_wc=np.eye(4)))
    scratch._make_slots(64)
    scratch.table()


def _is_compiled() -> bool:
    """Whether an earlier process left compiled code in numba's cache."""
    return any(Path(_update._cache.cache_path).glob("numba_hash._update*.nbi"))


@parallel
def _look_up(key, bounds, slots, row, slot, new):
    """The row of each voxel; new ones enter the hash and are numbered -1, -2, ... within their partition."""
    mask = np.uint64(slots.shape[1] - 1)
    for p in nb.prange(PARTITIONS):
        n = 0
        for v in range(bounds[p], bounds[p + 1]):
            at = np.int64(mix(key[v]) & mask)
            while slots[p, at].row != -1 and slots[p, at].key != key[v]:
                at = (at + 1) & np.int64(mask)
            slot[v] = at
            if slots[p, at].row == -1:
                n += 1
                slots[p, at].key = key[v]
                slots[p, at].row = -1 - n
                row[v] = -n
            else:
                row[v] = slots[p, at].row
        new[p] = n


@parallel
def _rehash(old, new):
    mask = np.uint64(new.shape[1] - 1)
    for p in nb.prange(PARTITIONS):
        for at in range(new.shape[1]):
            new[p, at].row = -1
        for i in range(old.shape[1]):
            if old[p, i].row >= 0:
                at = np.int64(mix(old[p, i].key) & mask)
                while new[p, at].row != -1:
                    at = (at + 1) & np.int64(mask)
                new[p, at].key = old[p, i].key
                new[p, at].row = old[p, i].row


@serial
def _observe_voxel(record, nodes, ranges, s, label, weight, first, last, pixels, op, out):
    """Add one observation to a voxel that disagrees with itself, or with the frame.

    s is work space (K,), all 0. Leaves in `out` the change of VSS, that of the entropy in bits, the drift in bits, and
    the dominant class before and after.
    """
    for e in range(first, last):
        s[label[e]] = weight[e] / pixels
    before, after = 1.0 / max(op, 1), 1.0 / (op + 1)
    top_before = top_after = plogp_before = plogp_after = drift = 0.0
    most_before = most_after = -1.0
    dominant_before = dominant_after = np.int64(0)
    at = np.int64(-2)  # the record itself
    while True:
        lab = np.int64(record.label if at == -2 else nodes[at].label)
        value = np.float64(record.value) if at == -2 else np.float64(nodes[at].value)
        if value > most_before or (value == most_before and lab < dominant_before):
            most_before, dominant_before = value, lab
        p = value * before
        value += s[lab]
        s[lab] = 0.0
        if value > most_after or (value == most_after and lab < dominant_after):
            most_after, dominant_after = value, lab
        q = value * after
        if at == -2:
            record.value = value
            following = np.int64(record.next)
        else:
            nodes[at].value = value
            following = np.int64(nodes[at].next)
        top_before, top_after = max(top_before, p), max(top_after, q)
        plogp_before += plogp(p)
        plogp_after += plogp(q)
        drift += js_term(p, q)
        if following < 0:
            break
        at = following
    for e in range(first, last):
        share = s[label[e]]
        if share > 0.0:
            s[label[e]] = 0.0
            if ranges[0] == ranges[1]:
                ranges[0], ranges[1] = ranges[2], ranges[3]
                ranges[2] = ranges[3]
            node = ranges[0]
            ranges[0] += 1
            nodes[node].label = label[e]
            nodes[node].value = share
            nodes[node].next = -1
            if at == -2:
                record.next = node
            else:
                nodes[at].next = node
            at = node
            lab = np.int64(label[e])
            if share > most_after or (share == most_after and lab < dominant_after):
                most_after, dominant_after = share, lab
            q = share * after
            top_after = max(top_after, q)
            plogp_after += plogp(q)
            drift += js_term(0.0, q)
    out[0] = top_after - top_before
    out[1] = plogp_before - plogp_after
    out[2] = min(max(drift, 0.0), 1.0) if op > 0 else 0.0
    out[3], out[4] = dominant_before, dominant_after


@parallel
def _update(
    key, pixels, start, label, weight, bounds, frame, K, row, slot, base, slots, records, nodes, ranges, sums,
    recurrent, drift_of, dominant_before, dominant_after,
):  # fmt: skip
    """Add the frame's observations; sums (PARTITIONS, 3) takes the changes of VSS and entropy, and the drift.

    row, the last three: see `Changes`.
    """
    for p in nb.prange(PARTITIONS):
        s = np.zeros(K)
        out = np.zeros(5)
        own = ranges[p]
        vss = entropy = drift = 0.0
        reached = 0
        for v in range(bounds[p], bounds[p + 1]):
            first, last = start[v], start[v + 1]
            r = row[v]
            if r < 0:
                r = base[p] - r - 1
                row[v] = r
                slots[p, slot[v]].row = r
                new = records[r]
                new.key = key[v]
                new.pixels = 0
                new.drift_sum = 0.0
                new.self_sum = 0.0
                new.frame_entropy_sum = 0.0
                new.value = 0.0
                new.next = -1
                new.op = 0
                new.first_frame = frame
                new.last_frame = frame
                new.label = label[first]
            record = records[r]
            op = record.op
            if last - first == 1 and record.next < 0 and record.label == label[first]:
                record.value += 1.0
                record.self_sum += 1.0
                vss += 1.0 if op == 0 else 0.0
                drift_of[v] = 0.0
                dominant_before[v] = dominant_after[v] = record.label
            else:
                _observe_voxel(record, nodes, own, s, label, weight, first, last, pixels[v], op, out)
                vss += out[0]
                entropy += out[1]
                drift += out[2]
                record.drift_sum += out[2]
                drift_of[v] = out[2]
                dominant_before[v], dominant_after[v] = np.uint16(out[3]), np.uint16(out[4])
                for e in range(first, last):
                    share = weight[e] / pixels[v]
                    record.self_sum += share * share
                    record.frame_entropy_sum -= plogp(share)
            if op == 0:
                drift_of[v] = np.nan
                dominant_before[v] = dominant_after[v]
            record.op = op + 1
            record.pixels += pixels[v]
            record.first_frame = min(record.first_frame, frame)
            record.last_frame = max(record.last_frame, frame)
            reached += 1 if op + 1 == RECURRENT else 0
        sums[p, 0], sums[p, 1], sums[p, 2] = vss, entropy, drift
        recurrent[p] = reached


@parallel
def _unchain(records, nodes, order, evidence):
    """Evidence (n, K) of the records in that order."""
    for i in nb.prange(order.shape[0]):
        record = records[order[i]]
        evidence[i, record.label] = record.value
        at = np.int64(record.next)
        while at >= 0:
            evidence[i, nodes[at].label] = nodes[at].value
            at = np.int64(nodes[at].next)
