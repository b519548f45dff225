"""The compiled loop that finds the largest scores of each pixel."""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.runtime.compiled import compiled, parallel

CHUNKS = 256


@compiled(fastmath={"reassoc", "contract"})
def _total(scores, at, K, shift, unit):
    """The sum of K scores by their bits: moved up by `shift` they are those of a double, the score in that unit."""
    total = 0.0
    for c in range(K):
        total += np.int64(np.int64(scores[at + c]) << shift).view(np.float64)
    return total * unit


@parallel
def cut(scores, k, kept, shift, unit, infinite, shares):
    """Copy the k largest scores of each pixel into `kept` (n, K), which is 0; scores (n * K,) by their bits.

    Bits of numbers from 0 on sort like the numbers, and NaN is above all: it is kept, and the pixel stays unusable.

    shift, unit  see `_total`; infinite: the bits of infinity
    shares       (CHUNKS, 3), 0: pixels with a prediction, the sum of the shares of their scores that are left out, and
                 the largest one
    """
    n, K = kept.shape
    for chunk in nb.prange(CHUNKS):
        place = np.empty(k, dtype=np.int64)  # of the largest so far, in descending order
        for i in range(n * chunk // CHUNKS, n * (chunk + 1) // CHUNKS):
            found = 0
            for c in range(K):
                value = scores[i * K + c]
                if found == k and value <= scores[i * K + place[k - 1]]:
                    continue
                at = min(found, k - 1)
                while at > 0 and scores[i * K + place[at - 1]] < value:
                    place[at] = place[at - 1]
                    at -= 1
                place[at] = c
                found = min(found + 1, k)
            for j in range(found):
                kept[i, place[j]] = scores[i * K + place[j]]
            if 0 < scores[i * K + place[0]] < infinite:
                left = 0.0
                for j in range(found):
                    left += _total(scores, i * K + place[j], 1, shift, unit)
                share = max(0.0, 1.0 - left / _total(scores, i * K, K, shift, unit))
                shares[chunk, 0] += 1.0
                shares[chunk, 1] += share
                shares[chunk, 2] = max(shares[chunk, 2], share)
