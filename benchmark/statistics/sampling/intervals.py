"""Intervals for this map and for the next flight, and differences between maps, from sums by frame and cube."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval, Question
from semstab.statistics.blocks import LEVEL
from semstab.statistics.sampling.influence import InfluenceSums, aligned, columns_of, defined, functional, value
from semstab.statistics.sampling.reach import Arrangement, Spread, arrangement

Float64 = npt.NDArray[np.float64]

LEAST_FRAMES = 40
"""Of fewer frames nothing is said about the next flight: bad ones may all have been missed, and a quality that lasts
looks constant."""

LEAST_DEGREES = 4.0
"""Of fewer places that err independently of each other nothing is said: errors reach as far as the scene."""

AS_FAR = "errors reach as far as the scene: fly more of it"
TOO_FEW = "too few frames to tell of the next flight: fly {least} or more"
NO_PLACES = "nothing was seen twice in two places: fly with more overlap"
ZERO = 1e-12


def estimate(
    sums: InfluenceSums, key: str, k: int | None = None, question: Question = NEXT_FLIGHT, level: float = LEVEL
) -> Interval:
    """A number of a map with its interval; see `FUNCTIONALS` for its key, k is a class.

    'this map': what other places like these would give in these very frames. 'the next flight': what other frames like
    these would give, too; where the frames are not known the interval is for this map, and says so.
    """
    found = value(sums, key, k)
    grid = _grid(sums, key, k)
    if grid is None:
        return Interval(found, math.nan, math.nan, undecided=NO_PLACES)
    question = question if sums.step else THIS_MAP
    spread = _two_way(grid, question)
    units = grid.units(question)
    if key == "alpha":
        low, high = _alpha_ends(found, spread, units, _chance(sums, k), level)
    else:
        low, high = _share_ends(found, spread, units, level)
    return _interval(found, low, high, grid, spread, question)


def difference(
    a: InfluenceSums,
    b: InfluenceSums,
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
    Each map counts with all its voxels: those of the cubes that only one holds add to the variance.
    """
    a, b = aligned(a, b)
    found = value(a, key, k) - value(b, key, k)
    one, other = _grid(a, key, k), _grid(b, key, k)
    if one is None or other is None:
        return Interval(found, math.nan, math.nan, undecided=NO_PLACES)
    question = question if a.step else THIS_MAP
    paired = np.array_equal(np.unique(a.frame), np.unique(b.frame)) if same_frames is None else same_frames
    spread = _two_way(one.minus(other), question) if paired else _apart(one, other, question)
    half = spread.half(level)
    low, high = found - half, found + half
    if spread.total <= ZERO:
        ends = [estimate(sums, key, k, question, level) for sums in (a, b)]
        low, high = ends[0].low - ends[1].high, ends[0].high - ends[1].low
    p = 2 * stats.t.sf(abs(found) / math.sqrt(spread.total), spread.degrees) if spread.total > ZERO else math.nan
    return dataclasses.replace(_interval(found, low, high, one.minus(other), spread, question), p_value=float(p))


# --- Influences -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Grid:
    """Influences of places and frames on a number; both sum to 0.

    places   (G, 3) cubes in which something counts, frames (F,) groups
    block    (G,) influence of each cube
    cell     (G, F) of each group of frames in each cube
    size     (G, F) how much is in it
    """

    places: npt.NDArray[np.int64]
    frames: npt.NDArray[np.int64]
    block: Float64
    cell: Float64
    size: Float64
    edge: float
    step: int

    def units(self, question: Question) -> int:
        """How many independent looks there can be."""
        return len(self.places) if question == THIS_MAP else min(len(self.places), len(self.frames) * self.step)

    def minus(self, other: _Grid) -> _Grid:
        """The influences on the difference of two numbers."""
        places, rows = np.unique(np.concatenate([self.places, other.places]), axis=0, return_inverse=True)
        frames, columns = np.unique(np.concatenate([self.frames, other.frames]), return_inverse=True)
        block, cell, size = np.zeros(len(places)), np.zeros((len(places), len(frames))), None
        size = cell.copy()
        row, column = np.split(rows.ravel(), [len(self.places)]), np.split(columns, [len(self.frames)])
        for grid, sign, at, to in zip((self, other), (1.0, -1.0), row, column, strict=True):
            block[at] += sign * grid.block
            cell[np.ix_(at, to)] += sign * grid.cell
            size[np.ix_(at, to)] += grid.size
        return _Grid(places, frames, block, cell, size, self.edge, self.step)


