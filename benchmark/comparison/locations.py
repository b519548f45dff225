"""Which places got worse: neighbouring voxels whose frames agree less, or that are wrong now; and which frames did it.

Chance makes places worse and better alike where nothing changed. So beside each place stands how many others improved
by as much: its rivals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.comparison.pairing import Common, in_share, joint_class
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.metrics.agreement import shared_rows, voxel_keys
from semstab.model.contrast import Blame, Place
from semstab.model.events import Events
from semstab.model.measures import dominant
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import disagreement
from semstab.statistics.correctness import join_truth

WORSE = 0.2
"""A voxel got worse where so much of its agreement is lost: of ten looks, one turned to another class."""

LEAST = 4
"""Neighbouring voxels that make a place."""

MOST = 20
"""Places that are told of, the largest loss first."""

SHARE, MOST_FRAMES = 0.9, 8
"""The frames that account for this share of a place's loss are blamed, so many at most."""


@dataclass(frozen=True, eq=False)
class Changed:
    """Voxel by voxel, of those that both maps saw twice or more.

    table   (n,) the base's voxels
    change  (n,) agreement between frames, the run's less the base's
    label   (n,) the class that both maps together give
    true    (n,) the true class, -1 where it is not known; None without ground truth
    right   (n,) -1 where it was right and is wrong now, 1 the other way round, else 0; None without ground truth
    """

    table: VoxelTable
    change: Float64
    label: Int64
    true: Int64 | None
    right: Int64 | None

    @classmethod
    def of(cls, base: VoxelTable, other: VoxelTable, truth: VoxelTable | None) -> Changed:
        """Of two maps, or of what both have in one place."""
        rows = shared_rows(base, other)
        again = (base.op[rows[0]] >= 2) & (other.op[rows[1]] >= 2)
        base, other = (table.rows(own[again]) for table, own in zip((base, other), rows, strict=True))
        between = [disagreement(table)[1] for table in (base, other)]
        true = right = None
        if truth is not None:
            true = join_truth(base, truth).label
            gained = (dominant(other) == true).astype(int) - (dominant(base) == true)
            right = np.where(true >= 0, gained, 0).astype(np.int64)
        return cls(base, between[0] - between[1], joint_class((base, other)), true, right)

    @property
    def matters(self) -> Mask:
        """(n,) which may be part of a place, or of its rivals."""
        much: Mask = np.abs(self.change) >= WORSE
        return much if self.right is None else much | (self.right != 0)

    def rows(self, where: Mask) -> Changed:
        """Some of them (n,)."""
        true, right = (None if own is None else own[where] for own in (self.true, self.right))
        return Changed(self.table.rows(where), self.change[where], self.label[where], true, right)

    @classmethod
    def joined(cls, parts: Sequence[Changed]) -> Changed:
        """Of several places."""
        order = np.lexsort(np.concatenate([part.table.index for part in parts]).T[::-1])

        def column(name: str) -> Any:
            own = [getattr(part, name) for part in parts]
            return None if own[0] is None else np.concatenate(own)[order]

        table = VoxelTable.joined([part.table for part in parts])
        return cls(table, *(column(name) for name in ("change", "label", "true", "right")))


@dataclass(frozen=True, eq=False)
class Changes:
    """What changed between two maps; of a large one `shown` are those that matter, and some of the others.

    compared, worse, better  how many voxels both saw twice or more, and how many changed by WORSE
    place, wrong_place       (m,) number of the place that got worse, or is wrong now, of each of `shown`; 0 in none
    parts                    all voxels with their changes, by name as a file has them, some after the others
    """

    shown: Changed
    compared: int
    worse: int
    better: int
    place: Int64
    wrong_place: Int64 | None
    parts: Callable[[], Iterator[dict[str, npt.NDArray[Any]]]]


@dataclass(frozen=True, eq=False)
class Worse:
    """The places that got worse, the frames to blame for all of them, and what changed in each voxel."""

    places: tuple[Place, ...]
    blamed: tuple[Blame, ...]
    changes: Changes


