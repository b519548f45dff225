"""The compiled loop that reads off each voxel's belief what the maps are coloured by."""

from __future__ import annotations

import math
from typing import Any

from semstab.compiled import serial


@serial
def read_off(evidence: Any, label: Any, vss: Any, bits: Any) -> None:
    """Dominant class, VSS and entropy in bits of evidence (n, K), as `semstab.metrics` defines them, in one pass.

    Fills label (n,) uint16, and vss and bits (n,) float64.
    """
    n, K = evidence.shape
    for i in range(n):
        total = 0.0
        most = 0
        for k in range(K):
            total += evidence[i, k]
            if evidence[i, k] > evidence[i, most]:
                most = k
        label[i] = most
        vss[i] = evidence[i, most] / total
        bits[i] = 0.0
        if evidence[i, most] < total:
            for k in range(K):
                if evidence[i, k] > 0.0:
                    p = evidence[i, k] / total
                    bits[i] -= p * math.log2(p)
