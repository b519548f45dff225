"""Everything that the statistics say of one map, and as maps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import require_same_map
from semstab.metrics.summary import STRATA, TableSums
from semstab.model.measures import dominant, mean
from semstab.model.results import TableSummary
from semstab.model.statistics import (
    BeyondCoin,
    BlockCut,
    ClassAgreement,
    CorrectnessStatistics,
    DriftStatistics,
    DriftTests,
    EntropyParts,
    Flipping,
    FlipRates,
    FrameAgreement,
    Interval,
    MapStatistics,
    Repeated,
    RuleOutcome,
    StratumStatistics,
)
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import (
    alpha_of,
    between_of,
    class_agreement,
    class_agreement_of,
    kappa_of,
    ratio_of,
)
from semstab.statistics.correctness import (
    Truth,
    by_stratum,
    join_truth,
    quadrants,
    reliability,
    rule_means,
    stable_wrong,
)
from semstab.statistics.judging.ceiling import losses
from semstab.statistics.judging.flipping import flipping
from semstab.statistics.judging.verdict import verdict
from semstab.statistics.looks import Sample, correlogram, reach_from
from semstab.statistics.map_sums import (
    BY_STRATUM,
    Maps,
    MapSums,
    maps_of,
    mean_columns,
    place_sums,
    stratum_sums,
)
from semstab.statistics.order import fusion_rules
from semstab.statistics.order.drift import (
    TESTABLE,
    VoxelDrift,
    benjamini_hochberg,
    expected_sbd,
    flips,
    trend_columns,
    voxel_drift,
)
from semstab.statistics.sampling import InfluenceSums, Places, PlaceSums, influence_sums, judged_of, with_sample
from semstab.statistics.scene_drift import scene_drift
from semstab.statistics.steady import steady

SCHEMA = 1
FALSE_DISCOVERIES = 0.05
"""Rate at which trending voxels are named."""

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Analysis:
    """What the statistics say of a map; `maps` have one value a voxel (n,), NaN where undefined.

    sums  by frame and cube of space, from which intervals and differences follow without voxels
    make  gives the maps, when they are asked for
    """

    summary: MapStatistics
    sums: InfluenceSums
    make: Callable[[], Maps]

    @functools.cached_property
    def maps(self) -> Maps:
        """One value a voxel (n,) by name."""
        return self.make()


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
    if events is None and truth is None and limit is None:
        return _of_table(table, sample=sample, name=name, seed=seed, edges=edges, critical=critical)
    if events is not None:
        require_same_map(table, events)
    again = table.op >= 2
    drift = None if events is None else voxel_drift(table, events, seed=seed)
    maps = maps_of(table, expected_sbd(table) if drift is None else drift.null)
    places = Places(table.index[again], table.voxel_size)
    means = _Means(place_sums(table, maps, places), places, again)
    known = None if truth is None else join_truth(table, truth)
    agreement = _agreement(means, class_agreement(table, events))
    by_log = None if drift is None or events is None else _by_log(table, events, drift, means, maps, seed)
    right = None if known is None else _correctness(table, known, means, maps, edges)
    sums = influence_sums(
        table,
        events,
        None if known is None else known.label,
        sample=None if sample is None else sample.shared(),
        sbd_excess=maps["sbd_excess"],
        edge=places.edge,
    )
    stable = steady(table)
    about = _About(name, seed, critical, TableSums.of(table, edges).summary(table.voxel_size, table.classes, edges))
    summary = _concluded(
        about,
        means,
        sums,
        sample,
        agreement=agreement,
        flipping=flipping(table, stable, places),
        drift=_drift(means, by_log),
        strata=_strata(about.table, stratum_sums(table, maps, edges)),
        geometry=None if limit is None else losses(table, limit, seed=seed),
        correctness=right,
        fusion_rules=None if events is None else _fusion_rules(table, events, known),
    )
    maps["stable"] = stable
    return Analysis(summary, sums, lambda: maps)


def _of_table(table: VoxelTable, *, edges: Sequence[int], **settings: Any) -> Analysis:
    """What `analyse` says of a map alone: no number of each voxel is kept."""
    sums = MapSums.of(table, edges)
    stable = steady(table)
    unstable = flipping(table, stable, Places(table.index[table.op >= 2], table.voxel_size, sums.places.edge))
    summary, influence = analyse_sums(
        sums, voxel_size=table.voxel_size, classes=table.classes, edges=edges, flipping=unstable, **settings
    )

    def maps() -> Maps:
        return {**maps_of(table, expected_sbd(table)), "stable": stable}

    return Analysis(summary, influence, maps)


def analyse_sums(
    sums: MapSums,
    *,
    voxel_size: float,
    classes: tuple[str, ...] = (),
    sample: Sample | None = None,
    name: str = "",
    seed: int = 0,
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
    flipping: Flipping | None = None,
) -> tuple[MapStatistics, InfluenceSums]:
    """What `analyse` says of a map without log and ground truth, from its sums, which may be those of its parts.

    flipping  of the map, where that is known
    """
    about = _About(name, seed, critical, sums.table.summary(voxel_size, classes, edges))
    means = _Means(sums.places)
    influence = sums.influence if sample is None else with_sample(sums.influence, sample.shared())
    summary = _concluded(
        about,
        means,
        influence,
        sample,
        agreement=_agreement(means, class_agreement_of(sums.classes, classes)),
        flipping=flipping,
        drift=_drift(means),
        strata=_strata(about.table, sums.strata),
    )
    return summary, influence


# --- Sections ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _About:
    """Of a map: what the verdict calls it and depends on, the seed of what is drawn, its means."""

    name: str
    seed: int
    critical: Sequence[str]
    table: TableSummary


class _Means:
    """Means over the voxels with OP >= 2, with their intervals for this map; more of them for a table at hand."""

    def __init__(
        self, sums: PlaceSums, places: Places | None = None, again: npt.NDArray[np.bool_] | None = None
    ) -> None:
        self.sums = sums
        self.places = places
        self.again = again

    def mean(self, name: str, bounds: tuple[float, float] = (0.0, 1.0)) -> Interval:
        """Of values by name, where they are defined."""
        return self.sums.estimate(name, ratio_of, bounds)

    def agreement(self, name: str, statistic: Callable[[Float64], Float64]) -> Interval:
        """Agreement beyond chance."""
        return self.sums.estimate(name, statistic, (-1.0, 1.0), "agreement")

    def of(self, values: Float64, bounds: tuple[float, float] = (0.0, 1.0)) -> Interval:
        """The mean of values (n,) of the table's voxels, where they are defined."""
        return self.function(mean_columns(values), ratio_of, bounds)

    def function(
        self, columns: Float64, statistic: Callable[[Float64], Float64], bounds: tuple[float, float] = (0.0, 1.0)
    ) -> Interval:
        """Of a statistic of the sums of columns (n, C) of the table's voxels."""
        assert self.places is not None
        assert self.again is not None
        return self.places.estimate(columns[self.again], statistic, bounds)


