"""Do the frames agree about a place? Measures whose expectation does not depend on how many frames saw it.

Voxels are the units and frames the raters. Evidence that is not one-hot counts by its expected value: s_t . s_u is the
probability that a class drawn from s_t equals one drawn from s_u.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.model.measures import Quantity
from semstab.model.statistics import ClassAgreement
from semstab.model.voxels import Events, VoxelTable

Float64 = npt.NDArray[np.float64]

PSA = Quantity(key="psa", title="PSA", better="higher")
KAPPA = Quantity(key="kappa", title="Kappa", better="higher", digits=(2, 4))
ALPHA = Quantity(key="alpha", title="Alpha", better="higher", digits=(2, 4))

ONE_HOT = 1e-9
"""Evidence whose squared norm is this near to 1 is one-hot."""


def psa(table: VoxelTable) -> Float64:
    """Pairwise semantic agreement (n,): the mean of s_t . s_u over pairs of different frames, in [0, 1].

    PSA = (||e||^2 - sum_t ||s_t||^2) / (T (T - 1)); NaN where T < 2. For frames that are independent draws from pi its
    expectation is ||pi||^2 for every T >= 2.
    """
    T = table.op.astype(np.float64)
    pairs = table.evidence.rowwise(lambda e: (e**2).sum(axis=1)) - table.self_sum
    agreement = np.full(len(table), np.nan)
    again = table.op >= 2
    agreement[again] = np.clip(pairs[again] / (T * (T - 1))[again], 0.0, 1.0)
    return agreement


def fleiss_kappa(table: VoxelTable) -> float:
    """Fleiss' kappa of the voxels with OP >= 2, each counting once (Fleiss 1971, Psychological Bulletin 76).

    1 - (1 - mean PSA) / (1 - ||p||^2) with p the mean belief. OP may vary from voxel to voxel: where it does not, this
    is Fleiss' own definition. NaN where no two frames saw one place, or only one class was predicted.
    """
    return float(kappa_of(kappa_columns(table).sum(axis=0)))


def krippendorff_alpha(table: VoxelTable) -> float:
    """Krippendorff's alpha, nominal, of the voxels with OP >= 2, each counting by its OP (Krippendorff 2018, ch. 12).

    1 - (1 - A) / (1 - A_e): A is the mean of PSA weighted by OP, and A_e is the same agreement between all
    observations, as if they were of one voxel. NaN where no two frames saw one place, or only one class was predicted.
    """
    return float(alpha_of(alpha_columns(table).sum(axis=0)))


def psa_columns(table: VoxelTable) -> Float64:
    """(n, 2): what a mean of PSA is a function of by its sum over voxels."""
    again = table.op >= 2
    return np.stack([np.where(again, psa(table), 0.0), again], axis=1)


def ratio_of(sums: Float64) -> Float64:
    """A mean (...,) from the sums (..., 2) of values and of weights; NaN where the weights sum to 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = sums[..., 0] / sums[..., 1]
    return ratio


def kappa_columns(table: VoxelTable) -> Float64:
    """(n, 2 + K): what Fleiss' kappa is a function of by its sum over voxels."""
    again = (table.op >= 2)[:, None]
    belief = np.where(again, table.evidence / table.op[:, None], 0.0)
    return np.concatenate([psa_columns(table), belief], axis=1)


def kappa_of(sums: Float64) -> Float64:
    """Fleiss' kappa (...,) from sums (..., 2 + K)."""
    observed = ratio_of(sums[..., :2])
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = ((sums[..., 2:] / sums[..., 1:2]) ** 2).sum(axis=-1)
    return _beyond_chance(observed, expected)


def alpha_columns(table: VoxelTable) -> Float64:
    """(n, 3 + K): what Krippendorff's alpha is a function of by its sum over voxels."""
    again = table.op >= 2
    T = np.where(again, table.op, 0)
    agreeing = T * np.where(again, psa(table), 0.0)
    own = np.where(again, table.self_sum, 0.0)
    return np.concatenate([np.stack([agreeing, T, own], axis=1), np.where(again[:, None], table.evidence, 0.0)], axis=1)


def alpha_of(sums: Float64) -> Float64:
    """Krippendorff's alpha (...,) from sums (..., 3 + K)."""
    n = sums[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = ((sums[..., 3:] ** 2).sum(axis=-1) - sums[..., 2]) / (n * (n - 1))
    return _beyond_chance(ratio_of(sums[..., :2]), expected)


def class_agreement(table: VoxelTable, events: Events | None = None) -> tuple[ClassAgreement, ...]:
    """Kappa and alpha of each class, every observation reduced to (s_k, 1 - s_k).

    Without events only one-hot evidence tells how the frames agree on a class: NaN where other evidence is there.
    """
    again, of = table.op >= 2, np.repeat(np.arange(len(table)), np.diff(table.evidence.starts))
    used = again[of]  # classes that nobody saw in a voxel are no disagreement there
    k, e, squares = table.evidence.label[used], table.evidence.weight[used], _squares(table, events)[used]
    T = table.op[of][used].astype(np.float64)
    disagreement = 2 * ((T - 1) * e - e**2 + squares) / (T * (T - 1))
    voxels, n = np.count_nonzero(again), table.op[again].sum(dtype=np.float64)

    def by_class(values: Float64) -> Float64:
        return np.bincount(k, weights=values, minlength=table.K).astype(np.float64)

    total = by_class(e)
    with np.errstate(invalid="ignore", divide="ignore"):
        p = by_class(e / T) / voxels
        kappa = _beyond_chance(1 - by_class(disagreement) / voxels, 1 - 2 * p * (1 - p))
        expected = 2 * ((n - 1) * total - total**2 + by_class(squares)) / (n * (n - 1))
        alpha = _beyond_chance(1 - by_class(T * disagreement) / n, 1 - expected)
    names = table.classes or tuple(str(k) for k in range(table.K))
    rows = zip(names, total, kappa, alpha, strict=True)
    return tuple(ClassAgreement(name, *(float(value) for value in values)) for name, *values in rows)


def _squares(table: VoxelTable, events: Events | None) -> Float64:
    """The sum over frames of s_tk^2 for each entry (m,) of the table's evidence."""
    if events is not None:
        from semstab.statistics import kernels, log_kernels

        squares, bounds = np.zeros(len(table.evidence.weight)), np.append(events.starts, len(events))
        voxels = table.evidence.entries
        kernels.in_chunks(log_kernels.sum_squares, bounds, events.evidence.entries, table.K, voxels, squares)
        return squares
    again = table.op >= 2
    one_hot = (np.abs(table.self_sum - table.op) <= ONE_HOT * table.op)[again].all()
    return table.evidence.weight if one_hot else np.full(len(table.evidence.weight), np.nan)


def _beyond_chance(observed: Float64, expected: Float64) -> Float64:
    """1 - (1 - observed) / (1 - expected); NaN where chance alone would always agree."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = (1 - observed) / (1 - expected)
    beyond: Float64 = np.where(1 - expected > ONE_HOT, 1 - ratio, np.nan)
    return beyond
