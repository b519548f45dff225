"""Agreement of features: alpha with the distance 1 - cosine, by range, angle, time and frame, and its worst places.

Labels are vectors with one 1; agreement of two labels is their product. With vectors of unit length in place of labels
the same sums give alpha of features: 1 - D / D_e with the mean distance D of two views of a spot and D_e of any two
observations (Krippendorff 2018, Content Analysis, ch. 12).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Int64, Scope
from semstab.data.statistics import UNKNOWN, FeatureAgreement, FeaturePlace, Interval, RangeStratum
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import alpha_of
from semstab.statistics.cluster_sums import (
    ALPHA_SUMS,
    FUNCTIONALS,
    ClusterSums,
    FrameGroups,
    Functional,
    distinct_rows,
    layout_of_features,
    most_groups,
    value,
)
from semstab.statistics.correlogram import BINS, Lag, in_bins
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.frame_disagreement import LEAST_VIEWS, LoneDisagreement, outlying_frames
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.ranges import LEAST_SEEN_TWICE, edges_of

FEATURE_ALPHA = dataclasses.replace(FUNCTIONALS["feature_alpha"], of_features=False)
PAIRED = Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=ALPHA_SUMS[:2])
"""Alpha of features, from their sums alone, of all observations and of pairs of them."""

SIDE, MOST_PLACES, LEAST_SPOTS, MOST_FRAMES = 8, 10, 8, 5
"""Coarse cells along the edge of a place; most places that are named, least spots of one, most frames named with it."""


@dataclass(frozen=True, eq=False)
class Likeness:
    """Agreement of each observation (m,) with the others of its spot, from their vectors.

    Attributes:
        views: Views T of its spot.
        own: Squared length of its vector: 1, or less if frames of one view differ.
        others: Mean cosine with the other views of its spot; NaN if there are none.
        among: Mean cosine of the other views with each other; NaN with fewer than two of them.
        spot: Mean cosine of two views of its spot; NaN if there is one.
        along: Its part along the sum of all vectors at spots that two views saw. How alpha changes with one vector
            depends on this part alone, as alpha depends on the length of the sum.
    """

    views: Int64
    own: Float64
    others: Float64
    among: Float64
    spot: Float64
    along: Float64


def likeness(observations: FeatureObservations) -> Likeness:
    """Return what vectors tell of each observation, with whole spots in memory one stretch after the other."""
    log = observations.log
    T, total = np.diff(log.bounds)[log.voxel], np.zeros(observations.D)
    for stretch in observations.stretches():
        total += (T[stretch] >= 2) @ observations.rows(stretch)
    along_all = total / (np.linalg.norm(total) or 1.0)
    squared_length, mean_with_others, among, spot, along = np.full((5, len(log)), np.nan)
    for stretch in observations.stretches():
        s, voxel, n = observations.rows(stretch), log.voxel[stretch], T[stretch].astype(np.float64)
        start, of = np.flatnonzero(np.diff(voxel, prepend=-1)), voxel - voxel[0]
        sums, square = np.add.reduceat(s, start, axis=0), np.einsum("ij,ij->i", s, s)
        with_others = np.einsum("ij,ij->i", s, sums[of]) - square
        pairs = (np.einsum("ij,ij->i", sums, sums) - np.add.reduceat(square, start))[of]  # of the spot, both ways
        squared_length[stretch], along[stretch] = square, s @ along_all
        with np.errstate(invalid="ignore", divide="ignore"):
            mean_with_others[stretch], spot[stretch] = with_others / (n - 1), pairs / (n * (n - 1))
            among[stretch] = (pairs - 2 * with_others) / ((n - 1) * (n - 2))
    among[T < LEAST_VIEWS] = np.nan
    return Likeness(T, squared_length, mean_with_others, among, spot, along)


def feature_sums(observations: FeatureObservations, of: Likeness, edge: float | None = None) -> ClusterSums:
    """Return the sums by cube and group of frames from which `FEATURE_ALPHA` follows.

    The mean cosine P of a spot is shared out among its T views, as the agreement of labels is:
    P + 2 (T - 1) / (T - 2) (a_t - P), where a_t is the mean cosine of view t with the others.
    """
    log = observations.log
    cubes, (groups, group, step, frames) = Cubes.of_log(log, edge), FrameGroups.at_most(most_groups(1), log.frame)
    at = cubes.at[log.voxel].astype(np.int64) * max(len(groups), 1) + group
    counted = np.flatnonzero((cubes.at[log.voxel] >= 0) & (of.views >= 2))
    T, spot, twice = of.views[counted], of.spot[counted], (of.views[counted] == 2).astype(np.float64)
    spread = np.where(T > 2, 2 * (T - 1) / np.maximum(T - 2, 1), 0.0)
    agreeing = spot + spread * (of.others[counted] - spot)
    columns = [
        1 / T, np.ones(len(counted)), agreeing, of.own[counted], twice, twice * spot,
        of.along[counted],
    ]  # fmt: skip
    total = cubes.count * len(groups)
    sums: Float64 = np.stack([np.bincount(at[counted], column, total).astype(np.float64) for column in columns], axis=1)
    rows = np.flatnonzero(sums[:, 1])
    cell, frame = np.divmod(rows, max(len(groups), 1))
    return ClusterSums(
        cubes.cell[cell], groups[frame].astype(np.int32), sums[rows],
        layout_of_features(), cubes.edge, step, log.voxel_size, (), frames,
    )  # fmt: skip


def alpha_of_features(observations: FeatureObservations) -> float:
    """Return alpha of features; NaN if no spot was seen by two views."""
    return value(feature_sums(observations, likeness(observations)), FEATURE_ALPHA) if len(observations) else math.nan


def feature_agreement(
    observations: FeatureObservations,
    of: Likeness,
    sums: ClusterSums,
    scope: Scope = THIS_SCENE,
    *,
    alone: bool = False,
    name: Callable[[int], str] = str,
) -> FeatureAgreement:
    """Return alpha of features with its interval, by range, angle, time and frame, and its worst places.

    Args:
        observations: Features that views give spots.
        of: Their `likeness`.
        sums: Their `feature_sums`.
        scope: Scope of the intervals, if there are enough views for it.
        alone: Whether the model gives no labels.
        name: Returns the name of a frame's file by its index.
    """
    n, similar, squares = (float(sums[key].sum()) for key in ("observations", "agreeing", "own"))
    total = float((sums["evidence"].sum(axis=0) ** 2).sum())
    return FeatureAgreement(
        components=observations.D,
        spots=round(float(sums["voxels"].sum())),
        views=len(observations.spots.views),
        one_in=observations.one_in,
        alpha=_alpha(sums, scope),
        cosine=similar / n if n else math.nan,
        chance=(total - squares) / (n * (n - 1)) if n > 1 else math.nan,
        alone=alone,
        correlogram=in_bins(observations.spots, functools.partial(_sums_of_pairs, observations, of), 1, PAIRED),
        ranges=_ranges(observations, scope),
        outlying_frames=outlying_frames(lone_features(observations, of), len(observations.spots.views), name=name),
        places=_places(observations, of),
    )


def _alpha(sums: ClusterSums, scope: Scope) -> Interval:
    return estimate(sums, FEATURE_ALPHA, scope=scope_of(sums, scope, FEATURE_ALPHA))


def _sums_of_pairs(
    features: FeatureObservations, of: Likeness, by_lag: Sequence[Lag], cluster: Int64, clusters: int
) -> list[Float64]:
    """Return the sums (bins + 1, clusters, 5) of pairs, as `in_bins` takes them: along the sum of a bin's vectors."""
    from semstab.statistics.loops.pairs import add_feature_pairs

    pairs_in = [_pairs_within(stretch, by_lag) for stretch in features.stretches()]
    totals = np.zeros((len(BINS) + 1, features.D))
    for stretch, pairs in zip(features.stretches(), pairs_in, strict=True):
        often = np.zeros((len(totals), stretch.stop - stretch.start))
        for first, second, bins in pairs:
            for axis in bins.T:
                np.add.at(often, (axis, first - stretch.start), 1)
                np.add.at(often, (axis, second - stretch.start), 1)
        totals += often @ features.rows(stretch)
    length = np.linalg.norm(totals, axis=1, keepdims=True)
    totals /= np.where(length > 0, length, 1.0)
    sums = np.zeros((len(totals), clusters, 5))
    for stretch, pairs in zip(features.stretches(), pairs_in, strict=True):
        s = features.rows(stretch)
        along = s @ totals.T
        for first, second, bins in pairs:
            agreed = np.einsum("ij,ij->i", s[first - stretch.start], s[second - stretch.start])
            add_feature_pairs(first, second, stretch.start, bins, cluster, agreed, of.own, along, sums)
    return [sums]


