"""Other rules to fuse a voxel's observations, applied to their log: does the choice change the findings?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.model.evidence import Evidence, row_chunks
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
class Belief(Evidence):
    """Beliefs (n, K) by the classes that each voxel saw; `rest` (n,) is that in each of the others."""

    rest: Float64

    def _stretch(self, first: int = 0, last: int | None = None) -> Float64:
        dense = super()._stretch(first, last)
        rest = np.broadcast_to(self.rest[first : first + len(dense), None], dense.shape)
        np.copyto(dense, rest, where=dense == 0.0)
        return dense


@dataclass(frozen=True, eq=False)
class Fused:
    """A map fused by one rule, of which every measure can be computed: `VSS.of(fused)`.

    evidence   the belief after the last observation
    op         (n,) int32 observations
    drift_sum  (n,) sum of the Jensen-Shannon divergences of successive beliefs, bits
    """

    evidence: Belief
    op: npt.NDArray[np.int32]
    drift_sum: Float64

    @property
    def belief(self) -> Float64:
        """(n, K) the belief after the last observation."""
        return np.asarray(self.evidence)


def fuse(events: Events, rule: str, *, floor: float | None = None) -> Fused:
    """Fuse the observations of every voxel, in their order, by one of `RULES`.

    A vote is for the argmax of s_bar, the lowest on ties. The products take max(s_bar, floor), normalised; floor is
    0.01, or 1/K where that is less.
    Raises ConfigError for another rule, or a floor outside (0, 1/K].
    """
    from semstab.statistics.loops import chunks, log_kernels

    K = events.evidence.K
    floor = min(FLOOR, 1 / K) if floor is None else floor
    if rule not in RULES:
        raise ConfigError(f"fusion rule '{rule}' is not known; there are {', '.join(RULES)}")
    if not 0 < floor <= 1 / K:
        raise ConfigError(f"floor = {floor:g}: it must be above 0 and at most 1/K = {1 / K:g}")
    bounds, log = np.append(events.starts, len(events)), events.evidence.entries
    count = np.zeros(len(bounds), np.int64)
    chunks.in_chunks(log_kernels.count_classes, bounds, log, K, count)
    first, entries = np.cumsum(count), np.diff(log[0][bounds])
    own = first, np.zeros(first[-1], np.uint16), np.zeros(first[-1]), np.zeros(len(entries))
    drift_sum = np.zeros(len(entries))
    chunks.in_chunks(
        log_kernels.fuse_by_rule, bounds, log, K, int(entries.max(initial=0)), RULES.index(rule), floor, own, drift_sum
    )
    first, label, belief, rest = own
    return Fused(Belief(first, label, belief, K, rest), np.diff(bounds).astype(np.int32), drift_sum)


def labels(evidence: Float64 | Evidence) -> npt.NDArray[np.int64]:
    """Class (n,) of the largest belief of evidence (n, K), the lowest of those that tie: rounding decides none."""
    return np.concatenate([_label(normalise(evidence[some])) for some in row_chunks(*evidence.shape)])


def _label(belief: Float64) -> npt.NDArray[np.int64]:
    near: npt.NDArray[np.bool_] = belief >= belief.max(axis=1, keepdims=True) - ONE_HOT
    highest: npt.NDArray[np.int64] = near.argmax(axis=1)
    return highest
