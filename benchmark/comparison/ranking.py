"""The ranking of several models by alpha of the observations that all of them made, with ties."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from semstab.comparison.differences import holm, sums_difference
from semstab.comparison.entries import gives_features_alone
from semstab.comparison.observations import compared_observations
from semstab.core.types import THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.labels import sharing_classes
from semstab.data.records import Record, Result
from semstab.data.statistics import Interval
from semstab.datasets import GROUND_TRUTH
from semstab.metrics import macro_mean
from semstab.statistics.agreement import ALPHA
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import mean_of, scope_of
from semstab.statistics.observations import SpotObservations

Value = TypeVar("Value")


@dataclass(frozen=True)
class AlphaDifference:
    """Alpha of a model less that of another on common observations, the mean over scenes, with its interval.

    Attributes:
        p_holm: p-value, corrected for all pairs of models.
        scope: What varies in the interval.
        undecided: Why nothing may be claimed; '' where something may.
        shown: Whether the difference is shown: Holm's p-value is below 0.05, the interval excludes 0, and it is not
            `silent`.
        silent: Whether the first two hold, but the more stable model owes that to what it leaves out: its alpha is the
            lower one if what has no label counts as disagreeing (`Ignored.alpha`).
    """

    model: str
    other: str
    value: float
    low: float
    high: float
    scenes: int
    p_holm: float
    scope: Scope
    undecided: str
    shown: bool
    silent: bool = False


@dataclass(frozen=True)
class Ranking:
    """Models by alpha of their common observations.

    Attributes:
        ranks: Each rank and its models, the most stable first. A rank is 1 plus the number of models that are shown to
            be more stable, so that models without a shown difference can share it.
        differences: Of all pairs, each in the order of the models in the run.
        unranked: Models whose map is nearly one class, about which alpha tells nothing.
        apart: Models with other classes than most, which cannot be compared with those.
    """

    ranks: tuple[tuple[int, tuple[str, ...]], ...]
    differences: tuple[AlphaDifference, ...]
    unranked: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()


def rank_models(result: Result) -> Ranking:
    """Return the ranking of a run's models by the observations that all of them made; empty for one model.

    Scenes in which not all models have observations do not count.
    """
    labelled = (record for record in result.select() if not gives_features_alone(record.statistics))
    records = [record for record in labelled if record.unit.model != GROUND_TRUTH]
    models: dict[str, list[Record]] = {}
    for record in records:
        models.setdefault(record.unit.model, []).append(record)
    unranked = tuple(name for name, of_scenes in models.items() if all(map(_is_uninformative, of_scenes)))
    names = tuple(name for name in models if name not in unranked)
    scenes = (_files([record for record in records if record.unit.scene == scene]) for scene in result.scenes)
    return replace(_ranking(tuple(filter(None, scenes)), names), unranked=unranked if len(models) > 1 else ())


Files = tuple[tuple[str, Path, int], ...]
"""The models of a scene, their files of observations, and when these were written."""


def _files(records: list[Record]) -> Files:
    """Return the files of a scene; none where a model has none."""
    files = [(record.unit.model, record.observations_file) for record in records]
    present = tuple(
        (name, file, file.stat().st_mtime_ns) for name, file in files if file is not None and file.is_file()
    )
    return present if len(present) == len(files) > 1 else ()


@functools.lru_cache(maxsize=8)
def _ranking(scenes: tuple[Files, ...], names: tuple[str, ...]) -> Ranking:
    """Return the ranking of some models, which terminal and report ask for one after the other."""
    common = [_common(files) for files in scenes] if len(names) > 1 else []
    apart = tuple(name for name in names if common and name not in common[0][0])
    names = tuple(name for name in names if name not in apart)
    complete = [scene for scene in common if {*names} <= scene[0].keys()]
    of_all = {name: macro_mean([alpha[name] for _, alpha in complete]) for name in names} if complete else {}
    return replace(ranked([sums for sums, _ in complete], names, of_all=of_all), apart=apart)


def ranked(
    scenes: Sequence[Mapping[str, ClusterSums]],
    names: Sequence[str],
    places: Sequence[str] | None = None,
    of_all: Mapping[str, float] | None = None,
) -> Ranking:
    """Return the ranking of models by their sums in each scene; each place counts once, however often it was flown.

    of_all is alpha of each model if what it leaves out counts as disagreeing: a model is not shown to be more stable
    than another where that is lower.
    """
    places = [str(k) for k in range(len(scenes))] if places is None else places
    pairs = list(itertools.combinations(names, 2)) if scenes else []
    changes = [over_places([_difference(by_model[b], by_model[a]) for by_model in scenes], places) for a, b in pairs]
    p_values = holm([change.p_value for change in changes])
    differences = []
    for (a, b), change, p in zip(pairs, changes, p_values, strict=True):
        differs = change.decided and p < 1 - change.level and not change.low <= 0 <= change.high
        silent = bool(differs and of_all) and change.value * ((of_all or {})[b] - (of_all or {})[a]) < 0
        interval = change.value, change.low, change.high
        is_significant = differs and not silent
        differences.append(
            AlphaDifference(b, a, *interval, len(scenes), p, change.scope, change.undecided, is_significant, silent)
        )
    alpha = {name: _mean_alpha(name, scenes, places) for name in names} if scenes else {}
    better = dict.fromkeys(alpha, 0)
    for difference in differences:
        if difference.shown:
            better[difference.other if difference.value > 0 else difference.model] += 1
    order = sorted(alpha, key=lambda name: (better[name], -alpha[name]))
    ranks = tuple((1 + n, tuple(tied)) for n, tied in itertools.groupby(order, key=better.__getitem__))
    return Ranking(ranks, tuple(differences))


def over_places(values: Sequence[Interval], places: Sequence[str]) -> Interval:
    """Return the mean over places of the mean over the scenes of each place, with its interval."""
    return mean_of([mean_of(of_place) for of_place in _by_place(values, places)])


def _by_place(values: Sequence[Value], places: Sequence[str]) -> list[list[Value]]:
    return [
        [place_value for place_value, of in zip(values, places, strict=True) if of == place]
        for place in dict.fromkeys(places)
    ]


def _mean_alpha(name: str, scenes: Sequence[Mapping[str, ClusterSums]], places: Sequence[str]) -> float:
    alpha = [value(by_model[name], ALPHA.key) for by_model in scenes]
    return macro_mean([macro_mean(of_place) for of_place in _by_place(alpha, places)])


def _difference(new: ClusterSums, other: ClusterSums) -> Interval:
    """Return alpha of a model minus alpha of another on common observations, for another flight if frames allow it."""
    scopes = {scope_of(sums) for sums in (new, other)}
    scope = THESE_FRAMES if THESE_FRAMES in scopes else THIS_SCENE
    return sums_difference(ALPHA.key, new, other, scope=scope)


def over_one_model(names: Sequence[str]) -> tuple[str, ...]:
    """Return the label sources NET@VOCABULARY of the model that has most of them; none if no model has two."""
    of: dict[str, list[str]] = {}
    for name in names:
        net, at, _ = name.rpartition("@")
        of.setdefault(net if at else "", []).append(name)
    of.pop("", None)
    most = max(of.values(), key=len, default=[])
    return tuple(most) if len(most) > 1 else ()


def with_one_number_of_classes(samples: Mapping[str, SpotObservations]) -> dict[str, SpotObservations]:
    """Return samples of different classes with as many classes as the largest has; alpha stays what it is."""
    K = max(sample.K for sample in samples.values())

    def widened(sample: SpotObservations) -> SpotObservations:
        label, neighbour, beyond = (
            np.where(labels >= sample.K, K, labels).astype(np.uint16)
            for labels in (sample.label, sample.neighbour, sample.beyond)
        )
        return replace(sample, label=label, neighbour=neighbour, beyond=beyond, K=K, classes=(), distances=None)

    return {name: widened(sample) for name, sample in samples.items()}


def _is_uninformative(record: Record) -> bool:
    return record.statistics is not None and record.statistics.verdict.level == "uninformative"


def _common(files: Files) -> tuple[Mapping[str, ClusterSums], Mapping[str, float]]:
    """Return the sums of the observations that all models of a scene with the same classes made.

    Vocabularies over the features of one model are compared whatever their names: alpha is beyond chance. Beside the
    sums is alpha of each model if what it leaves out counts as disagreeing.
    """
    loaded = {name: SpotObservations.load(file) for name, file, _ in files}
    names = sharing_classes({name: sample.classes for name, sample in loaded.items()})
    vocabularies = over_one_model([*loaded])
    if {*names} & {*vocabularies}:
        vocabularies = tuple(name for name in loaded if name in (*names, *vocabularies))
    if len(vocabularies) > len(names):
        names, loaded = vocabularies, with_one_number_of_classes({name: loaded[name] for name in vocabularies})
    if not names:
        return {}, {}
    common = compared_observations({name: loaded[name] for name in names})
    return common.sums, {row.model: row.alpha for row in common.compared.ignored}
