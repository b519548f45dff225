"""Everything that the statistics say of one map, and as maps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.core.types import Float64
from semstab.metrics.agreement import require_same_map
from semstab.metrics.summary import STRATA
from semstab.model.events import Events
from semstab.model.results import TableSummary
from semstab.model.statistics import (
    BeyondCoin,
    BlockCut,
    ClassAgreement,
    CorrectnessStatistics,
    Correlogram,
    DriftStatistics,
    EntropyParts,
    FlipRates,
    FrameAgreement,
    Interval,
    Judged,
    Losses,
    MapStatistics,
    Reach,
    Repeated,
    StratumStatistics,
)
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import alpha_of, between_of, class_agreement_of, kappa_of, ratio_of
from semstab.statistics.correctness import join_truth, quadrants_of, reliability_of, strata_of
from semstab.statistics.kinds import Kinds, spread
from semstab.statistics.looks import Sample, correlogram, reach_by, reach_from
from semstab.statistics.map_sums import BY_STRATUM, Maps, maps_of
from semstab.statistics.sampling import InfluenceSums, Mean, PlaceSums, answered, judged_by, with_sample
from semstab.statistics.sums import SecondSums, Whole, first_look, second_look
from semstab.statistics.verdict import losses_of, verdict

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Analysis:
    """What the statistics say of a map.

    table  the means of its measures
    sums  by frame and cube of space, from which intervals and differences follow without voxels
    make  gives the maps, when they are asked for
    """

    summary: MapStatistics
    table: TableSummary
    sums: InfluenceSums
    make: Callable[[], Maps]

    @functools.cached_property
    def maps(self) -> Maps:
        """One value a voxel (n,) by name, NaN where undefined."""
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
    if events is not None:
        require_same_map(table, events)
    kinds = Kinds.found(table, events, None if truth is None else join_truth(table, truth))
    measured, one, of = kinds.measured(), kinds.one.table, kinds.of
    first, further, null = first_look(measured, limit, edges=edges, seed=seed)
    whole = Whole(first, seed)
    second, more = second_look(measured, whole.overall, limit)
    summary, sums = concluded(
        whole,
        second,
        voxel_size=table.voxel_size,
        classes=table.classes,
        sample=sample,
        name=name,
        edges=edges,
        critical=critical,
    )

    def maps() -> Maps:  # until they are asked for, neither what was measured nor the log takes memory
        found = spread({**maps_of(one.measured(), null), **further, **more}, of)
        return {**found, **whole.overall.maps(table, found)}

    return Analysis(summary, first.own.table.summary(table.voxel_size, table.classes, edges), sums, maps)


def concluded(
    whole: Whole,
    second: SecondSums,
    *,
    voxel_size: float,
    classes: tuple[str, ...] = (),
    sample: Sample | None = None,
    by_lag: Correlogram | None = None,
    name: str = "",
    edges: Sequence[int] = STRATA,
    critical: Sequence[str] = (),
) -> tuple[MapStatistics, InfluenceSums]:
    """What `analyse` says of a map, and its sums by frame and cube, from both looks at it or at its parts.

    by_lag  the correlogram of the sample, where that is known by now
    """
    first, own = whole.first, whole.first.own
    table, influence = own.table.summary(voxel_size, classes, edges), whole.influence
    if sample is not None:
        influence = with_sample(influence, sample.shared(), logged=first.log is not None)
    found, judged, (unsteady,), reached, of_flips = answered(
        own.places.asked(MEANS),
        judged_by(influence),
        second.flipping.asked(),
        () if sample is None else reach_by(influence, table.K),
        () if first.log is None else first.log.places.asked(OF_FLIPS),
    )
    means = dict(zip(MEANS, found, strict=True))
    reach = None
    if sample is not None:
        reach = reach_from(sample.by, own.places["kappa"][2:], influence, reached, critical=critical)
    summary = _concluded(
        _About(name, whole.seed, table, Judged(*judged), reach),
        means,
        own.places,
        correlogram(sample) if by_lag is None and sample is not None else by_lag,
        agreement=_agreement(means, class_agreement_of(own.classes, classes)),
        flipping=second.flipping.flipping(unsteady, classes),
        drift=_drift(means, own.places, whole, of_flips),
        strata=_strata(table, own.strata),
        geometry=_geometry(whole, second, voxel_size),
        correctness=_correctness(whole, second, edges),
        fusion_rules=None if first.log is None else first.log.rule_outcomes(),
    )
    return summary, influence


# --- Sections ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _About:
    """Of a map: what the verdict calls it, the seed of what is drawn, its means, and what the verdict rests on."""

    name: str
    seed: int
    table: TableSummary
    judged: Judged
    reach: Reach | None


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
"""Over the very voxels that the first of `MEANS` are of, so that those are the same numbers without a log."""

OF_CHANGES: Mapping[str, Mean] = {
    "frames_since": Mean("frames_since", bounds=(0.0, math.inf)),
    "trend_excess": Mean("trend_excess", bounds=SIGNED),
}
"""Over fewer voxels."""


def _concluded(
    about: _About,
    means: Mapping[str, Interval],
    places: PlaceSums,
    by_lag: Correlogram | None,
    **sections: Any,
) -> MapStatistics:
    """All of it, from what was found section by section."""
    judged, reach, table, count = about.judged, about.reach, about.table, len(places.cell)
    repeats = int(places["psa"][1])
    repeated = Repeated(repeats, repeats / table.voxels if table.voxels else math.nan)
    said = verdict(
        about.name or "backbone",
        judged=judged,
        reach=reach,
        flips=sections["flipping"],
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
        correlogram=by_lag,
        uncertainty=EntropyParts(means["entropy"], means["entropy_within"], means["entropy_between"]),
        beyond_coin=BeyondCoin(means["coin"], means["steadier"]),
        **sections,
    )


def _agreement(means: Mapping[str, Interval], classes: tuple[ClassAgreement, ...]) -> FrameAgreement:
    names = ("psa", "kappa", "alpha", "vss", "within", "between", "alpha_between", "each_place")
    return FrameAgreement(**{name: means[name] for name in names}, classes=classes)


def _drift(
    means: Mapping[str, Interval], places: PlaceSums, whole: Whole, of_flips: Sequence[Interval]
) -> DriftStatistics:
    """Against its null; without a log only for one-hot evidence, and without tests."""
    log, tests, flips = whole.first.log, None, None
    if log is not None:
        since, trend = log.places.estimates(OF_CHANGES).values()
        tests, flips = whole.drift_tests(trend), FlipRates(*[*of_flips, since])
    return DriftStatistics(
        voxels=int(places["null"][1]),
        sbd=means["sbd"],
        null=means["null"],
        excess=means["excess"],
        tests=tests,
        flips=flips,
    )


def _geometry(whole: Whole, second: SecondSums, voxel_size: float) -> Losses | None:
    if second.losses is None or whole.loss_edge is None:
        return None
    return losses_of([second.losses], whole.loss_edge * voxel_size, seed=whole.seed)


def _correctness(whole: Whole, second: SecondSums, edges: Sequence[int]) -> CorrectnessStatistics | None:
    truth = whole.first.truth
    if truth is None or second.quadrants is None:
        return None
    return CorrectnessStatistics(
        accuracy=truth.right.estimate("right", ratio_of),
        strata=strata_of(truth.strata, edges),
        reliability=reliability_of(truth.reliability),
        quadrants=quadrants_of(second.quadrants),
    )


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
