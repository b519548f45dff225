"""The variance of a sum over places, or over frames, that err alike where they are near each other.

How far errors reach is found by likelihood; pairs within four times that count, by a kernel that is the mean of all
shifted grids of blocks; and what the kernel misses, where blocks are few or errors reach far, is put back.
"""

from __future__ import annotations

import functools
import math
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

Float64 = npt.NDArray[np.float64]

REACHES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""How far errors may reach, in cells, besides not at all."""

ALONE, DOUBT = (0.0, 0.5), 2.0
"""Shares of a cell's variance that it may have for itself, and by how much the log likelihood must be better for that:
a weak correlation that reaches far is seldom real, and leaves hardly anything to say."""

ROUNDING = 1e-13
"""Influences below are rounding's."""

BLOCK = 4.0
"""The edge of a block, in reaches."""

GROWTH = 0.75
"""A cell's standard deviation grows with this power of what is in it: between independent parts and equal ones."""


@dataclass(frozen=True)
class Spread:
    """The variance of a sum, the degrees of freedom of that number, and the block it was taken in, in cells."""

    variance: float
    degrees: float
    block: float


@dataclass(frozen=True, eq=False)
class _Model:
    """Correlations of cells: their reach, their matrix (G, G), its eigenvalues (G,) and eigenvectors (G, G)."""

    reach: float
    matrix: Float64
    values: Float64
    vectors: Float64


class Arrangement:
    """Cells of a grid, at (G, D) whole numbers: cubes of space, or groups of frames in their order."""

    def __init__(self, at: npt.NDArray[np.integer]) -> None:
        self.at = at.astype(np.float64)
        self.count = len(at)

    @functools.cached_property
    def _models(self) -> list[_Model]:
        distance = np.sqrt(((self.at[:, None] - self.at[None]) ** 2).sum(axis=2))
        eye = np.eye(self.count)
        models = [_Model(0.0, eye, np.ones(self.count), eye)]
        far = max(distance.max(initial=0.0), REACHES[0])
        for reach in (reach for reach in REACHES if reach <= far):
            for matrix in (np.exp(-distance / reach), np.exp(-0.5 * (distance / reach) ** 2)):
                values, vectors = np.linalg.eigh(matrix)
                models.append(_Model(reach, matrix, np.maximum(values, 1e-9), vectors))
        return models

    def kernel(self, block: float) -> Float64:
        """(G, G) in how many of the shifted grids of blocks of that edge, in cells, two cells share a block."""
        shared = np.ones((self.count, self.count))
        for axis in self.at.T:
            shared *= np.maximum(1.0 - np.abs(axis[:, None] - axis) / block, 0.0)
        return shared

    def spread(self, influence: Float64, size: Float64) -> Spread:
        """Of the sum over cells of influences (G,), which are centred; size (G,) is how much is in each cell."""
        if self.count < 2:
            return Spread(math.nan, 0.0, 1.0)
        if np.abs(influence).max() < ROUNDING:
            return Spread(0.0, self.count - 1.0, 1.0)
        with one_thread():
            return self._spread(influence, size)

    def _spread(self, influence: Float64, size: Float64) -> Spread:
        reach, model = self._likeliest(influence, size)
        scale = size**GROWTH
        covariance = model * scale[:, None] * scale
        block = max(1.0, BLOCK * reach)
        kernel = self.kernel(block)
        seen = _centred(kernel, size) @ covariance
        expected = float(np.trace(seen))
        if expected <= 0:
            return Spread(math.nan, 0.0, block)
        missed = float(covariance.sum()) / expected
        degrees = expected**2 / float((seen * seen.T).sum())
        return Spread(float(influence @ kernel @ influence) * missed, min(degrees, carriers(influence)), block)

    def _likeliest(self, influence: Float64, size: Float64) -> tuple[float, Float64]:
        """The reach, and the correlations (G, G), by the likelihood of what centring leaves (REML)."""
        scale = size**GROWTH
        seen, mean = influence / scale, size / scale
        best, found = -math.inf, self._models[0]
        share = 0.0
        for model in self._models:
            a, b = model.vectors.T @ seen, model.vectors.T @ mean
            for alone in ALONE if model.reach else (0.0,):
                v = (1 - alone) * model.values + alone
                within = float((b * b / v).sum())
                left = float((a * a / v).sum()) - float((a * b / v).sum()) ** 2 / within
                if left <= 0:
                    continue
                likely = -0.5 * (float(np.log(v).sum()) + math.log(within) + (self.count - 1) * math.log(left))
                likely -= DOUBT if alone else 0.0
                if likely > best:
                    best, found, share = likely, model, alone
        return found.reach, (1 - share) * found.matrix + share * np.eye(self.count)


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
