"""What is compared: run folders, a label source of them, and small summaries; opened, selected, held side by side."""

from __future__ import annotations

import csv
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from semstab.comparison.baseline import Baseline, Kept, load_baseline, save_baseline, valid_flicker
from semstab.config import nearest
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import load_result
from semstab.errors import ConfigError, DataError, one_line
from semstab.model.georeference import Georeference
from semstab.model.records import ImageSpace, Record, Result
from semstab.model.results import Unit, UnitSummary
from semstab.statistics.cluster_sums import ClusterSums

Flicker = Mapping[int, float]
"""Percent of the pixels whose label differs from that of the frame before, by frame index."""


@dataclass(frozen=True, eq=False)
class Entry:
    """A unit that is compared: a label source on a scene.

    where   the folder or the file that it is of
    record  what its folder has of it; None of a small summary, which holds no voxels
    up      the scene's up axis, where it is known
    seed    of a simulated scene
    """

    where: Path
    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    record: Record | None
    read_sums: Callable[[], ClusterSums]
    read_flicker: Callable[[], Flicker]

    @property
    def unit(self) -> Unit:
        """Its scene, label source and backend."""
        return self.summary.unit

    @functools.cached_property
    def sums(self) -> ClusterSums:
        """Its sums by frame and cube of space. Raises DataError where the run kept none."""
        return self.read_sums()

    @functools.cached_property
    def flicker(self) -> Flicker:
        """Flicker of each frame but the first."""
        return self.read_flicker()

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in order."""
        return self.sums.classes

    def with_voxels(self, what: str) -> Record:
        """The record with its voxels. Raises DataError, which names what needs them, where there are none."""
        if self.record is None:
            raise DataError(f"{self.where}: is a small summary, without the voxels that {what} needs; give the folder")
        return self.record


@dataclass(frozen=True, eq=False)
class Contender:
    """A label source with all scenes that it was fused in.

    name    as it is called beside others: by its backbone, its folder, or both
    source  the folder, or the file of a small summary
    """

    name: str
    source: Path
    backbone: str
    scenes: Mapping[str, Entry]


def open_contenders(named: Sequence[str | Path]) -> tuple[Contender, ...]:
    """Folders of runs or studies, 'FOLDER:BACKBONE', and files of small summaries, under names that tell them apart.

    Raises ConfigError or DataError as `open_contender` does.
    """
    found = [open_contender(each) for each in named]
    return tuple(replace(each, name=name) for each, name in zip(found, _names(found), strict=True))


def open_contender(named: str | Path) -> Contender:
    """A run's only label source, or the one that 'FOLDER:BACKBONE' selects, at the run's base settings and backend.

    Raises ConfigError where there is no such folder or label source, or several; DataError where it is damaged.
    """
    path, backbone = _selected(str(named))
    if path.is_file():
        return _of_baseline(path, load_baseline(path), backbone)
    result = load_result(path)
    backbone = _backbone(path, result.backbones, backbone)
    records = {record.unit.scene: record for record in result.select(backbone=backbone)}
    return Contender(backbone, path, backbone, {scene: _entry(path, result, own) for scene, own in records.items()})


def shared_scenes(contenders: Sequence[Contender]) -> tuple[str, ...]:
    """The scenes that all have, in the order of the first one.

    Raises DataError where there is none, where one was simulated with other seeds, or its classes differ.
    """
    first, *others = contenders
    scenes = tuple(scene for scene in first.scenes if all(scene in other.scenes for other in others))
    if not scenes:
        other = next((each for each in others if not first.scenes.keys() & each.scenes.keys()), others[-1])
        raise DataError(
            f"{first.source} and {other.source} have no scene in common ({_listed(first.scenes)}; "
            f"{_listed(other.scenes)}); run both on the same scenes"
        )
    for scene in scenes:
        for other in others:
            _require_same_scene(first.scenes[scene], other.scenes[scene])
            _require_same_classes(first.scenes[scene], other.scenes[scene])
    return scenes


def save_summary(contender: Contender, path: str | Path, most: int = 1_000_000) -> None:
    """Write all that a later comparison needs but voxels into one file of at most so many bytes."""
    kept = {
        scene: Kept(own.summary, own.image_space, own.georeference, own.up, own.seed, dict(own.flicker))
        for scene, own in contender.scenes.items()
    }
    sums = {scene: own.sums for scene, own in contender.scenes.items()}
    save_baseline(Baseline(contender.backbone, kept, sums), path, most)


# --- Parts ------------------------------------------------------------------------------------------------------------


def _selected(text: str) -> tuple[Path, str | None]:
    """The path, and what stands behind its last colon where it is not itself there."""
    path, colon, backbone = text.rpartition(":")
    if Path(text).exists() or not colon:
        path, backbone = text, ""
    if not Path(path).exists():
        raise ConfigError(f"{path}: there is no such folder; give the folder of a run, or FOLDER:BACKBONE")
    return Path(path), backbone or None


def _backbone(path: Path, there: Sequence[str], wanted: str | None) -> str:
    if wanted is not None:
        if wanted not in there:
            raise ConfigError(f"{path}: no backbone '{wanted}'; {nearest(wanted, there)}")
        return wanted
    own = [name for name in there if name != GROUND_TRUTH] or list(there)
    if len(own) != 1:
        listed = ", ".join(own[:4]) + (", ..." if len(own) > 4 else "")
        what = f"holds several label sources ({listed}); name one: {path}:{own[0]}" if own else "holds no finished unit"
        raise ConfigError(f"{path}: {what}")
    return own[0]


def _entry(folder: Path, result: Result, record: Record) -> Entry:
    scene = record.unit.scene
    return Entry(
        folder,
        record.summary,
        record.image_space,
        result.georeference.get(scene),
        result.up.get(scene),
        _seed(result),
        record,
        lambda: _sums(folder, record),
        lambda: _flicker(record.series),
    )


def _sums(folder: Path, record: Record) -> ClusterSums:
    file = record.influence_file
    if file is None or not file.is_file():
        raise DataError(f"{folder}: kept no sums by frame and place of {record.unit.slug}; run it again")
    try:
        return ClusterSums.load(file)
    except DataError as error:
        raise DataError(f"{error}; run it again") from error


def _flicker(file: Path | None) -> Flicker:
    if file is None:
        return {}
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = [(row["frame"], row["flicker_percent"]) for row in csv.DictReader(lines)]
        found = {int(frame): float(percent) for frame, percent in rows if percent}
        found = {frame: percent for frame, percent in found.items() if math.isfinite(percent)}
        if not valid_flicker(found, found.values()):
            raise ValueError("a percentage of flicker, or a frame's index, is out of range")
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise DataError(f"{file}: cannot be read ({one_line(error)}); run it again") from error
    return found


def _of_baseline(path: Path, found: Baseline, backbone: str | None) -> Contender:
    backbone = _backbone(path, [found.backbone], backbone)
    scenes = {
        scene: Entry(
            path, own.summary, own.image_space, own.georeference, own.up, own.seed, None,
            functools.partial(found.sums.__getitem__, scene), functools.partial(dict, own.flicker),
        )
        for scene, own in found.scenes.items()
    }  # fmt: skip
    return Contender(backbone, path, backbone, scenes)


def _seed(result: Result) -> int | None:
    seed = result.manifest.get("seed")
    return seed if isinstance(seed, int) else None


def _require_same_scene(one: Entry, other: Entry) -> None:
    if one.seed != other.seed:
        raise DataError(
            f"{one.where} and {other.where}: {one.unit.scene} was simulated with the seeds {one.seed} and {other.seed},"
            " which make other scenes; run both with one --seed"
        )


def _require_same_classes(one: Entry, other: Entry) -> None:
    if one.classes != other.classes:
        k = next(
            k for k, pair in enumerate(zip((*one.classes, ""), (*other.classes, ""), strict=False)) if len({*pair}) > 1
        )
        names = [(*own.classes, "no more")[k] for own in (one, other)]
        raise DataError(
            f"{one.where} and {other.where}: the classes of {one.unit.scene} differ ({len(one.classes)} and"
            f" {len(other.classes)}; class {k} is {names[0]} and {names[1]}); run both with one --taxonomy"
        )


def _names(found: Sequence[Contender]) -> list[str]:
    """The shortest names that are distinct; what is given twice is numbered."""
    folders, backbones = ([each.source.resolve().name for each in found], [each.backbone for each in found])
    both = [f"{folder}:{backbone}" for folder, backbone in zip(folders, backbones, strict=True)]
    whole = [f"{each.source}:{each.backbone}" for each in found]
    for names in (backbones, folders, both):
        if len(set(names)) == len(set(whole)):
            whole = names
            break
    times = [whole[: i + 1].count(name) for i, name in enumerate(whole)]
    return [name if nth == 1 else f"{name} ({nth})" for name, nth in zip(whole, times, strict=True)]


def _listed(names: Mapping[str, Entry]) -> str:
    some = ", ".join(list(names)[:3])
    return some + (", ..." if len(names) > 3 else "") if some else "none"
