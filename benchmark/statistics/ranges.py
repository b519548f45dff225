"""Agreement by the distance from which spots were seen, and the range up to which labels can be relied on."""

from __future__ import annotations

import itertools
import math

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Scope
from semstab.data.statistics import UNKNOWN, RangeAgreement, RangeStratum
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import chance_of
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.observations import SpotObservations
from semstab.statistics.verdict import LEAST_CLASSES, LIMITS, Limits

EDGES: Float64 = np.array([m * 10.0**e for e in range(-1, 4) for m in (1, 1.5, 2, 3, 5, 7)])
"""Ranges, in metres, at which strata end."""

LEAST_ENTRIES, LEAST_SHARE = 2000, 0.02
"""The least entries of a stratum, and their share in all; a smaller one is joined with the next."""

LEAST_SEEN_TWICE = 200
"""The least number of spots that two views saw from a range, for it to be assessed."""


def range_agreement(
    spots: SpotObservations, scope: Scope = THIS_SCENE, limits: Limits = LIMITS
) -> RangeAgreement | None:
    """Return alpha by range, from spots; None if all were seen from about one distance.

    A stratum is assessed, and has an alpha, where two views saw LEAST_SEEN_TWICE spots or more and they have
    LEAST_CLASSES effective classes or more.

    The range of an observation is the distance of the spot from its view's centre. A stratum has the observations that
    were made in it: two of one spot count together where both fall into it.
    """
    if not len(spots):
        return None
    distance = spots.distance
    edges = edges_of(distance)
    if len(edges) < 3:
        return None
    strata = []
    for low, high in itertools.pairwise(edges):
        within = spots.only((distance >= low) & ((distance < high) | (high == edges[-1])))
        sums = sums_of_spots(within)
        first = sums.answers[0]
        seen_twice = round(float(first["voxels"].sum()))
        assessed = seen_twice >= LEAST_SEEN_TWICE and chance_of(first) * LEAST_CLASSES <= 1
        alpha = estimate(sums, "alpha", scope=scope_of(sums, scope)) if assessed else UNKNOWN
        strata.append(RangeStratum(low, high, len(within) / len(spots), seen_twice, alpha))
    return RangeAgreement(tuple(strata), limits.usable, *_reliable(strata, limits.usable))


def edges_of(distance: Float64) -> list[float]:
    """Return ends of strata that each have enough entries, the first one 0; the last one is the farthest distance."""
    least = max(LEAST_ENTRIES, LEAST_SHARE * len(distance))
    chosen, below = [0.0], 0
    for edge in EDGES.tolist():
        nearer = int(np.count_nonzero(distance < edge))
        if nearer - below >= least and len(distance) - nearer >= least:
            chosen.append(edge)
            below = nearer
    farthest = float(distance.max())
    return [*(edge for edge in chosen if edge < farthest), farthest]


def _reliable(strata: list[RangeStratum], usable: float) -> tuple[float, float, float]:
    """Return the range up to which alpha stays above a level, and the least and the largest that it may be.

    Strata count from the nearest on, up to the first one below.
    """

    def up_to(values: list[float]) -> float:
        reached = 0.0
        for stratum, value in zip(strata, values, strict=True):
            if math.isnan(value):
                continue  # not assessed
            if value < usable:
                break
            reached = stratum.high
        return reached

    alphas = [stratum.alpha for stratum in strata]
    return up_to([a.value for a in alphas]), up_to([a.low for a in alphas]), up_to([a.high for a in alphas])
