"""What is compared: run folders, a label source of them, and small summaries; opened, selected, held side by side."""

from __future__ import annotations

import csv
import functools
import io
import json
import math
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from semstab.config import nearest
from semstab.core.files import atomic_path, parse_json, read_limited
from semstab.core.json_form import from_json, to_json
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import load_result
from semstab.errors import ConfigError, DataError, one_line
from semstab.model import earlier
from semstab.model.georeference import Georeference
from semstab.model.records import ImageSpace, Record, Result
from semstab.model.results import Unit, UnitSummary
from semstab.statistics.cluster_sums import ClusterSums

# A small summary: what a later comparison needs but voxels, in one file that a repository can keep.

SCHEMA, KIND = 2, "semstab small summary"
CONTENT = "summary.json"
LARGEST = 100_000_000
"""Bytes of a file that is looked into, and of all that is packed in it."""

MANY_GROUPS = 32
"""Groups of frames down to which these are joined, before cubes are."""


def valid_flicker(frames: Iterable[int], percents: Iterable[float]) -> bool:
    """Whether these are percentages, of frames that have an index."""
    return all(0 <= frame < 2**31 for frame in frames) and all(0 <= percent <= 100 for percent in percents)


@dataclass(frozen=True)
class Kept:
    """What is kept of a scene beside its sums; flicker in percent by frame."""

    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    flicker: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class Baseline:
    """A label source with its scenes, and the sums of each."""

    backbone: str
    scenes: Mapping[str, Kept]
    sums: Mapping[str, ClusterSums]


@dataclass(frozen=True)
class _Scene:
    """As it stands in the file: JSON has no numbers for keys."""

    name: str
    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    frames: tuple[int, ...]
    flicker: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.flicker) or not valid_flicker(self.frames, self.flicker):
            raise DataError("percentages of flicker, or the frames they are of, are out of range")


@dataclass(frozen=True)
class _Content:
    backbone: str
    scenes: tuple[_Scene, ...] = field(default=())


def save_baseline(baseline: Baseline, path: str | Path, most: int) -> None:
    """Write the file, with cubes of space and groups of frames as fine as `most` bytes allow.

    Raises DataError where even the coarsest are too many.
    """
    scenes = tuple(
        _Scene(
            name,
            own.summary,
            own.image_space,
            own.georeference,
            own.up,
            own.seed,
            (*own.flicker,),
            (*own.flicker.values(),),
        )
        for name, own in baseline.scenes.items()
    )
    content = {"kind": KIND, "schema": SCHEMA, **to_json(_Content(baseline.backbone, scenes))}
    sums = list(baseline.sums.values())
    while len(data := _archive(json.dumps(content), sums)) > most:
        coarser = [_coarser(own) for own in sums]
        if all(
            np.array_equal(new.cell, old.cell) and new.step == old.step for new, old in zip(coarser, sums, strict=True)
        ):
            raise DataError(f"{path}: a summary of {len(sums)} scenes takes {len(data)} bytes; keep fewer scenes")
        sums = coarser
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def load_baseline(path: str | Path) -> Baseline:
    """Read what `save_baseline` wrote. Raises DataError where it is damaged, or something else."""
    try:
        with zipfile.ZipFile(io.BytesIO(read_limited(path, LARGEST))) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST:
                raise DataError(f"{path}: unpacks to more than {LARGEST // 10**6} MB; write the summary again")
            text = parse_json(archive.read(CONTENT))
            if isinstance(text, dict) and text.get("schema") == SCHEMA - 1:
                text = earlier.translated(text, path) | {"schema": SCHEMA}
            if not isinstance(text, dict) or (text.get("kind"), text.get("schema")) != (KIND, SCHEMA):
                raise DataError("of another kind or version")
            content = from_json(_Content, text, path)
            files = [archive.read(f"{i}.parquet") for i in range(len(content.scenes))]
    except (OSError, zipfile.BadZipFile, zlib.error, LookupError, ValueError, RuntimeError, EOFError) as error:
        if isinstance(error, DataError) and str(path) in str(error):
            raise
        raise DataError(f"{path}: neither a run's folder nor a small summary ({one_line(error)})") from error
    with tempfile.TemporaryDirectory() as folder:
        sums = {}
        for scene, data in zip(content.scenes, files, strict=True):
            part = Path(folder) / "sums.parquet"
            part.write_bytes(data)
            try:
                sums[scene.name] = ClusterSums.load(part)
            except DataError as error:
                raise DataError(f"{path}: the sums of {scene.name} are damaged; write the summary again") from error
    kept = {
        own.name: Kept(
            own.summary,
            own.image_space,
            own.georeference,
            own.up,
            own.seed,
            dict(zip(own.frames, own.flicker, strict=True)),
        )
        for own in content.scenes
    }
    return Baseline(content.backbone, kept, sums)


def _archive(content: str, sums: list[ClusterSums]) -> bytes:
    """The file, byte for byte the same for the same content."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive, tempfile.TemporaryDirectory() as folder:
        archive.writestr(zipfile.ZipInfo(CONTENT), content, zipfile.ZIP_DEFLATED)
        for i, own in enumerate(sums):
            part = Path(folder) / "sums.parquet"
            own.save(part)
            archive.writestr(zipfile.ZipInfo(f"{i}.parquet"), part.read_bytes())
    return data.getvalue()


def _coarser(sums: ClusterSums) -> ClusterSums:
    """With half as many groups of frames where there are many, else with larger cubes."""
    if sums.step and sums.frames > MANY_GROUPS:
        return sums.coarsened(sums.edge, 2 * sums.step)
    return sums.coarsened(2 * sums.edge, sums.step)


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
