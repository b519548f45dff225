"""The variance of a sum over places, or over frames, that err alike where they are near each other.

How far errors reach is found by likelihood, and what is found is a weight of each reach, not one of them. Under each,
pairs within four times the reach count, by a kernel that is the mean of all shifted grids of blocks; and what the
kernel misses, where blocks are few or errors reach far, is put back.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from threadpoolctl import ThreadpoolController

from semstab.core.types import Float64
from semstab.statistics.sampling.arrangement import GROWTH, REACHES, Arrangement, Cells

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
class Errors:
    """Influences (n,) of cells on a sum, which are centred, and how much is in each cell (n,)."""

    cells: Cells
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
class Spread:
    """The variance of a sum, the degrees of freedom of that number, and the likeliest block, in cells.

    parts  what it is the mean of
    """

    variance: float
    degrees: float
    block: float
    parts: Parts = NONE

    @classmethod
    def mean(cls, parts: Parts) -> Spread:
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


def spreads(errors: Sequence[Errors], *, modelled: bool = False) -> list[Spread]:
    """Of the sums over cells of several errors.

    modelled  as the correlation has it, instead of by a kernel: where there are too few blocks for one
    """
    found = [Spread(0.0, len(own.cells) - 1.0, 1.0) if len(own.cells) > 1 else Spread.mean(NONE) for own in errors]
    for arrangement in {id(own.cells.of): own.cells.of for own in errors}.values():
        some = [k for k, own in enumerate(errors) if own.told and own.cells.of is arrangement]
        if some:
            together = _Together(arrangement, [errors[k] for k in some])
            parts = together.modelled() if modelled else together.by_kernel()
            for k, own in zip(some, parts, strict=True):
                found[k] = Spread.mean(own)
    return found


def longest(errors: Errors, level: float) -> float:
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

    def __init__(self, arrangement: Arrangement, errors: Sequence[Errors]) -> None:
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
