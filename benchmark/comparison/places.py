"""Which places got worse: neighbouring voxels whose frames agree less, or that are wrong now; and which frames did it.

Chance makes places worse and better alike where nothing changed. So beside each place stands how many others improved
by as much: its rivals.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.comparison.contrasts import joint_class
from semstab.comparison.pairing import Common
from semstab.metrics.matching import shared_rows, voxel_keys
from semstab.model.measures import dominant
from semstab.model.statistics.contrast import Blame, Place
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import disagreement
from semstab.statistics.correctness import join_truth

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

WORSE = 0.2
"""A voxel got worse where so much of its agreement is lost: of ten looks, one turned to another class."""

LEAST = 4
"""Neighbouring voxels that make a place."""

MOST = 20
"""Places that are told of, the largest loss first."""

SHARE, MOST_FRAMES = 0.9, 8
"""The frames that account for this share of a place's loss are blamed, so many at most."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Voxel by voxel, of those that both maps saw twice or more; 0 in a place's column: in none.

    table   (n,) the base's voxels
    change  (n,) agreement between frames, the run's less the base's
    label   (n,) the class that both maps together give
    place   (n,) number of the place that got worse
    right   (n,) -1 where it was right and is wrong now, 1 the other way round, else 0; None without ground truth
    wrong_place  (n,) number of the place that is wrong now
    """

    table: VoxelTable
    change: Float64
    label: Int64
    place: Int64
    right: Int64 | None
    wrong_place: Int64 | None

    @property
    def worse(self) -> int:
        """How many voxels got worse."""
        return int(np.count_nonzero(self.change <= -WORSE))

    @property
    def better(self) -> int:
        """How many got better by as much."""
        return int(np.count_nonzero(self.change >= WORSE))

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """By name, as a file has them."""
        table = self.table
        found: dict[str, npt.NDArray[Any]] = {
            "ix": table.ix,
            "iy": table.iy,
            "iz": table.iz,
            "change": self.change,
            "place": self.place.astype(np.int32),
        }
        if self.right is not None and self.wrong_place is not None:
            found |= {"right_change": self.right.astype(np.int8), "wrong_place": self.wrong_place.astype(np.int32)}
        return found


@dataclass(frozen=True, eq=False)
class Worse:
    """The places that got worse, the frames to blame for all of them, and what changed in each voxel."""

    places: tuple[Place, ...]
    blamed: tuple[Blame, ...]
    changes: Changes


def worse_places(common: Common, truth: VoxelTable | None, number: int) -> Worse:
    """Of a run against the base; the frames to blame are known where the looks were kept."""
    maps = (common.maps[0], common.maps[number])
    rows = shared_rows(*maps)
    again = (maps[0].op[rows[0]] >= 2) & (maps[1].op[rows[1]] >= 2)
    base, other = (table.rows(kept[again]) for table, kept in zip(maps, rows, strict=True))
    between = [disagreement(table)[1] for table in (base, other)]
    change = between[0] - between[1]
    label, index = joint_class((base, other)), base.index
    place, rivals = _clusters(index, label, -change, WORSE)
    looks = _looks(common, number, index)
    names = base.classes or tuple(str(k) for k in range(base.K))
    listed = _places("agreement", place, rivals, -change, index, base.voxel_size, label, names, looks)
    right = wrong_place = None
    if truth is not None:
        true = join_truth(base, truth).label
        right = np.where(true >= 0, (dominant(other) == true).astype(int) - (dominant(base) == true), 0).astype(
            np.int64
        )
        wrong_place, wrong_rivals = _clusters(index, true, -right.astype(float), 1.0)
        listed += _places(
            "truth", wrong_place, wrong_rivals, -right.astype(float), index, base.voxel_size, true, names, looks
        )
    changes = Changes(base, change, label, place, right, wrong_place)
    blamed = () if looks is None else _blamed(looks.among(place > 0, label))
    return Worse(tuple(listed), blamed, changes)


# --- Places -----------------------------------------------------------------------------------------------------------


def _clusters(index: npt.NDArray[np.int32], label: Int64, loss: Float64, least: float) -> tuple[Int64, Int64]:
    """The number (n,) of each voxel's place, the largest loss first, 0 in none; and the rivals of each place (m,)."""
    place, mass = _connected(index, label, loss, loss >= least)
    _, others = _connected(index, label, -loss, loss <= -least)
    return place, np.array([np.count_nonzero(others >= own - 1e-9) for own in mass], dtype=np.int64)


def _connected(
    index: npt.NDArray[np.int32], label: Int64, loss: Float64, where: npt.NDArray[np.bool_]
) -> tuple[Int64, Float64]:
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


def _touching(index: npt.NDArray[np.int32], label: Int64) -> tuple[Int64, Int64]:
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
    index: npt.NDArray[np.int32],
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

    def among(self, where: npt.NDArray[np.bool_], label: Int64) -> Seen:
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


def _looks(common: Common, number: int, index: npt.NDArray[np.int32]) -> Looks | None:
    """The common looks at the voxels (n, 3), in one order; None where they were not kept."""
    if not common.logs:
        return None
    base, other = (_rows_of(common.logs[k], index) for k in (0, number))
    there = base[0] >= 0
    return Looks(base[0][there], base[1][there], base[2][there], other[2][there])


def _rows_of(log: Events, index: npt.NDArray[np.int32]) -> tuple[Int64, Int64, Float64]:
    """Of each look the row of its voxel, -1 where that is not among them, its frame, and what it says."""
    own, wanted = voxel_keys(np.stack([log.ix, log.iy, log.iz], axis=1), index)
    at = np.minimum(np.searchsorted(wanted, own), max(len(wanted) - 1, 0))
    row = np.where(wanted[at] == own, at, -1) if len(wanted) else np.full(len(own), -1)
    return row[log.voxel].astype(np.int64), log.frame.astype(np.int64), log.evidence[:]
