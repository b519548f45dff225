"""The influence of locations and frames on a statistic, and the variance that follows from how far errors correlate.

Errors in clusters (cubes of space, or groups of frames) that are near each other are alike. How far that goes is
estimated by likelihood, as a weight of each correlation length. Under each, pairs within four times the length count,
by a kernel that is the mean of all shifted grids of blocks; what the kernel misses, where blocks are few or errors
reach far, is put back.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from semstab.core.types import Float64, Int64
from semstab.model.statistics import THIS_MAP, Question
from semstab.statistics.cluster_sums import ClusterIndex, Statistic

LENGTHS = (0.4, 0.5, 0.6, 0.75, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Correlation lengths of errors that are tried, in clusters, besides none at all."""

OWN_SHARES = (0.0, 0.5)
"""Shares of a cluster's variance that it may have for itself."""

DOUBT = 4.0
"""By how much the log likelihood must be better for a share of a cluster's variance that it has for itself: a weak
correlation that reaches far is seldom real, and leaves hardly anything to say."""

FAR = 0.5
"""In space, a correlation length counts with this power of itself besides: one that is too short does more harm."""

UNLIKELY = 1e-3
"""A correlation length of a smaller weight does not count."""

SINGULAR = 1e-9
"""What is added to the variance of each cluster, so that smooth correlations have an inverse."""

BLOCK = 4.0
"""The edge of a block, in correlation lengths."""

GROWTH = 0.75
"""A cluster's standard deviation grows with this power of its size: between independent parts and equal ones."""

ROUNDING = 1e-13
"""Influences below are rounding's."""

TINY = 1e-12
"""A variance below is none."""


# --- Correlation ------------------------------------------------------------------------------------------------------


