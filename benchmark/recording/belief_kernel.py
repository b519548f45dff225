"""The compiled loop that reads off each voxel's belief what the maps are coloured by."""

from __future__ import annotations

import math
from typing import Any

import numba as nb


@nb.njit(cache=True, nogil=True)
def read_off(evidence: Any, label: Any, vss: Any, entropy: Any) -> None:
    """Dominant class, VSS and normalised entropy of evidence (n, K), as `semstab.metrics` defines them, in one pass.

    Fills label (n,) uint16, and vss and entropy (n,) float32.
    """
    n, K = evidence.shape
    for i in range(n):
        total = 0.0
        most = 0
        for k in range(K):
            total += evidence[i, k]
            if evidence[i, k] > evidence[i, most]:
                most = k
        bits = 0.0
        for k in range(K):
            if 0.0 < evidence[i, k] < total:
                p = evidence[i, k] / total
                bits -= p * math.log2(p)
        label[i] = most
        vss[i] = evidence[i, most] / total
        entropy[i] = bits / math.log2(K)