def _grid(sums: InfluenceSums, key: str, k: int | None) -> _Grid | None:
    """The influences on a number; None where it is not defined, or all is in one cube."""
    if not (len(sums.frame) and defined(sums, key, k)):
        return None
    number, columns = functional(key, k), columns_of(sums, key, k)
    total = columns.sum(axis=0)
    gradient = _gradient(number.of, total)
    if not np.isfinite(gradient).all():
        return None
    own = columns @ gradient
    counted = np.abs(columns[:, 1])  # of each functional the second sum counts
    shared = own + _halves(sums, total, gradient, key) if k is None and number.agreement else own
    places, row = np.unique(sums.cell[counted > 0].astype(np.int64), axis=0, return_inverse=True)
    frames, column = np.unique(sums.frame[counted > 0].astype(np.int64), return_inverse=True)
    if len(places) < 2:
        return None
    block, cell, size = (
        np.zeros(len(places)),
        np.zeros((len(places), len(frames))),
        np.zeros((len(places), len(frames))),
    )
    np.add.at(block, row.ravel(), own[counted > 0])
    np.add.at(cell, (row.ravel(), column), shared[counted > 0])
    np.add.at(size, (row.ravel(), column), counted[counted > 0])
    return _Grid(places, frames, block, cell, size, sums.edge, sums.step)


def _halves(sums: InfluenceSums, total: Float64, gradient: Float64, key: str) -> Float64:
    """What is added where two frames saw a place: both are then held for all of its agreement, not for half each."""
    share = 0.5 if key == "psa" else 1.0
    mean = total[0] / total[1]
    added: Float64 = gradient[0] * share * (sums["twice_agreeing"] - mean * sums["twice"])[:, 0]
    return added


def _gradient(of: object, total: Float64) -> Float64:
    """Central differences (C,) of a functional at sums (C,)."""
    steps = np.diag(1e-5 * np.maximum(np.abs(total), ZERO))
    width = np.diagonal(steps)
    gradient: Float64 = (of(total + steps) - of(total - steps)) / (2 * width)  # type: ignore[operator]
    return np.where(total == 0, 0.0, gradient)


# --- Variance ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _TwoWay:
    """The variance that comes from places, and what frames add to it."""

    places: Spread
    frames: Spread

    @property
    def total(self) -> float:
        """Of both."""
        return self.places.variance + self.frames.variance

    @property
    def degrees(self) -> float:
        """Of the sum (Satterthwaite 1946)."""
        parts = (self.places, self.frames)
        spread = sum(part.variance**2 / part.degrees for part in parts if part.variance > 0)
        return max(self.total**2 / spread, 1.0) if spread else self.places.degrees

    def half(self, level: float) -> float:
        """Half the width of the interval."""
        if not self.degrees > 0:
            return math.nan
        return float(stats.t.ppf((1 + level) / 2, self.degrees)) * math.sqrt(self.total)


NO_FRAMES = Spread(0.0, math.inf, 1.0)


def _two_way(grid: _Grid, question: Question) -> _TwoWay:
    """V_frame + V_block - V_cell (Cameron, Gelbach, Miller 2011): pairs that share a frame or a block count once."""
    places = arrangement(grid.places)
    by_place = places.spread(grid.block, grid.size.sum(axis=1))
    if question == THIS_MAP or len(grid.frames) < 2:
        return _TwoWay(by_place, NO_FRAMES)
    return _TwoWay(by_place, _beyond_places(grid, places, by_place))


