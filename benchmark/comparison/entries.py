"""Label sources that are compared, and their scenes: numbers, sums and flicker of each, wherever they come from."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from semstab.data.contrast import FrameShare
from semstab.data.georeference import Georeference
from semstab.data.records import Record
from semstab.data.statistics import LabelledPairs, MapStatistics
from semstab.engine.series import read_cells, read_names
from semstab.errors import ConfigError, DataError, summarize_error
from semstab.statistics.cluster_sums import ClusterSums
from semstab.statistics.verdict import ADVICE, LEAST_CLASSES

Flicker = Mapping[int, float]
"""Percent of the pixels whose label differs from the label in the frame before, camera motion removed, by frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry:
    """A unit that is compared: a label source on a scene.

    Attributes:
        record: Its record; of a small summary without files.
        up: The scene's up axis, if it is known.
        seed: The seed of a simulated scene.
        where: The folder or the file that it comes from, in print; the model of a run that a program holds.
        is_small: True for a small summary, which holds no voxels.
        small: Sums and flicker, if they are not those of the record's files.
    """

    record: Record
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    where: str
    is_small: bool = False
    small: tuple[ClusterSums, Flicker] | None = None

    @property
    def pairs(self) -> LabelledPairs:
        """Return the pairs of views of a spot of which both have a label; all of them if that is not known."""
        statistics = self.record.statistics
        return LabelledPairs() if statistics is None or statistics.spots is None else statistics.spots.pairs

    @functools.cached_property
    def sums(self) -> ClusterSums:
        """Its sums by frame and cube of space.

        Raises:
            DataError: If the run has none.
        """
        if self.small is not None:
            return self.small[0]
        if (pixels := self.record.pixels) is not None:
            nothing = np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, 0))
            return ClusterSums(*nothing, {}, 1.0, classes=pixels.classes, fused=self.record.frames)
        file = self.record.sums_file
        if file is None or not file.is_file():
            raise DataError(f"{self.where}: it has no sums by frame and cube of {self.record.unit.slug}; run it again")
        try:
            return ClusterSums.load(file)
        except DataError as error:
            raise DataError(f"{error}; run it again") from error

    @functools.cached_property
    def flicker(self) -> Flicker:
        """Flicker of each frame but the first."""
        if self.small is not None:
            return self.small[1]
        return _flicker(self.record.series)

    def with_names(self, frames: Sequence[FrameShare]) -> tuple[FrameShare, ...]:
        """Return frames with the names of their files, where the run stored them."""
        if self.record.series is None:
            return tuple(frames)
        names = read_names(self.record.series)
        return tuple(replace(frame, name=names.get(frame.frame, "")) for frame in frames)

    @property
    def caveat(self) -> str:
        """Why its agreement does not assess its labels, in the words of its verdict; '' if agreement does."""
        statistics = self.record.statistics
        if (pixels := self.record.pixels) is not None:
            silent = pixels.effective_classes < LEAST_CLASSES
            return f"uninformative: nearly all of its labels are {pixels.largest_class}" if silent else ""
        if statistics is None or statistics.verdict.level not in ("uninformative", "misleading"):
            return ""
        return f"{statistics.verdict.level}: {ADVICE[statistics.verdict.level]}"

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in order."""
        return self.sums.classes

    def with_voxels(self, purpose: str) -> Record:
        """Return the record with its voxels. Raises DataError, which names the purpose, if the record has no voxels."""
        if self.is_small:
            raise DataError(
                f"{self.where}: it is a small summary, without the voxels that {purpose} needs; give the folder"
            )
        return self.record


@dataclass(frozen=True, eq=False)
class RunHandle:
    """A label source with all scenes that it was fused in.

    Attributes:
        name: Distinct among the runs that are compared: its model, its folder, or both.
        source: The folder, or the file of a small summary; None for a run that a program holds.
        about: What a small summary that was handed in says of its benchmark and its model.
    """

    name: str
    source: Path | None
    model: str
    scenes: Mapping[str, Entry]
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Its folder or file in print; the model of a run that a program holds."""
        return str(self.source or self.model)

    def __str__(self) -> str:
        return self.model if self.source is None else f"{self.model} ({self.source})"

    @property
    def features_alone(self) -> bool:
        """Return whether the model gives features and no labels."""
        return any(gives_features_alone(entry.record.statistics) for entry in self.scenes.values())

    def require_labels(self) -> None:
        """Raise ConfigError if the model gives features alone."""
        if self.features_alone:
            raise ConfigError(
                f"{self.where}: {self.model} gives features and no labels, and what is compared is of labels; name its"
                f" features (--vocabulary FILE), or see `semstab-bench show {self.source or 'RUN'} features`"
            )


def gives_features_alone(statistics: MapStatistics | None) -> bool:
    """Return whether a model gives features and no labels."""
    features = None if statistics is None else statistics.features
    return features is not None and features.alone


def shared_scenes(runs: Sequence[RunHandle]) -> tuple[str, ...]:
    """Return the scenes that all runs have, in the order of the first one.

    Raises:
        DataError: If there is none, where one was simulated with other seeds, or its classes differ.
    """
    first, *rest = runs
    scenes = tuple(scene for scene in first.scenes if all(scene in other.scenes for other in rest))
    if not scenes:
        other = next((run for run in rest if not first.scenes.keys() & run.scenes.keys()), rest[-1])
        listed = [", ".join([*run.scenes][:3]) + (", ..." if len(run.scenes) > 3 else "") for run in (first, other)]
        raise DataError(
            f"{first.where} and {other.where} have no scene in common ({listed[0] or 'none'}; {listed[1] or 'none'});"
            " run both on the same scenes"
        )
    for scene in scenes:
        for other in rest:
            _require_same_scene(scene, first.scenes[scene], other.scenes[scene])
    return scenes


def _require_same_scene(scene: str, one: Entry, other: Entry) -> None:
    where = f"{one.where} and {other.where}"
    if one.seed != other.seed:
        raise DataError(
            f"{where}: {scene} was simulated with the seeds {one.seed} and {other.seed}, which make other scenes;"
            " run both with one --seed"
        )
    if one.classes != other.classes:
        a, b = ((*entry.classes, "no more") for entry in (one, other))
        k = next(k for k, pair in enumerate(zip(a, b, strict=False)) if pair[0] != pair[1])
        raise DataError(
            f"{where}: the classes of {scene} differ ({len(one.classes)} and {len(other.classes)}; class {k} is {a[k]}"
            f" and {b[k]}); run both with one --taxonomy"
        )


def _flicker(file: Path | None) -> Flicker:
    if file is None:
        return {}
    cells = read_cells(file)
    try:
        rows = [(row["frame"], row.get("compensated_flicker_percent")) for row in cells]
        flicker = {int(frame): float(percent) for frame, percent in rows if percent}
        flicker = {frame: percent for frame, percent in flicker.items() if math.isfinite(percent)}
        if not valid_flicker(flicker, flicker.values()):
            raise ValueError("a percentage of flicker, or a frame's index, is out of range")
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{file}: cannot be read ({summarize_error(error)}); run it again") from error
    return flicker


def valid_flicker(frames: Iterable[int], percents: Iterable[float]) -> bool:
    """Return whether indices of frames, and percentages of flicker, are in range."""
    return all(0 <= frame < 2**31 for frame in frames) and all(0 <= percent <= 100 for percent in percents)
