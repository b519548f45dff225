"""Runs that are compared: run folders, one label source of a folder, and small summaries; matched by scene.

A small summary holds all data of a later comparison except voxels, in one file that a repository can store.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from semstab.config import nearest
from semstab.core.files import ScratchFolder, atomic_path, parse_json, read_limited
from semstab.core.json_form import from_json, to_json
from semstab.core.sealed_zip import packed, unpacked
from semstab.data import parquet
from semstab.data.contrast import FrameShare
from semstab.data.digests import require_unchanged
from semstab.data.georeference import Georeference
from semstab.data.labels import sharing_classes
from semstab.data.records import ImageSpace, Record, Result
from semstab.data.results import UnitSummary
from semstab.data.statistics import LabelledPairs, MapStatistics
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import load_result, run_and_model
from semstab.errors import ConfigError, DataError, sanitize, summarize_error
from semstab.statistics.cluster_sums import ClusterSums
from semstab.statistics.verdict import ADVICE, LEAST_CLASSES

Flicker = Mapping[int, float]
"""Percent of the pixels whose label differs from the label in the frame before, camera motion removed, by frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EntryNumbers:
    """Numbers of a unit that is compared.

    Attributes:
        up: The scene's up axis, if it is known.
        seed: The seed of a simulated scene.
    """

    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Entry(EntryNumbers):
    """A unit that is compared: a label source on a scene.

    Attributes:
        where: The folder or the file that it comes from, in print; the model of a run that a program holds.
        record: Its record in the folder; None for a small summary, which holds no voxels.
        small: Sums and flicker of a small summary.
    """

    where: str
    record: Record | None = None
    small: tuple[ClusterSums, Flicker] | None = None

    @property
    def pairs(self) -> LabelledPairs:
        """Return the pairs of views of a spot of which both have a label; all of them if that is not known."""
        statistics = self.summary.statistics
        return LabelledPairs() if statistics is None or statistics.spots is None else statistics.spots.pairs

    @functools.cached_property
    def sums(self) -> ClusterSums:
        """Its sums by frame and cube of space.

        Raises:
            DataError: If the run has none.
        """
        if self.small is not None:
            return self.small[0]
        assert self.record is not None
        if (pixels := self.record.pixels) is not None:
            nothing = np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros((0, 0))
            return ClusterSums(*nothing, {}, 1.0, classes=pixels.classes, fused=self.summary.frames)
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
        assert self.record is not None
        return _flicker(self.record.series)

    def named(self, frames: Sequence[FrameShare]) -> tuple[FrameShare, ...]:
        """Return frames with the names of their files, where the run stored them."""
        if self.record is None or self.record.series is None:
            return tuple(frames)
        with self.record.series.open(encoding="utf-8", newline="") as lines:
            names = {row["frame"]: row.get("name") or "" for row in csv.DictReader(lines)}
        return tuple(replace(frame, name=names.get(str(frame.frame), "")) for frame in frames)

    @property
    def caveat(self) -> str:
        """Why its agreement does not assess its labels, in the words of its verdict; '' if agreement does."""
        statistics = self.summary.statistics
        if self.record is not None and (pixels := self.record.pixels) is not None:
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
        if self.record is None:
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
        return any(gives_features_alone(entry.summary.statistics) for entry in self.scenes.values())

    def require_labels(self) -> None:
        """Raise ConfigError if the model gives features alone."""
        if self.features_alone:
            raise ConfigError(
                f"{self.where}: {self.model} gives features and no labels, and what is compared is of labels; name its"
                f" features (--vocabulary FILE), or see `semstab-bench show {self.source or 'RUN'} features`"
            )


def open_compared(named: Sequence[str | os.PathLike[str]]) -> tuple[RunHandle, ...]:
    """Open runs that are compared, or the models of one run; also such as have features and no labels.

    Raises:
        ConfigError: If there are fewer than two, and as `open_runs` does.
        DataError: As `open_runs` does.
    """
    handles = open_models(named[0]) if len(named) == 1 else open_runs(named)
    if len(handles) < 2:
        raise ConfigError("there is nothing to compare the run with; name two runs or more, the base first")
    return handles


