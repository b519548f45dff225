"""Plain loops that do what hand-written instructions of the compiled backends do: what these are held to, and timed."""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.backends.shared.score_loops import LANES

plain = nb.njit(error_model="numpy", nogil=True)


def compiled_call(by_hand):
    """Return what is written by hand for compiled loops as a function for tests."""

    @plain
    def call(*arguments):
        return by_hand(*arguments)

    return call


@plain
def touch(_array, _index):
    """Ask for no memory ahead."""


@plain
def _plogp(p):
    return p * np.log2(p) if p > 0.0 else 0.0


@plain
def observe_eights(evidence, sums, share, before, after):
    """Add s = share * sums to evidence, and return sums over the result; see `semstab.backends.shared.beliefs`."""
    plogp_after = plogp_between = squares = plogp_seen = 0.0
    top, dominant = -1.0, np.int64(0)
    for k in range(evidence.shape[0]):
        p, s = before * np.float64(evidence[k]), share * sums[k]
        evidence[k] += s
        q = after * np.float64(evidence[k])
        plogp_after += _plogp(q)
        plogp_between += _plogp(0.5 * (p + q))
        squares += s * s
        plogp_seen += _plogp(s)
        if evidence[k] > top:
            top, dominant = np.float64(evidence[k]), np.int64(k)
    return plogp_after, plogp_between, squares, plogp_seen, top, dominant


@plain
def plogp_eights(evidence, before):
    """Return the sum of p log2 p over p = before * evidence."""
    total = 0.0
    for k in range(evidence.shape[0]):
        total += _plogp(before * np.float64(evidence[k]))
    return total


@plain
def scale_eight(scores, at, K, keys, scale, u):
    """Invert the sum of each of eight pixels' scores; the key of a pixel whose sum is no positive number becomes -1."""
    for i in range(LANES):
        total = 0.0
        for k in range(K):
            total += np.float64(scores[at + i * K + k])
        if not 0.0 < total < np.inf:
            keys[u + i] = -1
        scale[u + i] = 1.0 / total


@plain
def add_two(scores, at, K, scale, u, end, sums, to, fresh):
    """Add the scores of two pixels, one if the second is not below `end`, to their voxel."""
    for k in range(K):
        total = 0.0 if fresh else sums[to + k]
        for pixel in range(u, min(u + 2, end)):
            total += scale[pixel] * np.float64(scores[at + pixel * K + k])
        sums[to + k] = total
    if fresh:
        for k in range(K, (K + LANES - 1) // LANES * LANES):
            sums[to + k] = 0.0


BY_HAND = {
    "memory asked for ahead": ("pixel_keys", ("touch",), (touch,)),
    "logarithms": ("beliefs", ("observe_eights", "plogp_eights"), (observe_eights, plogp_eights)),
    "sums of scores": ("score_loops", ("scale_eight", "add_two"), (scale_eight, add_two)),
}
"""What is written by hand: the module of `semstab.backends.shared`, its names there, and the plain loops."""
