"""Confidence intervals of numbers of a map and of differences between maps, from sums by frame and cube."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from semstab.core.types import THESE_FRAMES, THIS_SCENE, Float64, Int64, Scope
from semstab.data.statistics import CONFIDENCE, UNKNOWN, Estimate, HeadlineStatistics, Interval
from semstab.statistics.agreement import ratio_of
from semstab.statistics.cluster_sums import (
    MOST_GROUPS,
    ClusterSums,
    Functional,
    Scale,
    aligned,
    columns_of,
    frames_of,
    functional,
    parts_of,
    value,
)
from semstab.statistics.variance import (
    TINY,
    Influences,
    Spread,
    influences,
    one_thread,
    spread_of,
    spread_of_flights,
    spread_of_frames,
)

LEAST_FRAMES = 8
"""With fewer frames nothing is claimed about a flight."""

TOO_FEW = "too few frames to tell how frames differ: take {least} or more"

NO_LOCATIONS = "no two locations were seen twice: more overlap between frames is needed"


def estimate(
    sums: ClusterSums,
    key: str | Functional,
    k: int | None = None,
    scope: Scope = THIS_SCENE,
    level: float = CONFIDENCE,
) -> Interval:
    """Return a number with its interval: any functional of the sums, or one of `FUNCTIONALS` by its key; k is a class.

    The scope is explained at `Interval`; if frames are unknown, or all are in one group, it is 'these frames'.
    """
    number = functional(key, k)
    with one_thread():
        result, grid = value(sums, number), influences_of(sums, number)
        if grid is None:
            return Interval(result, math.nan, math.nan, undecided=NO_LOCATIONS, level=level)
        tells_frames = grid.per_group and len(grid.frames) > 1
        return _with_interval(result, number, grid, scope if tells_frames else THESE_FRAMES, level)


def difference(
    a: ClusterSums,
    b: ClusterSums,
    key: str,
    k: int | None = None,
    scope: Scope = THIS_SCENE,
    *,
    same_frames: bool | None = None,
    level: float = CONFIDENCE,
) -> Interval:
    """Return a number of map a less that of map b, paired on locations, and on frames where both have the same ones.

    - `same_frames`: False for another flight, whose frames have nothing to do with these; by default, frames are paired
      if both maps have the same

    Each map counts with all its voxels: voxels in cubes that only one map holds add to the variance. Identical sums
    have no difference anywhere: exactly 0, without a p-value.
    """
    a, b = aligned(a, b)
    number = functional(key, k)
    result = value(a, number) - value(b, number)
    if identical(a, b, number) and not math.isnan(result):
        return no_difference(estimate(a, number, scope=scope, level=level))
    one, other = influences_of(a, number), influences_of(b, number)
    if one is None or other is None:
        return Interval(result, math.nan, math.nan, undecided=NO_LOCATIONS)
    part, of_other = (parts_of(sums, number)[0][0] for sums in (a, b))
    scope = scope if part.step else THESE_FRAMES
    paired = (not part.step or same_flight(part, of_other)) if same_frames is None else same_frames
    between = one.minus(other)
    with one_thread():
        spread = spread_of(between, scope) if paired else spread_of_flights(one, other, between, scope)
    half = spread.half(level)
    low, high = result - half, result + half
    if spread.variance <= TINY:
        first, second = (estimate(sums, number, scope=scope, level=level) for sums in (a, b))
        low, high = first.low - second.high, first.high - second.low
    change = _interval(result, low, high, between, spread, scope, level)
    return dataclasses.replace(change, p_value=spread.p_value(result))


def identical(a: ClusterSums, b: ClusterSums, number: Functional) -> bool:
    """Return whether a number has identical sums in two maps, so that it has no difference anywhere."""
    one, other = ([part for part, _ in parts_of(sums, number)] for sums in aligned(a, b))
    if len(one) != len(other):
        return False
    for pair in zip(one, other, strict=True):
        columns = [columns_of(part, number) for part in pair]
        rows = [values.any(axis=1) for values in columns]
        same = [
            (values[where], part.cell[where], part.frame[where])
            for values, where, part in zip(columns, rows, pair, strict=True)
        ]
        if not all(np.array_equal(x, y, equal_nan=True) for x, y in zip(*same, strict=True)):
            return False
    return True


def no_difference(interval: Interval) -> Interval:
    """Return a difference of exactly 0, with the locations and frames of an interval."""
    return dataclasses.replace(interval, value=0.0, low=0.0, high=0.0, degrees=math.inf, undecided="", p_value=math.nan)


def scope_of(
    sums: ClusterSums, wanted: Scope = THIS_SCENE, key: str | Functional = "alpha", k: int | None = None
) -> Scope:
    """Return the scope of a number's interval: the wanted one if enough frames show it, else these frames."""
    number = functional(key, k)
    has_enough_frames = frames_of(sums, number) >= LEAST_FRAMES and not number.of_space_alone
    return wanted if has_enough_frames else THESE_FRAMES