def open_runs(named: Sequence[str | os.PathLike[str]]) -> tuple[RunHandle, ...]:
    """Open folders of runs or studies, 'FOLDER:MODEL', and small summaries, under the shortest distinct names.

    Raises:
        ConfigError, DataError: As `open_run` does.
    """
    runs = [open_run(source) for source in named]
    folders = ["" if run.source is None else run.source.resolve().name for run in runs]
    models = [run.model for run in runs]
    folder_and_model = [f"{folder}:{model}" for folder, model in zip(folders, models, strict=True)]
    full_names = [f"{run.source}:{run.model}" for run in runs]
    names = next(
        (naming for naming in (models, folders, folder_and_model) if len({*naming}) == len({*full_names})), full_names
    )
    names = [run.model if run.source is None else name for name, run in zip(names, runs, strict=True)]
    in_memory = [name for name, run in zip(names, runs, strict=True) if run.source is None]
    if twice := next((name for name in in_memory if names.count(name) > 1), None):
        raise ConfigError(f"two results are named '{twice}'; give each a name: semstab.fuse(frames, model=NAME)")
    times = [names[: i + 1].count(name) for i, name in enumerate(names)]
    names = [name if nth == 1 else f"{name} ({nth})" for name, nth in zip(names, times, strict=True)]
    return tuple(replace(run, name=name) for run, name in zip(runs, names, strict=True))


def open_models(named: str | os.PathLike[str]) -> tuple[RunHandle, ...]:
    """Open all label sources of one run that have the classes that most of them have; ground truth is left out.

    Models that give features alone are left out, too, unless there are no others.

    Raises:
        ConfigError, DataError: As `open_run` does.
    """
    path, model_named = run_and_model(named)
    if model_named is not None or not path.is_dir():
        return (open_run(named),)
    return models_of(load_result(path), path if isinstance(named, str | Path) else None)


def models_of(result: Result, source: Path | None = None) -> tuple[RunHandle, ...]:
    """Return the label sources of a run that have the classes that most of them have, without the ground truth.

    Models that give features alone are left out, unless there are no others.
    """
    names = [model for model in result.models if model != GROUND_TRUTH]
    of_models = [handle_of(result, model, source) for model in names]
    handles = [handle for handle in of_models if not handle.features_alone] or of_models
    scenes = set.intersection(*({*handle.scenes} for handle in handles)) if handles else set()
    if not scenes:
        return tuple(handles)
    scene = min(scenes)
    shared = sharing_classes({handle.model: handle.scenes[scene].classes for handle in handles})
    return tuple(handle for handle in handles if handle.model in shared)


def open_run(named: str | os.PathLike[str]) -> RunHandle:
    """Open a run's only label source, or the one that 'FOLDER:MODEL' selects, at the base settings and backend.

    Raises:
        ConfigError: If there is no such folder or label source, or several.
        DataError: If it is damaged.
    """
    path, model_named = run_and_model(named)
    model = model_named or ""
    if not path.exists():
        raise ConfigError(f"{path}: there is no such folder; give the folder of a run, or FOLDER:MODEL")
    if path.is_file():
        small = load_summary(path)
        _chosen(path, [small.model], model)
        return small
    result = load_result(path)
    source = path if isinstance(named, str | Path) else None
    return handle_of(result, _chosen(path, result.models, model), source)


def gives_features_alone(statistics: MapStatistics | None) -> bool:
    """Return whether a model gives features and no labels."""
    features = None if statistics is None else statistics.features
    return features is not None and features.alone


