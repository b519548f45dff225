"""Compute means of a study's units over scenes and repeats; tables and figures all take them from here."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from semstab.data.measures import Measure
from semstab.data.records import Record, Result, Variation
from semstab.data.results import Means
from semstab.data.statistics import UNDEFINED, Estimate, MapStatistics
from semstab.metrics import macro_mean, pool, split_last
from semstab.statistics.intervals import mean_with_ends

ENOUGH = 1000
"""The least number of voxels for a mean. With fewer, chance alone changes the second digit of a mean VSS: its
standard error is up to 0.5 / sqrt(1000) = 0.016, even if the voxels were independent."""


@dataclass(frozen=True)
class Pooled:
    """The voxels of several units together: a mean runs over all of them, so that a scene counts by its voxels.

    PSA, alpha and drift are macro means over the units, with intervals at CONFIDENCE; NaN if no unit has statistics.

    Attributes:
        every: All voxels.
        recurrent: Those with OP >= 3.
        strata: By OP, as the units have them.
        classes: By dominant class, in order of appearance.
        well_seen: The last stratum in parts, where most voxels are in it.
        psa: Pairwise semantic agreement.
        alpha: Krippendorff's alpha.
        drift: SBD in bits.
        drift_null: SBD of the same observations in random order, if it is known.
    """

    voxels: int
    points: int
    observations: int
    every: Means
    recurrent: Means
    strata: tuple[Means, ...]
    classes: tuple[Means, ...]
    well_seen: tuple[Means, ...]
    fuse_ms_per_frame: float
    psa: Estimate = UNDEFINED
    alpha: Estimate = UNDEFINED
    drift: Estimate = UNDEFINED
    drift_null: float = math.nan

    @property
    def excess_drift(self) -> float:
        """Return the SBD of the observations less their SBD in random order, bits."""
        return self.drift.value - self.drift_null

    @property
    def mean_op(self) -> float:
        """Return the mean number of observations of a voxel."""
        return self.observations / self.voxels if self.voxels else math.nan

    @property
    def pixels(self) -> float:
        """Return the sampled points per observation: how many pixels of a frame fall into a voxel."""
        return self.points / self.observations if self.observations else math.nan

    @property
    def once(self) -> float:
        """Return the share of the voxels that were seen once; NaN if the strata do not contain it."""
        return next((row.share for row in self.strata if row.name == "OP=1"), math.nan)


def pooled(records: Sequence[Record]) -> Pooled:
    """Pool the voxels of one or more units; the time of a frame is the macro mean."""
    tables = [record.map_summary for record in records]
    voxels = sum(table.voxels for table in tables)
    strata = tuple(pool(rows, voxels) for rows in zip(*(table.strata for table in tables), strict=True))
    names = dict.fromkeys(row.name for table in tables for row in table.classes)
    of_class = [[row for table in tables for row in table.classes if row.name == name] for name in names]
    return Pooled(
        voxels=voxels,
        points=sum(table.points for table in tables),
        observations=sum(table.observations for table in tables),
        every=dataclasses.replace(pool(strata, voxels), name="all"),
        recurrent=pool([table.recurrent for table in tables], voxels),
        strata=strata,
        classes=tuple(pool(rows, voxels) for rows in of_class),
        well_seen=tuple(split_last(tables)),
        fuse_ms_per_frame=macro_mean([record.fuse_ms_per_frame for record in records]),
        psa=_estimate(records, lambda stats: stats.agreement.psa_op2),
        alpha=_estimate(records, lambda stats: stats.headline.alpha),
        drift=_estimate(records, lambda stats: stats.drift.sbd_op2 if stats.order_known else UNDEFINED),
        drift_null=_macro(records, lambda stats: stats.drift.null if stats.order_known else UNDEFINED),
    )


def _together(records: Sequence[Record], take: Callable[[MapStatistics], Estimate]) -> Estimate:
    """Return the macro mean of an estimate with its interval, the units being independent."""
    estimates = [take(record.statistics) for record in records if record.statistics is not None]
    estimates = [estimate for estimate in estimates if not math.isnan(estimate.low)]
    return mean_with_ends(estimates) if estimates else UNDEFINED


def _estimate(records: Sequence[Record], take: Callable[[MapStatistics], Estimate]) -> Estimate:
    """Return the mean over every unit that has a value; without an interval where one of them has none."""
    estimates = [take(record.statistics) for record in records if record.statistics is not None]
    if any(math.isnan(estimate.low) for estimate in estimates if not math.isnan(estimate.value)):
        return Estimate(macro_mean([estimate.value for estimate in estimates]), math.nan, math.nan)
    return _together(records, take)


def _macro(records: Sequence[Record], take: Callable[[MapStatistics], Estimate]) -> float:
    """Return the macro mean of an estimate in the units' statistics; NaN if no unit has the estimate."""
    return macro_mean([take(record.statistics).value for record in records if record.statistics is not None])


def over_all(measure: Measure) -> Callable[[Pooled], float]:
    """Return a function that takes a measure's mean over all voxels."""
    return lambda pooled: pooled.every[measure]