def headline_of(sums: ClusterSums, wanted: Scope = THIS_SCENE) -> HeadlineStatistics:
    """Return the numbers that a verdict on a map rests on."""
    keys = ("alpha", "psa", "vss", "accuracy", "wrong_of_consistent")
    return HeadlineStatistics(*(estimate(sums, key, scope=scope_of(sums, wanted, key)) for key in keys))


def _with_interval(result: float, number: Functional, grid: Influences, scope: Scope, level: float) -> Interval:
    """Return a number with its interval in a scope, from the influences on it."""
    spread = spread_of(grid, scope)
    if math.isnan(result):
        low, high = math.nan, math.nan
    elif number.scale == "share":
        low, high = _share_ends(result, spread, len(grid.cubes), level)
    else:
        low, high = _ends(result, spread, grid.unseen(level), number.scale, level)
    return _interval(result, max(low, number.low), min(high, number.high), grid, spread, scope, level)


def influences_of(sums: ClusterSums, number: Functional) -> Influences | None:
    """Return the influences on a number; None if it is undefined, or all is in one cube."""
    total = None
    for part, weight in parts_of(sums, number):
        halves = number.pair_weight * part.side_by_side(number.pairs) if number.pairs else None
        influence = influences(part.index, columns_of(part, number), number.of, halves)
        if influence is None:
            return None
        total = influence.times(weight) if total is None else total.plus(influence.times(weight))
    return total


def probability_above(interval: Interval, threshold: float, scale: Scale) -> float:
    """Return how probable a number is above a threshold, from its interval; NaN if nothing is claimed."""
    from scipy import special

    low, high = interval.low, interval.high
    if scale == "agreement" and 1 - low <= math.e * (1 + TINY) * (1 - interval.value):  # on log(1 - x), see `_ends`
        value, error = -math.log(max(1 - interval.value, TINY)), -math.log(max(1 - interval.value, TINY))
        error -= -math.log(max(1 - low, TINY))
        above = -math.log(max(1 - threshold, TINY))
    elif scale == "agreement":  # by the end that no bound cuts off
        value, error, above = interval.value, interval.value - low, threshold
    else:
        value, error, above = interval.value, max(interval.value - low, high - interval.value), threshold
    if math.isnan(value) or math.isnan(error):
        return math.nan
    degrees = interval.degrees if interval.degrees > 0 else math.inf
    error /= float(special.stdtrit(degrees, (1 + interval.level) / 2))
    return float(special.stdtr(degrees, (value - above) / error)) if error > TINY else float(value >= above)


# --- Ends -------------------------------------------------------------------------------------------------------------


ROUNDED = 1e-6
"""Distance from 0 or 1 within which a share is that: sums may be stored in single precision."""


def _share_ends(p: float, spread: Spread, units: int, level: float) -> tuple[float, float]:
    """Return the ends for a mean of numbers from 0 to 1, by its effective sample size (Korn and Graubard 1998)."""
    from scipy import special

    p = float(np.rint(p)) if abs(p - np.rint(p)) < ROUNDED else min(max(p, 0.0), 1.0)
    observations: float = units
    if spread.variance > TINY and 0 < p < 1:
        quantile = special.stdtrit([max(units - 1, 1), spread.degrees], (1 + level) / 2)
        observations = p * (1 - p) / spread.variance * (quantile[0] / quantile[1]) ** 2
    tail, hits = (1 - level) / 2, observations * p
    low = special.betaincinv(hits, observations - hits + 1, tail) if hits > 0 else 0.0
    high = special.betaincinv(hits + 1, observations - hits, 1 - tail) if hits < observations else 1.0
    return float(low), float(high)


RESOLUTION = 0.02
"""Distance from 1 within which an alpha cannot be told from 1: the error that is left where cells on borders of labels
are extrapolated to cells without a size. Alpha of perfect labels is .98 to 1.00 (docs/metrics.md)."""