def handle_of(result: Result, model: str, source: Path | None = None) -> RunHandle:
    """Return one label source of a run, at the base settings and backend; `source` is its folder, if it has one."""
    seed = result.manifest.get("seed")
    scenes = {
        scene: Entry(
            summary=record.summary, image_space=record.image_space, georeference=result.georeference.get(scene),
            up=result.up.get(scene), seed=seed if isinstance(seed, int) else None, where=str(source or model),
            record=record,
        )
        for record in result.select(model=model)
        for scene in [record.unit.scene]
    }  # fmt: skip
    return RunHandle(model, source, model, scenes)


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


def _chosen(path: Path, models: Sequence[str], model: str) -> str:
    if model:
        if model not in models:
            raise ConfigError(f"{path}: no model '{model}'; {nearest(model, models)}")
        return model
    predicted = [name for name in models if name != GROUND_TRUTH] or list(models)
    if not predicted:
        raise ConfigError(f"{path}: it holds no finished unit")
    if len(predicted) > 1:
        listed = ", ".join(predicted[:4]) + (", ..." if len(predicted) > 4 else "")
        raise ConfigError(f"{path}: it holds several label sources ({listed}); name one: {path}:{predicted[0]}")
    return predicted[0]


def _flicker(file: Path | None) -> Flicker:
    if file is None:
        return {}
    require_unchanged(file)
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = [(row["frame"], row.get("compensated_flicker_percent")) for row in csv.DictReader(lines)]
        flicker = {int(frame): float(percent) for frame, percent in rows if percent}
        flicker = {frame: percent for frame, percent in flicker.items() if math.isfinite(percent)}
        if not _valid(flicker, flicker.values()):
            raise ValueError("a percentage of flicker, or a frame's index, is out of range")
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(f"{file}: cannot be read ({summarize_error(error)}); run it again") from error
    return flicker


def _valid(frames: Iterable[int], percents: Iterable[float]) -> bool:
    return all(0 <= frame < 2**31 for frame in frames) and all(0 <= percent <= 100 for percent in percents)


# --- Small summaries --------------------------------------------------------------------------------------------------

SCHEMA, KIND = 1, "semstab small summary"
CONTENT = "summary.json"
LARGEST = 100_000_000
"""Most bytes of a file, of its unpacked content, and of the numbers in it."""

LONGEST_NAME = 255
"""The largest number of characters of a name in an archive: file systems allow a file's name as many."""

LONGEST_CONTENT = 2**23
"""Most bytes of its text: of ten models in a hundred scenes it has a tenth."""

MANY_GROUPS = 32
"""Number of groups of frames above which these are joined, before cubes are."""


@dataclass(frozen=True, kw_only=True)
class _Scene(EntryNumbers):
    name: str
    frames: tuple[int, ...]
    flicker: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.flicker) or not _valid(self.frames, self.flicker):
            raise DataError("percentages of flicker, or the frames they are of, are out of range")


@dataclass(frozen=True)
class _Content:
    model: str
    scenes: tuple[_Scene, ...] = field(default=())
    about: dict[str, Any] = field(default_factory=dict)