class CorrelationModel:
    """Correlations between clusters at (G, D) whole numbers: cubes of space, or groups of frames in their order.

    The first clusters alone have the first rows and columns of all matrices, so that numbers for which some clusters do
    not count share a model with the others.

    Correlations (C,) are Gaussian or exponential, of a length; the first is none. Alternatives (A,) are correlations
    with a share of the variance that a cluster has for itself.

    length  (C,), blocks (C,) the edges of the blocks for it, in clusters
    number  (A,) the correlation of an alternative, own (A,) that share
    """

    def __init__(self, at: npt.NDArray[np.integer]) -> None:
        self.axes = at.shape[1]
        self._along = np.abs(at.T[:, :, None] - at.T[:, None]).astype(np.float64)
        self._distance = np.sqrt((self._along**2).sum(axis=0))
        far = max(self._distance.max(initial=0.0), LENGTHS[0])
        lengths = [length for length in LENGTHS if length <= far]
        self.length = np.repeat([0.0, *lengths], [1, *(2 for _ in lengths)])
        self.blocks = np.maximum(BLOCK * self.length, 1.0)
        self.number = np.repeat(np.arange(len(self.length)), np.where(self.length > 0, len(OWN_SHARES), 1))
        self.own = np.concatenate([[0.0], np.tile(OWN_SHARES, len(self.length) - 1)])
        self._kernels: dict[float, Float64] = {}
        self._moments: dict[tuple[int, bytes], list[Any]] = {}

    def __len__(self) -> int:
        return len(self._distance)

    def far(self, count: int) -> float:
        """Return how far the first clusters are from each other."""
        return float(self._distance[:count, :count].max(initial=0.0))

    @functools.cached_property
    def correlations(self) -> Float64:
        """(C, G, G)."""
        found = np.empty((len(self.length), len(self), len(self)))
        found[0] = np.eye(len(self))
        far = np.divide(self._distance, self.length[1::2, None, None], out=found[1::2])
        np.exp(-0.5 * far**2, out=found[2::2])
        np.exp(-far, out=far)
        return found

    @functools.cached_property
    def _factors(self) -> tuple[Float64, Float64]:
        """(A, G, G) Cholesky's factors of the alternatives' covariances, and the logarithms (A, G) of the determinants
        of those of the first 1, 2, ... clusters."""
        from scipy.linalg.lapack import dpotrf

        factors, diagonal = np.empty((len(self.number), len(self), len(self))), np.arange(len(self))
        for own, number, share in zip(factors, self.number, self.own, strict=True):
            np.multiply(self.correlations[number], 1 - share, out=own)
            own[diagonal, diagonal] += share + SINGULAR
            dpotrf(own.T, lower=1, clean=0, overwrite_a=1)  # in its place
        return factors, 2 * np.log(factors[:, diagonal, diagonal]).cumsum(axis=1)

    def log_determinants(self, count: Int64) -> Float64:
        """Return those (A, N) of the alternatives' covariances of the first clusters, so many (N,)."""
        return self._factors[1][:, count - 1]

    def whitened(self, errors: Float64) -> Float64:
        """Return errors (V, G) made independent under each alternative (A, V, G)."""
        from scipy.linalg.blas import dtrsm

        found, columns = np.empty((len(self.number), *errors.shape)), np.asfortranarray(errors.T)
        for to, factor in zip(found, self._factors[0], strict=True):
            to[:] = dtrsm(1.0, factor.T, columns, lower=1).T
        return found

    def kernel(self, block: float) -> Float64:
        """(G, G) in how many of the shifted grids of blocks of that edge two clusters share a block."""
        if block not in self._kernels:
            self._kernels[block] = np.maximum(1.0 - self._along / block, 0.0).prod(axis=0)
        return self._kernels[block]

    def moments(self, alternatives: Int64, size: Float64) -> tuple[Float64, Float64, Float64]:
        """Return (m,) each what an estimate by a kernel is worth under alternatives (m,), for sizes (n,).

        With the variance R of the errors of the first clusters, and the kernel Q on their scale without what is the
        same in all: the variance of the sum, the mean of the estimate tr(QR), and half its variance tr(QRQR). With a
        share that each cluster has for itself R is (1 - share) R + share I.
        """
        key, numbers = size.tobytes(), self.number[alternatives].tolist()
        unknown = [k for k in dict.fromkeys(numbers) if (k, key) not in self._moments]
        for k, own in zip(unknown, self._coefficients(unknown, size), strict=True):
            self._moments[k, key] = own
        known = np.array([self._moments[k, key] for k in numbers]).T
        share = self.own[alternatives]
        other = 1 - share
        twice, once = np.stack([other**2, 2 * other * share, share**2]), np.stack([other, share])
        return (once * known[:2]).sum(axis=0), (once * known[2:4]).sum(axis=0), (twice * known[4:]).sum(axis=0)

    def _coefficients(self, numbers: Sequence[int], size: Float64) -> Iterator[list[Any]]:
        """Yield the polynomials in the share of `moments` for each correlation, coefficient by coefficient."""
        n, scale, share, block = len(size), size**GROWTH, size / size.sum(), 0.0
        for number in numbers:
            if block != (block := float(self.blocks[number])):  # correlations of a length follow each other
                kernel = self.kernel(block)[:n, :n]
                left = kernel @ share
                kernel = (kernel - left[:, None] - (left - left @ share)) * scale[:, None] * scale
            covariance = self.correlations[number, :n, :n]
            both = kernel @ covariance
            yield [
                scale @ covariance @ scale, scale @ scale, both.trace(), kernel.trace(),
                np.vdot(both, both.T), np.vdot(both, kernel), np.vdot(kernel, kernel),
            ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class ClusterGrid:
    """Clusters (n,) that are the first ones of a correlation model: the model's k-th is the order[k]-th of these."""

    model: CorrelationModel
    order: Int64

    def __len__(self) -> int:
        return len(self.order)


def cluster_grids(sets: Sequence[npt.NDArray[np.integer]]) -> list[ClusterGrid]:
    """Return the grid of each set of clusters (n, D), none twice: sets that hold others share a model with them.

    The order of a model's clusters, and with it how sums round, depends on the sets alone.
    """
    keys = [(own.shape[1], np.ascontiguousarray(own, np.int64).tobytes()) for own in sets]
    known = _grids_of(tuple(dict.fromkeys(keys)))
    return [known[key] for key in keys]


@functools.lru_cache(maxsize=4)  # the same clusters of a map are asked for again and again
def _grids_of(keys: tuple[tuple[int, bytes], ...]) -> dict[tuple[int, bytes], ClusterGrid]:
    sets = {key: [tuple(own) for own in np.frombuffer(key[1], np.int64).reshape(-1, key[0]).tolist()] for key in keys}
    nests: list[list[tuple[int, bytes]]] = []  # of sets each of which holds the next one
    for key in sorted(keys, key=lambda key: -len(sets[key])):
        own = set(sets[key])
        nest = next((nest for nest in nests if own.issubset(sets[nest[-1]])), None)
        if nest is None:
            nests.append(nest := [])
        nest.append(key)
    grids: dict[tuple[int, bytes], ClusterGrid] = {}
    for nest in nests:
        place: dict[tuple[int, ...], int] = {}
        for key in reversed(nest):
            for cluster in sets[key]:
                place.setdefault(cluster, len(place))
        model = CorrelationModel(np.array(list(place)))
        grids |= {key: ClusterGrid(model, np.argsort([place[cluster] for cluster in sets[key]])) for key in nest}
    return grids


# --- The variance of a sum --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Residuals:
    """Influences (n,) of clusters on a sum, which are centred, and the size (n,) of each cluster."""

    clusters: ClusterGrid
    influence: Float64
    size: Float64

    @property
    def vary(self) -> bool:
        """Whether any cluster differs from the others."""
        return len(self.clusters) > 1 and bool(np.abs(self.influence).max() >= ROUNDING)


class Parts(NamedTuple):
    """The variance of a sum under each alternative (m,): weights, degrees of freedom, blocks in clusters.

    inflation  how much larger than that of independent clusters
    """

    weight: Float64
    variance: Float64
    degrees: Float64
    block: Float64
    inflation: Float64


NONE = Parts(*(np.zeros(0) for _ in range(5)))


@dataclass(frozen=True, eq=False)
class VarianceEstimate:
    """The variance of a sum, the degrees of freedom of that number, and the likeliest block, in clusters.

    parts  what it is the mean of
    """

    variance: float
    degrees: float
    block: float
    parts: Parts = NONE

    @classmethod
    def mean(cls, parts: Parts) -> VarianceEstimate:
        """Return the mean of the variances; degrees say how well its logarithm is known, with the doubt about lengths.

        The variance of the logarithm of an estimate of d degrees is about 2 / d; to it is added how far the logarithms
        of the parts lie apart (as in a mean over models: Hoeting et al. 1999, Statistical Science 14).
        """
        if not len(parts.weight):
            return cls(math.nan, 0.0, 1.0)
        block = float(parts.block[parts.weight.argmax()])
        mean = float(parts.weight @ parts.variance)
        if not mean > 0:
            return cls(0.0, math.inf, block, parts)
        logs = np.log(np.maximum(parts.variance, 1e-3 * mean))
        doubt = 2 / parts.degrees + (logs - parts.weight @ logs) ** 2
        return cls(mean, 2 / float(parts.weight @ doubt), block, parts)


def variance_estimates(errors: Sequence[Residuals], *, modelled: bool = False) -> list[VarianceEstimate]:
    """Estimate the variance of the sum over clusters of each of several errors.

    modelled  as the correlation has it, instead of by a kernel: where there are too few blocks for one
    """
    estimates = [
        VarianceEstimate(0.0, len(own.clusters) - 1.0, 1.0) if len(own.clusters) > 1 else VarianceEstimate.mean(NONE)
        for own in errors
    ]
    for model in {id(own.clusters.model): own.clusters.model for own in errors}.values():
        some = [k for k, own in enumerate(errors) if own.vary and own.clusters.model is model]
        if some:
            influence, size, count = _padded(model, [errors[k] for k in some])
            weight, scatter = _likelihoods(model, influence, size, count)
            if modelled:
                parts = _modelled(model, influence, size, count, weight, scatter)
            else:
                parts = _by_kernel(model, influence, size, count, weight)
            for k, own in zip(some, parts, strict=True):
                estimates[k] = VarianceEstimate.mean(own)
    return estimates


def longest_correlation(errors: Residuals, level: float) -> float:
    """Return the length, in clusters, that with the weight `level` is not exceeded; 0 for no correlation."""
    if not errors.vary:
        return 0.0
    model = errors.clusters.model
    with one_thread():
        weight = _likelihoods(model, *_padded(model, [errors]))[0][:, 0]
    some = np.flatnonzero(weight)  # alternatives are in the order of their lengths
    at = int(np.searchsorted(np.cumsum(weight[some]), level))
    return float(model.length[model.number[some[min(at, len(some) - 1)]]])


def _padded(model: CorrelationModel, errors: Sequence[Residuals]) -> tuple[Float64, Float64, Int64]:
    """Influences and sizes (N, G) with zeros for clusters that are not theirs, and how many clusters each has (N,)."""
    influence, size = np.zeros((2, len(errors), len(model)))
    for k, own in enumerate(errors):
        influence[k, : len(own.clusters)] = own.influence[own.clusters.order]
        size[k, : len(own.clusters)] = own.size[own.clusters.order]
    return influence, size, np.array([len(own.clusters) for own in errors])


def _likelihoods(model: CorrelationModel, influence: Float64, size: Float64, count: Int64) -> tuple[Float64, Float64]:
    """Weights (A, N) of the alternatives (REML), and the variance (A, N) of a cluster of size 1 under each."""
    there, scale = size > 0, size**GROWTH
    seen = np.divide(influence, scale, out=np.zeros_like(scale), where=there)
    mean = np.divide(size, scale, out=np.zeros_like(scale), where=there)
    white = model.whitened(np.concatenate([seen, mean])).reshape(len(model.number), 2, *there.shape) * there
    a, b = white[:, 0], white[:, 1]
    within = (b * b).sum(axis=2)
    left = (a * a).sum(axis=2) - (a * b).sum(axis=2) ** 2 / within
    length = model.length[model.number]
    far = np.maximum([model.far(own) for own in count], LENGTHS[0])
    some = (left > 0) & (length[:, None] <= far)
    log = model.log_determinants(count) + np.log(within) + (count - 1) * np.log(np.where(some, left, 1.0))
    prior = np.where(model.own > 0, -DOUBT, 0.0)
    if model.axes > 1:
        prior += FAR * np.log(np.maximum(length, LENGTHS[0]))
    likely = np.where(some, prior[:, None] - 0.5 * log, -math.inf)
    weight = np.exp(likely - np.maximum(likely.max(axis=0), -1e300))
    weight[weight < UNLIKELY * weight.sum(axis=0)] = 0.0
    return weight / np.maximum(weight.sum(axis=0), 1.0), left / (count - 1)


def _by_kernel(
    model: CorrelationModel, influence: Float64, size: Float64, count: Int64, weight: Float64
) -> Iterator[Parts]:
    """The variances under each alternative that is not unlikely, by its kernel."""
    block = model.blocks[model.number]
    plain = np.zeros_like(weight)
    for edge in set(block[weight.any(axis=1)].tolist()):
        plain[block == edge] = ((influence @ model.kernel(edge)) * influence).sum(axis=1)
    for k, n in enumerate(count):
        some = np.flatnonzero((weight[:, k] > 0) & (plain[:, k] > 0))
        total, expected, square = model.moments(some, size[k, :n])
        there = expected > 0
        some, total, expected, square = some[there], total[there], expected[there], square[there]
        degrees = np.minimum(expected**2 / square, carriers(influence[k]))
        share, variance = weight[some, k], plain[some, k] * total / expected
        yield Parts(share / share.sum(), variance, degrees, block[some], np.ones(len(some)))


def _modelled(
    model: CorrelationModel, influence: Float64, size: Float64, count: Int64, weight: Float64, scatter: Float64
) -> Iterator[Parts]:
    """The same as the correlations have it."""
    scale, share = size**GROWTH, model.own[:, None]
    independent = (scale**2).sum(axis=1)
    alike = ((model.correlations @ scale.T) * scale.T).sum(axis=1)[model.number]
    total = (1 - share) * alike + share * independent
    for k, n in enumerate(count):
        some = np.flatnonzero(weight[:, k])
        degrees = np.full(len(some), min(n - 1.0, carriers(influence[k])))
        variance, block = scatter[some, k] * total[some, k], model.blocks[model.number[some]]
        yield Parts(weight[some, k], variance, degrees, block, total[some, k] / independent[k])


@functools.cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> contextlib.AbstractContextManager[object]:
    """Matrices are so small that a second thread only waits, the longer the busier the machine is."""
    limited: contextlib.AbstractContextManager[object] = _blas().limit(limits=1, user_api="blas")
    return limited


def carriers(influence: Float64) -> float:
    """Return how many clusters carry the variance, less one: all where influences are normal, 2 where one is all."""
    fourth = float((influence**4).sum())
    return 3 * float((influence**2).sum()) ** 2 / fourth - 1 if fourth > 0 else math.inf


# --- Influences -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Influences:
    """Influences of cubes of space and groups of frames on a number.

    cubes    (G, 3) in which something counts, frames (F,) groups
    by_cube  (G,) influence of each cube; they sum to 0
    by_both  (G, F) of each group of frames in each cube
    size     (G, F) how much is in it, total (G,) in each cube
    one_off  what the number falls by where all that counts was not as the first sum has it, but the opposite
    """

    cubes: Int64
    frames: Int64
    by_cube: Float64
    by_both: Float64
    size: Float64
    total: Float64
    edge: float
    step: int
    one_off: float

    def units(self, question: Question) -> int:
        """Return how many independent observations there can be."""
        return len(self.cubes) if question == THIS_MAP else min(len(self.cubes), len(self.frames) * self.step)

    def unseen(self, question: Question, level: float) -> float:
        """Return what so many observations without a single error may have missed."""
        return self.one_off * float(1 - ((1 - level) / 2) ** (1 / self.units(question)))

    def minus(self, other: Influences) -> Influences:
        """Return the influences on the difference of two numbers."""
        cubes, rows = np.unique(np.concatenate([self.cubes, other.cubes]), axis=0, return_inverse=True)
        frames, columns = np.unique(np.concatenate([self.frames, other.frames]), return_inverse=True)
        by_cube, total = np.zeros((2, len(cubes)))
        by_both, size = np.zeros((2, len(cubes), len(frames)))
        row, column = np.split(rows.ravel(), [len(self.cubes)]), np.split(columns, [len(self.frames)])
        for grid, sign, at, to in zip((self, other), (1.0, -1.0), row, column, strict=True):
            by_cube[at] += sign * grid.by_cube
            total[at] += grid.total
            by_both[np.ix_(at, to)] += sign * grid.by_both
            size[np.ix_(at, to)] += grid.size
        one_off = max(self.one_off, other.one_off)
        return Influences(cubes, frames, by_cube, by_both, size, total, self.edge, self.step, one_off)


def influences(
    index: ClusterIndex, columns: Float64, of: Statistic, halves: Float64 | None = None
) -> Influences | None:
    """Return the influences of sums (m, C) by cube and group of frames; None where there are fewer than two cubes.

    halves (m, 2): of locations that two frames saw, what of the first two sums both account for, instead of half each.
    """
    total = columns.sum(axis=0)
    gradient = gradient_of(of, total)
    size = np.abs(index.by_cube(columns[:, 1]))
    some = size > TINY * size.sum()
    if some.sum() < 2 or size.sum() < TINY or not np.isfinite(gradient).all():
        return None  # of 150 classes hardly any voxel may count as stable: 1e-112 of all of them
    own: Float64 = columns @ gradient
    shared = own if halves is None else own + gradient[0] * (halves[:, 0] - total[0] / total[1] * halves[:, 1])
    by_both, size_of_both = index.by_both(shared), index.by_both(np.abs(columns[:, 1]))
    seen = size_of_both.sum(axis=0) > 0
    return Influences(
        index.cubes[some],
        index.frames[seen],
        index.by_cube(own)[some],
        by_both[np.ix_(some, seen)],
        size_of_both[np.ix_(some, seen)],
        size[some],
        index.edge,
        index.step,
        one_off=abs(float(gradient[0] * total[1])),
    )


# --- Two-way variance -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwoWay:
    """The variance that comes from locations, and what frames add to it.

    most  degrees of freedom that it has at most
    """

    space: VarianceEstimate
    frames: VarianceEstimate
    most: float = math.inf

    @property
    def total(self) -> float:
        """Return the variance of both."""
        return self.space.variance + self.frames.variance

    @property
    def degrees(self) -> float:
        """Return the degrees of freedom of the sum (Satterthwaite 1946)."""
        spread = sum(part.variance**2 / part.degrees for part in (self.space, self.frames) if part.variance > 0)
        return min(max(self.total**2 / spread, 1.0) if spread else self.space.degrees, self.most)

    def half(self, level: float) -> float:
        """Return half the width of the interval."""
        from scipy import special

        if not self.degrees > 0:
            return math.nan
        return float(special.stdtrit(self.degrees, (1 + level) / 2)) * math.sqrt(self.total)


NO_FRAMES = VarianceEstimate(0.0, math.inf, 1.0)


def two_way(grids: Sequence[Influences], questions: Sequence[Question]) -> list[TwoWay]:
    """V_frame + V_cube - V_both (Cameron, Gelbach, Miller 2011): pairs that share a frame or a cube count once."""
    clusters = cluster_grids([grid.cubes for grid in grids])
    errors = [Residuals(at, grid.by_cube, grid.total) for at, grid in zip(clusters, grids, strict=True)]
    with one_thread():
        space = variance_estimates(errors)
        of_flight = [k for k, grid in enumerate(grids) if questions[k] != THIS_MAP and len(grid.frames) > 1]
        of_frames = _frame_errors([grids[k] for k in of_flight])
        frames = [NO_FRAMES] * len(grids)
        for k, own, estimate in zip(of_flight, of_frames, variance_estimates(of_frames, modelled=True), strict=True):
            if estimate.variance > 0:
                frames[k] = _beyond_space(own, estimate, grids[k], clusters[k], space[k])
    return list(map(TwoWay, space, frames))


def _frame_errors(grids: Sequence[Influences]) -> list[Residuals]:
    """The influences of groups of frames, centred: of a sample they do not sum to 0."""
    errors = []
    for clusters, grid in zip(cluster_grids([grid.frames[:, None] for grid in grids]), grids, strict=True):
        influence, size = grid.by_both.sum(axis=0), grid.size.sum(axis=0)
        errors.append(Residuals(clusters, influence - size / size.sum() * influence.sum(), size))
    return errors


def _beyond_space(
    errors: Residuals, frames: VarianceEstimate, grid: Influences, cubes: ClusterGrid, space: VarianceEstimate
) -> VarianceEstimate:
    """What frames add: the variance that comes from them less the part within locations that err alike."""
    order, n = errors.clusters.order, len(cubes)
    influence, by_both = errors.influence[order], grid.by_both[np.ix_(cubes.order, order)]
    blocks, of = np.unique(space.parts.block, return_inverse=True)
    alike = np.zeros((n, n))
    for block, share in zip(blocks.tolist(), np.bincount(of, weights=space.parts.weight), strict=True):
        alike += share * cubes.model.kernel(block)[:n, :n]
    together = by_both.T @ alike @ by_both
    blocks, of = np.unique(frames.parts.block, return_inverse=True)
    kernels = [errors.clusters.model.kernel(block)[: len(order), : len(order)] for block in blocks.tolist()]
    plain = np.array([influence @ kernel @ influence for kernel in kernels])
    inside = np.array([(kernel * together).sum() for kernel in kernels])
    beyond = np.where(plain > 0, np.maximum(1 - inside / np.where(plain > 0, plain, 1.0), 0.0), 0.0)
    return VarianceEstimate.mean(frames.parts._replace(variance=frames.parts.variance * beyond[of]))


def unpaired_variance(one: Influences, other: Influences, question: Question) -> TwoWay:
    """Return the variance between two flights over the same locations: each adds that of its own frames."""
    both, first, second = two_way([one.minus(other), one, other], [THIS_MAP, question, question])
    if question == THIS_MAP:
        return both
    frames = TwoWay(first.frames, second.frames)
    return TwoWay(both.space, VarianceEstimate(frames.total, frames.degrees, first.frames.block))


# --- Gradients --------------------------------------------------------------------------------------------------------

STEP = 1e-20
"""Of a sum, into the complex plane: its square is nothing compared with 1."""

AT_ONCE = 2**20
"""Numbers in the sums of which a statistic is taken together: all of 20,000 classes would take 3 GB."""


def gradient_of(statistic: Statistic, total: Float64) -> Float64:
    """Return the gradient (C,) of a statistic at sums (C,): 0 where there is nothing to sum, NaN where undefined.

    By a step into the complex plane, which takes no difference and so loses no digit (Squire and Trapp 1998, SIAM
    Review 40).
    """
    gradient = np.zeros_like(total)
    some = np.flatnonzero(total)
    for at in np.array_split(some, len(some) * len(total) // AT_ONCE + 1):
        scale = np.maximum(np.abs(total[at]), TINY)
        along: Any = np.zeros((len(at), len(total)), np.complex128)
        along[np.arange(len(at)), at] = STEP * 1j * scale
        with np.errstate(all="ignore"):  # complex numbers warn of NaN where real ones do not
            value = statistic(total + along)
        gradient[at] = np.where(np.isnan(value.real), np.nan, value.imag / STEP) / scale
    return gradient
