"""Intervals for this map and for the next flight, and differences between maps, from sums by frame and cube."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, UNKNOWN, HeadlineStatistics, Interval, Question
from semstab.statistics.agreement import ratio_of
from semstab.statistics.cluster_sums import (
    MOST_GROUPS,
    ClusterIndex,
    ClusterSums,
    Scale,
    Statistic,
    aligned,
    distinct_rows,
    functional,
    parts_of,
    sums_for,
    value,
)
from semstab.statistics.variance import TINY, Influences, TwoWay, influences, two_way, unpaired_variance

LEVEL = 0.95
"""Of intervals, where no other is asked for."""

LEAST_FRAMES = 30
"""Of fewer frames nothing is said about the next flight: a kind of bad frame, one in ten, is missed by one flight of 20
frames in eight, by one of 30 in 24."""

LASTING = 6.0
"""For each degree of freedom of a number of the next flight so many frames are asked for, whatever they look like: that
quality lasts so long, or that there is a kind of bad frame which did not occur, does not show in a short flight."""

LEAST_DEGREES = 3.0
"""Where it is more likely than not that fewer locations err independently of each other, nothing is claimed: errors
reach as far as the scene. Where fewer frames do, nothing for a new flight: their quality lasts as long as this one."""

LEAST_OF_SPACE = 1.0
"""The same with fewer degrees of freedom, the doubt about correlation lengths in them."""

AS_FAR = "errors reach as far as the scene: fly more of it"
AS_LONG = "the quality of frames lasts about as long as the flight: fly longer"
TOO_FEW = "too few frames to tell of the next flight: fly {least} or more"
TOGETHER = 64
"""Numbers that are worked on together: of thousands of classes not all influences are there at once."""

ONE_CUBE = "nothing was seen twice in two places: fly with more overlap"


@dataclass(frozen=True, eq=False)
class EstimateSpec:
    """A number and the influences on it, None where it is undefined or all is in one cube; how its interval is made."""

    value: float
    grid: Influences | None
    question: Question
    scale: Scale
    bounds: tuple[float, float]
    level: float = LEVEL

    @property
    def answered(self) -> Question:
        """The question that is answered: a single group of frames tells nothing of a new flight."""
        several = self.grid is not None and self.grid.step and len(self.grid.frames) > 1
        return self.question if several else THIS_MAP


def confidence_intervals(specs: Iterable[EstimateSpec]) -> list[Interval]:
    """Return the intervals of numbers of one map; together, as most of the work is the same for all of them."""
    intervals: list[Interval] = []
    specs = iter(specs)
    while some := list(itertools.islice(specs, TOGETHER)):
        known = [(own.grid, own.answered) for own in some if own.grid is not None]
        variances = iter(two_way([grid for grid, _ in known], [question for _, question in known]))
        intervals += [
            _undefined(own.value) if own.grid is None else _interval_of(own, own.grid, next(variances)) for own in some
        ]
    return intervals


def grouped_intervals(*groups: Iterable[EstimateSpec]) -> list[list[Interval]]:
    """Return the intervals of groups of numbers of one map."""
    group_of: list[int] = []

    def specs() -> Iterator[EstimateSpec]:
        for k, group in enumerate(groups):
            for own in group:
                group_of.append(k)
                yield own

    intervals = confidence_intervals(specs())
    return [[own for own, of in zip(intervals, group_of, strict=True) if of == k] for k in range(len(groups))]


def estimate(
    sums: ClusterSums, key: str, k: int | None = None, question: Question = NEXT_FLIGHT, level: float = LEVEL
) -> Interval:
    """A number of a map with its interval; see `FUNCTIONALS` for its key, k is a class.

    'this map': what other places like these would give in these very frames. 'the next flight': what other frames like
    these would give, too; where the frames are not known the interval is for this map, and says so.
    """
    return confidence_intervals([spec_of(sums, key, k, question, level)])[0]


def spec_of(
    sums: ClusterSums, key: str, k: int | None = None, question: Question = NEXT_FLIGHT, level: float = LEVEL
) -> EstimateSpec:
    """Return what `confidence_intervals` takes, see `estimate`."""
    number = functional(key, k)
    bounds = number.low, number.high
    return EstimateSpec(value(sums, key, k), grid_of(sums, key, k), question, number.scale, bounds, level)


def difference(
    a: ClusterSums,
    b: ClusterSums,
    key: str,
    k: int | None = None,
    question: Question = NEXT_FLIGHT,
    *,
    same_frames: bool | None = None,
    level: float = LEVEL,
) -> Interval:
    """A number of map a less that of map b, paired on places, and on frames where both have the same ones.

    same_frames  False for another flight, whose frames have nothing to do with these; where it is not given, frames are
                 paired if both maps have the same
    Each map counts with all its voxels: those of the cubes that only one holds add to the variance. Of the very same
    sums there is no difference anywhere: exactly 0, without a p-value.
    """
    a, b = aligned(a, b)
    change = value(a, key, k) - value(b, key, k)
    if _identical(a, b, key, k) and not math.isnan(change):
        return no_difference(estimate(a, key, k, question, level))
    one, other = grid_of(a, key, k), grid_of(b, key, k)
    if one is None or other is None:
        return _undefined(change)
    question = question if a.step else THIS_MAP
    paired = np.array_equal(np.unique(a.frame), np.unique(b.frame)) if same_frames is None else same_frames
    between = one.minus(other)
    spread = two_way([between], [question])[0] if paired else unpaired_variance(one, other, question)
    half = spread.half(level)
    low, high = change - half, change + half
    if spread.total <= TINY:
        ends = confidence_intervals(spec_of(sums, key, k, question, level) for sums in (a, b))
        low, high = ends[0].low - ends[1].high, ends[0].high - ends[1].low
    return dataclasses.replace(
        _interval(change, low, high, between, spread, question), p_value=_p_value(change, spread)
    )


def _identical(a: ClusterSums, b: ClusterSums, key: str, k: int | None = None) -> bool:
    """Whether a number is of the very same sums in two maps, so that it has no difference, anywhere."""
    rows = []
    for sums in (a, b):
        columns, parts = sums_for(sums, key, k), parts_of(sums, functional(key, k))[:1]
        there = columns.any(axis=1) & bool(parts)
        rows.append([columns[there], *(own[there] for part in parts for own in (part.cell, part.frame))])
    return all(np.array_equal(one, other, equal_nan=True) for one, other in zip(*rows, strict=True))


def no_difference(like: Interval) -> Interval:
    """Return a difference of exactly 0, of as many locations and frames as another interval."""
    return dataclasses.replace(like, value=0.0, low=0.0, high=0.0, degrees=math.inf, undecided="", p_value=math.nan)


def interval_of_cubes(
    cell: npt.NDArray[np.integer],
    edge: float,
    columns: Float64,
    statistic: Statistic,
    scale: Scale,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    level: float = LEVEL,
) -> Interval:
    """The statistic of sums (m, C) of cubes (m, 3) of an edge in metres, with its interval for this map.

    The second column counts what the first is a sum of.
    """
    return confidence_intervals(
        [spec_of_cubes(ClusterIndex.of(cell, None, edge), columns, statistic, scale, bounds, level)]
    )[0]


def spec_of_cubes(
    where: ClusterIndex,
    columns: Float64,
    statistic: Statistic,
    scale: Scale,
    bounds: tuple[float, float] = (-math.inf, math.inf),
    level: float = LEVEL,
) -> EstimateSpec:
    """Return what `confidence_intervals` takes, see `interval_of_cubes`."""
    grid = influences(where, columns, statistic)
    return EstimateSpec(float(statistic(columns.sum(axis=0))), grid, THIS_MAP, scale, bounds, level)


def spec_of_observations(
    cell: npt.NDArray[np.integer],
    frame: npt.NDArray[np.integer],
    edge: float,
    step: int,
    columns: Float64,
    halves: Float64,
    statistic: Statistic,
    level: float = LEVEL,
) -> EstimateSpec:
    """Return the spec of an agreement of sums (m, C) of cubes and groups of frames, see `influences`.

    Its interval is for the next flight where frames tell of it, else for this map.
    """
    found = float(statistic(columns.sum(axis=0)))
    grid = influences(ClusterIndex.of(cell, frame, edge, step), columns, statistic, halves)
    told = grid is not None and len(grid.frames) * step >= LEAST_FRAMES
    return EstimateSpec(found, grid, NEXT_FLIGHT if told else THIS_MAP, "agreement", (-1.0, 1.0), level)


def question_of(sums: ClusterSums) -> Question:
    """What verdicts on a map answer: for the next flight, if there are enough frames to tell."""
    return NEXT_FLIGHT if sums.frames * sums.step >= LEAST_FRAMES else THIS_MAP


def headline_specs(sums: ClusterSums) -> Iterator[EstimateSpec]:
    """Yield the numbers that a verdict on a map rests on, in the order of `HeadlineStatistics`."""
    question = question_of(sums)
    return (spec_of(sums, field.name, question=question) for field in dataclasses.fields(HeadlineStatistics))


def _undefined(value: float) -> Interval:
    return Interval(value, math.nan, math.nan, undecided=ONE_CUBE)


def _interval_of(spec: EstimateSpec, grid: Influences, spread: TwoWay) -> Interval:
    value, question, level = spec.value, spec.answered, spec.level
    if question == NEXT_FLIGHT:  # with no more degrees of freedom than a quality that lasts may leave
        spread = dataclasses.replace(spread, most=max(len(grid.frames) * grid.step / LASTING, LEAST_DEGREES))
    if math.isnan(value) or not spread.degrees > 0:
        low, high = math.nan, math.nan
    elif spec.scale == "share":
        low, high = _share_ends(value, spread, grid.units(question), level)
    else:
        low, high = _ends(value, spread, grid.unseen(question, level), spec.scale, level)
    return _interval(value, max(low, spec.bounds[0]), min(high, spec.bounds[1]), grid, spread, question)


def grid_of(sums: ClusterSums, key: str, k: int | None = None) -> Influences | None:
    """The influences on a number; None where it is not defined, or all is in one cube."""
    number, columns = functional(key, k), sums_for(sums, key, k)
    if not columns.size:
        return None
    rows = parts_of(sums, number)[0]
    halves = rows.of(("twice_agreeing", "twice")) * (0.5 if key == "psa" else 1.0) if number.pairs else None
    return influences(rows.index, columns, number.of, halves)


# --- Ends -------------------------------------------------------------------------------------------------------------


def _share_ends(p: float, spread: TwoWay, units: int, level: float) -> tuple[float, float]:
    """Of a share, or of a mean of numbers from 0 to 1, by the looks that it is worth (Korn and Graubard 1998)."""
    from scipy import special

    p = min(max(p, 0.0), 1.0)
    looks: float = units
    if spread.total > TINY and 0 < p < 1:
        quantile = special.stdtrit([max(units - 1, 1), spread.degrees], (1 + level) / 2)
        looks = p * (1 - p) / spread.total * (quantile[0] / quantile[1]) ** 2
    tail, hits = (1 - level) / 2, looks * p
    low = special.betaincinv(hits, looks - hits + 1, tail) if hits > 0 else 0.0
    high = special.betaincinv(hits + 1, looks - hits, 1 - tail) if hits < looks else 1.0
    return float(low), float(high)


def _ends(found: float, spread: TwoWay, unseen: float, scale: Scale, level: float) -> tuple[float, float]:
    """By Student's t, for agreement on the scale log(1 - found), so that no end passes 1; or what may be unseen."""
    if spread.total <= TINY:
        return found - unseen, found if scale == "agreement" else found + unseen
    half = spread.half(level)
    if scale == "plain" or 1 - found <= TINY:
        return found - half, found + half
    ratio = min(half / (1 - found), 30.0)
    return 1 - (1 - found) * math.exp(ratio), 1 - (1 - found) * math.exp(-ratio)