def _ends(result: float, spread: Spread, unseen: float, scale: Scale, level: float) -> tuple[float, float]:
    """Return the ends by Student's t, with half the width h.

    An agreement x has its interval on the scale log(1 - x), so that none passes 1, as long as h is below 1 - x:

        1 - (1 - x) exp(h / (1 - x)) to 1 - (1 - x) exp(-h / (1 - x))

    - From h = 1 - x on, the lower end is (e - 1) h below x: the scale's own end at h = 1 - x, from where on h tells
      nothing of the relative error of 1 - x. The few errors that were seen may be fewer than those that were missed, so
      that `unseen`, the part that locations without a single error may have missed, counts in addition, by
      1 - (1 - x) / h: not at all at h = 1 - x, in full at x = 1.
    - An upper end within RESOLUTION of 1 is 1.
    - Without any variance the lower end is `unseen` below x.
    """
    if spread.variance <= TINY:
        return result - unseen, _up_to_one(result) if scale == "agreement" else result + unseen
    half = spread.half(level)
    if scale == "plain" or math.isnan(half):
        return result - half, result + half
    apart = max(1 - result, TINY)
    ratio = half / apart
    high = _up_to_one(1 - apart * math.exp(-ratio))
    if ratio < 1:
        return 1 - apart * math.exp(ratio), high
    return result - math.hypot((math.e - 1) * half, unseen * (1 - 1 / ratio)), high


def _up_to_one(high: float) -> float:
    """Return the upper end of an agreement's interval: 1 if it cannot be distinguished from 1."""
    return 1.0 if 1 - high <= RESOLUTION else high


def _interval(
    result: float, low: float, high: float, grid: Influences, spread: Spread, scope: Scope, level: float
) -> Interval:
    frames = round(len(grid.frames) * grid.per_group)
    few = scope != THESE_FRAMES and frames < LEAST_FRAMES
    return Interval(
        result,
        low,
        high,
        scope=scope,
        frames=frames,
        locations=len(grid.cubes),
        degrees=spread.degrees if math.isfinite(spread.degrees) else math.nan,
        undecided=TOO_FEW.format(least=LEAST_FRAMES) if few else "",
        level=level,
    )


# Intervals of differences and means of independent numbers, from their intervals.


def unpaired(a: Interval, b: Interval) -> Interval:
    """Return a number less an independent one, from their intervals of one level (Zou and Donner 2008)."""
    result = a.value - b.value
    low = result - math.hypot(a.value - a.low, b.high - b.value)
    high = result + math.hypot(a.high - a.value, b.value - b.low)
    return _combined(result, low, high, (a, b), 1.0)


def mean_of(result: Sequence[Interval]) -> Interval:
    """Return the mean of numbers with independent errors, such as scenes have, whose intervals have one level."""
    mean = mean_with_ends(result)
    return result[0] if len(result) == 1 else _combined(mean.value, mean.low, mean.high, result, 1 / len(result))


def mean_with_ends(numbers: Sequence[Estimate]) -> Estimate:
    """Return the mean of numbers with independent errors, and the ends of its interval (Zou and Donner 2008)."""
    n = len(numbers)
    value = sum(number.value for number in numbers) / n
    low = value - math.hypot(*(number.value - number.low for number in numbers)) / n
    high = value + math.hypot(*(number.high - number.value for number in numbers)) / n
    return Estimate(value, low, high)


def _combined(value: float, low: float, high: float, parts: Sequence[Interval], weight: float) -> Interval:
    """Return the p-value by the variances that the parts' intervals stand for, each with its degrees of freedom."""
    from scipy import special

    variances = [(weight * standard_error(interval)) ** 2 for interval in parts]
    spread = sum(
        v**2 / interval.degrees for v, interval in zip(variances, parts, strict=True) if v > 0 and interval.degrees > 0
    )
    total = sum(variances)
    degrees = max(total**2 / spread, 1.0) if spread > 0 else math.inf
    p = float(2 * special.stdtr(degrees, -abs(value) / math.sqrt(total))) if total > 0 else math.nan
    scopes = {interval.scope for interval in parts}
    return Interval(
        value,
        low,
        high,
        scope=scopes.pop() if len(scopes) == 1 else THESE_FRAMES,
        frames=min(interval.frames for interval in parts),
        locations=sum(interval.locations for interval in parts),
        degrees=degrees,
        undecided="; ".join(dict.fromkeys(interval.undecided for interval in parts if interval.undecided)),
        p_value=p,
        level=parts[0].level,
    )


def standard_error(interval: Interval) -> float:
    """Return the standard error that an interval by Student's t stands for."""
    from scipy import special

    if not interval.degrees > 0:
        return (interval.high - interval.low) / 2 / float(special.ndtri((1 + interval.level) / 2))
    return (interval.high - interval.low) / 2 / float(special.stdtrit(interval.degrees, (1 + interval.level) / 2))


# Intervals without sums by frame and cube: of a series over frames, and of the coverage of one map by another.


