"""Runs of models that give features and no labels: alpha of features of each, and its change within one network."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.comparison.differences import sums_difference
from semstab.comparison.entries import Entry, RunHandle, shared_scenes
from semstab.comparison.opening import open_compared
from semstab.comparison.pairing import other_frame_of_reference
from semstab.core.types import THIS_SCENE, Scope
from semstab.data.measures import Quantity
from semstab.data.statistics import FeatureAgreement, Interval
from semstab.errors import ConfigError, DataError
from semstab.statistics.cluster_sums import functional, parts_of
from semstab.statistics.intervals import mean_of

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
    return None if entry.record.statistics is None else entry.record.statistics.features


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


def difference_of_features(new: Entry, base: Entry, scope: Scope = THIS_SCENE) -> Interval:
    """Return alpha of features minus alpha of features of the base, paired on cubes of space and on common frames.

    Runs in other frames of reference have nothing in common: their errors are independent.
    """
    apart = bool(other_frame_of_reference([base, new]))
    return sums_difference(FEATURE_ALPHA.key, new.sums, base.sums, scope=scope, apart=apart)


def feature_differences(runs: Sequence[RunHandle], scenes: Sequence[str]) -> list[FeatureDifference]:
    """Return the differences of runs from the first one, in scenes that all have.

    Raises:
        DataError: If a run has no features in a scene.
    """
    base, *others = runs
    for run in runs:
        if without := next((scene for scene in scenes if not _has_features(run.scenes[scene])), None):
            raise DataError(f"{run.where}: {run.model} has no alpha of features of {without}; run it again")
    result = []
    for other in others:
        if why := next(filter(None, (other_network(base, other, scene) for scene in scenes)), ""):
            result.append(FeatureDifference(other.name, (), None, why))
            continue
        by_scene = [difference_of_features(other.scenes[scene], base.scenes[scene]) for scene in scenes]
        result.append(FeatureDifference(other.name, tuple(by_scene), mean_of(by_scene)))
    return result


def _has_features(entry: Entry) -> bool:
    return bool(parts_of(entry.sums, functional(FEATURE_ALPHA.key)))


def compare_features(*runs: str | os.PathLike[str]) -> tuple[FeatureDifference, ...]:
    """Compare alpha of features of runs with the first of them, for models with features and without labels.

    Args:
        runs: Folders of runs, 'FOLDER:MODEL' if there are several models, or small summaries; the first is the base.
            One folder alone: its models are compared.

    Returns:
        The difference of each other run. Networks of another name or another number of components are not compared,
        and it says why: alpha of features depends on how a network spreads its vectors.

    Raises:
        ConfigError: If fewer than two runs are named, or one has labels.
        DataError: If they have no scene in common, or one has no features in a scene.

    Examples:
        >>> for change in semstab.compare_features("before", "after"):  # doctest: +SKIP
        ...     print(change.other, change.difference)
    """
    handles = open_compared(runs)
    if labelled := next((run for run in handles if not run.features_alone), None):
        raise ConfigError(f"{labelled.where}: {labelled.model} has labels; semstab.compare compares them")
    return tuple(feature_differences(handles, shared_scenes(handles)))