def _pairs_within(stretch: slice, by_lag: Sequence[Lag]) -> list[Lag]:
    """Return the pairs of each lag whose observations are in a stretch."""
    at = (slice(*np.searchsorted(first, (stretch.start, stretch.stop))) for first, _, _ in by_lag)
    return [(first[pairs], second[pairs], bins[pairs]) for pairs, (first, second, bins) in zip(at, by_lag, strict=True)]


def _ranges(features: FeatureObservations, scope: Scope) -> tuple[RangeStratum, ...]:
    """Return alpha of the observations from each range; empty if all were seen from about one distance."""
    distance = features.spots.distance
    edges = edges_of(distance) if len(distance) else []
    if len(edges) < 3:
        return ()
    strata = []
    for low, high in itertools.pairwise(edges):
        within = features.only((distance >= low) & ((distance < high) | (high == edges[-1])))
        sums = feature_sums(within, likeness(within))
        spots = round(float(sums["voxels"].sum()))
        alpha = _alpha(sums, scope) if spots >= LEAST_SEEN_TWICE else UNKNOWN
        strata.append(RangeStratum(low, high, len(within.vectors) / len(features.vectors), spots, alpha))
    return tuple(strata)


def lone_features(observations: FeatureObservations, of: Likeness) -> LoneDisagreement:
    """Return how far each frame's features are from those of other views at the same spots, in halves of 1 - cosine.

    The null is the same between these other views: so spots that are hard for all views blame no frame.
    """
    several = of.views >= LEAST_VIEWS
    frame, number = np.unique(observations.log.frame[several], return_inverse=True)
    places = np.bincount(number, minlength=len(frame))
    share, null = (
        np.bincount(number, (1 - cosine[several]) / 2, len(frame)).clip(min=0) / places
        for cosine in (of.others, of.among)
    )
    return LoneDisagreement(frame.astype(np.int64), places, share, null)


