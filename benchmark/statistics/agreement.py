"""Agreement of frames at a location, by measures whose expectation does not depend on how many frames saw it.

Voxels are the units and frames the raters. Evidence that is not one-hot counts by its expected value: s_t . s_u is the
probability that a class drawn from s_t equals one drawn from s_u.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import distinct_keys
from semstab.core.types import Float64, Int64, Mask
from semstab.data.events import Events
from semstab.data.measures import Quantity, entropy, vss
from semstab.data.statistics import ClassAgreement
from semstab.data.voxels import VoxelTable

PSA = Quantity(key="psa", title="PSA", better="higher", op=2)
KAPPA = Quantity(key="kappa", title="Kappa", better="higher", digits=(2, 4))
ALPHA = Quantity(key="alpha", title="Alpha", better="higher", digits=(3, 4))
"""The agreement of two views at the same spot beyond chance: the number that decides, see `docs/metrics.md`."""

ALPHA_BY_MEANING = Quantity(key="alpha_by_meaning", title="Alpha by meaning", better="higher", digits=(3, 4))
"""The same with distances between classes, where they are given: see `docs/open-vocabulary.md`."""

VOXEL_ALPHA = Quantity(key="voxel_alpha", title="Voxel alpha", better="higher", digits=(3, 4), op=2)
"""Krippendorff's alpha of the voxels of a map, which depends on their size."""

CONSISTENT = 0.8
"""A voxel is consistent where PSA >= 0.8: of ten frames at most one disagrees."""

ONE_HOT = 1e-9
"""Evidence whose squared norm is this near to 1 is one-hot."""


def psa(table: VoxelTable) -> Float64:
    """Return pairwise semantic agreement (n,): the mean of s_t . s_u over pairs of different frames, in [0, 1].

    PSA = (||e||^2 - sum_t ||s_t||^2) / (T (T - 1)); NaN if T < 2. For frames that are independent draws from pi its
    expectation is ||pi||^2 for every T >= 2.
    """
    T = table.op.astype(np.float64)
    agreeing = table.evidence.concentration.squares - table.self_sum
    return np.where(T >= 2, np.clip(agreeing / np.maximum(T * (T - 1), 1), 0.0, 1.0), np.nan)


def fleiss_kappa(table: VoxelTable) -> float:
    """Return Fleiss' kappa of the voxels with OP >= 2, each counting once (Fleiss 1971, Psychological Bulletin 76).

    1 - (1 - mean PSA) / (1 - ||p||^2) with p the mean belief. OP may vary from voxel to voxel: if it does not, this
    is Fleiss' own definition. NaN if no two frames saw one location, or only one class was predicted.
    """
    return float(kappa_of(_sums(kappa_columns, table)))


def krippendorff_alpha(table: VoxelTable) -> float:
    """Return Krippendorff's alpha, nominal, of the voxels with OP >= 2, each counting by its OP (Krippendorff 2018, ch.

    12).

    1 - (1 - A) / (1 - A_e): A is the mean of PSA weighted by OP, and A_e is the same agreement between all
    observations, as if they were of one voxel. NaN if no two frames saw one location, or only one class was
    predicted.
    """
    return float(alpha_of(alpha_sums(table)))


