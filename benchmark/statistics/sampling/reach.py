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
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

Float64 = npt.NDArray[np.float64]

REACHES = (0.4, 0.5, 0.6, 0.75, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""How far errors may reach, in cells, besides not at all."""

ALONE, DOUBT = (0.0, 0.5), 4.0
"""Shares of a cell's variance that it may have for itself, and by how much the log likelihood must be better for that:
a weak correlation that reaches far is seldom real, and leaves hardly anything to say."""

FAR = 0.5
"""Of places, a reach counts with this power of its length besides: one that is found too short does more harm."""

UNLIKELY = 1e-3
"""A reach of a smaller weight does not count."""

ROUNDING = 1e-13
"""Influences below are rounding's."""

SINGULAR = 1e-9
"""What is added to the variance of each cell, so that smooth correlations have an inverse."""

BLOCK = 4.0
"""The edge of a block, in reaches."""

GROWTH = 0.75
"""A cell's standard deviation grows with this power of what is in it: between independent parts and equal ones."""

MOST_KNOWN = 96
"""So many answers of an arrangement are kept for the next number of the same map."""


@dataclass(frozen=True)
class Part:
    """The variance of a sum as it is under one reach: its weight, degrees of freedom, and the block, in cells.

    alike  how much larger than that of independent cells
    """

    weight: float
    variance: float
    degrees: float
    block: float
    alike: float = 1.0


@dataclass(frozen=True)
class Spread:
    """The variance of a sum, the degrees of freedom of that number, and the likeliest block, in cells.

    parts  what it is the mean of
    """

    variance: float
    degrees: float
    block: float
    parts: tuple[Part, ...] = ()

    @classmethod
    def mean(cls, parts: Sequence[Part]) -> Spread:
        """The mean of the variances; degrees say how well its logarithm is known, with the doubt about the reach.

        The variance of the logarithm of an estimate of d degrees is about 2 / d; to it is added how far the logarithms
        of the parts lie apart (as in a mean over models: Hoeting et al. 1999, Statistical Science 14).
        """
        block = max(parts, key=lambda part: part.weight).block
        weight = np.array([part.weight for part in parts])
        variance = np.array([part.variance for part in parts])
        found = float(weight @ variance)
        if not found > 0:
            return cls(0.0, math.inf, block, tuple(parts))
        logs = np.log(np.maximum(variance, 1e-3 * found))
        doubt = 2 / np.array([part.degrees for part in parts]) + (logs - weight @ logs) ** 2
        return cls(found, 2 / float(weight @ doubt), block, tuple(parts))

    def with_fewer(self, degrees: float) -> float:
        """The weight of the parts that have fewer degrees of freedom."""
        return sum(part.weight for part in self.parts if part.degrees < degrees)

    def with_more_alike(self, times: float) -> float:
        """The weight of the parts whose variance is more than so many times that of independent cells."""
        return sum(part.weight for part in self.parts if part.alike > times)


@dataclass(frozen=True)
class _Correlation:
    """Correlations of cells of a reach: Gaussian or exponential."""

    reach: float
    gaussian: bool

    def __call__(self, distance: Float64) -> Float64:
        """(G, G) of cells that are so far apart."""
        if not self.reach:
            return np.eye(len(distance))
        far = distance / self.reach
        correlations: Float64 = np.exp(-0.5 * far**2) if self.gaussian else np.exp(-far)
        return correlations


@dataclass(frozen=True)
class _Likely:
    """A correlation by its number, what a cell has for itself, its weight, and the variance of a cell of size 1."""

    number: int
    alone: float
    weight: float
    scatter: float


class Arrangement:
    """Cells of a grid, at (G, D) whole numbers: cubes of space, or groups of frames in their order."""

    def __init__(self, at: npt.NDArray[np.integer]) -> None:
        self.at = at.astype(np.float64)
        self.count = len(at)
        self._far = FAR if at.shape[1] > 1 else 0.0
        self._known: dict[tuple[int, float, bytes], tuple[float, float, float]] = {}
        self._kernels: dict[float, Float64] = {}

    @functools.cached_property
    def _distance(self) -> Float64:
        distance: Float64 = np.sqrt(((self.at[:, None] - self.at[None]) ** 2).sum(axis=2))
        return distance

    @functools.cached_property
    def _correlations(self) -> list[_Correlation]:
        far = max(self._distance.max(initial=0.0), REACHES[0])
        reaches = [reach for reach in REACHES if reach <= far]
        return [_Correlation(0.0, True), *(_Correlation(reach, form) for reach in reaches for form in (False, True))]

    def kernel(self, block: float) -> Float64:
        """(G, G) in how many of the shifted grids of blocks of that edge, in cells, two cells share a block."""
        if block not in self._kernels:
            shared = np.ones((self.count, self.count))
            for axis in self.at.T:
                shared *= np.maximum(1.0 - np.abs(axis[:, None] - axis) / block, 0.0)
            self._kernels[block] = shared
        return self._kernels[block]

    def mean_kernel(self, parts: Sequence[Part]) -> Float64:
        """The mean (G, G) of the kernels of parts."""
        total = np.zeros((self.count, self.count))
        for part in parts:
            total += part.weight * self.kernel(part.block)
        return total

    def spread(self, influence: Float64, size: Float64, *, modelled: bool = False) -> Spread:
        """Of the sum over cells of influences (G,), which are centred; size (G,) is how much is in each cell.

        modelled  as the correlation has it, instead of by a kernel: where there are too few blocks for one
        """
        if self.count < 2:
            return Spread(math.nan, 0.0, 1.0)
        if np.abs(influence).max() < ROUNDING:
            return Spread(0.0, self.count - 1.0, 1.0)
        with one_thread():
            parts = (self._modelled if modelled else self._parts)(influence, size)
        return Spread.mean(parts) if parts else Spread(math.nan, 0.0, 1.0)

    def longest(self, influence: Float64, size: Float64, level: float) -> float:
        """The reach, in cells, that errors exceed with no more than the weight 1 - level; 0 where they do not reach."""
        if self.count < 2 or np.abs(influence).max() < ROUNDING:
            return 0.0
        with one_thread():
            weights = self._weights(influence, size)
        reaches, shares = np.array(sorted((self._correlations[own.number].reach, own.weight) for own in weights)).T
        return float(reaches[min(np.searchsorted(np.cumsum(shares), level), len(reaches) - 1)])

    def _parts(self, influence: Float64, size: Float64) -> list[Part]:
        """What the variance is under each reach that is not unlikely, by its kernel."""
        most, found = carriers(influence), []
        for own in self._weights(influence, size):
            block = self._block(own)
            _, missed, degrees = self._under(own, size)
            variance = float(influence @ self.kernel(block) @ influence) * missed
            if variance > 0 and degrees > 0:
                found.append(Part(own.weight, variance, min(degrees, most), block))
        total = sum(part.weight for part in found)
        return [Part(part.weight / total, part.variance, part.degrees, part.block) for part in found]

    def _modelled(self, influence: Float64, size: Float64) -> list[Part]:
        """The same as its correlation has it."""
        degrees = min(self.count - 1.0, carriers(influence))
        alone, found = float((size ** (2 * GROWTH)).sum()), []
        for own in self._weights(influence, size):
            total = self._under(own, size)[0]
            found.append(Part(own.weight, own.scatter * total, degrees, self._block(own), total / alone))
        return found

    def _block(self, of: _Likely) -> float:
        return max(1.0, BLOCK * self._correlations[of.number].reach)

    def _under(self, of: _Likely, size: Float64) -> tuple[float, float, float]:
        """The variance of the sum where that of a cell of size 1 is 1, by how much the kernel falls short of it, and
        the degrees of freedom of that."""
        key = (of.number, of.alone, size.tobytes())
        if key not in self._known:
            scale = size**GROWTH
            covariance = (1 - of.alone) * self._correlations[of.number](self._distance) * scale[:, None] * scale
            covariance[np.diag_indices(self.count)] += of.alone * scale**2
            seen = _centred(self.kernel(self._block(of)), size) @ covariance
            total, expected = float(covariance.sum()), float(np.trace(seen))
            some = expected > 0
            degrees = expected**2 / float((seen * seen.T).sum()) if some else 0.0
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[key] = total, total / expected if some else math.nan, degrees
        return self._known[key]

    def _weights(self, influence: Float64, size: Float64) -> list[_Likely]:
        """How likely each correlation is (REML)."""
        scale = size**GROWTH
        seen, mean = influence / scale, size / scale
        number, alone, whitens, logs, before = self._alternatives
        a, b = np.moveaxis(whitens @ np.stack([seen, mean], axis=1), -1, 0)
        within = (b * b).sum(axis=1)
        left = (a * a).sum(axis=1) - (a * b).sum(axis=1) ** 2 / within
        some = np.flatnonzero(left > 0)
        log = logs[some] + np.log(within[some]) + (self.count - 1) * np.log(left[some])
        likely = before[some] - 0.5 * log
        weight = np.exp(likely - likely.max(initial=-math.inf))
        weight = np.where(weight < UNLIKELY * weight.sum(), 0.0, weight)
        found = zip(number[some], alone[some], weight / weight.sum(), left[some] / (self.count - 1), strict=True)
        return [_Likely(int(k), float(own), float(w), float(scatter)) for k, own, w, scatter in found if w > 0]

    @functools.cached_property
    def _alternatives(self) -> tuple[npt.NDArray[np.int64], Float64, Float64, Float64, Float64]:
        """Numbers of correlations (A,), with what a cell has for itself (A,).

        Then what makes cells that correlate so independent (A, G, G), the logarithms of the determinants of their
        covariances (A,) and what counts besides (A,).
        """
        from scipy.linalg.lapack import dtrtri

        pairs = [
            (number, alone)
            for number, correlation in enumerate(self._correlations)
            for alone in (ALONE if correlation.reach else (0.0,))
        ]
        number, alone = np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])
        whitens, logs = np.empty((len(pairs), self.count, self.count)), np.empty(len(pairs))
        for own, (k, part) in enumerate(pairs):
            covariance = (1 - part) * self._correlations[k](self._distance)
            covariance[np.diag_indices(self.count)] += part + SINGULAR
            factor = np.linalg.cholesky(covariance)
            logs[own] = 2 * np.log(np.diag(factor)).sum()
            whitens[own] = dtrtri(factor, lower=1)[0]
        reach = np.array([of.reach for of in self._correlations])[number]
        before = self._far * np.log(np.maximum(reach, REACHES[0])) - np.where(alone > 0, DOUBT, 0.0)
        return number, alone, whitens, logs, before


@functools.lru_cache(maxsize=4)
def _arrangement(at: bytes, axes: int) -> Arrangement:
    return Arrangement(np.frombuffer(at, dtype=np.int64).reshape(-1, axes))


def arrangement(at: npt.NDArray[np.integer]) -> Arrangement:
    """Of cells at (G, D); the last few are at hand, as many numbers of one map are asked for."""
    return _arrangement(np.ascontiguousarray(at, dtype=np.int64).tobytes(), at.shape[1])


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


def _centred(kernel: Float64, size: Float64) -> Float64:
    """M' K M, where M takes the mean out: of each cell, as much as it holds."""
    share = size / size.sum()
    left = kernel @ share
    centred: Float64 = kernel - left[:, None] - left[None] + share @ left
    return centred
