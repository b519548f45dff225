"""Merge classes until views agree on the groups, which tells which distinctions hold.

One matrix of coincidences, how often two views of a spot give it two classes, tells alpha of any groups of classes
(Krippendorff 2011, Computing Krippendorff's Alpha-Reliability, has the name). So merges are tried without the
labels.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Int64, Scope
from semstab.data.events import Events
from semstab.data.statistics import Grouping, Groupings, Interval, Merge
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, lever_of
from semstab.statistics.intervals import estimate, probability_above, scope_of
from semstab.statistics.observations import SpotObservations
from semstab.statistics.verdict import DECIDED, LIMITS, Limits

MOST_CLASSES = 300
"""The largest number of classes whose merges are looked for: their matrix of coincidences takes .7 MB."""

LEAST_APART = 1e-6
"""Probability that two observations from anywhere differ below which nothing is left to agree about."""

FURTHER = 0.005
"""By how much alpha grows until the next grouping is looked at, if the one before is not surely stable."""


@dataclass(frozen=True, eq=False)
class Coincidences:
    """How often two views of a spot give it two classes, as alpha weighs them.

    Attributes:
        pairs: (K, K) shares of the pairs, symmetric; their sum is 1.
    """

    pairs: Float64

    @classmethod
    def from_counts(cls, counted: Float64) -> Coincidences:
        """Build them from numbers of pairs (K, K)."""
        total = float(counted.sum())
        return cls(counted / total if total > 0 else counted)

    @property
    def shares(self) -> Float64:
        """(K,) share of each class in the labels."""
        total: Float64 = self.pairs.sum(axis=1)
        return total

    @property
    def size(self) -> tuple[int, float]:
        """Number of classes that have a label, and exp of the entropy of their shares."""
        p = self.shares
        p = p[p > 0]
        return len(p), float(np.exp(-(p * np.log(p)).sum()))

    def alpha(self) -> float:
        """Return alpha of the classes; NaN if there is one class alone."""
        apart, expected = 1 - float(np.trace(self.pairs)), 1 - float((self.shares**2).sum())
        return 1 - apart / expected if expected > LEAST_APART else math.nan

    def merged(self, group: Int64) -> Coincidences:
        """Return the coincidences of groups (K,) of the classes, numbered from 0 on."""
        member = np.zeros((len(self.pairs), int(group.max()) + 1))
        member[np.arange(len(group)), group] = 1
        return Coincidences(member.T @ self.pairs @ member)

    def best_merge(self) -> tuple[int, int]:
        """Return the two classes, a < b, whose merge gives the largest alpha.

        A merge of a and b adds 2 p_ab to the pairs that agree, and 2 p_a p_b to those that would agree by chance.
        """
        p = self.shares
        apart = 1 - np.trace(self.pairs) - 2 * self.pairs
        expected = 1 - (p**2).sum() - 2 * np.outer(p, p)
        with np.errstate(invalid="ignore", divide="ignore"):
            alpha = np.where(expected > LEAST_APART, 1 - apart / expected, -np.inf)
        alpha[np.tril_indices(len(p))] = -np.inf
        a, b = np.unravel_index(int(alpha.argmax()), alpha.shape)
        return min(int(a), int(b)), max(int(a), int(b))


def halves_of(spots: SpotObservations, sums: ClusterSums) -> Float64:
    """Return coincidences (2, K, K) at the spots of two halves of space: every second cube of the sums is in one.

    First and second answers tell what they are at the spots as they tell alpha there, see `lever_of`.
    """
    first, second = (_pairs(log, sums.answers[0].edge) for log, _ in spots.logs()[:2])
    return np.maximum(first + lever_of(sums.answers) * (first - second), 0.0)


def _pairs(log: Events, edge: float) -> Float64:
    """Return (2, K, K): how often two views of a spot give it two classes, in both halves of space."""
    from semstab.statistics.loops.pairs import add_coincidences

    cube = np.stack([np.floor((axis + 0.5) * (log.voxel_size / edge)) for axis in (log.ix, log.iy, log.iz)])
    pairs = np.zeros((2, log.K, log.K))
    add_coincidences(log.bounds, log.evidence.entries, cube.sum(axis=0).astype(np.int64) & 1, pairs)
    return pairs


Step = tuple[int, int]
"""Two groups that are merged, each by one of its classes."""


def merges_of(found: Coincidences) -> list[Step]:
    """Return merges down to two groups; each raises alpha more than any other one would."""
    representatives = np.flatnonzero(found.shares > 0)  # a class of each group
    merged, steps = Coincidences(found.pairs[np.ix_(representatives, representatives)]), []
    while len(representatives) > 2:
        a, b = merged.best_merge()
        steps.append((int(representatives[a]), int(representatives[b])))
        group = np.arange(len(representatives))
        group[b:] -= 1
        group[b] = a
        merged, representatives = merged.merged(group), np.delete(representatives, b)
    return steps


def groups_after(K: int, steps: Sequence[Step]) -> Int64:
    """Return the group (K,) of each class after merges, numbered from 0 on by their first classes."""
    group = np.arange(K)
    for a, b in steps:
        members = group == group[b]
        group[members] = group[a]
    _, first, of = np.unique(group, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[of].astype(np.int64)


def flattery(halves: Sequence[Coincidences], most: int) -> Float64:
    """Return by how much (most,) the choice of 1, 2, ... merges flatters alpha.

    On each half, alpha of the groups that were chosen there is compared with that of those chosen on the other half.
    """
    K, (one, other) = len(halves[0].pairs), (merges_of(half) for half in halves)
    lost = np.zeros((2, most))
    for row, half, steps_of_half, steps_of_other in zip(lost, halves, (one, other), (other, one), strict=True):
        for n in range(most):
            alphas = (half.merged(groups_after(K, steps[: n + 1])).alpha() for steps in (steps_of_half, steps_of_other))
            row[n] = next(alphas) - next(alphas)
    mean: Float64 = np.nan_to_num(lost).mean(axis=0).clip(min=0)
    return mean


def groupings(
    spots: SpotObservations, sums: ClusterSums, scope: Scope = THIS_SCENE, limits: Limits = LIMITS
) -> Groupings | None:
    """Return which distinctions between classes hold; None for fewer than three classes or more than MOST_CLASSES.

    Args:
        spots: Labels that views give spots.
        sums: Sums with these spots.
        scope: Scope of the intervals, if the views suffice for it.
        limits: Limits of 'stable' and 'usable'.
    """
    K = spots.K
    if not (sums.answers and 2 < K <= MOST_CLASSES):
        return None
    pairs = halves_of(spots, sums)
    coincidences = Coincidences.from_counts(pairs.sum(axis=0))
    if not (steps := merges_of(coincidences)):
        return None
    less = flattery([Coincidences.from_counts(half) for half in pairs], len(steps))
    names = spots.classes or tuple(str(k) for k in range(K))
    merges = []
    for n, step in enumerate(steps):
        before = groups_after(K, steps[:n])
        first, second = (tuple(names[k] for k in np.flatnonzero(before == before[of])) for of in step)
        merged = coincidences.merged(groups_after(K, steps[: n + 1]))
        merges.append(Merge(first, second, *merged.size, merged.alpha() - less[n]))

    def finest(level: Literal["stable", "usable"], least: float) -> Grouping | None:
        """Return the finest grouping that is surely enough of a level, with its interval."""
        if coincidences.alpha() >= least:
            return None
        for n, merge in enumerate(merges):
            if not merge.alpha >= least:
                continue
            group = groups_after(K, steps[: n + 1])
            alpha = _alpha_of(spots, group, scope, less[n])
            if probability_above(alpha, least, "agreement") >= DECIDED:
                members = (np.flatnonzero(group == number) for number in range(int(group.max()) + 1))
                merged = tuple(tuple(names[k] for k in classes) for classes in members if len(classes) > 1)
                return Grouping(level, merged, merge.groups, merge.effective, alpha)
            least = merge.alpha + FURTHER
        return None

    stable, usable = finest("stable", limits.stable), finest("usable", limits.usable)
    if stable is not None and usable is not None and usable.groups <= stable.groups:
        usable = None
    return Groupings(coincidences.size[0], tuple(merges), stable, usable)


def grouped(spots: SpotObservations, group: Int64) -> SpotObservations:
    """Return the answers with groups (K,) of classes in place of classes; an answer without a label stays without."""
    K = int(group.max()) + 1
    of = np.concatenate([group, [K]]).astype(np.uint16)
    answers = {name: of[getattr(spots, name)] for name in ("label", "neighbour", "beyond")}
    return dataclasses.replace(spots, **answers, K=K, classes=(), distances=None)


def _alpha_of(spots: SpotObservations, group: Int64, scope: Scope, less: float) -> Interval:
    """Return alpha of groups of the classes, less what their choice flatters."""
    sums = sums_of_spots(grouped(spots, group))
    alpha = estimate(sums, "alpha", scope=scope_of(sums, scope))
    ends = {name: getattr(alpha, name) - less for name in ("value", "low", "high")}
    return dataclasses.replace(alpha, **ends)
