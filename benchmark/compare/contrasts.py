"""By how much runs differ: each measure with its interval, the question that this answers, and its p-value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from semstab.compare.opening import Entry
from semstab.compare.pairing import Common
from semstab.compare.quantities import (
    BY_CLASS,
    COVERAGE,
    FLICKER,
    HEADLINES,
    IN_SUMS,
    ONE_AGAINST_ALL,
    REACHED,
    quantities,
)
from semstab.errors import DataError
from semstab.metrics import macro_mean
from semstab.model.contrast import Contrast
from semstab.model.measures import Measure, Quantity, dominant, mean
from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, UNKNOWN, Interval, Question
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ALPHA_BETWEEN, ratio_of
from semstab.statistics.comparison import LEAST_VOXELS, holm
from semstab.statistics.sampling import (
    InfluenceSums,
    Places,
    difference,
    estimate,
    mean_of,
    question_of,
    standard_error,
    unpaired,
    value,
)
from semstab.statistics.sampling.paired import coverage, identical, mean_over_frames

Mask = npt.NDArray[np.bool_]

LEVEL = 0.05
"""Corrected p-value below which a difference is claimed."""


def contrasts(common: Common, base: Entry, other: Entry, number: int) -> tuple[Contrast, ...]:
    """All that is compared of a scene, in the order of `quantities`; `number` is the other run's among the runs."""
    found = {row.measure: row for row in _rows(common, base, other, number)}
    return tuple(found[quantity.key] for quantity in quantities() if quantity.key in found)


def by_class(common: Common, base: Entry, other: Entry, number: int) -> tuple[Contrast, ...]:
    """The same of each class: against all others, or of the places that are of the class.

    These are by the ground truth, or else by what all runs together say, so that none of them chooses its own.
    """
    names = base.classes or tuple(str(k) for k in range(base.sums.K))
    own = list(_of_places(common, names, number)) if common.tables else []
    rows = [*_against_all(common, base, other, names, number), *own]
    order = {quantity.key: place for place, quantity in enumerate(BY_CLASS)}
    return tuple(sorted(rows, key=lambda row: (names.index(row.of), order[row.measure])))


def over_scenes(found: Sequence[Sequence[Contrast]]) -> tuple[Contrast, ...]:
    """The macro mean of each measure (and class) over the scenes that have it."""
    groups: dict[tuple[str, str], list[Contrast]] = {}
    for row in (row for rows in found for row in rows):
        groups.setdefault((row.measure, row.of), []).append(row)
    return tuple(
        Contrast(
            measure,
            of,
            macro_mean([row.base for row in rows]),
            macro_mean([row.other for row in rows]),
            mean_of([row.difference for row in rows]),
            math.nan,
            "",
        )
        for (measure, of), rows in groups.items()
    )


def tested(lists: Sequence[Sequence[Contrast]]) -> list[tuple[Contrast, ...]]:
    """Lists with p-values corrected for all that stand in them together, and what is said of each difference."""
    corrected = iter(holm([row.difference.p_value for rows in lists for row in rows]))
    better = {quantity.key: quantity.sign for quantity in (*quantities(), *BY_CLASS)}
    return [tuple(_said(row, next(corrected), better[row.measure]) for row in rows) for rows in lists]


def _said(row: Contrast, p_holm: float, sign: float) -> Contrast:
    shown = p_holm < LEVEL and row.difference.decided
    gain = -sign * row.difference.value
    return dataclasses.replace(row, p_holm=p_holm, change=("better" if gain > 0 else "worse") if shown else "")


# --- Of a scene -------------------------------------------------------------------------------------------------------


def _rows(common: Common, base: Entry, other: Entry, number: int) -> Iterator[Contrast]:
    for quantity in IN_SUMS:
        sums = common.whole if quantity is ALPHA_BETWEEN else common.sums
        yield from _row(quantity, sums[0], sums[number], common)
    if _same_ceiling(base, other):
        yield from _row(REACHED, *_alike(base.sums, other.sums), common)
    if common.basis != "flights":
        yield _coverage(base.sums, other.sums)
    if base.flicker and other.flicker:
        yield _flicker(base, other, paired=common.same_frames is not False)
    done = {quantity.key for quantity in (*HEADLINES, *IN_SUMS)}
    for quantity in quantities():
        if isinstance(quantity, Measure) and quantity.key not in done and common.tables:
            yield _of_voxels(quantity, common.tables[0], common.tables[number], common.sums[0].edge)


def _row(
    quantity: Quantity, base: InfluenceSums, other: InfluenceSums, common: Common, k: int | None = None, of: str = ""
) -> Iterator[Contrast]:
    """A number of the sums, where either run has it."""
    key = quantity.key
    values = value(base, key, k), value(other, key, k)
    if all(math.isnan(one) for one in values):
        return
    yield Contrast(key, of, *values, _difference(base, other, key, k, common), math.nan, "")


def _difference(base: InfluenceSums, other: InfluenceSums, key: str, k: int | None, common: Common) -> Interval:
    question = _question(base, other)
    if identical(base, other):
        return dataclasses.replace(estimate(base, key, k, question), value=0.0, low=0.0, high=0.0, p_value=math.nan)
    if common.basis == "flights":
        return unpaired(*(estimate(sums, key, k, question) for sums in (other, base)))
    return difference(other, base, key, k, question, same_frames=common.same_frames)