def save_summary(
    run: RunHandle, path: str | Path, most: int = 1_000_000, *, single: bool = False, keep_spots: bool = False
) -> None:
    """Write all data of a later comparison except voxels into one file.

    Its cubes of space and groups of frames are as fine as `most` bytes allow; sums are rounded to single precision on
    request, which halves the file; `keep_spots` makes sums of the map coarser alone.

    Raises:
        DataError: If even the coarsest sums need more, or a scene is a video: it has no sums.
    """
    if video := next((name for name, entry in run.scenes.items() if not entry.sums.layout), None):
        raise DataError(f"{path}: {video} is a video, without a map to summarise; compare the folder of the run")
    scenes = tuple(
        _Scene(**_numbers(entry), name=name, frames=(*entry.flicker,), flicker=(*entry.flicker.values(),))
        for name, entry in run.scenes.items()
    )
    content = json.dumps({"kind": KIND, "schema": SCHEMA, **to_json(_Content(run.model, scenes, {**run.about}))})
    sums = [entry.sums for entry in run.scenes.values()]
    while len(data := _archive(content, sums, single=single)) > most:
        coarser = [_coarser(part, keep_spots=keep_spots) for part in sums]
        if all(np.array_equal(a.cell, b.cell) and a.step == b.step for a, b in zip(coarser, sums, strict=True)):
            raise DataError(f"{path}: a summary of {len(sums)} scenes takes {len(data)} bytes; use fewer scenes")
        sums = coarser
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def load_summary(path: str | Path) -> RunHandle:
    """Return what `save_summary` wrote.

    Raises:
        DataError: For any other file.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(io.BytesIO(read_limited(path, LARGEST))) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST:
                raise DataError(f"{path}: it unpacks to more than {LARGEST // 10**6} MB; write the summary again")
            if archive.getinfo(CONTENT).file_size > LONGEST_CONTENT:
                raise DataError(f"{path}: its text has more than {LONGEST_CONTENT} bytes; write the summary again")
            members = unpacked(archive)
            text = parse_json(members[CONTENT])
            if not isinstance(text, dict) or (text.get("kind"), text.get("schema")) != (KIND, SCHEMA):
                raise DataError("it is of another kind or version")
            content = from_json(_Content, text, path)
            for name in (content.model, *(scene.name for scene in content.scenes)):
                _require_name(path, name)
            files = [members[f"{i}.parquet"] for i in range(len(content.scenes))]
    except (OSError, zipfile.BadZipFile, zlib.error, LookupError, ValueError, RuntimeError, EOFError) as error:
        if isinstance(error, DataError) and str(path) in str(error):
            raise
        raise DataError(
            f"{path}: it is neither a run's folder nor a small summary ({summarize_error(error)})"
        ) from error
    scenes, room = {}, LARGEST
    with ScratchFolder() as folder:
        part = folder / "sums.parquet"
        for numbers, data in zip(content.scenes, files, strict=True):
            part.write_bytes(data)
            try:
                room -= parquet.unpacked_bytes(part)
                if room < 0:
                    raise DataError(f"{part}: its sums take more than {LARGEST} bytes")
                sums = ClusterSums.load(part)
            except DataError as error:
                raise DataError(f"{path}: the sums of {numbers.name} are damaged; write the summary again") from error
            flicker = dict(zip(numbers.frames, numbers.flicker, strict=True))
            scenes[numbers.name] = Entry(**_numbers(numbers), where=str(path), small=(sums, flicker))
    return RunHandle(content.model, path, content.model, scenes, content.about)


def _require_name(path: Path, name: str) -> None:
    """Raise DataError for a name that no folder of a scene or model has."""
    if not name or len(name) > LONGEST_NAME or not name.isprintable():
        raise DataError(f"{path}: {sanitize(repr(name))[:80]} is no name of a scene or model; write the summary again")


def _numbers(numbers: EntryNumbers) -> dict[str, Any]:
    return {field.name: getattr(numbers, field.name) for field in dataclasses.fields(EntryNumbers)}


def _archive(content: str, sums: list[ClusterSums], *, single: bool) -> bytes:
    """Return the file, byte for byte the same for the same content."""
    members = {CONTENT: content.encode()}
    with ScratchFolder() as folder:
        for i, scene_sums in enumerate(sums):
            part = folder / "sums.parquet"
            scene_sums.save(part, single=single)
            members[f"{i}.parquet"] = part.read_bytes()
    return packed(members)


def _coarser(sums: ClusterSums, *, keep_spots: bool) -> ClusterSums:
    """Join pairs of groups of frames if the sums have more than MANY_GROUPS groups, else join cubes."""
    coarsened = sums.map_coarsened if keep_spots else sums.coarsened
    if sums.step and sums.frames > MANY_GROUPS:
        return coarsened(sums.edge, 2 * sums.step)
    return coarsened(2 * sums.edge, sums.step)
