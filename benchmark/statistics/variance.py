"""The influences of places and frames on a number, and the variance that they make together."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from threadpoolctl import ThreadpoolController

from semstab.core.types import Float64, Int64
from semstab.model.statistics import THIS_MAP, Question
from semstab.statistics.cluster_sums import ClusterIndex, Statistic
from semstab.statistics.correlation import GROWTH, REACHES, ClusterGrid, CorrelationModel, cluster_grids

# The variance of a sum over places, or over frames, that err alike where they are near each other.
#
# How far errors reach is found by likelihood, and what is found is a weight of each reach, not one of them. Under each,
# pairs within four times the reach count, by a kernel that is the mean of all shifted grids of blocks; and what the
# kernel misses, where blocks are few or errors reach far, is put back.

DOUBT = 4.0
"""By how much the log likelihood must be better for a share of a cell's variance that it has for itself: a weak
correlation that reaches far is seldom real, and leaves hardly anything to say."""

FAR = 0.5
"""Of places, a reach counts with this power of its length besides: one that is found too short does more harm."""

UNLIKELY = 1e-3
"""A reach of a smaller weight does not count."""

ROUNDING = 1e-13
"""Influences below are rounding's."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Influences (n,) of cells on a sum, which are centred, and how much is in each cell (n,)."""

    cells: ClusterGrid
    influence: Float64
    size: Float64

    @property
    def told(self) -> bool:
        """Whether there is anything to tell of."""
        return len(self.cells) > 1 and bool(np.abs(self.influence).max() >= ROUNDING)


@dataclass(frozen=True, eq=False)
class Parts:
    """The variance of a sum as it is under each of the reaches (m,): weights, degrees of freedom, blocks, in cells.

    alike  how much larger than that of independent cells
    """

    weight: Float64
    variance: Float64
    degrees: Float64
    block: Float64
    alike: Float64

    def times(self, factor: Float64) -> Parts:
        """With variances so many times as large."""
        return Parts(self.weight, self.variance * factor, self.degrees, self.block, self.alike)


NONE = Parts(*(np.zeros(0) for _ in range(5)))


@dataclass(frozen=True, eq=False)
class VarianceEstimate:
    """The variance of a sum, the degrees of freedom of that number, and the likeliest block, in cells.

    parts  what it is the mean of
    """

    variance: float
    degrees: float
    block: float
    parts: Parts = NONE

    @classmethod
    def mean(cls, parts: Parts) -> VarianceEstimate:
        """The mean of the variances; degrees say how well its logarithm is known, with the doubt about the reach.

        The variance of the logarithm of an estimate of d degrees is about 2 / d; to it is added how far the logarithms
        of the parts lie apart (as in a mean over models: Hoeting et al. 1999, Statistical Science 14).
        """
        if not len(parts.weight):
            return cls(math.nan, 0.0, 1.0)
        block = float(parts.block[parts.weight.argmax()])
        found = float(parts.weight @ parts.variance)
        if not found > 0:
            return cls(0.0, math.inf, block, parts)
        logs = np.log(np.maximum(parts.variance, 1e-3 * found))
        doubt = 2 / parts.degrees + (logs - parts.weight @ logs) ** 2
        return cls(found, 2 / float(parts.weight @ doubt), block, parts)

    def with_fewer(self, degrees: float) -> float:
        """The weight of the parts that have fewer degrees of freedom."""
        return float(self.parts.weight[self.parts.degrees < degrees].sum())

    def with_more_alike(self, times: float) -> float:
        """The weight of the parts whose variance is more than so many times that of independent cells."""
        return float(self.parts.weight[self.parts.alike > times].sum())


def variance_estimates(errors: Sequence[Residuals], *, modelled: bool = False) -> list[VarianceEstimate]:
    """Of the sums over cells of several errors.

    modelled  as the correlation has it, instead of by a kernel: where there are too few blocks for one
    """
    found = [
        VarianceEstimate(0.0, len(own.cells) - 1.0, 1.0) if len(own.cells) > 1 else VarianceEstimate.mean(NONE)
        for own in errors
    ]
    for arrangement in {id(own.cells.of): own.cells.of for own in errors}.values():
        some = [k for k, own in enumerate(errors) if own.told and own.cells.of is arrangement]
        if some:
            together = _Together(arrangement, [errors[k] for k in some])
            parts = together.modelled() if modelled else together.by_kernel()
            for k, own in zip(some, parts, strict=True):
                found[k] = VarianceEstimate.mean(own)
    return found