def alpha(unit: npt.ArrayLike, label: npt.ArrayLike) -> float:
    """Return Krippendorff's alpha, nominal, of labels alone, without a run or a map (Krippendorff 2018, ch. 12).

    A unit weighs by its number of labels. Units with one label do not count.

    Args:
        unit: (n,) integers: the spot, voxel or object that a view labelled.
        label: (n,) integers: the class that the view gave it; negative ones are no label.

    Returns:
        Alpha, at most 1; NaN if no unit has two labels, or all labels are of one class.

    Raises:
        ValueError: If the two differ in shape, or are not integers.

    Examples:
        Two views label four spots; they differ about the last one:

        >>> round(alpha([0, 0, 1, 1, 2, 2, 3, 3], [5, 5, 5, 5, 2, 2, 2, 5]), 3)
        0.533
    """
    units, labels = np.asarray(unit), np.asarray(label)
    if units.shape != labels.shape or units.ndim != 1 or not {units.dtype.kind, labels.dtype.kind} <= {"i", "u"}:
        raise ValueError("unit and label must be integers of one shape (n,)")
    units, labels = units[labels >= 0], labels[labels >= 0]
    _, units, views = np.unique(units, return_inverse=True, return_counts=True)
    again = views[units] >= 2
    units, labels = units[again], np.unique(labels[again], return_inverse=True)[1]
    of_class = np.bincount(labels)
    pairs, count = np.unique(units * len(of_class) + labels, return_counts=True)
    agreeing = count * (count - 1.0) / (views[pairs // max(len(of_class), 1)] - 1)
    n = float(len(labels))
    return float(alpha_of(np.array([agreeing.sum(), n, n, *of_class])))


def alpha_sums(table: VoxelTable) -> Float64:
    """Return the sums (3 + K,) that give Krippendorff's alpha of a map; sums of its parts add up."""
    return _sums(alpha_columns, table)


def _sums(columns: Callable[[VoxelTable], Float64], table: VoxelTable) -> Float64:
    """Return sums (C,) of columns (n, C) over a table's voxels, of which few are dense at a time."""
    return functools.reduce(np.add, (columns(table.rows(rows)).sum(axis=0) for rows in table.evidence.chunks()))


def psa_columns(table: VoxelTable) -> Float64:
    """Return (n, 2): the columns whose sums over voxels give the mean of PSA."""
    again = table.op >= 2
    return np.stack([np.where(again, psa(table), 0.0), again], axis=1)


def ratio_of(sums: Float64) -> Float64:
    """Return a mean (...,) from the sums (..., 2) of values and of weights; NaN if the weights sum to 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = sums[..., 0] / sums[..., 1]
    return ratio


def kappa_columns(table: VoxelTable) -> Float64:
    """Return (n, 2 + K): the columns whose sums over voxels give Fleiss' kappa."""
    again = (table.op >= 2)[:, None]
    belief = np.where(again, table.evidence / table.op[:, None], 0.0)
    return np.concatenate([psa_columns(table), belief], axis=1)


def kappa_of(sums: Float64) -> Float64:
    """Return Fleiss' kappa (...,) from sums (..., 2 + K)."""
    observed = ratio_of(sums[..., :2])
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = ((sums[..., 2:] / sums[..., 1:2]) ** 2).sum(axis=-1)
    return beyond_chance(1 - observed, 1 - expected)


def alpha_columns(table: VoxelTable) -> Float64:
    """Return (n, 3 + K): the columns whose sums over voxels, each counting by its OP, give Krippendorff's alpha."""
    again = table.op >= 2
    w = np.where(again, table.op, 0.0)
    agreeing, self_agreement = w * np.where(again, psa(table), 0.0), w * table.self_sum / table.op
    return np.concatenate(
        [np.stack([agreeing, w, self_agreement], axis=1), (w / table.op)[:, None] * table.evidence], axis=1
    )


def alpha_of(sums: Float64) -> Float64:
    """Return Krippendorff's alpha (...,) from sums (..., 3 + K)."""
    n = sums[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = ((sums[..., 3:] ** 2).sum(axis=-1) - sums[..., 2]) / (n * (n - 1))
    return beyond_chance(1 - ratio_of(sums[..., :2]), 1 - expected)


def meaning_alpha_of(sums: Float64) -> Float64:
    """Return alpha (...,) with distances between classes, which are points: sums (..., 4 + 2 K) of `MEANING_SUMS`.

    With points z and squared distances d(a, b) = |z_a|^2 + |z_b|^2 - 2 z_a . z_b, alpha = 1 - mean d of two labels of
    one spot / mean d of two labels of anywhere (Krippendorff 2018, Content Analysis, ch. 12). The last K coordinates
    count negatively.
    """
    n, K = sums[..., 1], (sums.shape[-1] - 4) // 2
    with np.errstate(invalid="ignore", divide="ignore"):
        total = (sums[..., 4 : 4 + K] ** 2).sum(axis=-1) - (sums[..., 4 + K :] ** 2).sum(axis=-1)
        norm, apart = sums[..., 3] / n, (total - sums[..., 2]) / (n * (n - 1))
        return beyond_chance(norm - sums[..., 0] / n, norm - apart)


def class_alpha_of(sums: Float64) -> Float64:
    """Return alpha (...,) of a class against all others, from sums (..., 4).

    They are of the disagreement of each observation with the others of its location, of observations, of evidence s for
    the class, and of s^2 of single observations.
    """
    apart, n, total, squares = np.moveaxis(sums, -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * ((n - 1) * total - total**2 + squares) / (n * (n - 1))
        return beyond_chance(apart / n, expected)


def disagreement(table: VoxelTable) -> tuple[Float64, Float64]:
    """Return 1 - PSA of each voxel as a sum (n,), (n,): within a frame, and between frames; NaN if OP < 2.

    The part within is the mean of 1 - ||s_t||^2, of two pixels of one frame; the part between is half the mean
    ||s_t - s_u||^2 of two frames. The expectation of neither depends on OP where frames are independent draws.
    """
    agreement = psa(table)
    again = table.op >= 2
    self_agreement = np.where(again, table.self_sum / table.op, np.nan)
    return 1 - self_agreement, np.maximum(self_agreement - agreement, 0.0)


def class_agreement(table: VoxelTable, events: Events | None = None) -> tuple[ClassAgreement, ...]:
    """Return kappa and alpha of each class, every observation reduced to (s_k, 1 - s_k).

    Without events, only one-hot evidence shows how the frames agree on a class: the result is NaN for other evidence.
    """
    return class_agreement_of(class_sums(table, events), table.classes)


def class_sums(table: VoxelTable, events: Events | None = None) -> Float64:
    """Return the sums (7, K) over the voxels with OP >= 2 that `class_agreement_of` takes.

    They are evidence, that / OP, disagreement, that * OP, squares of single observations, voxels and observations.
    """
    K, again, T = table.K, table.op >= 2, table.op.astype(np.float64)
    one_hot, has_squares = table.self_sum == table.op, True
    if events is None:
        one_hot, has_squares = np.ones(len(table), np.bool_), one_hot_where(table, again)
    pairs = np.where(again, T * np.maximum(T - 1, 1), 1.0)

    def squares(s: Float64, voxel: Int64) -> Float64:
        return np.where(one_hot[voxel], s, 0.0)

    def disagreement(s: Float64, voxel: Int64) -> Float64:
        apart: Float64 = 2.0 * ((T[voxel] - 1.0) * s - s * s + squares(s, voxel)) / pairs[voxel]
        return apart

    def weighted(s: Float64, voxel: Int64) -> Float64:
        return T[voxel] * disagreement(s, voxel)

    group = np.where(again, 0, -1)
    sums = table.evidence.sums_by_class(
        group, 1, lambda s, _: s, lambda s, voxel: s / T[voxel], disagreement, weighted, squares
    )
    if events is not None:  # evidence that is not one-hot: the log has the squares of its observations
        of = events.voxel

        def further(s: Float64, row: Int64) -> Float64:
            apart: Float64 = 2.0 * s**2 / pairs[of[row]]
            return apart

        logged = events.evidence.sums_by_class(
            np.where(one_hot, -1, group)[of], 1, further, lambda s, row: T[of[row]] * further(s, row), lambda s, _: s**2
        )
        sums[2:] = [a + b for a, b in zip(sums[2:], logged, strict=True)]
    by_class = np.concatenate(sums)
    if not has_squares:
        by_class[2:, by_class[0] > 0] = np.nan
    counts = np.full((2, K), [[np.count_nonzero(again)], [table.op.sum(where=again, dtype=np.float64)]], np.float64)
    return np.concatenate([by_class, counts])


def class_agreement_of(sums: Float64, classes: Sequence[str] = ()) -> tuple[ClassAgreement, ...]:
    """Return kappa and alpha of each class, from `class_sums`."""
    total, shares, apart, weighted, squares, voxels, n = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        p = shares / voxels
        kappa = beyond_chance(apart / voxels, 2 * p * (1 - p))
    alpha = class_alpha_of(np.stack([weighted, n, total, squares], axis=-1))
    names = classes or tuple(str(k) for k in range(len(total)))
    rows = zip(names, total, kappa, alpha, strict=True)
    return tuple(ClassAgreement(name, *(float(value) for value in values)) for name, *values in rows)


def one_hot_where(table: VoxelTable, where: Mask) -> bool:
    """Return whether all observations are one-hot of the voxels for which `where` (n,) holds."""
    return bool((np.abs(table.self_sum - table.op) <= ONE_HOT * table.op)[where].all())


def beyond_chance(observed: Float64, expected: Float64) -> Float64:
    """Return 1 - D_o / D_e from disagreement, observed and by chance; NaN if chance alone would always agree."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = observed / expected
    beyond: Float64 = np.where(expected.real > ONE_HOT, 1 - ratio, np.nan)
    return beyond


# The entropy of a voxel's belief comes from within each frame, or from disagreement between frames.


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Normalised entropy of each voxel (n,) as a sum of two parts, all in units of log K, in [0, 1].

    Attributes:
        within: Mean entropy of the frames' own evidence: class borders, voxels larger than things, unsure scores.
        between: Generalised Jensen-Shannon divergence of the frames' evidence: their disagreement in time.
        total: Within + between, the entropy of the belief.
    """

    within: Float64
    between: Float64
    total: Float64


def decompose(table: VoxelTable) -> Uncertainty:
    """Split the entropy: H(mean_t s_t) = mean_t H(s_t) + JSD(s_1, ..., s_T) (Lin 1991, IEEE TIT 37, equal weights).

    Between-frame entropy is 0 at OP = 1 and grows with OP for the very same predictions: compare it within a stratum.
    """
    total = entropy(table)
    within = table.frame_entropy_sum / table.op / math.log2(table.K)
    return Uncertainty(np.minimum(within, total), np.maximum(total - within, 0.0), total)


# The consistency of a location is a probability, because a few frames that agree show less than many.
#
# Frames agree or not by chance: of locations that all err in one frame of ten, those that three frames saw look perfect
# more often than those that thirty saw. So a location borrows from all locations of its map.

LIKELY = 0.5
"""A location is called consistent from this probability on."""

STEPS, ROUNDS = 80, 200
"""Shares of the dominant class that a location may have, between 1/2 and 1, and rounds of the EM algorithm."""


def consistent_share(agreement: float = CONSISTENT) -> float:
    """Return the share p of the dominant class from which two frames agree with that probability: p^2 + (1 - p)^2."""
    return (1 + math.sqrt(2 * agreement - 1)) / 2


def shares_of(table: VoxelTable) -> Float64:
    """Return how many of a map's locations (STEPS,) have which share of the dominant class."""
    num_frames, most, of = _votes(table)
    count, likelihood, share = np.bincount(of), _likelihood(num_frames, most), np.full(STEPS, 1 / STEPS)
    if not len(num_frames):
        return share
    for _ in range(ROUNDS):  # probability of each share, a posteriori
        share = share * ((count / (likelihood @ share)) @ likelihood) / count.sum()
    return share


def consistency_posterior(
    table: VoxelTable, shares: Float64 | None = None, *, consistent: float = CONSISTENT
) -> Float64:
    """Return (n,) the probability that a location is consistent, given its frames and all locations; NaN if OP < 2.

    Of T frames m vote for the dominant class, which happens with the probability b(m; T, p) + b(T - m; T, p) where its
    share is p. How many locations have which p is estimated from all of them without any form of its distribution
    (Kiefer and Wolfowitz 1956, Annals of Mathematical Statistics 27; by the EM algorithm), then Bayes' theorem is
    applied. `shares` are those of the whole map, where the table has only some of its locations. Of evidence that does
    not count frames it is unknown: NaN.
    """
    if not table.counts_frames:
        return np.full(len(table), np.nan)
    num_frames, most, of = _votes(table)
    posterior = _likelihood(num_frames, most) * (shares_of(table) if shares is None else shares)
    posterior /= posterior.sum(axis=1, keepdims=True)
    likely = np.full(len(table), np.nan)
    enough = posterior[:, consistent_share(consistent) <= STEPS_OF_P]
    likely[table.op >= 2] = np.ascontiguousarray(enough).sum(axis=1)[of]  # else a part's order would differ
    return likely


STEPS_OF_P = 0.5 + 0.5 * (np.arange(STEPS) + 0.5) / STEPS


def _likelihood(num_frames: Int64, most: Int64) -> Float64:
    """Return (v, STEPS) of votes given each share, up to a factor of each row."""
    m, rest, p, q = most[:, None], (num_frames - most)[:, None], np.log(STEPS_OF_P), np.log1p(-STEPS_OF_P)
    direct, folded = m * p + rest * q, rest * p + m * q
    best = np.maximum(direct, folded).max(axis=1, keepdims=True)
    likelihood: Float64 = np.exp(direct - best) + np.exp(folded - best)
    return likelihood


def _votes(table: VoxelTable) -> tuple[Int64, Int64, Int64]:
    """Return each pair of frames that saw a location and votes for its class once (v,), (v,).

    The third array has the pair of each location with OP >= 2.
    """
    again = table.op >= 2
    T = table.op[again].astype(np.int64)
    longest = int(T.max(initial=0)) + 1
    pairs, of = distinct_keys(np.rint(vss(table)[again] * T).astype(np.int64) + T * longest)
    num_frames, most = np.divmod(pairs, longest)
    return num_frames, most, of