def over_recurrent(measure: Measure) -> Callable[[Pooled], float]:
    """Return a function that takes a measure's mean over the voxels with OP >= 3."""
    return lambda pooled: pooled.recurrent[measure]


@dataclass(frozen=True)
class RepeatSpread:
    """The mean and standard deviation over the repeats of a random variation; sd is NaN for a single repeat."""

    mean: float
    sd: float
    repeats: int

    @classmethod
    def from_values(cls, values: Sequence[float]) -> RepeatSpread:
        """Return the statistics of the repeats where the value is defined."""
        defined = [value for value in values if not math.isnan(value)]
        sd = statistics.stdev(defined) if len(defined) > 1 else math.nan
        return cls(macro_mean(defined), sd, len(defined))


@dataclass(frozen=True)
class Level:
    """A value of a sweep, with the pooled voxels of each repeat."""

    value: float
    repeats: tuple[Pooled, ...]

    def spread(self, measure: Callable[[Pooled], float]) -> RepeatSpread:
        """Return a measure over the repeats."""
        return RepeatSpread.from_values([measure(repeat) for repeat in self.repeats])

    def mean(self, measure: Callable[[Pooled], float]) -> float:
        """Return the measure's mean over the repeats."""
        return self.spread(measure).mean

    def interval(self, estimate: Callable[[Pooled], Estimate]) -> Estimate:
        """Return the means of an estimate and of its interval over the repeats, whose errors are not independent."""
        estimates = [estimate(repeat) for repeat in self.repeats]
        value, low, high = (
            macro_mean(ends) for ends in zip(*((e.value, e.low, e.high) for e in estimates), strict=True)
        )
        return Estimate(value, low, high)

    @property
    def assessed(self) -> bool:
        """Return whether it has statistics that are defined."""
        return not math.isnan(self.mean(lambda pooled: pooled.psa.value))


@dataclass(frozen=True)
class Sweep:
    """The name of a swept setting, in a sentence and above a column; a value is printed as `{value * scale:g} unit`.

    Attributes:
        noise: True if it disturbs the geometry; 0 then leaves the geometry unchanged.
    """

    name: str
    title: str
    header: str
    unit: str = ""
    scale: float = 1.0
    noise: bool = False

    def text(self, value: float) -> str:
        """Return a value of it, without the unit."""
        return f"{value * self.scale:.6g}"


_SWEEPS = (
    Sweep("voxel_size", "voxel size", "Voxel (m)", "m"),
    Sweep("depth_noise", "depth noise", "Noise (%)", "% of depth", 100.0, noise=True),
    Sweep("translation_noise", "position noise, independent by frame", "Noise (m)", "m", noise=True),
    Sweep("rotation_noise", "rotation noise, independent by frame", "Noise (°)", "°", noise=True),
    Sweep("translation_drift", "position drift, a random walk", "Step (m)", "m a frame", noise=True),
    Sweep("rotation_drift", "rotation drift, a random walk", "Step (°)", "° a frame", noise=True),
    Sweep("frame_count", "temporal sampling", "Frames", "frames"),
    Sweep("pixel_stride", "pixel stride", "Stride (px)", "px"),
)


def describe(sweep: str) -> Sweep:
    """Return the description of a sweep; one that is not known goes by its name."""
    return next((description for description in _SWEEPS if description.name == sweep), _unknown(sweep))


def _unknown(name: str) -> Sweep:
    title = name.replace("_", " ")
    return Sweep(name, title, title.capitalize())


def swept(result: Result) -> list[Sweep]:
    """Return the sweeps of a study that have values, in a fixed order."""
    present = result.sweeps()
    described = [sweep for sweep in _SWEEPS if sweep.name in present]
    return [*described, *(describe(name) for name in present if describe(name) not in described)]


def levels(result: Result, sweep: str, model: str, scene: str | None = None) -> tuple[Level, ...]:
    """Return the values of a sweep, ascending, over the scenes that have all of them."""
    scenes = complete_scenes(result, sweep, model)
    by_value: dict[float, dict[int, list[Record]]] = {}
    for record in result.select(sweep, model=model):
        value, repeat = record.variation.value, record.variation.repeat
        if value is not None and record.unit.scene in scenes and scene in (None, record.unit.scene):
            by_value.setdefault(value, {}).setdefault(repeat, []).append(record)
    return tuple(
        Level(value, tuple(pooled(rows) for _, rows in sorted(repeats.items())))
        for value, repeats in sorted(by_value.items())
    )


def complete_scenes(result: Result, sweep: str, model: str) -> tuple[str, ...]:
    """Return the scenes of a sweep that have each of its values and repeats."""
    points: dict[str, set[Variation]] = {}
    for record in result.select(sweep, model=model):
        points.setdefault(record.unit.scene, set()).add(record.variation)
    all_variations = set().union(*points.values())
    return tuple(scene for scene, of_scene in points.items() if of_scene == all_variations)


def by_model(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Return the records of each model, in order."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(record.unit.model, []).append(record)
    return groups