def longest_correlation(errors: Residuals, level: float) -> float:
    """The reach, in cells, that errors exceed with no more than the weight 1 - level; 0 where they do not reach."""
    if not errors.told:
        return 0.0
    arrangement = errors.cells.of
    with one_thread():
        weight, reach = _Together(arrangement, [errors]).weight[:, 0], arrangement.reach[arrangement.number]
    some = np.flatnonzero(weight)  # alternatives are in the order of their reaches
    at = int(np.searchsorted(np.cumsum(weight[some]), level))
    return float(reach[some[min(at, len(some) - 1)]])


class _Together:
    """Errors (N,) of cells of one arrangement; matrices have zeros where cells are not theirs.

    weight   (A, N) of each alternative
    scatter  (A, N) the variance of a cell of size 1 under it
    """

    def __init__(self, arrangement: CorrelationModel, errors: Sequence[Residuals]) -> None:
        self._of = arrangement
        self._count = np.array([len(own.cells) for own in errors])
        shape = len(errors), len(arrangement.at)
        self._influence, self._size = np.zeros(shape), np.zeros(shape)
        for k, own in enumerate(errors):
            self._influence[k, : len(own.cells)] = own.influence[own.cells.order]
            self._size[k, : len(own.cells)] = own.size[own.cells.order]
        self._scale = self._size**GROWTH
        self.weight, self.scatter = self._likely()

    def _likely(self) -> tuple[Float64, Float64]:
        """How likely each alternative is (REML)."""
        of, there = self._of, self._size > 0
        seen = np.divide(self._influence, self._scale, out=np.zeros_like(self._scale), where=there)
        mean = np.divide(self._size, self._scale, out=np.zeros_like(self._scale), where=there)
        white = of.whitened(np.concatenate([seen, mean])).reshape(len(of.number), 2, *there.shape) * there
        a, b = white[:, 0], white[:, 1]
        within = (b * b).sum(axis=2)
        left = (a * a).sum(axis=2) - (a * b).sum(axis=2) ** 2 / within
        reach = of.reach[of.number]
        far = np.maximum([of.far(count) for count in self._count], REACHES[0])
        some = (left > 0) & (reach[:, None] <= far)
        log = of.logarithms(self._count) + np.log(within) + (self._count - 1) * np.log(np.where(some, left, 1.0))
        before = np.where(of.alone > 0, -DOUBT, 0.0)
        if of.at.shape[1] > 1:
            before += FAR * np.log(np.maximum(reach, REACHES[0]))
        likely = np.where(some, before[:, None] - 0.5 * log, -math.inf)
        weight = np.exp(likely - np.maximum(likely.max(axis=0), -1e300))
        weight[weight < UNLIKELY * weight.sum(axis=0)] = 0.0
        return weight / np.maximum(weight.sum(axis=0), 1.0), left / (self._count - 1)

    def by_kernel(self) -> list[Parts]:
        """What the variances are under each reach that is not unlikely, by its kernel."""
        block = self._of.blocks[self._of.number]
        plain = np.zeros_like(self.weight)
        for edge in set(block[self.weight.any(axis=1)].tolist()):
            plain[block == edge] = ((self._influence @ self._of.kernel(edge)) * self._influence).sum(axis=1)
        return [self._by_kernel(k, plain[:, k]) for k in range(len(self._count))]

    def _by_kernel(self, k: int, plain: Float64) -> Parts:
        of, some, size = self._of, np.flatnonzero((self.weight[:, k] > 0) & (plain > 0)), self._size[k]
        total, expected, square = of.moments(of.number[some], size[: self._count[k]]).at(of.alone[some])
        there = expected > 0
        some, total, expected, square = some[there], total[there], expected[there], square[there]
        weight, degrees = self.weight[some, k], np.minimum(expected**2 / square, carriers(self._influence[k]))
        variance = plain[some] * total / expected
        return Parts(weight / weight.sum(), variance, degrees, of.blocks[of.number[some]], np.ones(len(some)))

    def modelled(self) -> list[Parts]:
        """The same as the correlations have it."""
        of, alone = self._of, (self._scale**2).sum(axis=1)
        alike = ((of.correlations @ self._scale.T) * self._scale.T).sum(axis=1)[of.number]
        share = of.alone[:, None]
        total = (1 - share) * alike + share * alone
        most = [min(count - 1.0, carriers(own)) for count, own in zip(self._count, self._influence, strict=True)]
        parts = []
        for k, degrees in enumerate(most):
            some = np.flatnonzero(self.weight[:, k])
            variance, block = self.scatter[some, k] * total[some, k], of.blocks[of.number[some]]
            parts.append(
                Parts(self.weight[some, k], variance, np.full(len(some), degrees), block, total[some, k] / alone[k])
            )
        return parts


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """Matrices are so small that a second thread only waits, the longer the busier the machine is."""
    limited: AbstractContextManager[object] = _blas().limit(limits=1, user_api="blas")
    return limited