def _p_value(found: float, spread: TwoWay) -> float:
    """That a number of that spread is 0, two-sided, by Student's t."""
    from scipy import special

    if spread.total <= TINY:
        return math.nan
    return float(2 * special.stdtr(spread.degrees, -abs(found) / math.sqrt(spread.total)))


def _interval(found: float, low: float, high: float, grid: Influences, spread: TwoWay, question: Question) -> Interval:
    frames = len(grid.frames) * grid.step
    space = spread.space
    fewer = float(space.parts.weight[space.parts.degrees < LEAST_DEGREES].sum())
    few = fewer > 0.5 or not space.degrees >= LEAST_OF_SPACE
    far = spread.total > TINY and few
    reasons = [AS_FAR] if far else []
    if question == NEXT_FLIGHT and frames < LEAST_FRAMES:
        reasons.append(TOO_FEW.format(least=LEAST_FRAMES))
    elif not far:
        parts = spread.frames.parts
        if parts.weight[parts.inflation > len(grid.frames) / LEAST_DEGREES].sum() > 0.5:
            reasons.append(AS_LONG)
    return Interval(
        found,
        low,
        high,
        question=question,
        frames=frames,
        places=len(grid.cubes),
        block_size=space.block * grid.edge,
        degrees=spread.degrees,
        undecided="; ".join(reasons),
    )


