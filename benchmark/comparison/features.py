"""Runs of models that give features and no labels: alpha of features of each, and its change within one network."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.comparison.entries import Entry, RunHandle
from semstab.data.measures import Quantity
from semstab.data.statistics import FeatureAgreement, Interval
from semstab.errors import DataError
from semstab.statistics.intervals import mean_of, unpaired

FEATURE_ALPHA = Quantity(key="feature_alpha", title="Alpha of features", better="higher", digits=(3, 4))


@dataclass(frozen=True, eq=False)
class FeatureDifference:
    """Alpha of features of a run minus alpha of features of the base.

    Attributes:
        by_scene: In each scene.
        difference: Mean over the scenes; None if the networks differ, so that sizes of alpha tell nothing.
        why: Why the networks are taken for different ones; '' for the same network.
    """

    other: str
    by_scene: tuple[Interval, ...]
    difference: Interval | None
    why: str = ""


def agreement_of(entry: Entry) -> FeatureAgreement | None:
    """Return the agreement of a run's features in a scene; None if it has none."""
    return None if entry.summary.statistics is None else entry.summary.statistics.features


def other_network(base: RunHandle, other: RunHandle, scene: str) -> str:
    """Return why two runs are taken for runs of different networks; '' for the same network.

    A network is the same if its name and its number of components are.
    """
    before, after = (agreement_of(run.scenes[scene]) for run in (base, other))
    if base.model != other.model:
        return f"{base.model} and {other.model} are two networks"
    if before is not None and after is not None and before.components != after.components:
        return f"{base.model} has {before.components} and {after.components} components"
    return ""


def difference_of_features(new: FeatureAgreement, base: FeatureAgreement) -> Interval:
    """Return alpha of features minus alpha of another run, as if errors were independent.

    Errors of runs over the same frames are correlated, so the interval is rather too wide than too narrow.
    """
    return unpaired(new.alpha, base.alpha)


def feature_differences(runs: Sequence[RunHandle], scenes: Sequence[str]) -> list[FeatureDifference]:
    """Return the differences of runs from the first one, in scenes that all have.

    Raises:
        DataError: If a run has no features in a scene.
    """
    base, *others = runs
    for run in runs:
        if without := next((scene for scene in scenes if agreement_of(run.scenes[scene]) is None), None):
            raise DataError(f"{run.where}: {run.model} has no alpha of features of {without}; run it again")
    result = []
    for other in others:
        if why := next(filter(None, (other_network(base, other, scene) for scene in scenes)), ""):
            result.append(FeatureDifference(other.name, (), None, why))
            continue
        pairs = [(agreement_of(other.scenes[scene]), agreement_of(base.scenes[scene])) for scene in scenes]
        by_scene = [difference_of_features(new, old) for new, old in pairs if new is not None and old is not None]
        result.append(FeatureDifference(other.name, tuple(by_scene), mean_of(by_scene)))
    return result


def at_level(interval: Interval, level: float) -> Interval:
    """Return an interval at another level: its ends lie farther or nearer as quantiles of Student's t do."""
    from scipy import special

    degrees = interval.degrees if interval.degrees > 0 else float("inf")
    wanted, given = (float(special.stdtrit(degrees, (1 + each) / 2)) for each in (level, interval.level))
    low, high = (interval.value + wanted / given * (end - interval.value) for end in (interval.low, interval.high))
    return dataclasses.replace(interval, low=max(low, -1.0), high=min(high, 1.0), level=level)
