"""The variance of a number over new frames and new locations, by a model of random effects.

The influences x_gf on a number, from frame f at location g, are a sum over n_gf observations of a location's
effect, a frame's effect and noise:

    x_gf = n_gf (l_g + q_f) + e_gf,    var e_gf = s^2 n_gf

Effects of frames d apart correlate by rho^d; effects of locations d apart by exp(-d / reach). The same scene flown
again has the same l and new q and e; other scenes have new l, q and e. The size and reach of effects are not
decided: the variance is a mean over a grid of both, weighted by the restricted likelihood (Harville 1977, Journal of
the American Statistical Association 72).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from threadpoolctl import ThreadpoolController

from semstab.core.types import THESE_FRAMES, THIS_SCENE, Float64, Int64, Scope
from semstab.statistics.cluster_sums import ClusterIndex, Statistic

LASTING = {0.0: 4.0, 0.8: 1.0}
"""Correlations rho of the effects of successive frames, and their weights before the data."""

REACHES = {0.0: 4.0, 0.08: 1.0}
"""Correlation lengths of the effects of locations, as a share of the scene's extent, and their weights before the data:
an effect that reaches as far as the scene cannot be separated from none."""

SIZES = 7
"""Variances of an effect that are tried, evenly spaced in their logarithm: more of them, or more correlations, cover no
better (docs/validity.md)."""

SMALLEST, UNLIKELY = 1e-4, 0.01
"""The smallest of them, as a share of the variance that was seen; the largest would show so little with this
probability."""

MOST_LOCATIONS = 64
"""Most locations of a model: neighbouring cubes are taken together."""

TINY = 1e-12
"""A smaller variance counts as 0."""

ROUNDING = 1e-13
"""Smaller influences come from rounding."""


@dataclass(frozen=True)
class Spread:
    """The variance of a number, and the degrees of freedom of the t distribution of its error."""

    variance: float
    degrees: float

    def half(self, level: float) -> float:
        """Return half the width of the confidence interval; NaN if it is unknown."""
        from scipy import special

        if not self.degrees > 0:
            return math.nan
        return float(special.stdtrit(self.degrees, (1 + level) / 2)) * math.sqrt(self.variance)

    def p_value(self, value: float) -> float:
        """Return the two-sided p-value of a number that is 0 without an effect; NaN without a variance."""
        from scipy import special

        if not self.variance > TINY:
            return math.nan
        return float(2 * special.stdtr(self.degrees, -abs(value) / math.sqrt(self.variance)))


EXACT = Spread(0.0, math.inf)


@dataclass(frozen=True, eq=False)
class Variances:
    """Possible variances (m,), and the probability of each (m,)."""

    weight: Float64
    variance: Float64

    def plus(self, other: Variances) -> Variances:
        """Return the variances of a sum of independent errors."""
        weight = np.outer(self.weight, other.weight).ravel()
        return Variances(weight, np.add.outer(self.variance, other.variance).ravel())

    def spread(self) -> Spread:
        """Return the t distribution that a mean over normal ones of these variances comes to.

        Degrees follow from how well the logarithm of the variance is known: of d degrees its variance is about
        2 / (d - 1), and its mean is log(d / 2) - psi(d / 2) above that of the t distribution's scale.
        """
        from scipy import special

        logs = np.log(self.variance)
        mean = float(self.weight @ logs)
        doubt = float(self.weight @ (logs - mean) ** 2)
        degrees = 2 / doubt + 1 if doubt > 0 else math.inf
        shift = special.psi(degrees / 2) - math.log(degrees / 2) if degrees < 1e6 else 0.0
        return Spread(math.exp(mean + float(shift)), degrees)


NOTHING = Variances(np.ones(1), np.zeros(1))


def variances(
    effect: Float64, weight: Float64, noise: Float64, distance: Float64, ranges: Mapping[float, float]
) -> Variances:
    """Return the possible variances of sum(weight * effect) if the effects (n,) are drawn again.

    Args:
        effect: (n,) estimated effects.
        weight: (n,) their weights.
        noise: (n, n) covariance of the errors of `effect`.
        distance: (n, n) between the effects, whose correlation is exp(-distance / range); range 0: independent.
        ranges: Correlation lengths that are tried, and their weights before the data.
    """
    n, spread = len(effect), effect.var()
    if n < 2 or not spread > 0:
        return NOTHING
    contrasts = _contrasts(n)
    error = contrasts.T @ noise @ contrasts + 1e-9 * spread * np.eye(n - 1)
    whiten = np.linalg.inv(np.linalg.cholesky(error)) @ contrasts.T
    whitened, sizes = whiten @ effect, spread * n / (n - 1) * _sizes(n)
    logs, result = [], []
    for reach, prior in ranges.items():
        alike = np.exp(-distance / reach) if reach > 0 else np.eye(n)
        eigenvalues, vectors = np.linalg.eigh(whiten @ alike @ whiten.T)
        total = 1 + np.outer(sizes, np.maximum(eigenvalues, 0.0))
        logs.append(math.log(prior) - 0.5 * (np.log(total) + (vectors.T @ whitened) ** 2 / total).sum(axis=1))
        result.append(sizes * (weight @ alike @ weight))
    log = np.concatenate(logs)
    likely = np.exp(log - log.max())
    return Variances(likely / likely.sum(), np.concatenate(result))


# --- Influences -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Influences:
    """Influences of locations and frames on a number.

    Attributes:
        cubes: (G, 3) cubes in which something counts, frames (F,) groups.
        block: (G,) influence of each cube; they sum to 0.
        cell: (G, F) influence of each group of frames in each cube.
        size: (G, F) amount that counts there, all (G,) the amount in each cube.
        one_off: Amount by which the number falls if everything that counts were the opposite of the first sum.
    """

    cubes: Int64
    frames: Int64
    block: Float64
    cell: Float64
    size: Float64
    all: Float64
    edge: float
    per_group: float
    one_off: float

    def unseen(self, level: float) -> float:
        """Return the part of the number that locations without a single error may have missed."""
        return self.one_off * float(1 - ((1 - level) / 2) ** (1 / len(self.cubes)))

    def times(self, factor: float) -> Influences:
        """Return the influences on a multiple of the number."""
        scaled = {name: factor * getattr(self, name) for name in ("block", "cell")}
        return dataclasses.replace(self, **scaled, one_off=abs(factor) * self.one_off)

    def minus(self, other: Influences) -> Influences:
        """Return the influences on the difference of two numbers."""
        return self.plus(other.times(-1.0))

    def plus(self, other: Influences) -> Influences:
        """Return the influences on the sum of two numbers."""
        locations, rows = np.unique(np.concatenate([self.cubes, other.cubes]), axis=0, return_inverse=True)
        frames, columns = np.unique(np.concatenate([self.frames, other.frames]), return_inverse=True)
        block, everything = np.zeros(len(locations)), np.zeros(len(locations))
        cell, size = np.zeros((len(locations), len(frames))), np.zeros((len(locations), len(frames)))
        row, column = np.split(rows.ravel(), [len(self.cubes)]), np.split(columns, [len(self.frames)])
        for grid, at, to in zip((self, other), row, column, strict=True):
            block[at] += grid.block
            everything[at] += grid.all
            cell[np.ix_(at, to)] += grid.cell
            size[np.ix_(at, to)] += grid.size
        one_off = max(self.one_off, other.one_off)
        return Influences(locations, frames, block, cell, size, everything, self.edge, self.per_group, one_off)


def influences(
    index: ClusterIndex, columns: Float64, of: Statistic, halves: Float64 | None = None
) -> Influences | None:
    """Return the influences of sums (m, C) by cube and group of frames; None if all is in one cube.

    halves (m, 2) are the parts of the first two sums, at locations that two frames saw, that count for both frames
    instead of half for each.
    """
    total = columns.sum(axis=0)
    gradient = gradient_of(of, total)
    everything = np.abs(index.by_cube(columns[:, 1]))
    occupied = everything > TINY * everything.sum()
    if occupied.sum() < 2 or everything.sum() < TINY or not np.isfinite(gradient).all():
        return None  # with 150 classes hardly any voxel may count as consistent: 1e-112 of all of them
    influence: Float64 = columns @ gradient
    shared = (
        influence if halves is None else influence + gradient[0] * (halves[:, 0] - total[0] / total[1] * halves[:, 1])
    )
    by_frame, size = index.by_both(shared), index.by_both(np.abs(columns[:, 1]))
    occupied_frames = size.sum(axis=0) > 0
    return Influences(
        index.cubes[occupied],
        index.frames[occupied_frames],
        index.by_cube(influence)[occupied],
        by_frame[np.ix_(occupied, occupied_frames)],
        size[np.ix_(occupied, occupied_frames)],
        everything[occupied],
        index.edge,
        index.per_group,
        one_off=abs(float(gradient[0] * total[1])),
    )


# --- The model of a number --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Effects:
    """The model of a number's influences.

    Attributes:
        noise: The variance from noise; unit is that of a single observation.
        frame: (F,) effects of the frames, error (F, F) the covariance of their errors; None if frames are unknown.
    """

    grid: Influences
    noise: float
    unit: float
    frame: Float64 | None
    error: Float64 | None

    @classmethod
    def from_influences(cls, grid: Influences) -> Effects:
        """Fit the model to influences."""
        occupied = grid.size.sum(axis=1) > 0
        cell, size = grid.cell[occupied], grid.size[occupied]
        by_location, by_frame = size.sum(axis=1), size.sum(axis=0)
        if grid.per_group == 0 or len(by_frame) < 2 or len(by_location) < 2:
            return cls(grid, 0.0, 0.0, None, None)
        normal = np.diag(by_frame) - size.T @ (size / by_location[:, None])
        right = cell.sum(axis=0) - size.T @ (cell.sum(axis=1) / by_location)
        frame = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right
        location = (cell.sum(axis=1) - size @ frame) / by_location
        residual = cell - size * np.add.outer(location, frame)
        cells, total = int(np.count_nonzero(size)), float(by_location.sum())
        degrees_of_freedom = max(cells - len(by_location) - len(by_frame) + 1, 1)
        unit = float((residual**2 / np.where(size > 0, size, 1.0)).sum()) / degrees_of_freedom
        mean = by_location @ location / total
        scatter = float(by_location @ (location - mean) ** 2) / total - unit * len(by_location) / total
        shrink = unit / max(scatter, 1e-3 * unit / float(np.median(by_location)), TINY * TINY)
        ridge = size / (by_location + shrink)[:, None]  # locations as random effects: differences of frames stay
        normal = np.diag(by_frame * (1 + 1e-9)) - size.T @ ridge
        frame = np.linalg.solve(normal, cell.sum(axis=0) - ridge.T @ cell.sum(axis=1))
        error: Float64 = unit * np.linalg.inv(normal).astype(np.float64)
        return cls(grid, float((residual**2).sum()) * cells / degrees_of_freedom, unit, frame, error)

    @functools.cached_property
    def frames(self) -> Variances:
        """The variances over new frames."""
        if self.frame is None or self.error is None:
            return NOTHING
        weight = self.grid.size.sum(axis=0)
        return _of_frames(self.frame, weight, self.error, self.grid.frames.astype(np.float64))

    @functools.cached_property
    def locations(self) -> Variances:
        """The variances over new locations."""
        of, weight, apart, extent = _locations(self.grid.cubes, self.grid.all)
        effect = np.bincount(of, weights=self.grid.block)
        return variances(
            effect / weight,
            weight,
            np.diag(self.unit / weight),
            apart,
            {length * extent: prior for length, prior in REACHES.items()},
        )


@functools.lru_cache(maxsize=64)
def _contrasts(n: int) -> Float64:
    """Return (n, n - 1) orthonormal contrasts of n effects."""
    contrasts: Float64 = np.linalg.svd(np.eye(n) - 1 / n)[0][:, : n - 1]
    contrasts.setflags(write=False)
    return contrasts


@functools.lru_cache(maxsize=64)
def _sizes(n: int) -> Float64:
    """Return the variances (SIZES,) of n effects that are tried, as shares of the variance that was seen."""
    from scipy import special

    sizes: Float64 = np.geomspace(SMALLEST, (n - 1) / special.chdtri(n - 1, 1 - UNLIKELY), SIZES)
    sizes.setflags(write=False)
    return sizes


def _of_frames(effect: Float64, weight: Float64, noise: Float64, at: Float64) -> Variances:
    """Return the variances over new frames; `at` (F,) is when they were taken, ascending."""
    step = float(np.median(np.diff(at)))  # effects last for a number of fused frames
    ranges = {-step / math.log(rho) if rho > 0 else 0.0: prior for rho, prior in LASTING.items()}
    return variances(effect, weight, noise, np.abs(np.subtract.outer(at, at)), ranges)


Locations = tuple[Int64, Float64, Float64, float]


def _locations(cubes: Int64, amount: Float64) -> Locations:
    """Return the locations of a model, of cubes (G, 3) that each hold an amount (G,).

    These are the location (G,) of each cube, the amount (n,) in each location, the distance (n, n) between locations
    and the extent of all, in edges of a cube.
    """
    return _located(np.ascontiguousarray(cubes, np.int64).tobytes(), np.ascontiguousarray(amount, np.float64).tobytes())


@functools.lru_cache(maxsize=16)
def _located(cubes: bytes, amount: bytes) -> Locations:
    """Return the locations of cubes: most numbers of a map count the same in the same ones."""
    points, of, amounts = _points(cubes), _halved(cubes, MOST_LOCATIONS), np.frombuffer(amount)
    weight: Float64 = np.bincount(of, weights=amounts).astype(np.float64)
    at = np.stack([np.bincount(of, weights=amounts * axis) / weight for axis in points.T], axis=1)
    apart: Float64 = np.linalg.norm(at[:, None] - at[None], axis=2)
    centre = weight @ at / weight.sum()
    extent = 2 * math.sqrt(float(weight @ ((at - centre) ** 2).sum(axis=1)) / float(weight.sum()))
    for array in (weight, apart):
        array.setflags(write=False)
    return of, weight, apart, extent


def _points(cubes: bytes) -> Float64:
    return np.frombuffer(cubes, np.int64).reshape(-1, 3).astype(np.float64)


@functools.lru_cache(maxsize=16)
def _halved(cubes: bytes, most: int) -> Int64:
    """Return the group (G,) of cubes (G, 3), in at most `most` groups of neighbours: halves of halves."""
    points = _points(cubes)
    groups = [np.arange(len(points))]
    while 2 * len(groups) <= most and len(groups) < len(points):
        halves = []
        for group in groups:
            along = int(np.ptp(points[group], axis=0).argmax())
            order = group[np.argsort(points[group, along], kind="stable")]
            middle = (len(order) + 1) // 2
            halves += [half for half in (order[:middle], order[middle:]) if len(half)]
        groups = halves
    of = np.empty(len(points), np.int64)
    for number, group in enumerate(groups):
        of[group] = number
    of.setflags(write=False)
    return of


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS has one thread: matrices are so small that a second one only waits."""
    limited: AbstractContextManager[object] = _blas().limit(limits=1, user_api="blas")
    return limited


