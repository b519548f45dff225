"""Areas that got worse: neighbouring voxels whose frames agree less, or that are wrong now; and the frames behind it.

Chance makes areas worse as often as better if nothing changed. So each area has the number of other areas that
improved by as much: its `improved_alike`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.comparison.pairing import Common, joint_class
from semstab.comparison.voxels import in_share
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.contrast import Area, FrameShare
from semstab.data.events import Events
from semstab.data.measures import dominant
from semstab.data.voxel_keys import in_order, voxel_keys
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import shared_rows
from semstab.statistics.agreement import disagreement
from semstab.statistics.correctness import join_truth

WORSE = 0.2
"""A voxel got worse where so much of its agreement is lost: of ten observations, one turned to another class."""

LEAST = 4
"""Least neighbouring voxels that make an area."""

MOST = 20
"""Most areas that are reported, the largest loss first."""

SHARE, MOST_FRAMES = 0.9, 8
"""An area lists the frames that account for this share of its loss, and at most MOST_FRAMES frames."""


@dataclass(frozen=True, eq=False)
class Changed:
    """Changes voxel by voxel, for those that both maps saw twice or more.

    Attributes:
        table: (n,) the base's voxels.
        change: (n,) agreement between frames, the run's less the base's.
        label: (n,) the class that both maps together give.
        true: (n,) the true class, -1 for an unknown class; None without ground truth.
        right: (n,) -1 if the base is right and the run wrong, 1 the other way round, else 0; None without ground truth.
    """

    table: VoxelTable
    change: Float64
    label: Int64
    true: Int64 | None
    right: Int64 | None

    @classmethod
    def between(cls, base: VoxelTable, other: VoxelTable, truth: VoxelTable | None) -> Changed:
        """Compare two maps, or parts of them, voxel by voxel."""
        rows = shared_rows(base, other)
        again = (base.op[rows[0]] >= 2) & (other.op[rows[1]] >= 2)
        base, other = (table.rows(table_rows[again]) for table, table_rows in zip((base, other), rows, strict=True))
        between = [disagreement(table)[1] for table in (base, other)]
        change = (between[0] - between[1]).round(9)  # one of ten that turned is WORSE, whatever the last digit is
        true = right = None
        if truth is not None:
            true = join_truth(base, truth).label
            gained = (dominant(other) == true).astype(int) - (dominant(base) == true)
            right = np.where(true >= 0, gained, 0).astype(np.int64)
        return cls(base, change, joint_class((base, other)), true, right)

    @property
    def matters(self) -> Mask:
        """(n,) true for voxels that may be part of an area, or of its `improved_alike`."""
        much: Mask = np.abs(self.change) >= WORSE
        return much if self.right is None else much | (self.right != 0)

    def rows(self, where: Mask) -> Changed:
        """Return some of them (n,)."""
        true, right = (None if column is None else column[where] for column in (self.true, self.right))
        return Changed(self.table.rows(where), self.change[where], self.label[where], true, right)

    @classmethod
    def joined(cls, parts: Sequence[Changed]) -> Changed:
        """Join the changes of several parts."""
        order = in_order(np.concatenate([part.table.index for part in parts]))

        def column(name: str) -> Any:
            columns = [getattr(part, name) for part in parts]
            return None if columns[0] is None else np.concatenate(columns)[order]

        table = VoxelTable.joined([part.table for part in parts])
        return cls(table, *(column(name) for name in ("change", "label", "true", "right")))


@dataclass(frozen=True, eq=False)
class VoxelChanges:
    """Changes between two maps; of a large map `shown` has those that matter, and some of the others.

    Attributes:
        compared, worse, better: Number of voxels that both saw twice or more, and that changed by WORSE.
        area, wrong_area: (m,) number of the area that got worse, or is wrong now, of each of `shown`; 0 in none.
        parts: All voxels with their changes, by name as a file has them, some after the others.
    """

    shown: Changed
    compared: int
    worse: int
    better: int
    area: Int64
    wrong_area: Int64 | None
    parts: Callable[[], Iterator[dict[str, npt.NDArray[Any]]]]


@dataclass(frozen=True, eq=False)
class Worse:
    """The areas that got worse, the frames that contribute most, and the changes in each voxel."""

    areas: tuple[Area, ...]
    top_frames: tuple[FrameShare, ...]
    changes: VoxelChanges


def worse_areas(common: Common, number: int) -> Worse:
    """Return the areas of a run that got worse than the base; frames are known where observations were stored."""
    compared = worse = better = 0
    relevant_parts, displayed_parts = list[Changed](), list[Changed]()
    for changed in _changed(common, number):
        compared += len(changed.change)
        worse += int(np.count_nonzero(changed.change <= -WORSE))
        better += int(np.count_nonzero(changed.change >= WORSE))
        relevant_parts.append(changed.rows(changed.matters))
        displayed_parts.append(changed.rows(changed.matters | in_share(changed.table, common.shown)))
    result, displayed = Changed.joined(relevant_parts), Changed.joined(displayed_parts)
    index = result.table.index
    area, improved_alike = _clusters(index, result.label, -result.change, WORSE)
    observations = _observations(common, number, index, result.table.voxel_size)
    names = result.table.classes or tuple(str(k) for k in range(result.table.K))
    size = result.table.voxel_size
    listed = _areas("agreement", area, improved_alike, -result.change, index, size, result.label, names, observations)
    wrong_area = None
    if result.true is not None and result.right is not None:
        loss = -result.right.astype(float)
        wrong_area, wrong_alike = _clusters(index, result.true, loss, 1.0)
        listed += _areas("truth", wrong_area, wrong_alike, loss, index, size, result.true, names, observations)

    def numbers(table: VoxelTable) -> tuple[Int64, Int64 | None]:
        """Return the areas of some voxels (n,), which hold those that matter among them."""
        keys, theirs = voxel_keys(table.index, index)
        at = np.minimum(np.searchsorted(keys, theirs), max(len(keys) - 1, 0))
        inside = keys[at] == theirs if len(keys) else np.zeros(len(theirs), np.bool_)
        wrong = None if wrong_area is None else _put(len(keys), at[inside], wrong_area[inside])
        return _put(len(keys), at[inside], area[inside]), wrong

    def parts() -> Iterator[dict[str, npt.NDArray[Any]]]:
        for changed in _changed(common, number):
            yield _columns(changed, *numbers(changed.table))

    changes = VoxelChanges(displayed, compared, worse, better, *numbers(displayed.table), parts)
    top_frames = () if observations is None else _top_frames(observations.among(area > 0, result.label))
    return Worse(tuple(listed), top_frames, changes)


def _changed(common: Common, number: int) -> Iterator[Changed]:
    assert common.regions is not None
    for region in common.regions():
        tables = [*region.tables.values()]
        yield Changed.between(tables[0], tables[number], region.truth)


def _put(n: int, at: Int64, values: Int64) -> Int64:
    result = np.zeros(n, dtype=np.int64)
    result[at] = values
    return result


def _columns(changed: Changed, area: Int64, wrong_area: Int64 | None) -> dict[str, npt.NDArray[Any]]:
    table = changed.table
    columns: dict[str, npt.NDArray[Any]] = {"ix": table.ix, "iy": table.iy, "iz": table.iz, "change": changed.change}
    columns["area"] = area.astype(np.int32)
    if changed.right is not None and wrong_area is not None:
        columns |= {"right_change": changed.right.astype(np.int8), "wrong_area": wrong_area.astype(np.int32)}
    return columns


# --- Areas ------------------------------------------------------------------------------------------------------------


def _clusters(index: Int32, label: Int64, loss: Float64, least: float) -> tuple[Int64, Int64]:
    """Return the number (n,) of each voxel's area, the largest loss first, 0 in none.

    The second array (m,) counts the areas that improved by as much.
    """
    area, mass = connected(index, label, loss, loss >= least)
    _, improved_mass = connected(index, label, -loss, loss <= -least)
    return area, np.array([np.count_nonzero(improved_mass >= observed - 1e-9) for observed in mass], dtype=np.int64)


def connected(index: Int32, label: Int64, loss: Float64, where: Mask) -> tuple[Int64, Float64]:
    """Return the areas of voxels of one class that touch each other, and the loss that each sums up to."""
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
    large_areas = order[count[order] >= LEAST]
    rank = np.zeros(len(mass), dtype=np.int64)
    rank[large_areas] = np.arange(1, len(large_areas) + 1)
    number[rows] = rank[of]
    return number, mass[large_areas]


def _touching(index: Int32, label: Int64) -> tuple[Int64, Int64]:
    """Return pairs of voxels of one class that share a face, an edge or a corner."""
    low, size = index.min(axis=0).astype(np.int64) - 1, np.ptp(index, axis=0).astype(np.int64) + 3
    x, y, z = (index.astype(np.int64) - low).T
    key = (x * size[1] + y) * size[2] + z  # ascending like the voxels
    result: list[tuple[Int64, Int64]] = []
    for dx, dy, dz in itertools.product((0, 1), (-1, 0, 1), (-1, 0, 1)):
        if (step := (dx * size[1] + dy) * size[2] + dz) > 0:
            at = np.minimum(np.searchsorted(key, key + step), len(key) - 1)
            matched = np.flatnonzero((key[at] == key + step) & (label[at] == label))
            result.append((matched, at[matched]))
    first, second = zip(*result, strict=True)
    return np.concatenate(first), np.concatenate(second)


def _areas(
    what: Literal["agreement", "truth"],
    number: Int64,
    improved_alike: Int64,
    loss: Float64,
    index: Int32,
    voxel_size: float,
    label: Int64,
    names: Sequence[str],
    observations: PairedObservations | None,
) -> list[Area]:
    listed = []
    for k in range(1, min(len(improved_alike), MOST) + 1):
        where = number == k
        cells = (index[where] + 0.5) * voxel_size
        x, y, z = cells.mean(axis=0).tolist()
        of_area = None if observations is None else observations.among(where, label)
        of = int(label[where][0])
        listed.append(
            Area(
                k, what, names[of], "" if of_area is None else of_area.confused_with(of, names), len(cells),
                float(loss[where].mean()), (x, y, z), float(np.linalg.norm(np.ptp(cells, axis=0) + voxel_size)),
                int(improved_alike[k - 1]), () if of_area is None else _top_frames(of_area),
            )
        )  # fmt: skip
    return listed


# --- Frames -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PairedObservations:
    """The observations of both maps at voxels: (m,) each.

    Attributes:
        voxel: Row of the voxel; frame of the observation.
        base, other: (m, K) shares of the classes; where the base saw nothing, its mean at the voxel.
    """

    voxel: Int64
    frame: Int64
    base: Float64
    other: Float64

    def among(self, where: Mask, label: Int64) -> AreaObservations:
        """Return the observations at some of the voxels (n,), with their classes (n,) as the expected ones."""
        rows = where[self.voxel]
        k = label[self.voxel[rows]][:, None]
        base, other = self.base[rows], self.other[rows]
        lost = (np.take_along_axis(base, k, axis=1) - np.take_along_axis(other, k, axis=1))[:, 0]
        return AreaObservations(self.frame[rows], lost, other)


@dataclass(frozen=True, eq=False)
class AreaObservations:
    """Observations of an area: frame (m,), loss of the area's class (m,), and shares of the classes (m, K)."""

    frame: Int64
    lost: Float64
    shares: Float64

    def confused_with(self, of: int, names: Sequence[str]) -> str:
        """Return the class that replaces the area's own."""
        missing = np.maximum(self.lost, 0) @ self.shares if len(self.lost) else np.zeros(len(names))
        missing[of] = 0
        return names[int(missing.argmax())] if missing.max(initial=0) > 0 else ""