def mean_over_frames(frame: npt.NDArray[np.integer], values: Float64, level: float = CONFIDENCE) -> Interval:
    """Return the mean of values (F,), NaN if undefined, of frames (F,) by their index, for another flight."""
    defined = ~np.isnan(values)
    if defined.sum() < 2:
        return UNKNOWN
    frame, values = np.asarray(frame)[defined], values[defined]
    groups = np.array_split(np.argsort(frame, kind="stable"), min(len(frame), MOST_GROUPS))
    effect, size = np.array([values[rows].mean() for rows in groups]), np.array([len(rows) for rows in groups])
    spread = spread_of_frames(effect, size / size.sum(), np.array([frame[rows].mean() for rows in groups]))
    result, half = float(values.mean()), spread.half(level)
    few = TOO_FEW.format(least=LEAST_FRAMES) if len(values) < LEAST_FRAMES else ""
    return Interval(
        result, result - half, result + half, THIS_SCENE, len(values), degrees=spread.degrees, undecided=few,
        p_value=spread.p_value(result), level=level,
    )  # fmt: skip


def difference_over_frames(a: Mapping[int, float], b: Mapping[int, float], level: float = CONFIDENCE) -> Interval:
    """Return the mean difference of two series by frame, paired on the frames of both, for another flight."""
    frames = sorted(a.keys() & b.keys())
    differences = np.array([a[frame] - b[frame] for frame in frames])
    if not differences.any():
        return no_difference(Interval(0.0, 0.0, 0.0, THIS_SCENE, frames=len(frames)))
    return mean_over_frames(np.array(frames), differences, level)


def coverage(
    new: ClusterSums, base: ClusterSums, level: float = CONFIDENCE, *, same_frames: bool | None = None
) -> Interval:
    """Return how many voxels with OP >= 2 a map has for each one of another, less 1, for these frames.

    For the same frames (by default the sums show it) it is a count, without an interval; else it is an estimate,
    paired on cubes.
    """
    if same_flight(new, base) if same_frames is None else same_frames:
        return counted(shares_of(new, base)["voxels"] - 1, new)
    edge = max(new.edge, base.edge)
    parts = [sums.coarsened(edge, 0) for sums in (new, base)]
    cell, row = np.unique(np.concatenate([part.cell for part in parts]), axis=0, return_inverse=True)
    of = np.split(row.ravel(), [len(parts[0].cell)])
    after, before = (
        np.bincount(at, weights=part["voxels"][:, 0], minlength=len(cell)) for at, part in zip(of, parts, strict=True)
    )
    voxels = np.stack([after - before, after + before, before], axis=1)
    result = estimate(ClusterSums.of_cubes(cell, edge, {"voxels": voxels}), GROWTH, level=level)
    return no_difference(result) if np.allclose(after, before, rtol=1e-9) else result


GROWTH = Functional(("voxels",), lambda sums: ratio_of(sums[..., [0, 2]]), -math.inf, math.inf, "plain")
"""The difference of voxels, then those of both maps, over those of the earlier one."""


def shares_of(new: ClusterSums, base: ClusterSums) -> dict[str, float]:
    """Return how many voxels with OP >= 2, and labelled observations in them, a map has for each one of another.

    The numbers are NaN if the other map has no voxels or observations.
    """
    totals = {name: [round(float(part[name].sum())) for part in (new, base)] for name in ("voxels", "observations")}
    return {name: after / before if before else math.nan for name, (after, before) in totals.items()}


def counted(value: float, sums: ClusterSums) -> Interval:
    """Return a change that is a count of the frames of some sums, and no estimate; undecided if it is undefined."""
    of = sums if sums.step or not sums.answers else sums.answers[0]
    return Interval(
        value, value, value, frames=of.frame_count, locations=sums.cells, degrees=math.inf,
        undecided=NO_LOCATIONS if math.isnan(value) else "", p_value=0.0 if abs(value) > 0 else math.nan,
    )  # fmt: skip


def same_flight(a: ClusterSums, b: ClusterSums) -> bool:
    """Return whether both have the same groups of frames, so that they can be paired."""
    one, other = _groups_of(a, b)
    return len(one) > 0 and np.array_equal(one, other)


def within_a_flight(a: ClusterSums, b: ClusterSums) -> bool:
    """Return whether one has no groups of frames but the other's, as where a model gives no label in whole frames."""
    one, other = _groups_of(a, b)
    common = len(np.intersect1d(one, other))
    return common > 0 and common in (len(one), len(other))


def _groups_of(a: ClusterSums, b: ClusterSums) -> tuple[Int64, Int64]:
    """Return the groups of frames of both, of the same number of frames each; none where they are unknown.

    Without a log these are the views of the cells.
    """
    a, b = (part if part.step or not part.answers else part.answers[0] for part in (a, b))
    step, has_groups = max(a.step, b.step), bool(a.step and b.step)
    one, other = (np.unique(part.frame[part.frame >= 0] // (step // part.step if has_groups else 1)) for part in (a, b))
    return (
        (one.astype(np.int64), other.astype(np.int64)) if has_groups else (np.zeros(0, np.int64), np.zeros(0, np.int64))
    )
