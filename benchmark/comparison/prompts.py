"""Vocabularies of which names were left out, added or renamed, compared with the full vocabulary of the same run."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.comparison.differences import sums_difference
from semstab.comparison.observations import common_observations
from semstab.comparison.ranking import with_one_number_of_classes
from semstab.core.types import Int64
from semstab.data.records import Record, Result
from semstab.data.statistics import Interval
from semstab.predict.prompts import VocabularyChanges
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.agreement import ALPHA
from semstab.statistics.observations import SpotObservations, same_spots

NO_LABEL = "no label"


@dataclass(frozen=True)
class Effect:
    """The effect of a change of names on the labels of a vocabulary.

    Attributes:
        difference: Alpha with the change minus alpha of the full vocabulary, where both give a label.
        changed: Share of the labels of views at spots that become another name; an old and a new name are one.
        most: The most frequent of these.
        share: Its share of the labels that become another name.
    """

    difference: Interval
    changed: float
    most: str
    share: float


@dataclass(frozen=True, eq=False)
class ChangedVocabulary:
    """A vocabulary with other names, on a scene: its record, the changes, and their effect."""

    full: str
    changes: VocabularyChanges
    record: Record
    effect: Effect


def changed_vocabularies(result: Result) -> Iterator[ChangedVocabulary]:
    """Yield the vocabularies of a run with other names than a full one of the run, scene by scene."""
    records = {(record.unit.scene, record.unit.model): record for record in result.select()}
    for (scene, model), record in records.items():
        name, changes = VocabularyChanges.of_model(model)
        full = records.get((scene, name))
        if not changes or full is None:
            continue
        files = [
            file for compared in (full, record) if (file := compared.observations_file) is not None and file.is_file()
        ]
        if len(files) == 2:
            (first, first_time), (other, other_time) = ((file, file.stat().st_mtime_ns) for file in files)
            yield ChangedVocabulary(name, changes, record, _effect_of(first, other, changes, (first_time, other_time)))


@functools.lru_cache(maxsize=1024)
def _effect_of(full: Path, other: Path, changes: VocabularyChanges, _: tuple[int, int]) -> Effect:
    """Return the effect of changes from files of observations, which terminal, tables and report ask for in turn."""
    return effect(SpotObservations.load(full), SpotObservations.load(other), changes)


def effect(full: SpotObservations, other: SpotObservations, changes: VocabularyChanges) -> Effect:
    """Return what changes of names do to the labels that views of the same frames give spots."""
    wide = with_one_number_of_classes({"full": full, "other": other})
    before, after = common_observations([wide["full"], wide["other"]]).shared
    base = sums_of_spots(before)
    difference = sums_difference(ALPHA.key, sums_of_spots(after, base.answers[0].edge), base)
    old_name = {new: old for old, new in changes.rename}
    names = [*dict.fromkeys((*full.classes, *(old_name.get(name, name) for name in other.classes), NO_LABEL))]
    number = {name: k for k, name in enumerate(names)}
    old = np.array([number[name] for name in (*full.classes, NO_LABEL)])
    new = np.array([number[old_name.get(name, name)] for name in (*other.classes, NO_LABEL)])
    one, two = same_spots([full, other])
    _, at_one, at_two = np.intersect1d(_observation(one), _observation(two), return_indices=True)
    from_name, to_name = old[one.label[at_one]], new[two.label[at_two]]
    differs = from_name != to_name
    if not differs.any():
        return Effect(difference, 0.0, "", 0.0)
    pairs, often = np.unique(from_name[differs] * len(names) + to_name[differs], return_counts=True)
    before_name, after_name = divmod(int(pairs[often.argmax()]), len(names))
    most = f"{names[before_name]} to {names[after_name]}"
    return Effect(difference, float(differs.mean()), most, float(often.max() / often.sum()))


def _observation(sample: SpotObservations) -> Int64:
    """Return the number (m,) of the spot and view of each answer, the same in samples with the same spots."""
    number: Int64 = sample.spot.astype(np.int64) * max(len(sample.views), 1) + sample.view
    return number