def _beyond_places(grid: _Grid, places: Arrangement, by_place: Spread) -> Spread:
    """What frames add: the influences that one frame, and those near it, have in places far from each other."""
    frames = arrangement(grid.frames[:, None])
    by_frame = frames.spread(grid.cell.sum(axis=0), grid.size.sum(axis=0))
    if not by_frame.variance > 0:
        return NO_FRAMES
    influence = grid.cell.sum(axis=0)
    kernel = frames.kernel(by_frame.block)
    plain = float(influence @ kernel @ influence)
    inside = float((kernel * (grid.cell.T @ places.kernel(by_place.block) @ grid.cell)).sum())
    return dataclasses.replace(by_frame, variance=by_frame.variance * max(1 - inside / plain, 0.0))


def _apart(one: _Grid, other: _Grid, question: Question) -> _TwoWay:
    """Of two flights over the same places: each adds the variance of its own frames."""
    both = _two_way(one.minus(other), THIS_MAP)
    if question == THIS_MAP:
        return both
    added = [_two_way(grid, question).frames for grid in (one, other)]
    joined = _TwoWay(*added)
    return _TwoWay(both.places, Spread(joined.total, joined.degrees, added[0].block))


# --- Ends -------------------------------------------------------------------------------------------------------------


def _share_ends(p: float, spread: _TwoWay, units: int, level: float) -> tuple[float, float]:
    """Of a share, or of a mean of numbers from 0 to 1, by the looks that it is worth (Korn and Graubard 1998)."""
    if math.isnan(p) or not spread.degrees > 0:
        return math.nan, math.nan
    p = min(max(p, 0.0), 1.0)
    looks: float = units
    if spread.total > ZERO and 0 < p < 1:
        quantile = stats.t.ppf((1 + level) / 2, [max(units - 1, 1), spread.degrees])
        looks = p * (1 - p) / spread.total * (quantile[0] / quantile[1]) ** 2
    tail, hits = (1 - level) / 2, looks * p
    low = stats.beta.ppf(tail, hits, looks - hits + 1) if hits > 0 else 0.0
    high = stats.beta.ppf(1 - tail, hits + 1, looks - hits) if hits < looks else 1.0
    return float(low), float(high)


def _alpha_ends(alpha: float, spread: _TwoWay, units: int, chance: float, level: float) -> tuple[float, float]:
    """On the scale log(1 - alpha), so that neither end passes 1; without any disagreement as many as a share has."""
    if math.isnan(alpha) or not spread.degrees > 0:
        return math.nan, math.nan
    if 1 - alpha <= ZERO or spread.total <= ZERO:
        return max(-1.0, alpha - _share_ends(0.0, spread, units, level)[1] / chance), alpha
    ratio = min(spread.half(level) / (1 - alpha), 30.0)
    return max(-1.0, 1 - (1 - alpha) * math.exp(ratio)), 1 - (1 - alpha) * math.exp(-ratio)


def _chance(sums: InfluenceSums, k: int | None) -> float:
    """The disagreement that chance alone gives: what 1 - alpha is a share of."""
    if k is not None:
        _, n, total, squares = columns_of(sums, "alpha", k).sum(axis=0)
        return float(2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1)))
    _, n, own, *evidence = columns_of(sums, "alpha").sum(axis=0)
    return float(1 - (np.square(evidence).sum() - own) / (n * (n - 1)))


def _interval(found: float, low: float, high: float, grid: _Grid, spread: _TwoWay, question: Question) -> Interval:
    frames = len(grid.frames) * grid.step
    reasons = [AS_FAR] if not spread.places.degrees >= LEAST_DEGREES else []
    if question == NEXT_FLIGHT and frames < LEAST_FRAMES:
        reasons.append(TOO_FEW.format(least=LEAST_FRAMES))
    return Interval(
        found,
        low,
        high,
        question=question,
        frames=frames,
        places=len(grid.places),
        block_size=spread.places.block * grid.edge,
        degrees=spread.degrees,
        undecided="; ".join(reasons),
    )