def carriers(influence: Float64) -> float:
    """How many cells carry the variance, less one: all of them where influences are normal, 2 where one is all."""
    fourth = float((influence**4).sum())
    return 3 * float((influence**2).sum()) ** 2 / fourth - 1 if fourth > 0 else math.inf


TINY = 1e-12
"""A variance below is none."""

# --- Influences -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Influences:
    """Influences of places and frames on a number.

    places   (G, 3) cubes in which something counts, frames (F,) groups
    block    (G,) influence of each cube; they sum to 0
    cell     (G, F) of each group of frames in each cube
    size     (G, F) how much is in it, all (G,) in each cube
    one_off  what the number falls by where all that counts was not as the first sum has it, but the opposite
    """

    places: Int64
    frames: Int64
    block: Float64
    cell: Float64
    size: Float64
    all: Float64
    edge: float
    step: int
    one_off: float

    def units(self, question: Question) -> int:
        """How many independent looks there can be."""
        return len(self.places) if question == THIS_MAP else min(len(self.places), len(self.frames) * self.step)

    def unseen(self, question: Question, level: float) -> float:
        """What so many looks without a single error may have missed."""
        return self.one_off * float(1 - ((1 - level) / 2) ** (1 / self.units(question)))

    def minus(self, other: Influences) -> Influences:
        """The influences on the difference of two numbers."""
        places, rows = np.unique(np.concatenate([self.places, other.places]), axis=0, return_inverse=True)
        frames, columns = np.unique(np.concatenate([self.frames, other.frames]), return_inverse=True)
        block, everything = np.zeros(len(places)), np.zeros(len(places))
        cell, size = np.zeros((len(places), len(frames))), np.zeros((len(places), len(frames)))
        row, column = np.split(rows.ravel(), [len(self.places)]), np.split(columns, [len(self.frames)])
        for grid, sign, at, to in zip((self, other), (1.0, -1.0), row, column, strict=True):
            block[at] += sign * grid.block
            everything[at] += grid.all
            cell[np.ix_(at, to)] += sign * grid.cell
            size[np.ix_(at, to)] += grid.size
        return Influences(
            places, frames, block, cell, size, everything, self.edge, self.step, max(self.one_off, other.one_off)
        )


def influences(
    where: ClusterIndex, columns: Float64, of: Statistic, halves: Float64 | None = None
) -> Influences | None:
    """The influences of sums (m, C) by cube and group of frames.

    halves (m, 2): of places that two frames saw, what of the first two sums both are held for, instead of half each.
    """
    total = columns.sum(axis=0)
    gradient = gradient_of(of, total)
    everything = np.abs(where.by_place(columns[:, 1]))
    some = everything > TINY * everything.sum()
    if some.sum() < 2 or everything.sum() < TINY or not np.isfinite(gradient).all():
        return None  # of 150 classes hardly any voxel may count as stable: 1e-112 of all of them
    own: Float64 = columns @ gradient
    shared = own if halves is None else own + gradient[0] * (halves[:, 0] - total[0] / total[1] * halves[:, 1])
    by_frame, size = where.by_both(shared), where.by_both(np.abs(columns[:, 1]))
    seen = size.sum(axis=0) > 0
    return Influences(
        where.places[some],
        where.frames[seen],
        where.by_place(own)[some],
        by_frame[np.ix_(some, seen)],
        size[np.ix_(some, seen)],
        everything[some],
        where.edge,
        where.step,
        one_off=abs(float(gradient[0] * total[1])),
    )


# --- Variance ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwoWay:
    """The variance that comes from places, and what frames add to it.

    most  degrees of freedom that it has at most
    """

    places: VarianceEstimate
    frames: VarianceEstimate
    most: float = math.inf

    @property
    def total(self) -> float:
        """Of both."""
        return self.places.variance + self.frames.variance

    @property
    def degrees(self) -> float:
        """Of the sum (Satterthwaite 1946)."""
        parts = (self.places, self.frames)
        spread = sum(part.variance**2 / part.degrees for part in parts if part.variance > 0)
        return min(max(self.total**2 / spread, 1.0) if spread else self.places.degrees, self.most)

    def half(self, level: float) -> float:
        """Half the width of the interval."""
        from scipy import special

        if not self.degrees > 0:
            return math.nan
        return float(special.stdtrit(self.degrees, (1 + level) / 2)) * math.sqrt(self.total)


NO_FRAMES = VarianceEstimate(0.0, math.inf, 1.0)