def worse_places(common: Common, number: int) -> Worse:
    """Of a run against the base; the frames to blame are known where the looks were kept."""
    compared = worse = better = 0
    kept, shown = list[Changed](), list[Changed]()
    for own in _changed(common, number):
        compared += len(own.change)
        worse += int(np.count_nonzero(own.change <= -WORSE))
        better += int(np.count_nonzero(own.change >= WORSE))
        kept.append(own.rows(own.matters))
        shown.append(own.rows(own.matters | in_share(own.table, common.shown)))
    found, seen = Changed.joined(kept), Changed.joined(shown)
    index = found.table.index
    place, rivals = _clusters(index, found.label, -found.change, WORSE)
    looks = _looks(common, number, index)
    names = found.table.classes or tuple(str(k) for k in range(found.table.K))
    size = found.table.voxel_size
    listed = _places("agreement", place, rivals, -found.change, index, size, found.label, names, looks)
    wrong_place = None
    if found.true is not None and found.right is not None:
        loss = -found.right.astype(float)
        wrong_place, wrong_rivals = _clusters(index, found.true, loss, 1.0)
        listed += _places("truth", wrong_place, wrong_rivals, loss, index, size, found.true, names, looks)

    def numbers(table: VoxelTable) -> tuple[Int64, Int64 | None]:
        """The places of some voxels (n,), which hold those that matter among them."""
        own, theirs = voxel_keys(table.index, index)
        at = np.minimum(np.searchsorted(own, theirs), max(len(own) - 1, 0))
        there = own[at] == theirs if len(own) else np.zeros(len(theirs), np.bool_)
        wrong = None if wrong_place is None else _put(len(own), at[there], wrong_place[there])
        return _put(len(own), at[there], place[there]), wrong

    def parts() -> Iterator[dict[str, npt.NDArray[Any]]]:
        for own in _changed(common, number):
            yield _columns(own, *numbers(own.table))

    changes = Changes(seen, compared, worse, better, *numbers(seen.table), parts)
    blamed = () if looks is None else _blamed(looks.among(place > 0, found.label))
    return Worse(tuple(listed), blamed, changes)


def _changed(common: Common, number: int) -> Iterator[Changed]:
    assert common.regions is not None
    for region in common.regions():
        tables = [*region.tables.values()]
        yield Changed.of(tables[0], tables[number], region.truth)


def _put(n: int, at: Int64, values: Int64) -> Int64:
    found = np.zeros(n, dtype=np.int64)
    found[at] = values
    return found


def _columns(own: Changed, place: Int64, wrong_place: Int64 | None) -> dict[str, npt.NDArray[Any]]:
    table = own.table
    found: dict[str, npt.NDArray[Any]] = {
        "ix": table.ix,
        "iy": table.iy,
        "iz": table.iz,
        "change": own.change,
        "place": place.astype(np.int32),
    }
    if own.right is not None and wrong_place is not None:
        found |= {"right_change": own.right.astype(np.int8), "wrong_place": wrong_place.astype(np.int32)}
    return found


# --- Places -----------------------------------------------------------------------------------------------------------


def _clusters(index: Int32, label: Int64, loss: Float64, least: float) -> tuple[Int64, Int64]:
    """The number (n,) of each voxel's place, the largest loss first, 0 in none; and the rivals of each place (m,)."""
    place, mass = _connected(index, label, loss, loss >= least)
    _, others = _connected(index, label, -loss, loss <= -least)
    return place, np.array([np.count_nonzero(others >= own - 1e-9) for own in mass], dtype=np.int64)