# Intervals of differences and means of numbers that have nothing in common, from the intervals of these.


def unpaired(a: Interval, b: Interval, level: float = LEVEL) -> Interval:
    """A number less another one of which nothing is shared, from their intervals (Zou and Donner 2008)."""
    found = a.value - b.value
    low = found - math.hypot(a.value - a.low, b.high - b.value)
    high = found + math.hypot(a.high - a.value, b.value - b.low)
    return _combined(found, low, high, (a, b), 1.0, level)


def mean_of(found: Sequence[Interval], level: float = LEVEL) -> Interval:
    """The mean of numbers, of scenes for example, of which each errs by itself."""
    n = len(found)
    value = sum(own.value for own in found) / n
    low = value - math.hypot(*(own.value - own.low for own in found)) / n
    high = value + math.hypot(*(own.high - own.value for own in found)) / n
    return found[0] if n == 1 else _combined(value, low, high, found, 1 / n, level)


def _combined(
    value: float, low: float, high: float, parts: Sequence[Interval], weight: float, level: float
) -> Interval:
    """The p-value by the variances that the parts' intervals stand for, each with its degrees of freedom."""
    from scipy import special

    variances = [(weight * standard_error(own, level)) ** 2 for own in parts]
    spread = sum(v**2 / own.degrees for v, own in zip(variances, parts, strict=True) if v > 0 and own.degrees > 0)
    total = sum(variances)
    degrees = max(total**2 / spread, 1.0) if spread > 0 else math.inf
    p = float(2 * special.stdtr(degrees, -abs(value) / math.sqrt(total))) if total > 0 else math.nan
    questions = {own.question for own in parts}
    return Interval(
        value,
        low,
        high,
        question=NEXT_FLIGHT if questions == {NEXT_FLIGHT} else THIS_MAP,
        frames=min(own.frames for own in parts),
        places=sum(own.places for own in parts),
        block_size=max(own.block_size for own in parts),
        degrees=degrees,
        undecided="; ".join(dict.fromkeys(own.undecided for own in parts if own.undecided)),
        p_value=p,
    )


