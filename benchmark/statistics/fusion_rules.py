"""Other rules to fuse a voxel's observations, applied to their log: does the choice change the findings?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int32, Int64, UInt16
from semstab.errors import ConfigError
from semstab.model.events import Events
from semstab.model.evidence import Evidence
from semstab.model.information import Concentration
from semstab.statistics.agreement import ONE_HOT

RULES = ("averaging", "majority", "product", "geometric")
"""The paper's mean of evidence; the share of frames that vote for a class; Bayes' product of the frames' evidence under
a flat prior; its geometric mean."""

FLOOR = 0.01
"""Smallest evidence of a class in the two products: a frame that gives a class none would veto it for ever."""


@dataclass(frozen=True, eq=False)
class Belief(Evidence):
    """Beliefs (n, K) by the classes that each voxel saw; `rest` (n,) is that in each of the others."""

    rest: Float64

    @classmethod
    def with_bits(cls, first: Int64, label: UInt16, weight: Float64, K: int, rest: Float64, bits: Float64) -> Belief:
        """Where the entropy (n,) of each is known."""
        known = Concentration.of(first, label, weight, K, rest, bits)
        return cls(first, label, weight, K, rest, known=known)

    @property
    def unseen(self) -> Float64:
        """(n,) what each class without an entry has."""
        return self.rest

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
    op: Int32
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
    K = events.evidence.K
    floor = min(FLOOR, 1 / K) if floor is None else floor
    if rule not in RULES:
        raise ConfigError(f"fusion rule '{rule}' is not known; there are {', '.join(RULES)}")
    if not 0 < floor <= 1 / K:
        raise ConfigError(f"floor = {floor:g}: it must be above 0 and at most 1/K = {1 / K:g}")
    return fuse_all(events, [rule], floor=floor)[0]


def fuse_all(
    events: Events,
    rules: Sequence[str],
    *,
    floor: float | None = None,
    evidence: Evidence | None = None,
    rows: Int64 | None = None,
) -> list[Fused]:
    """Fuse the observations of every voxel by each of some rules, in one pass, as `fuse` does.

    evidence  of its voxels (n, K), where that is known: it has an entry for each class that a voxel ever saw
    rows      (n,) which voxels of the log these are, where they are not all
    """
    from semstab.core.compiled import in_chunks
    from semstab.statistics.loops.orders import fuse_by_rules

    K, log = events.evidence.K, events.evidence.entries
    first, label = _classes_seen(events) if evidence is None else (evidence.starts, evidence.label)
    starts, ends = (bounds if rows is None else bounds[rows] for bounds in (events.starts, events.ends))
    belief, *sums = (np.zeros((len(rules), size)) for size in (len(label), *3 * [len(starts)]))
    how = np.array([RULES.index(rule) for rule in rules]), min(FLOOR, 1 / K) if floor is None else floor
    in_chunks(fuse_by_rules, starts, ends, log, K, first, label, *how, belief, *sums)
    return [
        Fused(Belief.with_bits(first, label, own, K, rest, bits), (ends - starts).astype(np.int32), drift_sum)
        for own, rest, drift_sum, bits in zip(belief, *sums, strict=True)
    ]


def _classes_seen(events: Events) -> tuple[Int64, UInt16]:
    """The classes that each voxel of a log ever saw, ascending: bounds (n + 1,) and labels (m,)."""
    evidence, K = events.evidence, events.K
    key = np.unique(np.repeat(events.voxel, np.diff(evidence.starts)).astype(np.int64) * K + evidence.label)
    return np.searchsorted(key // K, np.arange(len(events.ix) + 1)), (key % K).astype(np.uint16)


def labels(evidence: Float64 | Evidence) -> Int64:
    """Return the class (n,) of the largest belief of evidence (n, K), the lowest of those that tie but for rounding."""
    evidence = Evidence.of(evidence)
    starts, label, weight = evidence.entries
    count = np.diff(starts)
    of, others = np.repeat(np.arange(len(evidence)), count), evidence.K - count
    rest = np.zeros(len(evidence)) if evidence.unseen is None else evidence.unseen
    total = np.bincount(of, weights=weight, minlength=len(evidence)) + others * rest
    least = np.maximum(np.maximum.reduceat(weight, starts[:-1]), np.where(others > 0, rest, 0.0)) - ONE_HOT * total
    lowest = np.minimum.reduceat(np.where(weight >= least[of], label, evidence.K).astype(np.int64), starts[:-1])
    # the lowest class without an entry: labels ascend, so that each entry at its own place has all lower ones before it
    gap = np.bincount(of[label == np.arange(len(label)) - starts[of]], minlength=len(evidence))
    return np.where((others > 0) & (rest >= least), np.minimum(lowest, gap), lowest)
