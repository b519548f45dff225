"""All statistics of one map, as a summary and as a column for each voxel."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from semstab.core.types import THIS_SCENE, Float64, Scope
from semstab.data.events import Events
from semstab.data.features import OF_FEATURES
from semstab.data.information import by_group
from semstab.data.measures import SBD, MeasureMeans, measures
from semstab.data.results import TableSummary
from semstab.data.statistics import (
    UNKNOWN,
    ClassAgreement,
    CorrectnessStatistics,
    DriftStatistics,
    EntropyParts,
    FeatureAgreement,
    FlipRates,
    FrameAgreement,
    HeadlineStatistics,
    Interval,
    MapStatistics,
    Repeated,
    StratumStatistics,
)
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import shared_rows
from semstab.metrics.summary import STRATA, groups_of
from semstab.statistics.accumulate import Cubes, cluster_sums_of
from semstab.statistics.agreement import class_agreement_of, class_sums, consistency_posterior, shares_of
from semstab.statistics.cluster_sums import ClusterSums
from semstab.statistics.correctness import (
    MIOU,
    Predictions,
    Truth,
    by_stratum,
    correctness_of,
    join_truth,
    prediction_sums,
    quadrants,
    reliability_of,
    wrong_where_consistent,
)
from semstab.statistics.correlogram import correlogram
from semstab.statistics.cube_sums import (
    MEANS,
    OF_CHANGES,
    OF_CLUSTERS,
    OF_FLIPS,
    Columns,
    FlippingSums,
    location_sums,
    log_sums,
    row_columns,
)
from semstab.statistics.drift import expected_sbd
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.features import feature_agreement, feature_sums, likeness
from semstab.statistics.frame_disagreement import LoneDisagreement, by_frame, lone_disagreement, outlying_frames
from semstab.statistics.geometry import losses
from semstab.statistics.groupings import groupings
from semstab.statistics.intervals import estimate, headline_of, scope_of
from semstab.statistics.moving import moved_spots, moving_percent
from semstab.statistics.observations import SpotObservations
from semstab.statistics.ranges import range_agreement
from semstab.statistics.sample import MapSample
from semstab.statistics.spot_agreement import spot_agreement
from semstab.statistics.verdict import LIMITS, Limits, verdict

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Analysis:
    """The statistics of a map.

    Attributes:
        summary: All numbers, as `describe` returns them.
        table: Means of the measures over all voxels.
        sums: Sums by frame and cube of space, from which intervals and differences follow without voxels.
        sample: The voxels that the statistics rest on.
        shares: Number of locations with each share of the dominant class: see `consistency_posterior`.
        drawn: Columns (n,) of the voxels of the sample that need its log or its true labels.
        lone: How often each frame stands alone; None without spots.
    """

    summary: MapStatistics
    table: TableSummary
    sums: ClusterSums
    sample: MapSample
    shares: Float64
    drawn: Columns
    lone: LoneDisagreement | None = None
    moving: Mapping[int, float] = field(default_factory=dict)

    def of_frames(self) -> dict[int, dict[str, float]]:
        """Return the numbers of each frame by its index, as the time series names them.

        See `LoneDisagreement` and `moving_percent`.
        """
        alone = {} if self.lone is None else by_frame(self.lone, self.summary.outlying_frames)
        moving = {frame: {"moving_percent": percent} for frame, percent in self.moving.items()}
        return {frame: alone.get(frame, {}) | moving.get(frame, {}) for frame in alone.keys() | moving.keys()}

    def columns(self, table: VoxelTable, truth: VoxelTable | None = None) -> Columns:
        """Return one value per voxel (n,) by name for the map or any part of it, NaN if undefined.

        Columns that need the log are NaN for voxels that were not drawn. True labels are known for the drawn voxels
        (-1 elsewhere), and for all where `truth`, the true labels' map of the part, is given.
        """
        table = table.summing_to_op()
        rows, sample_rows = shared_rows(table, self.sample.table)
        spread: Columns = {}
        for name, values in self.drawn.items():
            spread[name] = np.full(len(table), -1 if values.dtype == np.int64 else np.nan, values.dtype)
            spread[name][rows] = values[sample_rows]
        null = expected_sbd(table)
        if "sbd_null" in spread:
            null[rows] = spread.pop("sbd_null")[rows]
        consistent = consistency_posterior(table, self.shares)
        columns = row_columns(table, null) | spread
        if truth is not None:
            columns["true_label"] = join_truth(table, truth).label
        columns["consistent"] = consistent
        if (label := columns.get("true_label")) is not None:
            columns["consistent_wrong"] = wrong_where_consistent(table, Truth(label >= 0, label), consistent)
        return columns


def describe(
    table: VoxelTable,
    events: Events | None = None,
    truth: VoxelTable | None = None,
    *,
    limit: VoxelTable | None = None,
    spots: SpotObservations | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> MapStatistics:
    """Return all statistics of one map: a `MapSample` is drawn and analysed.

    - `events`: the log behind the table; without it there is no flip rate
    - `truth`: the map of the ground truth labels of the same frames; without it correctness is unknown
    - `limit`: the map of view-independent labels (`ceiling`), from which geometry's part of the disagreement follows

    The other arguments are those of `analyse`.

    Raises:
        DataError: If events, truth or limit do not belong to the table.
    """
    sample = MapSample.draw(table, events, truth, edges=edges)
    return analyse(sample, spots, limit=limit, name=name, seed=seed, edges=edges, critical=critical).summary


def analyse(
    sample: MapSample,
    spots: SpotObservations | None = None,
    *,
    features: FeatureObservations | None = None,
    limit: VoxelTable | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
    scope: Scope = THIS_SCENE,
    limits: Limits = LIMITS,
    frame_name: Callable[[int], str] = str,
    moving_untold: str = "",
) -> Analysis:
    """Return all statistics of one map; the same seed gives the same numbers.

    Intervals are at CONFIDENCE, and for these frames where `scope` does not apply; undefined numbers are NaN, and a
    section that cannot be computed is None.

    Args:
        sample: The map, or a sample of it, with its log and the ground truth.
        spots: Labels that views give spots, taken of the same frames by a `Sampler`; without them there is no alpha and
            no verdict.
        features: Features that views give spots, taken by the same sampler.
        limit: The map of view-independent labels; the ground truth's by default.
        name: Name of the model, for the verdict.
        seed: Seed of random orders.
        edges: Upper bounds of the strata of OP.
        critical: The classes that the verdict depends on; by default, all with enough locations.
        scope: Scope of the headline and of alpha by class, if the views suffice for it.
        limits: Limits of the verdict.
        frame_name: Returns the name of a frame's file by its index.
        moving_untold: Why it is not told which spots moved.
    """
    table, events = sample.table.measured(), sample.events
    alone = spots is not None and spots.classes == OF_FEATURES.classes
    truth = None if sample.truth is None else join_truth(table, sample.truth)
    limit = sample.truth if limit is None else limit
    true_label = None if truth is None else truth.label

    shares = shares_of(table)
    consistent = consistency_posterior(table, shares)
    null = expected_sbd(table, events, seed=seed)
    columns, cubes = row_columns(table, null), Cubes.from_table(table)
    sums = cluster_sums_of(
        table, events, true_label, spots=spots, sbd_excess=columns["sbd_excess"], cubes=cubes, consistent=consistent
    )
    agreement_of_features = None
    if features is not None:
        sums, agreement_of_features = _with_features(sums, features, scope, alone=alone, frame_name=frame_name)
    locations = location_sums(table, columns, cubes)
    sample_columns, log = log_sums(sample, cubes)
    sample_columns |= {} if log is None else {"sbd_null": null}
    sample_columns |= {} if true_label is None else {"true_label": true_label}

    map_summary = sample.summary.summary(table.voxel_size, table.classes, edges)
    repeats = map_summary.means.voxels[SBD.key]
    repeated = Repeated(repeats, repeats / map_summary.voxels if map_summary.voxels else math.nan)
    headline, means = headline_of(sums, scope), _means(locations, sums, scope)
    flips = FlippingSums.from_table(table, consistent, cubes).flipping(table.classes)
    lone = None if spots is None else lone_disagreement(spots)
    of_spots: dict[str, Any] = dict.fromkeys(OF_SPOTS)
    if spots is not None:
        of_spots = _of_spots(spots, sums, table, headline.alpha, lone, scope, critical, limits, frame_name)
    stability = verdict(
        name or "model", headline=headline, spots=of_spots["spots"], flips=flips, voxels=repeats, share=repeated.share,
        limits=limits, moved=of_spots["moved"], labels=not alone,
    )  # fmt: skip
    summary = MapStatistics(
        schema=SCHEMA, name=name, seed=seed, K=table.K, voxel_size=table.voxel_size,
        voxels=map_summary.voxels, observations=map_summary.observations, repeated=repeated, cubes=len(cubes.cell),
        verdict=stability,
        agreement=_agreement(means, class_agreement_of(class_sums(table, events), table.classes)),
        flipping=flips,
        headline=headline,
        drift=_drift(repeats, means, locations, log),
        uncertainty=EntropyParts(means["entropy"], means["entropy_within"], means["entropy_between"]),
        geometry=None if limit is None else losses(table, limit),
        correctness=None if truth is None else _correctness(table, truth, consistent, sums, edges, headline),
        strata=_strata(map_summary, table, columns, edges),
        moving_untold=moving_untold,
        features=agreement_of_features,
        **of_spots,
    )  # fmt: skip
    if alone:
        summary, lone = _without_classes(summary), None
    moving = {} if spots is None else moving_percent(spots)
    return Analysis(summary, map_summary, sums, sample, shares, sample_columns, lone, moving)


OF_SPOTS = ("spots", "correlogram", "outlying_frames", "ranges", "groupings", "moved")
"""The sections of `MapStatistics` that need labels at spots."""


def _of_spots(
    spots: SpotObservations,
    sums: ClusterSums,
    table: VoxelTable,
    alpha: Interval,
    lone: LoneDisagreement | None,
    scope: Scope,
    critical: Sequence[str],
    limits: Limits,
    frame_name: Callable[[int], str],
) -> dict[str, Any]:
    """Return the sections `OF_SPOTS` by name."""
    outlying = None if lone is None else outlying_frames(lone, len(spots.views), name=frame_name)
    with ThreadPoolExecutor(1, thread_name_prefix="semstab-correlogram") as pool:  # it takes as long as the others
        by_distance = pool.submit(correlogram, spots)
        return {
            "spots": spot_agreement(spots, sums, table, scope, critical, limits),
            "outlying_frames": outlying,
            "ranges": range_agreement(spots, scope, limits),
            "groupings": groupings(spots, sums, scope, limits),
            "moved": moved_spots(spots, alpha, scope, frame_name),
            "correlogram": by_distance.result(),
        }


def _with_features(
    sums: ClusterSums,
    features: FeatureObservations,
    scope: Scope,
    *,
    alone: bool,
    frame_name: Callable[[int], str],
) -> tuple[ClusterSums, FeatureAgreement]:
    """Return the sums of a map with the sums of features, and the agreement of features."""
    alike = likeness(features)
    of_features = feature_sums(features, alike)
    agreement = feature_agreement(features, alike, of_features, scope, alone=alone, name=frame_name)
    return dataclasses.replace(sums, features=of_features), agreement


def _without_classes(summary: MapStatistics) -> MapStatistics:
    """Return the statistics of the map of a model without labels: no number of labels is defined."""

    def unknown(section: Any) -> Any:
        values = {field.name: getattr(section, field.name) for field in dataclasses.fields(section)}
        nothing: dict[type, Any] = {Interval: UNKNOWN, float: math.nan, tuple: ()}
        changed = {name: nothing[type(value)] for name, value in values.items() if type(value) in nothing}
        return dataclasses.replace(section, **changed)

    means = MeasureMeans(dict.fromkeys((measure.key for measure in measures()), math.nan), {})
    strata = tuple(dataclasses.replace(unknown(stratum), means=means) for stratum in summary.strata)
    sections = {name: unknown(getattr(summary, name)) for name in ("agreement", "headline", "drift", "uncertainty")}
    sections |= dict.fromkeys(("flipping", "correlogram", "geometry", "correctness"))
    sections |= dict.fromkeys(("outlying_frames", "ranges", "groupings", "moved"))
    return dataclasses.replace(summary, **sections, strata=strata)


def _means(locations: ClusterSums, sums: ClusterSums, scope: Scope) -> dict[str, Interval]:
    """Return the means over the voxels with OP >= 2 by name, those of `OF_CLUSTERS` in the scope where they can be."""
    of_cubes = {name: estimate(locations, number) for name, number in MEANS.items()}
    return of_cubes | {name: estimate(sums, key, scope=scope_of(sums, scope, key)) for name, key in OF_CLUSTERS.items()}


def _agreement(means: Mapping[str, Interval], classes: tuple[ClassAgreement, ...]) -> FrameAgreement:
    voxels = {f"{name}_op2": means[name] for name in ("psa", "kappa", "voxel_alpha", "vss")}
    return FrameAgreement(**voxels, within=means["within"], between=means["between"], classes=classes)


def _drift(
    repeats: int, means: Mapping[str, Interval], locations: ClusterSums, log: ClusterSums | None
) -> DriftStatistics:
    """Return SBD and its null; without a log only for one-hot evidence, and without flips."""
    rates, (sampled, with_null) = None, (locations[name][:, 1].sum() for name in ("psa", "null"))
    if log is not None:
        rates = FlipRates(*(estimate(log, number) for number in (*OF_FLIPS, *OF_CHANGES)))
    return DriftStatistics(
        voxels=round(with_null / sampled * repeats) if sampled else 0,
        sbd_op2=means["sbd"],
        null=means["null"],
        excess=means["excess"],
        flips=rates,
    )


def _correctness(
    table: VoxelTable,
    truth: Truth,
    consistent: Float64,
    sums: ClusterSums,
    edges: Sequence[int],
    headline: HeadlineStatistics,
) -> CorrectnessStatistics:
    predictions = Predictions.from_evidence(table.evidence, truth.label)
    repeated = prediction_sums(predictions, truth.known & (table.op >= 2))
    miou = estimate(sums, MIOU.key, scope=scope_of(sums, headline.accuracy_op2.scope, MIOU.key))
    if math.isnan(miou.value):  # more than MOST_CLASSES classes have no sums by class
        miou = dataclasses.replace(miou, value=correctness_of(repeated).miou)
    return CorrectnessStatistics(
        accuracy_op2=headline.accuracy_op2,
        miou_op2=miou,
        strata=by_stratum(predictions, table.op, truth.known, edges),
        reliability=reliability_of(repeated),
        quadrants=quadrants(table, truth, consistent, sums.edge, headline.wrong_of_consistent_op3),
    )


BY_STRATUM = ("psa", "sbd_null", "sbd_excess", "entropy_within", "entropy_between")
"""Columns whose mean is reported for each stratum of OP."""


def _strata(
    map_summary: TableSummary, table: VoxelTable, columns: Columns, edges: Sequence[int]
) -> tuple[StratumStatistics, ...]:
    sums, count = by_group(groups_of(table.op, edges), [columns[name] for name in BY_STRATUM], len(edges) + 1)
    with np.errstate(invalid="ignore"):
        means = sums / count
    return tuple(
        StratumStatistics(
            stratum.name, stratum.voxels, stratum.means, **dict(zip(BY_STRATUM, of_stratum.tolist(), strict=True))
        )
        for stratum, of_stratum in zip(map_summary.strata, means, strict=True)
    )