def standard_error(found: Interval, level: float = LEVEL) -> float:
    """That which an interval by Student's t stands for."""
    from scipy import special

    if not found.degrees > 0:
        return (found.high - found.low) / 2 / float(special.ndtri((1 + level) / 2))
    return (found.high - found.low) / 2 / float(special.stdtrit(found.degrees, (1 + level) / 2))


# Intervals of what has no sums by frame and cube: a series over frames, and how much of a map another one covers.

LASTS = "what frames are like lasts as long as the flight: fly more"


def mean_over_frames(frame: npt.NDArray[np.integer], values: Float64, level: float = LEVEL) -> Interval:
    """The mean of values (F,), NaN where undefined, of frames (F,) by their index, for the next flight.

    Frames that are near each other may be alike: how far that goes is found as for places, on a line.
    """
    there = ~np.isnan(values)
    if there.sum() < 2:
        return UNKNOWN
    frame, values = np.asarray(frame)[there], values[there]
    step = 1
    while len(groups := np.unique(frame // step)) > MOST_GROUPS:
        step *= 2
    at = np.searchsorted(groups, frame // step)
    columns = np.stack([np.bincount(at, weights=values), np.bincount(at)], axis=1).astype(np.float64)
    cell = np.stack([groups, np.zeros_like(groups), np.zeros_like(groups)], axis=1)
    found = interval_of_cubes(cell, step, columns, ratio_of, "plain", level=level)
    reasons = [LASTS] if found.undecided else []
    reasons += [TOO_FEW.format(least=LEAST_FRAMES)] if len(values) < LEAST_FRAMES else []
    return dataclasses.replace(
        found, question=NEXT_FLIGHT, frames=len(values), places=0, block_size=math.nan, undecided="; ".join(reasons)
    )


def difference_over_frames(a: Mapping[int, float], b: Mapping[int, float], level: float = LEVEL) -> Interval:
    """The mean of a series by frame less that of another one, paired on the frames of both, for the next flight."""
    frames = sorted(a.keys() & b.keys())
    differences = np.array([a[frame] - b[frame] for frame in frames])
    if not differences.any():
        return no_difference(Interval(0.0, 0.0, 0.0, NEXT_FLIGHT, frames=len(frames)))
    return mean_over_frames(np.array(frames), differences, level)


def coverage(new: ClusterSums, base: ClusterSums, level: float = LEVEL) -> Interval:
    """Return how many voxels with OP >= 2 a map has for each one of another, less 1, paired on cubes, for this map."""
    edge = max(new.edge, base.edge)
    parts = [sums.coarsened(edge, 0) for sums in (new, base)]
    cell, row = distinct_rows(np.concatenate([part.cell for part in parts]))
    of = np.split(row, [len(parts[0].cell)])
    after, before = (
        np.bincount(at, weights=part["voxels"][:, 0], minlength=len(cell)) for at, part in zip(of, parts, strict=True)
    )
    columns = np.stack([after - before, after + before, before], axis=1)
    change = interval_of_cubes(cell, edge, columns, lambda s: ratio_of(s[..., [0, 2]]), "plain", level=level)
    return no_difference(change) if np.allclose(after, before, rtol=1e-9) else change


def same_flight(a: ClusterSums, b: ClusterSums) -> bool:
    """Whether both have the same groups of frames, so that they can be paired."""
    step = max(a.step, b.step)
    if not a.step or not b.step:
        return False
    one, other = (np.unique(part.frame[part.frame >= 0] // (step // part.step)) for part in (a, b))
    return len(one) > 0 and np.array_equal(one, other)