def two_way(grids: Sequence[Influences], questions: Sequence[Question]) -> list[TwoWay]:
    """V_frame + V_block - V_cell (Cameron, Gelbach, Miller 2011): pairs that share a frame or a block count once."""
    cells = cluster_grids([grid.places for grid in grids])
    errors = [Residuals(at, grid.block, grid.all) for at, grid in zip(cells, grids, strict=True)]
    with one_thread():
        found = [TwoWay(own, NO_FRAMES) for own in variance_estimates(errors)]
        of_flight = [k for k, grid in enumerate(grids) if questions[k] != THIS_MAP and len(grid.frames) > 1]
        beyond = _beyond_places([(grids[k], cells[k], found[k].places) for k in of_flight])
    for k, frames in zip(of_flight, beyond, strict=True):
        found[k] = TwoWay(found[k].places, frames)
    return found


def _beyond_places(grids: Sequence[tuple[Influences, ClusterGrid, VarianceEstimate]]) -> list[VarianceEstimate]:
    """What frames add: the influences that one frame, and those near it, have in places far from each other."""
    errors = []
    for cells, (grid, _, _) in zip(cluster_grids([grid.frames[:, None] for grid, _, _ in grids]), grids, strict=True):
        influence, size = grid.cell.sum(axis=0), grid.size.sum(axis=0)
        influence = influence - size / size.sum() * influence.sum()  # of a sample they do not sum to 0
        errors.append(Residuals(cells, influence, size))
    found = variance_estimates(errors, modelled=True)
    return [
        _less_of_places(own, frames, grid, places, by_place) if frames.variance > 0 else NO_FRAMES
        for own, frames, (grid, places, by_place) in zip(errors, found, grids, strict=True)
    ]


def _less_of_places(
    errors: Residuals, frames: VarianceEstimate, grid: Influences, places: ClusterGrid, by_place: VarianceEstimate
) -> VarianceEstimate:
    """The variance that comes from frames less what is within places that err alike."""
    order, influence = errors.cells.order, errors.influence[errors.cells.order]
    cell = grid.cell[np.ix_(places.order, order)]
    together = cell.T @ places.kernel(by_place.parts.block, by_place.parts.weight) @ cell
    blocks, of = np.unique(frames.parts.block, return_inverse=True)
    kernels = [errors.cells.of.kernel(block)[: len(order), : len(order)] for block in blocks.tolist()]
    plain = np.array([influence @ kernel @ influence for kernel in kernels])
    inside = np.array([(kernel * together).sum() for kernel in kernels])
    beyond = np.where(plain > 0, np.maximum(1 - inside / np.where(plain > 0, plain, 1.0), 0.0), 0.0)
    return VarianceEstimate.mean(frames.parts.times(beyond[of]))


def apart(one: Influences, other: Influences, question: Question) -> TwoWay:
    """Of two flights over the same places: each adds the variance of its own frames."""
    both, first, second = two_way([one.minus(other), one, other], [THIS_MAP, question, question])
    if question == THIS_MAP:
        return both
    joined = TwoWay(first.frames, second.frames)
    return TwoWay(both.places, VarianceEstimate(joined.total, joined.degrees, first.frames.block))


# --- Gradients --------------------------------------------------------------------------------------------------------

STEP = 1e-20
"""Of a sum, into the complex plane: its square is nothing beside 1."""

AT_ONCE = 2**20
"""Numbers in the sums of which a statistic is taken together: all of 20,000 classes would take 3 GB."""


def slope(statistic: Statistic, totals: Float64, direction: Float64) -> Float64:
    """The derivative (...,) of a statistic at totals (..., C) along a direction (..., C); NaN where it is undefined.

    By a step into the complex plane, which takes no difference and so loses no digit (Squire and Trapp 1998, SIAM
    Review 40).
    """
    with np.errstate(all="ignore"):  # complex numbers warn of NaN where real ones do not
        value = statistic(totals + STEP * 1j * direction)
    derivative: Float64 = np.where(np.isnan(value.real), np.nan, value.imag / STEP)
    return derivative


def gradient_of(statistic: Statistic, total: Float64) -> Float64:
    """The gradient (C,) of a statistic at sums (C,), 0 where there is nothing to sum."""
    gradient = np.zeros_like(total)
    some = np.flatnonzero(total)
    for at in np.array_split(some, len(some) * len(total) // AT_ONCE + 1):
        scale = np.maximum(np.abs(total[at]), TINY)
        along = np.zeros((len(at), len(total)))
        along[np.arange(len(at)), at] = scale
        gradient[at] = slope(statistic, total, along) / scale
    return gradient
