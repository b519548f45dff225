"""Terms of entropy and of the Jensen-Shannon divergence, as compiled loops over classes add them up."""

from __future__ import annotations

from typing import Any

import numpy as np

from semstab.backends.shared.scores.belief_vectors import observe_eights
from semstab.runtime.compiled import compiled, serial


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


@compiled(forceinline=True)
def observe_row(evidence, sums, pixels, op, dominant, plogp_before, out):
    """Add one observation to a voxel's dense evidence, seen `op` times before.

    evidence, sums  as `observe_eights` takes them; sums are those of the normalised scores of its pixels

    `dominant` and `plogp_before` are what the observation before left in out[4] and out[7], which spares looking for
    them. Leaves in `out` the change of VSS, that of the entropy in bits, the drift in bits, the dominant class before
    and after, the squared length of s_bar, its entropy in bits, and the sum of p log2 p over the classes.
    """
    before, after = 1.0 / max(op, 1), 1.0 / (op + 1)
    top_before = evidence[dominant] * before
    found: Any = observe_eights(evidence, sums, 1.0 / pixels, before, after)
    plogp_after, plogp_between, squares, plogp_seen, top, then = found
    out[0] = top * after - top_before
    out[1] = plogp_before - plogp_after
    out[2] = min(max(0.5 * (plogp_before + plogp_after) - plogp_between, 0.0), 1.0) if op > 0 else 0.0
    out[3], out[4], out[5], out[6], out[7] = dominant, then, squares, -plogp_seen, plogp_after
