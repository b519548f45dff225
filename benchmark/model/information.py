"""Entropy and Jensen-Shannon divergence in bits, over the last axis."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def normalise(evidence: npt.ArrayLike) -> Array:
    """The belief p: non-negative evidence (..., K) scaled to sum to 1 (paper, Persistent Voxel Evidence)."""
    e = np.asarray(evidence, dtype=np.float64)
    belief: Array = e / e.sum(axis=-1, keepdims=True)
    return belief


def entropy_bits(p: npt.ArrayLike) -> Array:
    """Shannon entropy -sum_k p_k log2 p_k of distributions (..., K), in bits; 0 log 0 = 0.

    >>> float(entropy_bits([0.5, 0.5]))
    1.0
    """
    p = np.asarray(p, dtype=np.float64)
    logs = np.log2(p, out=np.zeros_like(p), where=p > 0)
    entropy: Array = -(p * logs).sum(axis=-1)
    return np.maximum(entropy, 0.0)


def js_divergence(p: npt.ArrayLike, q: npt.ArrayLike) -> Array:
    """Jensen-Shannon divergence of distributions (..., K), in bits, so in [0, 1] (Lin 1991, IEEE TIT 37).

    D_JS(p, q) = 1/2 sum_k p_k log2(p_k / m_k) + 1/2 sum_k q_k log2(q_k / m_k), with m = (p + q) / 2.

    >>> float(js_divergence([1.0, 0.0], [0.0, 1.0]))
    1.0
    >>> round(float(js_divergence([1.0, 0.0], [0.5, 0.5])), 5)
    0.31128
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    m = (p + q) / 2
    divergence: Array = (_relative_entropy(p, m) + _relative_entropy(q, m)) / 2
    return np.clip(divergence, 0.0, 1.0)


def _relative_entropy(p: Array, m: Array) -> Array:
    """Kullback-Leibler divergence sum_k p_k log2(p_k / m_k), in bits; 0 where m_k underflows to 0."""
    p, m = np.broadcast_arrays(p, m)
    ratio = np.divide(p, m, out=np.ones(p.shape), where=np.minimum(p, m) > 0)
    divergence: Array = (p * np.log2(ratio)).sum(axis=-1)
    return divergence
