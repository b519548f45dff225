"""Other rules to fuse a voxel's observations, applied to their log: does the choice change the findings?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.model.information import normalise
from semstab.model.voxels import Events
from semstab.statistics.agreement import ONE_HOT

Float64 = npt.NDArray[np.float64]

RULES = ("averaging", "majority", "product", "geometric")
"""The paper's mean of evidence; the share of frames that vote for a class; Bayes' product of the frames' evidence under
a flat prior; its geometric mean."""

FLOOR = 0.01
"""Smallest evidence of a class in the two products: a frame that gives a class none would veto it for ever."""


@dataclass(frozen=True, eq=False)
class Fused:
    """A map fused by one rule, of which every measure can be computed: `VSS.of(fused)`.

    belief     (n, K) after the last observation
    op         (n,) int32 observations
    drift_sum  (n,) sum of the Jensen-Shannon divergences of successive beliefs, bits
    """

    belief: Float64
    op: npt.NDArray[np.int32]
    drift_sum: Float64

    @property
    def evidence(self) -> Float64:
        """The belief."""
        return self.belief


def fuse(events: Events, rule: str, *, floor: float = FLOOR) -> Fused:
    """Fuse the observations of every voxel, in their order, by one of `RULES`.

    A vote is for the argmax of s_bar, the lowest on ties. The products take max(s_bar, floor), normalised.
    Raises ConfigError for another rule, or a floor outside (0, 1/K].
    """
    from semstab.statistics import kernels

    K = events.evidence.shape[1]
    if rule not in RULES:
        raise ConfigError(f"fusion rule '{rule}' is not known; there are {', '.join(RULES)}")
    if not 0 < floor <= 1 / K:
        raise ConfigError(f"floor = {floor:g}: it must be above 0 and at most 1/K = {1 / K:g}")
    n = len(events.ix)
    starts = np.append(events.starts, len(events))
    belief, drift_sum = np.zeros((n, K)), np.zeros(n)
    evidence = _evidence(events.evidence, rule, floor)
    kernels.in_chunks(
        kernels.fuse_by_rule, starts, evidence, rule in ("product", "geometric"), rule != "product", belief, drift_sum
    )
    return Fused(belief, np.diff(starts).astype(np.int32), drift_sum)


def labels(belief: Float64) -> npt.NDArray[np.int64]:
    """Class (n,) of the largest belief, the lowest of those that tie: rounding decides none."""
    near: npt.NDArray[np.bool_] = belief >= belief.max(axis=1, keepdims=True) - ONE_HOT
    highest: npt.NDArray[np.int64] = near.argmax(axis=1)
    return highest


def _evidence(s_bar: Float64, rule: str, floor: float) -> Float64:
    if rule == "averaging":
        return s_bar
    if rule == "majority":
        votes: Float64 = np.eye(s_bar.shape[1])[s_bar.argmax(axis=1)]
        return votes
    floored = np.maximum(s_bar, floor)
    return normalise(floored)
