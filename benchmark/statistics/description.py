"""Everything that the statistics say of one map, and as maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics import strata
from semstab.metrics.matching import require_same_map
from semstab.metrics.summary import STRATA
from semstab.model.measures import MeasureMeans, dominant, mean, measures, sbd, vss
from semstab.model.statistics import (
    BeyondCoin,
    BlockCut,
    CorrectnessStatistics,
    DriftStatistics,
    DriftTests,
    EntropyParts,
    FlipRates,
    FrameAgreement,
    Interval,
    MapStatistics,
    Repeated,
    RuleOutcome,
    StratumStatistics,
)
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics import fusion_rules
from semstab.statistics.agreement import (
    alpha_columns,
    alpha_of,
    between_of,
    class_agreement,
    disagreement,
    kappa_columns,
    kappa_of,
    psa,
    ratio_of,
)
from semstab.statistics.ceiling import losses
from semstab.statistics.correctness import (
    Truth,
    by_stratum,
    join_truth,
    quadrants,
    reliability,
    rule_means,
    stable_wrong,
)
from semstab.statistics.drift import (
    TESTABLE,
    VoxelDrift,
    benjamini_hochberg,
    expected_sbd,
    flips,
    trend_columns,
    voxel_drift,
)
from semstab.statistics.flipping import flipping
from semstab.statistics.looks import Sample, correlogram, reach_of
from semstab.statistics.sampling import InfluenceSums, Places, influence_sums, judged_of
from semstab.statistics.scene_drift import scene_drift
from semstab.statistics.steady import steady
from semstab.statistics.uncertainty import decompose
from semstab.statistics.verdict import verdict

SCHEMA = 1
FALSE_DISCOVERIES = 0.05
"""Rate at which trending voxels are named."""

Float64 = npt.NDArray[np.float64]
Maps = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Analysis:
    """What the statistics say of a map; `maps` have one value a voxel (n,), NaN where undefined.

    sums  by frame and cube of space, from which intervals and differences follow without voxels
    """

    summary: MapStatistics
    maps: Maps
    sums: InfluenceSums


def describe(
    table: VoxelTable,
    events: Events | None = None,
    truth: VoxelTable | None = None,
    *,
    limit: VoxelTable | None = None,
    sample: Sample | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> MapStatistics:
    """All statistics of one map: the `summary` of `analyse`, which takes the same arguments."""
    return analyse(
        table, events, truth, limit=limit, sample=sample, name=name, seed=seed, edges=edges, critical=critical
    ).summary


def analyse(
    table: VoxelTable,
    events: Events | None = None,
    truth: VoxelTable | None = None,
    *,
    limit: VoxelTable | None = None,
    sample: Sample | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> Analysis:
    """All statistics of one map; the same seed gives the same numbers.

    events  the log behind the table; without it there is no drift test, no flip rate and no other fusion rule
    truth   the map of the ground truth labels of the same frames; without it nothing is said about right and wrong
    limit   the map of view-independent labels (`ceiling`); without it nothing is said about geometry's part
    sample  what a `Sampler` took of the same frames; without it there is no ceiling to judge agreement against
    name    of the backbone, for the verdict
    edges   upper bounds of the strata of OP
    critical  the classes that the verdict depends on; where none is named, all with enough places

    Intervals are at 95 %, for this map, but those of `judged` and `reach`; undefined numbers are NaN, and a section
    that cannot be computed is None.
    Raises DataError where events, truth or limit do not belong to the table.
    """
    if events is not None:
        require_same_map(table, events)
    again = table.op >= 2
    means = _Means(again, Places(table.index[again], table.voxel_size))
    maps: Maps = {"psa": psa(table), "stable": steady(table)}
    known = None if truth is None else join_truth(table, truth)
    agreement = _agreement(table, events, means, maps)
    drift = _drift(table, events, means, maps, seed)
    uncertainty = _uncertainty(table, means, maps)
    right = None if known is None else _correctness(table, known, means, maps, edges)
    sums = influence_sums(
        table,
        events,
        None if known is None else known.label,
        sample=None if sample is None else sample.shared(),
        sbd_excess=maps["sbd_excess"],
        edge=means.places.edge,
    )
    judged = judged_of(sums)
    flips_at = flipping(table, maps["stable"], means.places)
    repeats = int(np.count_nonzero(again))
    repeated = Repeated(repeats, repeats / len(table) if len(table) else math.nan)
    reach = None if sample is None else reach_of(sample, table, sums, critical=critical)
    said = verdict(
        name or "backbone",
        judged=judged,
        reach=reach,
        flips=flips_at,
        voxels=repeated.voxels,
        share=repeated.share,
        blocks=means.places.count,
    )
    summary = MapStatistics(
        schema=SCHEMA,
        name=name,
        seed=seed,
        K=table.K,
        voxel_size=table.voxel_size,
        voxels=len(table),
        observations=int(table.op.sum(dtype=np.int64)),
        repeated=repeated,
        blocks=BlockCut(means.places.count, judged.alpha.block_size),
        verdict=said,
        agreement=agreement,
        flipping=flips_at,
        judged=judged,
        reach=reach,
        correlogram=None if sample is None else correlogram(sample),
        drift=drift,
        uncertainty=uncertainty,
        geometry=None if limit is None else losses(table, limit, seed=seed),
        correctness=right,
        fusion_rules=None if events is None else _fusion_rules(table, events, known),
        strata=_strata(table, maps, edges),
        beyond_coin=_beyond_coin(table, means, maps),
    )
    return Analysis(summary, maps, sums)


# --- Sections ---------------------------------------------------------------------------------------------------------


class _Means:
    """Means over the voxels with OP >= 2, with their intervals for this map."""

    def __init__(self, again: npt.NDArray[np.bool_], places: Places) -> None:
        self.again = again
        self.places = places

    def mean(self, values: Float64, bounds: tuple[float, float] = (0.0, 1.0)) -> Interval:
        """Of values (n,) where they are defined."""
        own = values[self.again]
        defined = ~np.isnan(own)
        return self.places.estimate(np.stack([np.where(defined, own, 0.0), defined], axis=1), ratio_of, bounds)

    def function(
        self,
        columns: Float64,
        statistic: Callable[[Float64], Float64],
        bounds: tuple[float, float] = (0.0, 1.0),
    ) -> Interval:
        """Of a statistic of the sums of columns (m, C) of the m voxels with OP >= 2."""
        return self.places.estimate(columns, statistic, bounds)

    def of_table(
        self,
        table: VoxelTable,
        columns: Callable[[VoxelTable], Float64],
        statistic: Callable[[Float64], Float64],
    ) -> Interval:
        """Of agreement beyond chance by the sums of the columns (m, C) that are made of these voxels.

        The first column is agreement itself, the second its weight.
        """
        return self.places.estimate_of(table, np.flatnonzero(self.again), columns, statistic, (-1.0, 1.0), "agreement")


def _agreement(table: VoxelTable, events: Events | None, means: _Means, maps: Maps) -> FrameAgreement:
    T = table.op[means.again].astype(np.float64)
    parts = dict(zip(("disagreement_within", "disagreement_between"), disagreement(table), strict=True))
    within, between = (T * part[means.again] for part in parts.values())
    maps |= parts
    return FrameAgreement(
        psa=means.mean(maps["psa"]),
        kappa=means.of_table(table, kappa_columns, kappa_of),
        alpha=means.of_table(table, alpha_columns, alpha_of),
        vss=means.mean(vss(table)),
        within=means.function(np.stack([within, T], axis=1), ratio_of, (0.0, 1.0)),
        between=means.function(np.stack([between, T], axis=1), ratio_of, (0.0, 1.0)),
        alpha_between=means.of_table(table, alpha_columns, between_of),
        each_place=means.of_table(table, lambda some: alpha_columns(some, np.ones(len(some))), between_of),
        classes=class_agreement(table, events),
    )


def _drift(table: VoxelTable, events: Events | None, means: _Means, maps: Maps, seed: int) -> DriftStatistics:
    """Against its null; without events only for one-hot evidence, and without tests."""
    drift = None if events is None else voxel_drift(table, events, seed=seed)
    null = expected_sbd(table) if drift is None else drift.null
    maps |= {"sbd_null": null, "sbd_excess": sbd(table) - null}
    known = ~np.isnan(null)
    tested = None if drift is None or events is None else _tests(table, events, drift, means, maps, seed)
    return DriftStatistics(
        voxels=int(known.sum()),
        sbd=means.mean(np.where(known, sbd(table), np.nan)),
        null=means.mean(null),
        excess=means.mean(maps["sbd_excess"], (-1.0, 1.0)),
        tests=tested,
        flips=None if events is None else _flips(events, means, maps),
    )


def _tests(table: VoxelTable, events: Events, drift: VoxelDrift, means: _Means, maps: Maps, seed: int) -> DriftTests:
    tested = table.op >= TESTABLE
    maps |= {
        "drift_p": drift.p_value,
        "drift_q": benjamini_hochberg(np.where(tested, drift.p_value, np.nan)),
        "trend": drift.trend,
        "trend_p": drift.trend_p,
        "trend_q": benjamini_hochberg(np.where(tested, drift.trend_p, np.nan)),
    }
    scene = scene_drift(table, events, drift, seed=seed)
    one_way, by_chance, all_of_it = trend_columns(table, drift).T
    excess = np.stack([one_way - by_chance, all_of_it], axis=1)[means.again]
    return DriftTests(
        sbd_p=scene.p_value,
        trend=scene.trend,
        trend_null=scene.trend_null,
        trend_excess=means.function(excess, ratio_of, (-1.0, 1.0)),
        trend_p=scene.trend_p,
        stretches=scene.stretches,
        voxels=scene.voxels,
        tested_voxels=int(np.count_nonzero(~np.isnan(maps["trend_q"]))),
        unusual_sbd_voxels=_discoveries(maps["drift_q"]),
        trending_voxels=_discoveries(maps["trend_q"]),
    )


def _flips(events: Events, means: _Means, maps: Maps) -> FlipRates:
    changes = flips(events)
    maps |= {"flip_rate": changes.rate, "frames_since_flip": changes.since}
    return FlipRates(
        rate=means.mean(changes.rate),
        null=means.mean(changes.null),
        excess=means.mean(changes.rate - changes.null, (-1.0, 1.0)),
        frames_since=means.mean(changes.since, (0.0, math.inf)),
    )


def _discoveries(q: Float64) -> int:
    with np.errstate(invalid="ignore"):
        return int(np.count_nonzero(q <= FALSE_DISCOVERIES))


def _uncertainty(table: VoxelTable, means: _Means, maps: Maps) -> EntropyParts:
    parts = decompose(table)
    maps |= {"entropy_within": parts.within, "entropy_between": parts.between}
    return EntropyParts(means.mean(parts.total), means.mean(parts.within), means.mean(parts.between))


def _correctness(
    table: VoxelTable, truth: Truth, means: _Means, maps: Maps, edges: Sequence[int]
) -> CorrectnessStatistics:
    maps |= {"true_label": truth.label, "stable_wrong": stable_wrong(table, truth)}
    right = np.where(truth.known, dominant(table) == truth.label, np.nan)
    counted = truth.known & means.again
    everywhere = Places(table.index, table.voxel_size, means.places.edge)
    return CorrectnessStatistics(
        accuracy=means.mean(right),
        strata=by_stratum(table, truth, edges),
        reliability=reliability(table.evidence.take(counted), truth.label[counted]),
        quadrants=quadrants(table, truth, everywhere),
    )


def _fusion_rules(table: VoxelTable, events: Events, truth: Truth | None) -> tuple[RuleOutcome, ...]:
    """Means over the voxels with OP >= 2 under each rule."""
    again = table.op >= 2
    usual = fusion_rules.labels(table.evidence)
    rows = []
    for rule in fusion_rules.RULES:
        fused = fusion_rules.fuse(events, rule)
        relabelled = fusion_rules.labels(fused.evidence) != usual
        rows.append(RuleOutcome(rule, rule_means(fused, again, truth), mean(relabelled[again])))
    return tuple(rows)


def _beyond_coin(table: VoxelTable, means: _Means, maps: Maps) -> BeyondCoin:
    """PSA does not depend on OP for a coin, nor does SBD on the order."""
    op, agreement = table.op[means.again], maps["psa"][means.again]
    excess = np.where(table.op > 2, maps["sbd_excess"], np.nan)
    groups = [np.stack([agreement * where, where], axis=1) for where in (op == 2, op > 2)]
    return BeyondCoin(
        means.function(np.concatenate(groups, axis=1), _less, (-1.0, 1.0)), means.mean(-excess, (-1.0, 1.0))
    )


def _less(sums: Float64) -> Float64:
    """A ratio less another, (...,) from sums (..., 4)."""
    return ratio_of(sums[..., :2]) - ratio_of(sums[..., 2:])


def _strata(table: VoxelTable, maps: Maps, edges: Sequence[int]) -> tuple[StratumStatistics, ...]:
    values = {measure: measure.of(table) for measure in measures()}
    rows = []
    for name, low, high in strata(edges):
        where = (table.op >= low) & (table.op <= high)
        rows.append(
            StratumStatistics(
                name,
                int(np.count_nonzero(where)),
                MeasureMeans.over(values, table.op, where),
                psa=mean(maps["psa"][where]),
                sbd_null=mean(maps["sbd_null"][where]),
                sbd_excess=mean(maps["sbd_excess"][where]),
                entropy_within=mean(maps["entropy_within"][where]),
                entropy_between=mean(maps["entropy_between"][where]),
            )
        )
    return tuple(rows)
