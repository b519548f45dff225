"""Terms of entropy and of the Jensen-Shannon divergence, as compiled loops over classes add them up."""

from __future__ import annotations

import numpy as np

from semstab.runtime.compiled import serial


@serial
def plogp(p):
    """p log2 p, 0 for 0."""
    return p * np.log2(p) if p > 0.0 else 0.0


@serial
def js_term(p, q):
    """One class's part of the Jensen-Shannon divergence, bits."""
    m = 0.5 * (p + q)
    term = 0.0
    if p > 0.0 and m > 0.0:
        term += p * np.log2(p / m)
    if q > 0.0 and m > 0.0:
        term += q * np.log2(q / m)
    return 0.5 * term
