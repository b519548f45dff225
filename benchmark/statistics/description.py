"""All statistics of one map, as a summary and as a column for each voxel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.metrics.agreement import shared_rows
from semstab.metrics.summary import STRATA, groups_of
from semstab.model.events import Events
from semstab.model.evidence import stretches
from semstab.model.information import by_group
from semstab.model.measures import SBD, Beliefs, sbd, vss
from semstab.model.results import TableSummary
from semstab.model.statistics import (
    BeyondCoin,
    BlockCut,
    ClassAgreement,
    CorrectnessStatistics,
    DriftStatistics,
    DriftTests,
    EntropyParts,
    FlipRates,
    FrameAgreement,
    Interval,
    Judged,
    MapStatistics,
    Repeated,
    RuleOutcome,
    StratumStatistics,
)
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import (
    alpha_of,
    between_of,
    class_agreement_of,
    class_sums,
    decompose,
    disagreement,
    kappa_of,
    psa,
    ratio_of,
)
from semstab.statistics.correctness import (
    Predictions,
    Truth,
    join_truth,
    judged_strata,
    judged_where,
    quadrant_sums,
    quadrants_of,
    reliability_of,
    rule_means_of,
    rule_sums,
    strata_of,
    wrong_of_steady,
)
from semstab.statistics.flipping import FlippingSums
from semstab.statistics.looks import ObservationSample, correlogram, reach_by, reach_from
from semstab.statistics.order import fusion_rules
from semstab.statistics.order.drift import TESTABLE, Flips, VoxelDrift, expected_sbd, flips, trend_columns, voxel_drift
from semstab.statistics.order.p_values import benjamini_hochberg, rounded_up
from semstab.statistics.sample import MapSample
from semstab.statistics.sampling import InfluenceSums, Mean, Places, PlaceSums, answered, influence_sums, judged_by
from semstab.statistics.scene_drift import OrderTest, order_test
from semstab.statistics.steady import Votes, steady
from semstab.statistics.verdict import losses, verdict

SCHEMA = 1

FALSE_DISCOVERIES = 0.05
"""Rate at which single voxels are reported as trending, or as drifting unusually."""

Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Analysis:
    """The statistics of a map.

    summary  all numbers, as `describe` returns them
    table    means of the measures over all voxels
    sums     sums by frame and cube of space, from which intervals and differences follow without voxels
    sample   the voxels that the statistics rest on
    shares   how often the dominant class is seen, over all locations: see `steady`
    drawn    columns (n,) of the voxels of the sample that need its log or its true labels
    """

    summary: MapStatistics
    table: TableSummary
    sums: InfluenceSums
    sample: MapSample
    shares: Float64
    drawn: Columns

    def columns(self, table: VoxelTable, truth: VoxelTable | None = None) -> Columns:
        """Return one value a voxel (n,) by name for the map or any part of it, NaN where undefined.

        Columns that need the log are NaN for voxels that were not drawn. True labels are known of the drawn voxels
        (-1 elsewhere), and of all where `truth`, the true labels' map of the part, is given.
        """
        rows, drawn = shared_rows(table, self.sample.table)
        spread: Columns = {}
        for name, values in self.drawn.items():
            spread[name] = np.full(len(table), -1 if values.dtype == np.int64 else np.nan, values.dtype)
            spread[name][rows] = values[drawn]
        null = expected_sbd(table)
        if "sbd_null" in spread:
            null[rows] = spread.pop("sbd_null")[rows]
        stable = steady(table, self.shares)
        columns = row_columns(table, null) | spread
        if truth is not None:
            columns["true_label"] = join_truth(table, truth).label
        columns["stable"] = stable
        if (label := columns.get("true_label")) is not None:
            columns["stable_wrong"] = wrong_of_steady(table, Truth(label >= 0, label), stable)
        return columns


def describe(
    table: VoxelTable,
    events: Events | None = None,
    truth: VoxelTable | None = None,
    *,
    limit: VoxelTable | None = None,
    observations: ObservationSample | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> MapStatistics:
    """Return all statistics of one map: a `MapSample` is drawn and analysed.

    events  the log behind the table; without it there is no drift test, no flip rate and no other fusion rule
    truth   the map of the ground truth labels of the same frames; without it correctness is not known
    limit   the map of view-independent labels (`ceiling`), from which geometry's part of the disagreement follows

    The other arguments are those of `analyse`. Raises DataError where events, truth or
    limit do not belong to the table.
    """
    sample = MapSample.draw(table, events, truth, edges=edges)
    return analyse(sample, observations, limit=limit, name=name, seed=seed, edges=edges, critical=critical).summary


def analyse(
    sample: MapSample,
    observations: ObservationSample | None = None,
    *,
    limit: VoxelTable | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> Analysis:
    """Return all statistics of one map; the same seed gives the same numbers.

    observations  taken of the same frames by a `Sampler`; without them agreement has no ceiling to be judged against
    limit     the map of view-independent labels; the ground truth's where it is not given
    name      of the backbone, for the verdict
    edges     upper bounds of the strata of OP
    critical  the classes that the verdict depends on; where none is named, all with enough locations

    Intervals are at 95 %, for this map, but those of `judged` and `reach`; undefined numbers are NaN, and a section
    that cannot be computed is None.
    """
    table, events = sample.table.measured(), sample.events
    truth = None if sample.truth is None else join_truth(table, sample.truth)
    limit = sample.truth if limit is None else limit
    shares = Votes.of(table).shares()
    stable = steady(table, shares)
    drift = None if events is None else voxel_drift(table, events, seed=seed)
    null = expected_sbd(table) if drift is None else drift.null
    columns = row_columns(table, null)
    places = Places.of(table)
    of_places = place_sums(table, columns, places)
    influence = influence_sums(
        table,
        events,
        None if truth is None else truth.label,
        sample=None if observations is None else observations.shared(),
        sbd_excess=columns["sbd_excess"],
        places=places,
        stable=stable,
    )
    flipping = FlippingSums.of(table, stable, places)
    drawn, log = _of_log(table, sample, places, drift, seed)
    if truth is not None:
        drawn["true_label"] = truth.label
    found, judged, (unsteady,), reached, of_flips = answered(
        of_places.asked(MEANS),
        judged_by(influence),
        flipping.asked(),
        () if observations is None else reach_by(influence, table.K),
        () if log is None else log.places.asked(OF_FLIPS),
    )
    means, whole = dict(zip(MEANS, found, strict=True)), sample.summary.summary(table.voxel_size, table.classes, edges)
    reach = None
    if observations is not None:
        reach = reach_from(observations.by, of_places["kappa"][2:], influence, reached, critical=critical)
    headline, count = Judged(*judged), len(places.cell)
    repeats = whole.means.voxels[SBD.key]
    repeated = Repeated(repeats, repeats / whole.voxels if whole.voxels else math.nan)
    flips_of_map = flipping.flipping(unsteady, table.classes)
    summary = MapStatistics(
        schema=SCHEMA,
        name=name,
        seed=seed,
        K=table.K,
        voxel_size=table.voxel_size,
        voxels=whole.voxels,
        observations=whole.observations,
        repeated=repeated,
        blocks=BlockCut(count, headline.alpha.block_size),
        verdict=verdict(
            name or "backbone",
            judged=headline,
            reach=reach,
            flips=flips_of_map,
            voxels=repeated.voxels,
            share=repeated.share,
            blocks=count,
        ),
        agreement=_agreement(means, class_agreement_of(class_sums(table, events), table.classes)),
        flipping=flips_of_map,
        judged=headline,
        reach=reach,
        correlogram=None if observations is None else correlogram(observations),
        drift=_drift(repeats, means, of_places, log, of_flips),
        uncertainty=EntropyParts(means["entropy"], means["entropy_within"], means["entropy_between"]),
        geometry=None if limit is None else losses(table, limit, seed=seed),
        correctness=None if truth is None else _correctness(table, truth, stable, places, edges),
        fusion_rules=None if events is None else rule_outcomes(table, events, truth),
        strata=_strata(whole, table, columns, edges),
        beyond_coin=BeyondCoin(means["coin"], means["steadier"]),
    )
    return Analysis(summary, whole, influence, sample, shares, drawn)


# --- Columns and means ------------------------------------------------------------------------------------------------


def row_columns(table: VoxelTable, null: Float64) -> Columns:
    """Return the columns (n,) that follow from the row of each voxel and its SBD in random order, `null` (n,)."""
    within, between = disagreement(table)
    parts = decompose(table)
    return {
        "psa": psa(table),
        "disagreement_within": within,
        "disagreement_between": between,
        "sbd_null": null,
        "sbd_excess": sbd(table) - null,
        "entropy_within": parts.within,
        "entropy_between": parts.between,
    }


def _less(sums: Float64) -> Float64:
    """A ratio less another, (...,) from sums (..., 4)."""
    return ratio_of(sums[..., :2]) - ratio_of(sums[..., 2:])


SIGNED = (-1.0, 1.0)
MEANS: Mapping[str, Mean] = {
    **{name: Mean(name) for name in ("psa", "vss", "within", "between", "sbd", "null")},
    **{name: Mean(name) for name in ("entropy", "entropy_within", "entropy_between")},
    **{name: Mean(name, bounds=SIGNED) for name in ("excess", "steadier")},
    "coin": Mean("coin", _less, SIGNED),
    "kappa": Mean("kappa", kappa_of, SIGNED, "agreement"),
    "alpha": Mean("alpha", alpha_of, SIGNED, "agreement"),
    "alpha_between": Mean("alpha", between_of, SIGNED, "agreement"),
    "each_place": Mean("each_place", between_of, SIGNED, "agreement"),
}
"""Over the voxels with OP >= 2, of values where they are defined, and agreement beyond chance."""

OF_FLIPS: Mapping[str, Mean] = {
    **{name: Mean(name) for name in ("flip_rate", "flip_null")},
    "flip_excess": Mean("flip_excess", bounds=SIGNED),
}
"""Over the same voxels as the first of `MEANS`, so that those are the same to the last bit without a log."""

OF_CHANGES: Mapping[str, Mean] = {
    "frames_since": Mean("frames_since", bounds=(0.0, math.inf)),
    "trend_excess": Mean("trend_excess", bounds=SIGNED),
}
"""Over fewer voxels."""


def place_sums(table: VoxelTable, columns: Columns, places: Places) -> PlaceSums:
    """Return the sums over cubes of the voxels with OP >= 2 of which `MEANS` are functions."""
    T, op, agreement = table.op.astype(np.float64), table.op, columns["psa"]
    sums = places.means(
        {
            "psa": agreement,
            "vss": vss(table),
            "sbd": columns["sbd_excess"] + columns["sbd_null"],
            "null": columns["sbd_null"],
            "excess": columns["sbd_excess"],
            "steadier": np.where(op > 2, -columns["sbd_excess"], np.nan),
            "entropy": columns["entropy_within"] + columns["entropy_between"],
            "entropy_within": columns["entropy_within"],
            "entropy_between": columns["entropy_between"],
            "of two": np.where(op == 2, agreement, np.nan),
            "of more": np.where(op > 2, agreement, np.nan),
            "observations": T,
            "agreeing": T * agreement,
            "own": table.self_sum,
            "own of an observation": table.self_sum / T,
            **{name: T * columns[f"disagreement_{name}"] for name in ("within", "between")},
        }
    )
    observations, agreeing, own, own_of_one = (
        sums.pop(name)[:, :1] for name in ("observations", "agreeing", "own", "own of an observation")
    )
    by_observation, by_voxel = places.sums_by_class(table)
    further = {
        **{name: [sums[name][:, :1], observations] for name in ("within", "between")},
        "coin": [sums.pop("of two"), sums.pop("of more")],
        "kappa": [sums["psa"], by_voxel],  # as of `kappa_columns`, and of `alpha_columns` twice
        "alpha": [agreeing, observations, own, by_observation],
        "each_place": [sums["psa"], own_of_one, by_voxel],
    }
    return PlaceSums(places.cell, places.edge, sums | {name: np.hstack(parts) for name, parts in further.items()})


# --- Sections ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Log:
    """The sums and tests that need a log: sums over cubes, `trend_columns` summed (3,), and how many voxels trend."""

    places: PlaceSums
    trend: Float64
    test: OrderTest
    tested: int
    unusual: int
    trending: int


def _of_log(
    table: VoxelTable, sample: MapSample, places: Places, drift: VoxelDrift | None, seed: int
) -> tuple[Columns, _Log | None]:
    """The columns and sums that need a log; none without one."""
    if sample.events is None or drift is None:
        return {}, None
    changes: Flips = flips(sample.events)
    tell, trend = trend_columns(table, drift)
    trends = places.rows(tell).sums(trend)
    means = {
        "flip_rate": changes.rate,
        "flip_null": changes.null,
        "flip_excess": changes.rate - changes.null,
        "frames_since": changes.since,
    }
    sums = places.means(means)
    sums["trend_excess"] = np.stack([trends[:, 0] - trends[:, 1], trends[:, 2]], axis=1)
    testable = table.op >= TESTABLE
    drift_q = benjamini_hochberg(np.where(testable, drift.p_value, np.nan))
    trend_q = benjamini_hochberg(rounded_up(np.where(testable, drift.trend_p, np.nan)))
    log = _Log(
        PlaceSums(places.cell, places.edge, sums),
        trends.sum(axis=0),
        order_test(table, sample.events, seed=seed),
        int(np.count_nonzero(~np.isnan(trend_q))),
        int(np.count_nonzero(drift_q <= FALSE_DISCOVERIES)),
        int(np.count_nonzero(trend_q <= FALSE_DISCOVERIES)),
    )
    columns: Columns = {
        "sbd_null": drift.null,
        "drift_p": drift.p_value,
        "trend": drift.trend,
        "trend_p": drift.trend_p,
        "flip_rate": changes.rate,
        "frames_since_flip": changes.since,
        "drift_q": drift_q,
        "trend_q": trend_q,
    }
    return columns, log


def _agreement(means: Mapping[str, Interval], classes: tuple[ClassAgreement, ...]) -> FrameAgreement:
    names = ("psa", "kappa", "alpha", "vss", "within", "between", "alpha_between", "each_place")
    return FrameAgreement(**{name: means[name] for name in names}, classes=classes)


def _drift(
    repeats: int, means: Mapping[str, Interval], places: PlaceSums, log: _Log | None, of_flips: Sequence[Interval]
) -> DriftStatistics:
    """SBD against its null; without a log only for one-hot evidence, and without tests."""
    tests, rates, sampled = None, None, places["psa"][1]
    if log is not None:
        one_way, by_chance, all_of_it = log.trend
        since, excess = log.places.estimates(OF_CHANGES).values()
        tests = DriftTests(
            sbd_p=log.test.p_value,
            trend=float(one_way / all_of_it) if all_of_it else math.nan,
            trend_null=float(by_chance / all_of_it) if all_of_it else math.nan,
            trend_excess=excess,
            trend_p=log.test.trend_p,
            stretches=log.test.stretches,
            voxels=log.test.voxels,
            tested_voxels=log.tested,
            unusual_sbd_voxels=log.unusual,
            trending_voxels=log.trending,
        )
        rate, null, beyond = of_flips
        rates = FlipRates(rate, null, beyond, since)
    return DriftStatistics(
        voxels=round(places["null"][1] / sampled * repeats) if sampled else 0,
        sbd=means["sbd"],
        null=means["null"],
        excess=means["excess"],
        tests=tests,
        flips=rates,
    )


def _correctness(
    table: VoxelTable, truth: Truth, stable: Float64, places: Places, edges: Sequence[int]
) -> CorrectnessStatistics:
    judged = Predictions.of(table.evidence, truth.label)
    right = places.means({"right": np.where(truth.known, judged.right, np.nan)})
    return CorrectnessStatistics(
        accuracy=PlaceSums(places.cell, places.edge, right).estimate("right", ratio_of),
        strata=strata_of(judged_strata(judged, table.op, truth.known, edges), edges),
        reliability=reliability_of(judged_where(judged, truth.known & (table.op >= 2))),
        quadrants=quadrants_of(quadrant_sums(table, truth, stable, places.edge)),
    )


TOGETHER = 1 << 16
"""Voxels whose beliefs under all rules are in memory at once."""


def rule_outcomes(table: VoxelTable, events: Events, truth: Truth | None) -> tuple[RuleOutcome, ...]:
    """Return the means over the voxels with OP >= 2 under each rule of fusion."""
    again = np.flatnonzero(table.op >= 2)
    parts = [_rule_sums(table, events, truth, again[some]) for some in stretches(len(again), TOGETHER)]
    total = np.sum(parts, axis=0)
    return tuple(
        RuleOutcome(rule, rule_means_of(own[2:]), float(ratio_of(own[:2])))
        for rule, own in zip(fusion_rules.RULES, total, strict=True)
    )


def _rule_sums(table: VoxelTable, events: Events, truth: Truth | None, rows: Int64) -> Float64:
    """(R, 2 + C) for each rule how many voxels it relabels, of how many, and `rule_sums`."""
    _, *others = fusion_rules.RULES  # the first one is the map's own
    some, own = table.rows(rows), None if truth is None else Truth(truth.known[rows], truth.label[rows])
    fused: list[Beliefs] = [some, *fusion_rules.fuse_all(events, others, evidence=some.evidence, rows=rows)]
    usual, *labels = (fusion_rules.labels(belief.evidence) for belief in fused)
    relabelled = [0, *(np.count_nonzero(label != usual) for label in labels)]
    weights = np.ones(len(rows))
    return np.stack(
        [
            np.concatenate([[count, len(rows)], rule_sums(belief, weights, own)])
            for count, belief in zip(relabelled, fused, strict=True)
        ]
    )


BY_STRATUM = ("psa", "sbd_null", "sbd_excess", "entropy_within", "entropy_between")
"""Columns whose mean is reported for each stratum of OP."""


def _strata(
    whole: TableSummary, table: VoxelTable, columns: Columns, edges: Sequence[int]
) -> tuple[StratumStatistics, ...]:
    sums, count = by_group(groups_of(table.op, edges), [columns[name] for name in BY_STRATUM], len(edges) + 1)
    with np.errstate(invalid="ignore"):
        means = sums / count
    return tuple(
        StratumStatistics(
            stratum.name, stratum.voxels, stratum.means, **dict(zip(BY_STRATUM, own.tolist(), strict=True))
        )
        for stratum, own in zip(whole.strata, means, strict=True)
    )
