"""The compiled loop that finds the largest scores of each pixel."""

from __future__ import annotations

import numba as nb
import numpy as np

from semstab.runtime.compiled import parallel

CHUNKS = 256


@parallel
def cut(scores, k, kept):
    """Copy the k largest scores of each pixel into `kept` (n, K), which is 0; scores (n * K,) by their bits.

    Bits of numbers from 0 on sort like the numbers, and NaN is above all: it is kept, and the pixel stays unusable.
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