def _concluded(
    about: _About,
    means: _Means,
    sums: InfluenceSums,
    sample: Sample | None,
    **sections: Any,
) -> MapStatistics:
    """All of it, from what was found section by section."""
    judged, table, count = judged_of(sums), about.table, len(means.sums.cell)
    repeats = int(means.sums["psa"][1])
    repeated = Repeated(repeats, repeats / table.voxels if table.voxels else math.nan)
    reach = None if sample is None else reach_from(sample.by, means.sums["kappa"][2:], sums, critical=about.critical)
    said = verdict(
        about.name or "backbone",
        judged=judged,
        reach=reach,
        flips=sections.get("flipping"),
        voxels=repeated.voxels,
        share=repeated.share,
        blocks=count,
    )
    return MapStatistics(
        schema=SCHEMA,
        name=about.name,
        seed=about.seed,
        K=table.K,
        voxel_size=table.voxel_size,
        voxels=table.voxels,
        observations=table.observations,
        repeated=repeated,
        blocks=BlockCut(count, judged.alpha.block_size),
        verdict=said,
        judged=judged,
        reach=reach,
        correlogram=None if sample is None else correlogram(sample),
        uncertainty=EntropyParts(means.mean("entropy"), means.mean("entropy_within"), means.mean("entropy_between")),
        beyond_coin=BeyondCoin(means.sums.estimate("coin", _less, (-1.0, 1.0)), means.mean("steadier", (-1.0, 1.0))),
        **({"flipping": None, "geometry": None, "correctness": None, "fusion_rules": None} | sections),
    )


def _agreement(means: _Means, classes: tuple[ClassAgreement, ...]) -> FrameAgreement:
    return FrameAgreement(
        psa=means.mean("psa"),
        kappa=means.agreement("kappa", kappa_of),
        alpha=means.agreement("alpha", alpha_of),
        vss=means.mean("vss"),
        within=means.mean("within"),
        between=means.mean("between"),
        alpha_between=means.agreement("alpha", between_of),
        each_place=means.agreement("each_place", between_of),
        classes=classes,
    )


def _drift(means: _Means, by_log: tuple[DriftTests, FlipRates] | None = None) -> DriftStatistics:
    """Against its null; without a log only for one-hot evidence, and without tests."""
    tests, changes = by_log or (None, None)
    return DriftStatistics(
        voxels=int(means.sums["null"][1]),
        sbd=means.mean("sbd"),
        null=means.mean("null"),
        excess=means.mean("excess", (-1.0, 1.0)),
        tests=tests,
        flips=changes,
    )


def _by_log(
    table: VoxelTable, events: Events, drift: VoxelDrift, means: _Means, maps: Maps, seed: int
) -> tuple[DriftTests, FlipRates]:
    return _tests(table, events, drift, means, maps, seed), _flips(events, means, maps)


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
    excess = np.stack([one_way - by_chance, all_of_it], axis=1)
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
        rate=means.of(changes.rate),
        null=means.of(changes.null),
        excess=means.of(changes.rate - changes.null, (-1.0, 1.0)),
        frames_since=means.of(changes.since, (0.0, math.inf)),
    )


def _discoveries(q: Float64) -> int:
    with np.errstate(invalid="ignore"):
        return int(np.count_nonzero(q <= FALSE_DISCOVERIES))


def _correctness(
    table: VoxelTable, truth: Truth, means: _Means, maps: Maps, edges: Sequence[int]
) -> CorrectnessStatistics:
    maps |= {"true_label": truth.label, "stable_wrong": stable_wrong(table, truth)}
    right = np.where(truth.known, dominant(table) == truth.label, np.nan)
    counted = truth.known & (table.op >= 2)
    everywhere = Places(table.index, table.voxel_size, means.sums.edge)
    return CorrectnessStatistics(
        accuracy=means.of(right),
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


def _less(sums: Float64) -> Float64:
    """A ratio less another, (...,) from sums (..., 4)."""
    return ratio_of(sums[..., :2]) - ratio_of(sums[..., 2:])


def _strata(table: TableSummary, sums: Float64) -> tuple[StratumStatistics, ...]:
    with np.errstate(invalid="ignore"):
        values = dict(zip(BY_STRATUM, sums[::2] / sums[1::2], strict=True))
    return tuple(
        StratumStatistics(
            stratum.name,
            stratum.voxels,
            stratum.means,
            **{name: float(value[g]) for name, value in values.items()},
        )
        for g, stratum in enumerate(table.strata)
    )