def _connected(index: Int32, label: Int64, loss: Float64, where: Mask) -> tuple[Int64, Float64]:
    """The places that voxels of one class make which touch each other, and the loss that each sums up to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number, rows = np.zeros(len(index), dtype=np.int64), np.flatnonzero(where)
    if not len(rows):
        return number, np.zeros(0)
    ends = _touching(index[rows], label[rows])
    pairs = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(len(rows), len(rows)))
    of = connected_components(pairs, directed=False)[1]
    mass: Float64 = np.bincount(of, weights=loss[rows]).astype(np.float64)
    count = np.bincount(of)
    order = np.lexsort((np.arange(len(mass)), -mass))
    kept = order[count[order] >= LEAST]
    rank = np.zeros(len(mass), dtype=np.int64)
    rank[kept] = np.arange(1, len(kept) + 1)
    number[rows] = rank[of]
    return number, mass[kept]


def _touching(index: Int32, label: Int64) -> tuple[Int64, Int64]:
    """Pairs of voxels of one class that share a face, an edge or a corner."""
    low, size = index.min(axis=0).astype(np.int64) - 1, np.ptp(index, axis=0).astype(np.int64) + 3
    x, y, z = (index.astype(np.int64) - low).T
    key = (x * size[1] + y) * size[2] + z  # ascending, as the voxels are
    found: list[tuple[Int64, Int64]] = []
    for dx, dy, dz in itertools.product((0, 1), (-1, 0, 1), (-1, 0, 1)):
        if (step := (dx * size[1] + dy) * size[2] + dz) > 0:
            at = np.minimum(np.searchsorted(key, key + step), len(key) - 1)
            there = np.flatnonzero((key[at] == key + step) & (label[at] == label))
            found.append((there, at[there]))
    first, second = zip(*found, strict=True)
    return np.concatenate(first), np.concatenate(second)


def _places(
    what: Literal["agreement", "truth"],
    number: Int64,
    rivals: Int64,
    loss: Float64,
    index: Int32,
    voxel_size: float,
    label: Int64,
    names: Sequence[str],
    looks: Looks | None,
) -> list[Place]:
    listed = []
    for k in range(1, min(len(rivals), MOST) + 1):
        where = number == k
        cells = (index[where] + 0.5) * voxel_size
        x, y, z = cells.mean(axis=0).tolist()
        seen = None if looks is None else looks.among(where, label)
        of = int(label[where][0])
        listed.append(
            Place(
                k,
                what,
                names[of],
                "" if seen is None else seen.instead(of, names),
                len(cells),
                float(loss[where].mean()),
                (x, y, z),
                float(np.linalg.norm(np.ptp(cells, axis=0) + voxel_size)),
                int(rivals[k - 1]),
                () if seen is None else _blamed(seen),
            )
        )
    return listed


# --- Frames -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Looks:
    """The looks of both maps at voxels: (m,) each.

    voxel  row of the voxel; frame of the look
    base, other  (m, K) what they say; of the base its mean at the voxel where it did not look
    """

    voxel: Int64
    frame: Int64
    base: Float64
    other: Float64

    def among(self, where: Mask, label: Int64) -> Seen:
        """Those at some of the voxels (n,), whose classes (n,) are what the looks should say."""
        rows = where[self.voxel]
        k = label[self.voxel[rows]][:, None]
        base, other = self.base[rows], self.other[rows]
        lost = (np.take_along_axis(base, k, axis=1) - np.take_along_axis(other, k, axis=1))[:, 0]
        return Seen(self.frame[rows], lost, other)


@dataclass(frozen=True, eq=False)
class Seen:
    """Looks at a place: frame (m,), what each lost of the place's class (m,), and what it says (m, K)."""

    frame: Int64
    lost: Float64
    says: Float64

    def instead(self, of: int, names: Sequence[str]) -> str:
        """The class that stands where the place's own is missing."""
        said = np.maximum(self.lost, 0) @ self.says if len(self.lost) else np.zeros(len(names))
        said[of] = 0
        return names[int(said.argmax())] if said.max(initial=0) > 0 else ""


def _blamed(seen: Seen) -> tuple[Blame, ...]:
    """The frames that lost most, as far as they account for it."""
    frames, of = np.unique(seen.frame, return_inverse=True)
    lost = np.maximum(np.bincount(of, weights=seen.lost, minlength=len(frames)), 0.0)
    if not lost.sum() > 0:
        return ()
    order = np.argsort(-lost, kind="stable")
    share = lost[order] / lost.sum()
    enough = min(int(np.searchsorted(np.cumsum(share), SHARE - 1e-9)) + 1, MOST_FRAMES)
    return tuple(Blame(int(frames[k]), float(part)) for k, part in zip(order[:enough], share[:enough], strict=True))


def _looks(common: Common, number: int, index: Int32) -> Looks | None:
    """The common looks at the voxels (n, 3), in one order; None where they were not kept."""
    if not common.logs:
        return None
    base, other = (_rows_of(common.logs[k], index) for k in (0, number))
    there = base[0] >= 0
    return Looks(base[0][there], base[1][there], base[2][there], other[2][there])


def _rows_of(log: Events, index: Int32) -> tuple[Int64, Int64, Float64]:
    """Of each look the row of its voxel, -1 where that is not among them, its frame, and what it says."""
    own, wanted = voxel_keys(np.stack([log.ix, log.iy, log.iz], axis=1), index)
    at = np.minimum(np.searchsorted(wanted, own), max(len(wanted) - 1, 0))
    row = np.where(wanted[at] == own, at, -1) if len(wanted) else np.full(len(own), -1)
    return row[log.voxel].astype(np.int64), log.frame.astype(np.int64), log.evidence[:]