def _top_frames(observations: AreaObservations) -> tuple[FrameShare, ...]:
    frames, of = np.unique(observations.frame, return_inverse=True)
    lost = np.maximum(np.bincount(of, weights=observations.lost, minlength=len(frames)), 0.0)
    if not lost.sum() > 0:
        return ()
    order = np.argsort(-lost, kind="stable")
    share = lost[order] / lost.sum()
    enough = min(int(np.searchsorted(np.cumsum(share), SHARE - 1e-9)) + 1, MOST_FRAMES)
    return tuple(
        FrameShare(int(frames[k]), float(part)) for k, part in zip(order[:enough], share[:enough], strict=True)
    )


def _observations(common: Common, number: int, index: Int32, voxel_size: float) -> PairedObservations | None:
    if not common.logs:
        return None
    base, other = (_rows_of(common.logs[k], index, voxel_size) for k in (0, number))
    there = base[0] >= 0
    return PairedObservations(base[0][there], base[1][there], base[2][there], other[2][there])


def _rows_of(log: Events, index: Int32, voxel_size: float) -> tuple[Int64, Int64, Float64]:
    """Return for each observation the row of the voxel that holds its spot, or -1, its frame and its shares."""
    centre = (np.stack([log.ix, log.iy, log.iz], axis=1) + 0.5) * log.voxel_size
    keys, table_keys = voxel_keys(np.floor(centre / voxel_size).astype(np.int32), index)
    at = np.minimum(np.searchsorted(table_keys, keys), max(len(table_keys) - 1, 0))
    row = np.where(table_keys[at] == keys, at, -1) if len(table_keys) else np.full(len(keys), -1)
    return row[log.voxel].astype(np.int64), log.frame.astype(np.int64), log.evidence[:]
