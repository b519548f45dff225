"""Cells of a grid: how far errors in them may reach, what makes such errors independent, and which share a block."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64

REACHES = (0.4, 0.5, 0.6, 0.75, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""How far errors may reach, in cells, besides not at all."""

ALONE = (0.0, 0.5)
"""Shares of a cell's variance that it may have for itself."""

SINGULAR = 1e-9
"""What is added to the variance of each cell, so that smooth correlations have an inverse."""

BLOCK = 4.0
"""The edge of a block, in reaches."""

GROWTH = 0.75
"""A cell's standard deviation grows with this power of what is in it: between independent parts and equal ones."""

MOST_KNOWN = 2048
"""So many moments of an arrangement are kept for the next number of the same map."""

KEPT = 4
"""So many times what was asked for together is kept: of one map the same cells are asked for again and again."""


@dataclass(frozen=True, eq=False)
class ClusterGrid:
    """Some cells as the first ones of an arrangement, and which of them each of these is (n,)."""

    of: CorrelationModel
    order: Int64

    def __len__(self) -> int:
        return len(self.order)

    def kernel(self, block: Float64, weight: Float64) -> Float64:
        """The mean (n, n) of the arrangement's kernels of blocks (m,) by their weights (m,)."""
        mean = np.zeros((len(self), len(self)))
        edges, of = np.unique(block, return_inverse=True)
        for edge, share in zip(edges.tolist(), np.bincount(of, weights=weight), strict=True):
            mean += share * self.of.kernel(edge)[: len(self), : len(self)]
        return mean


@dataclass(frozen=True, eq=False)
class Moments:
    """What an estimate by a kernel is worth under correlations (m,), of errors whose scale is that of sizes.

    Of the variance R of these errors, and of the kernel Q on their scale without what is the same in all: the variance
    of the sum, that which the kernel finds on average, tr(QR), and half the variance of the latter, tr(QRQR). All as a
    polynomial in the share that each cell has for itself, where R is (1 - share) R + share I.
    """

    total: Float64
    expected: Float64
    square: Float64

    def at(self, share: Float64) -> tuple[Float64, Float64, Float64]:
        """All three (m,) at shares (m,)."""
        other = 1 - share
        twice = np.stack([other**2, 2 * other * share, share**2])
        once = np.stack([other, share])
        return (once * self.total).sum(axis=0), (once * self.expected).sum(axis=0), (twice * self.square).sum(axis=0)


