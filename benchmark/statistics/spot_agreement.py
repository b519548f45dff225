"""Alpha of each class at spots, its share of the disagreement, and classes that move."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Scope
from semstab.data import labels
from semstab.data.measures import dominant
from semstab.data.statistics import ClassAlpha, Meaning, MovingClasses, SpotAgreement
from semstab.data.voxels import VoxelTable
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import MOST_CLASSES, ClusterSums, chance_of, value
from semstab.statistics.groupings import halves_of
from semstab.statistics.intervals import estimate, probability_above, scope_of
from semstab.statistics.meaning import share_near
from semstab.statistics.observations import SpotObservations
from semstab.statistics.silence import silence
from semstab.statistics.verdict import LIMITS, Limits

LITTLE, MUCH = 0.01, 0.1
"""The shares of the disagreement from which on a class that moves, and all of them together, are analysed."""


def spot_agreement(
    spots: SpotObservations,
    sums: ClusterSums,
    table: VoxelTable,
    scope: Scope = THIS_SCENE,
    critical: Sequence[str] = (),
    limits: Limits = LIMITS,
) -> SpotAgreement:
    """Return alpha of each class, with the observations that alpha rests on.

    Args:
        spots: Labels that views give spots.
        sums: Sums of the map with these spots.
        table: The map, by which locations of a class are counted.
        scope: Scope of the intervals, if the views suffice for it.
        critical: Classes that the verdict depends on; by default, the classes with enough locations.
        limits: Limits of the verdict.
    """
    first = sums.answers[0]
    names, critical_names = sums.classes or tuple(str(k) for k in range(table.K)), set(critical) & set(sums.classes)
    locations = np.bincount(dominant(table)[table.op >= 2], minlength=table.K).tolist()
    scope_of_spots, evidence = scope_of(sums, scope), first["evidence"].sum(axis=0)
    alphas = [estimate(sums, "alpha", k, scope_of_spots) for k in range(table.K) if table.K <= MOST_CLASSES]
    silent = silence(spots)
    n, largest = float(first["observations"].sum()), int(evidence.argmax())
    disagreement = _disagreement(evidence / n if n else evidence, np.array([alpha.value for alpha in alphas]))
    moving = [k for k in labels.moving(names) if k < len(disagreement) and disagreement[k] >= LITTLE]
    return SpotAgreement(
        spacing=spots.spacing,
        spots=round(float(first["voxels"].sum())),
        cubes=first.cells,
        frames=spots.frames,
        views=len(spots.views),
        chance=chance_of(first),
        largest_class=names[largest],
        largest_share=float(evidence[largest]) / n if n else math.nan,
        labelled=spots.labelled_share(),
        classes=tuple(
            ClassAlpha(
                name,
                locations[k],
                name in critical_names if critical_names else locations[k] >= limits.class_locations,
                alpha,
                1 - probability_above(alpha, limits.usable, "agreement"),
                float(disagreement[k]),
            )
            for k, (name, alpha) in enumerate(zip(names, alphas, strict=False))
        ),
        moving=moving_classes(spots, sums, moving) if disagreement[moving].sum() >= MUCH else None,
        pixels_labelled=silent.pixels,
        pairs_labelled=silent.pairs,
        meaning=_meaning(spots, sums, scope),
    )


def _meaning(spots: SpotObservations, sums: ClusterSums, scope: Scope) -> Meaning | None:
    """Return agreement with the distances between classes; None without any."""
    if spots.distances is None or not sums.answers:
        return None
    number = "alpha_by_meaning"
    near = share_near(halves_of(spots, sums).sum(axis=0), spots.distances)
    return Meaning(estimate(sums, number, scope=scope_of(sums, scope, number)), near)


def moving_classes(spots: SpotObservations, sums: ClusterSums, moving: Sequence[int]) -> MovingClasses | None:
    """Return the share of the disagreement at locations of these classes, and alpha without them; None without any.

    The sums are of all spots.
    """

    def disagreeing(of: ClusterSums, alpha: float) -> float:
        first = of.answers[0]
        return float(first["observations"].sum()) * (1 - alpha) * (1 - chance_of(first))

    rest = sums_of_spots(spots.without(moving))
    alpha_of_all, alpha = (value(part, "alpha") for part in (sums, rest))
    if not (everywhere := disagreeing(sums, alpha_of_all)) > 0:
        return None
    share = 1 - disagreeing(rest, alpha) / everywhere
    return MovingClasses(tuple(sums.classes[k] for k in moving), min(max(share, 0.0), 1.0), alpha)


def _disagreement(shares: Float64, alpha: Float64) -> Float64:
    """Return the share (K,) of each class in all disagreement, from shares of the observations and alpha of each class.

    A class against all others disagrees with the probability (1 - alpha) 2 p (1 - p).
    """
    weight = np.nan_to_num((1 - alpha) * shares[: len(alpha)] * (1 - shares[: len(alpha)])).clip(min=0)
    total = weight.sum()
    return weight / total if total > 0 else np.full(len(weight), np.nan)