def spread_of(grid: Influences, scope: Scope) -> Spread:
    """Return the spread of a number: for these frames, this scene flown again, or other scenes."""
    largest = float(np.abs(grid.block).max(initial=np.abs(grid.cell).max(initial=0.0)))
    if largest < ROUNDING:
        return EXACT
    effects = Effects.from_influences(grid)
    noise = Variances(np.ones(1), np.array([effects.noise]))
    if scope == THESE_FRAMES:
        parts = effects.locations.plus(noise)
    elif scope == THIS_SCENE:
        parts = effects.frames.plus(noise)
    else:
        parts = effects.frames.plus(effects.locations).plus(noise)
    return parts.spread() if (parts.variance > 0).all() else EXACT


def spread_of_flights(one: Influences, other: Influences, between: Influences, scope: Scope) -> Spread:
    """Return the spread of the difference of two flights over the same locations, each with frames of its own."""
    if scope == THESE_FRAMES:
        return spread_of(between, scope)
    effects = [Effects.from_influences(one), Effects.from_influences(other)]
    noise = effects[0].noise + effects[1].noise
    parts = effects[0].frames.plus(effects[1].frames).plus(Variances(np.ones(1), np.array([noise])))
    if scope != THIS_SCENE:
        parts = parts.plus(Effects.from_influences(between).locations)
    return parts.spread() if (parts.variance > 0).all() else EXACT