class CorrelationModel:
    """Cells of a grid, at (G, D) whole numbers: cubes of space, or groups of frames in their order.

    The first cells alone are an arrangement too, of which the first rows and columns of all matrices hold: so numbers
    for which some cells do not count go with the others.

    Correlations (C,) are Gaussian or exponential, of a reach; the first is none. Alternatives (A,) are correlations
    with a share of the variance that a cell has for itself.

    reach   (C,), blocks (C,) the edges of the blocks for it, in cells
    number  (A,) the correlation of an alternative, alone (A,) that share
    """

    def __init__(self, at: npt.NDArray[np.integer]) -> None:
        self.at = at.astype(np.float64)
        far = max(self._distance.max(initial=0.0), REACHES[0])
        reaches = [reach for reach in REACHES if reach <= far]
        self.reach = np.repeat([0.0, *reaches], [1, *(2 for _ in reaches)])
        self.blocks = np.maximum(BLOCK * self.reach, 1.0)
        self.number = np.repeat(np.arange(len(self.reach)), np.where(self.reach > 0, len(ALONE), 1))
        self.alone = np.concatenate([[0.0], np.tile(ALONE, len(self.reach) - 1)])
        self._kernels: dict[float, Float64] = {}
        self._known: dict[tuple[int, bytes], Float64] = {}

    @functools.cached_property
    def _distance(self) -> Float64:
        return np.asarray(np.sqrt((self._along**2).sum(axis=0)), np.float64)

    @functools.cached_property
    def _along(self) -> Float64:
        """(D, G, G) how far cells are apart along each axis."""
        return np.abs(self.at.T[:, :, None] - self.at.T[:, None])

    def far(self, count: int) -> float:
        """How far the first cells are from each other."""
        return float(self._distance[:count, :count].max(initial=0.0))

    @functools.cached_property
    def correlations(self) -> Float64:
        """(C, G, G)."""
        count = len(self.at)
        found = np.empty((len(self.reach), count, count))
        found[0] = np.eye(count)
        far = np.divide(self._distance, self.reach[1::2, None, None], out=found[1::2])
        np.exp(-0.5 * far**2, out=found[2::2])
        np.exp(-far, out=far)
        return found

    @functools.cached_property
    def _factors(self) -> tuple[Float64, Float64]:
        """(A, G, G) Cholesky's factors of the alternatives' covariances, and the logarithms (A, G) of the determinants
        of those of the first 1, 2, ... cells."""
        from scipy.linalg.lapack import dpotrf

        count = len(self.at)
        factors, diagonal = np.empty((len(self.number), count, count)), np.arange(count)
        for own, number, share in zip(factors, self.number, self.alone, strict=True):
            np.multiply(self.correlations[number], 1 - share, out=own)
            own[diagonal, diagonal] += share + SINGULAR
            dpotrf(own.T, lower=1, clean=0, overwrite_a=1)  # in its place
        return factors, 2 * np.log(factors[:, diagonal, diagonal]).cumsum(axis=1)

    def logarithms(self, count: Int64) -> Float64:
        """Of the determinants (A, N) of the alternatives' covariances of the first cells, so many (N,)."""
        return self._factors[1][:, count - 1]

    def whitened(self, errors: Float64) -> Float64:
        """Errors (V, G) made independent under each alternative (A, V, G)."""
        from scipy.linalg.blas import dtrsm

        found, columns = np.empty((len(self.number), *errors.shape)), np.asfortranarray(errors.T)
        for to, factor in zip(found, self._factors[0], strict=True):
            to[:] = dtrsm(1.0, factor.T, columns, lower=1).T
        return found

    def kernel(self, block: float) -> Float64:
        """(G, G) in how many of the shifted grids of blocks of that edge two cells share a block."""
        if block not in self._kernels:
            shared = np.ones(self._along.shape[1:])
            for along in self._along:
                shared *= np.maximum(1.0 - along / block, 0.0)
            self._kernels[block] = shared
        return self._kernels[block]

    def moments(self, number: Int64, size: Float64) -> Moments:
        """Of correlations (m,) for sizes (n,) of the first cells."""
        key = size.tobytes()
        if len(self._known) >= MOST_KNOWN:
            self._known.clear()
        unknown = [k for k in dict.fromkeys(number.tolist()) if (k, key) not in self._known]
        self._known |= {(k, key): own for k, own in zip(unknown, self._moments(unknown, size), strict=True)}
        known = np.array([self._known[k, key] for k in number.tolist()]).T
        return Moments(known[:2], known[2:4], known[4:])

    def _moments(self, numbers: Sequence[int], size: Float64) -> Iterator[Float64]:
        """Of each correlation, as in `Moments`, coefficient by coefficient."""
        n, scale, share, block = len(size), size**GROWTH, size / size.sum(), 0.0
        plain = scale @ scale
        for number in numbers:
            if block != (block := float(self.blocks[number])):  # correlations of a reach follow each other
                kernel = self.kernel(block)[:n, :n]
                left = kernel @ share
                kernel = (kernel - left[:, None] - (left - left @ share)) * scale[:, None] * scale
                of_kernel = kernel.trace(), np.vdot(kernel, kernel)
            covariance = self.correlations[number, :n, :n]
            both = kernel @ covariance
            yield np.array([
                scale @ covariance @ scale, plain, both.trace(), of_kernel[0],
                np.vdot(both, both.T), np.vdot(both, kernel), of_kernel[1],
            ])  # fmt: skip


# --- Cells of several numbers -----------------------------------------------------------------------------------------


def cluster_grids(sets: Sequence[npt.NDArray[np.integer]]) -> list[ClusterGrid]:
    """Sets of cells, each (n, D), none of them twice: those that hold others share an arrangement with them.

    What was asked for lately is at hand. The order of an arrangement's cells, and with it how sums round, depends on
    the sets alone, never on what was asked before.
    """
    keys = [_key(own) for own in sets]
    known = _made(tuple(dict.fromkeys(keys)))
    return [known[key] for key in keys]


@functools.lru_cache(maxsize=KEPT)
def _made(keys: tuple[bytes, ...]) -> dict[bytes, ClusterGrid]:
    nests = _nests({key: np.frombuffer(key[1:], np.int64).reshape(-1, key[0]) for key in keys})
    return {key: own for nest in nests for key, own in _nested(nest).items()}


def _key(cells: npt.NDArray[np.integer]) -> bytes:
    return bytes([cells.shape[1]]) + np.ascontiguousarray(cells, dtype=np.int64).tobytes()


_Nest = list[tuple[bytes, list[tuple[int, ...]]]]


def _nests(sets: Mapping[bytes, npt.NDArray[np.integer]]) -> list[_Nest]:
    """Sets by key, each in the first list whose last one holds it."""
    nests: list[_Nest] = []
    innermost: list[set[tuple[int, ...]]] = []
    for key, own in sorted(sets.items(), key=lambda each: -len(each[1])):
        cells = [tuple(cell) for cell in own.tolist()]
        there = set(cells)
        at = next((k for k, last in enumerate(innermost) if there <= last), len(nests))
        if at == len(nests):
            nests.append([])
            innermost.append(there)
        nests[at].append((key, cells))
        innermost[at] = there
    return nests


def _nested(nest: _Nest) -> dict[bytes, ClusterGrid]:
    """Sets of cells, each of which holds the next one, as the first cells of an arrangement."""
    place: dict[tuple[int, ...], int] = {}
    for _, cells in reversed(nest):
        for cell in cells:
            place.setdefault(cell, len(place))
    of = CorrelationModel(np.array(list(place)))
    return {key: ClusterGrid(of, np.argsort([place[cell] for cell in cells])) for key, cells in nest}