def _question(*sums: InfluenceSums) -> Question:
    return NEXT_FLIGHT if {question_of(own) for own in sums} == {NEXT_FLIGHT} else THIS_MAP


def _alike(*sums: InfluenceSums) -> Iterator[InfluenceSums]:
    """Without the sums of ground truth, which not all may have."""
    for own in sums:
        yield own.without_truth()


def _same_ceiling(base: Entry, other: Entry) -> bool:
    """Whether both judge against the same labels: those of the truth, or their own in finer cells."""
    found = [entry.summary.statistics and entry.summary.statistics.reach for entry in (base, other)]
    return all(found) and len({reach.by for reach in found if reach}) == 1


def _coverage(base: InfluenceSums, other: InfluenceSums) -> Contrast:
    ratio = coverage(other, base)
    shifted = dataclasses.replace(ratio, value=ratio.value - 1, low=ratio.low - 1, high=ratio.high - 1)
    return Contrast(COVERAGE.key, "", 1.0, ratio.value, _with_p_value(shifted), math.nan, "")


def _flicker(base: Entry, other: Entry, *, paired: bool) -> Contrast:
    values = macro_mean([*base.flicker.values()]), macro_mean([*other.flicker.values()])
    frames = np.array(sorted(base.flicker.keys() & other.flicker.keys()), dtype=np.int64) if paired else np.zeros(0)
    if len(frames) > 1:
        values = tuple(macro_mean([each.flicker[frame] for frame in frames]) for each in (base, other))
        change = np.array([other.flicker[frame] - base.flicker[frame] for frame in frames])
        found = mean_over_frames(frames, change)
    else:
        each = [mean_over_frames(np.array([*e.flicker]), np.array([*e.flicker.values()])) for e in (other, base)]
        found = unpaired(*each)
    return Contrast(FLICKER.key, "", *values, _with_p_value(found), math.nan, "")


def _of_voxels(measure: Measure, base: VoxelTable, other: VoxelTable, edge: float) -> Contrast:
    """The mean of a measure over the voxels where it is defined, by its differences voxel by voxel."""
    values = measure.of(base), measure.of(other)
    known = ~np.isnan(values[0]) & ~np.isnan(values[1])
    if not known.any():
        return Contrast(measure.key, "", math.nan, math.nan, UNKNOWN, math.nan, "")
    columns = np.stack([(values[1] - values[0])[known], np.ones(known.sum())], axis=1)
    places = Places(base.index[known], base.voxel_size, edge)
    found = places.estimate(columns, ratio_of, (-measure.largest, measure.largest), "plain")
    means = (mean(own[known]) for own in values)
    return Contrast(measure.key, "", *means, _with_p_value(found), math.nan, "")


def _with_p_value(found: Interval) -> Interval:
    """That the number is 0, by its interval; where nothing varies, nothing differs."""
    from scipy import stats

    error = standard_error(found)
    if found.value == 0 and found.low == found.high == 0:
        return found
    if not error > 0:
        return found
    degrees = found.degrees if found.degrees > 0 else math.inf
    return dataclasses.replace(found, p_value=float(2 * stats.t.sf(abs(found.value) / error, degrees)))


# --- By class ---------------------------------------------------------------------------------------------------------


def _against_all(
    common: Common, base: Entry, other: Entry, names: Sequence[str], number: int
) -> Iterator[Contrast]:
    for quantity in ONE_AGAINST_ALL:
        if quantity is REACHED:
            pair = tuple(_alike(base.sums, other.sums)) if _same_ceiling(base, other) else ()
        else:
            sums = common.whole if quantity is ALPHA_BETWEEN else common.sums
            pair = (sums[0], sums[number])
        for k, name in enumerate(names) if pair else ():
            if _enough(pair[0], k):
                yield from _row(quantity, pair[0], pair[1], common, k, name)


def _enough(sums: InfluenceSums, k: int) -> bool:
    """Whether a class has evidence worth so many voxels."""
    seen = sums["observations"].sum() / max(sums["voxels"].sum(), 1e-9)
    return bool(sums["evidence"][:, k].sum() >= LEAST_VOXELS * seen)


def _of_places(common: Common, names: Sequence[str], number: int) -> Iterator[Contrast]:
    labels = class_of_places(common)
    wanted = [quantity for quantity in BY_CLASS if quantity not in ONE_AGAINST_ALL]
    for k, name in enumerate(names):
        where = labels == k
        if np.count_nonzero(where) < LEAST_VOXELS:
            continue
        sums = common.among(where)
        for quantity in wanted:
            yield from _row(quantity, sums[0], sums[number], common, of=name)


def class_of_places(common: Common) -> npt.NDArray[np.int64]:
    """The class (n,) of each common place: the true one, or what all runs together say; -1 where it is not known."""
    return common.label if common.label is not None else joint_class(common.tables)


def joint_class(tables: Iterable[VoxelTable]) -> npt.NDArray[np.int64]:
    """The dominant class (n,) of the same voxels in several maps, each counting alike."""
    first, *others = tables
    beliefs = first.evidence[:] / first.op[:, None]
    for other in others:
        beliefs = beliefs + other.evidence[:] / other.op[:, None]
    label: npt.NDArray[np.int64] = beliefs.round(9).argmax(axis=1)
    return label


__all__ = ["DataError", "by_class", "class_of_places", "contrasts", "dominant", "joint_class", "over_scenes", "tested"]