def _places(features: FeatureObservations, of: Likeness) -> tuple[FeaturePlace, ...]:
    """Return the cubes of SIDE coarse cells where features of two views differ most."""
    log = features.log
    again = np.flatnonzero(of.views >= 2)
    spot, first = np.unique(log.voxel[again], return_index=True)
    if not len(spot):
        return ()
    apart = 1 - of.spot[again][first]
    centre = (np.stack([log.ix, log.iy, log.iz], axis=1)[spot] + 0.5) * log.voxel_size
    _, at = distinct_rows(np.floor(centre / (SIDE * features.spots.spacing)).astype(np.int64))
    count, lost = np.bincount(at), np.bincount(at, apart)
    order = np.argsort(-lost, kind="stable")
    order = order[count[order] >= LEAST_SPOTS][:MOST_PLACES]
    total_loss, of_spot = float(lost.sum()), np.full(len(log.ix), -1)
    of_spot[spot] = at
    places = []
    for k in order.tolist():
        x, y, z = centre[at == k].mean(axis=0).tolist()
        frames, often = np.unique(log.frame[of_spot[log.voxel] == k], return_counts=True)
        most = frames[np.argsort(-often, kind="stable")[:MOST_FRAMES]]
        share = float(lost[k]) / total_loss if total_loss > 0 else math.nan
        cosine = 1 - float(lost[k] / count[k])
        places.append(FeaturePlace((x, y, z), int(count[k]), cosine, share, tuple(sorted(most.tolist()))))
    return tuple(places)