def spread_of_frames(effect: Float64, weight: Float64, at: Float64) -> Spread:
    """Return the spread of sum(weight * effect) of a series (F,) over frames taken at times (F,), ascending."""
    parts = _of_frames(effect, weight, np.zeros((len(effect),) * 2), at)
    return parts.spread() if (parts.variance > 0).all() else EXACT


# --- Gradients --------------------------------------------------------------------------------------------------------

STEP = 1e-20
"""Step of a sum into the complex plane: its square is negligible against 1."""

AT_ONCE = 2**20
"""Most numbers in the sums of one evaluation: all sums of 20,000 classes would take 3 GB."""


def slope(statistic: Statistic, totals: Float64, direction: Float64) -> Float64:
    """Return the derivative (...,) of a statistic at totals (..., C) along a direction (..., C).

    The derivative is NaN if the statistic is undefined.

    It is a step into the complex plane, which takes no difference and so loses no digit (Squire and Trapp 1998, SIAM
    Review 40).
    """
    with np.errstate(all="ignore"):  # complex numbers warn of NaN, real numbers do not
        value = statistic(totals + STEP * 1j * direction)
    derivative: Float64 = np.where(np.isnan(value.real), np.nan, value.imag / STEP)
    return derivative


def gradient_of(statistic: Statistic, total: Float64) -> Float64:
    """Return the gradient (C,) of a statistic at sums (C,), 0 for sums that are 0."""
    gradient = np.zeros_like(total)
    nonzero = np.flatnonzero(total)
    for at in np.array_split(nonzero, len(nonzero) * len(total) // AT_ONCE + 1):
        scale = np.maximum(np.abs(total[at]), TINY)
        along = np.zeros((len(at), len(total)))
        along[np.arange(len(at)), at] = scale
        gradient[at] = slope(statistic, total, along) / scale
    return gradient
