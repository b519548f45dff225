"""The folder of a run or a study: files of each finished unit, from which a killed run or study continues."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import itertools
import logging
import os
import shutil
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from semstab.backends import keeps_log
from semstab.config import Config, read_yaml
from semstab.core.files import (
    TEMPORARY,
    FolderLock,
    atomic_path,
    file_digest,
    read_json,
    read_sealed,
    remove_leftovers,
    require_seal,
    write_sealed,
    write_text,
)
from semstab.core.json_form import from_json, to_json
from semstab.data.digests import DIGESTS, write_digests
from semstab.data.image_measures import ImageSpace
from semstab.data.records import (
    EVENTS,
    FRAMES,
    OBSERVATIONS,
    OF_THE_UNIT,
    OVERVIEW,
    SUMS,
    TRUTH,
    UNITS,
    VOXELS,
    Record,
    RegionFlicker,
    Result,
)
from semstab.data.results import SCHEMA, UnitName, slug
from semstab.engine.units import Plan, Unit, unit_key
from semstab.engine.work import TILES, Start, Work
from semstab.errors import ConfigError, DataError

logger = logging.getLogger("semstab")

LAYOUT = "# semstab, folder layout 4"
"""First line of config.yaml: a folder that begins otherwise is of another version."""

OF_MAPS = (
    "dataset", "taxonomy", "voxel_size", "pixel_stride", "top_k", "frames", "scene_frames", "exclude", "perturbation",
)  # fmt: skip
"""The settings that decide which observations fall into which voxels."""

SETTINGS = "config.yaml"
FAILURES = "failures.log"
WRITTEN = (UNITS, VOXELS, TRUTH, EVENTS, OBSERVATIONS, FRAMES, SUMS, OVERVIEW, TILES, "tables", "figures")
"""Folders into which files are written."""

OWN_FILES = (SETTINGS, FAILURES, DIGESTS, "summary.json", "manifest.json", "report.html", "recording.rrd")
"""Files of a run next to these folders."""


def require_output(path: str | Path, inputs: Iterable[str | Path | None] = ()) -> None:
    """Require that a file to write is not a run's own file, and not a file that is read for it.

    Raises:
        ConfigError: If it is such a file.
    """
    path = Path(path)
    real = path.resolve()
    for folder in real.parents:
        parts = real.relative_to(folder).parts
        is_run_file = (parts[0] in WRITTEN and len(parts) > 1) or (real.name in OWN_FILES and len(parts) == 1)
        if is_run_file and (folder / SETTINGS).is_file() and _holds_run(folder):
            raise ConfigError(f"{path}: is a file of the run in this folder; name another file")
    if any(real == Path(input_path).resolve() for input_path in inputs if input_path is not None):
        raise ConfigError(f"{path}: is also read; name another file")


def _holds_run(folder: Path) -> bool:
    """Return whether a folder holds a run or a study, of any version."""
    with (folder / SETTINGS).open(encoding="utf-8", errors="replace") as lines:
        return lines.readline(200).startswith(LAYOUT.rstrip("0123456789"))


def require_file_names(out: Path, units: Iterable[UnitName]) -> None:
    """Raise ConfigError where two units' files would share a name, or one is too long for the file system."""
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    longest = os.pathconf(existing, "PC_NAME_MAX") - len(".parquet")
    units_by_slug: dict[str, UnitName] = {}
    for unit in units:
        other = units_by_slug.setdefault(unit.slug, unit)
        if other != unit:
            raise ConfigError(f"{other} and {unit} would be written to one file, {unit.slug}; rename a scene or model")
        if len(os.fsencode(unit.slug)) > longest:
            raise ConfigError(
                f"{existing}: its file system allows no name as long as {unit.slug}; choose another --out"
            )


class Folder:
    """OUT/ of a run or study, with what was computed with the same settings; one process owns it until `close`.

    Raises:
        ConfigError: If another process owns it, or if it holds other files or results of an earlier version. Without
            `overwrite`, also if it holds another run of which this plan would keep nothing.
    """

    def __init__(self, path: str | Path, plan: Plan, *, overwrite: bool = False) -> None:
        self.path = Path(path).absolute()
        earlier, config = _claimed(self.path), plan.config
        self._files = {file.stem: file for file in (self.path / UNITS).glob("*.json")}
        before, now = earlier or {}, config.model_dump(mode="json")
        other_map = _first_change({key: before[key] for key in OF_MAPS if key in before}, now)
        if (
            other_map
            and self._files
            and not overwrite
            and not self._keeps_some(plan, before["dataset"] == now["dataset"])
        ):
            raise ConfigError(
                f"{path}: holds another run ({other_map}); choose another --out, or --overwrite to replace it"
            )
        self._lock = FolderLock(self.path)
        (self.path / UNITS).mkdir(exist_ok=True)
        if change := _first_change(before, now):
            logger.warning("%s: earlier results of other settings (%s) are replaced", path, change)
        write_text(self.path / SETTINGS, f"{LAYOUT}\n{config.to_yaml()}")

    def _keeps_some(self, plan: Plan, same_dataset: bool) -> bool:
        """Return whether the folder has a unit of a plan: of these settings and this dataset, or of this very input."""
        units = plan.distinct().values()
        if same_dataset:
            return any(name.startswith(unit.identity) for name in self._files for unit in units)
        with contextlib.suppress(DataError):
            return any(unit.key in self._files for unit in units)
        return False

    def remove_outputs(self) -> None:
        """Remove report, tables, figures and recording of earlier results, which are about to change."""
        for name in ("report.html", "recording.rrd"):
            (self.path / name).unlink(missing_ok=True)
        for name in ("tables", "figures"):
            shutil.rmtree(self.path / name, ignore_errors=True)

    def close(self) -> None:
        """Let another process have it."""
        self._lock.release()

    def finished(self, unit: Unit) -> Record | RegionFlicker | None:
        """Return a unit that an earlier start finished, if its input is the same and all that is wanted is there."""
        if not any(name.startswith(unit.identity) for name in self._files):
            return None
        try:
            file = self._files.get(unit.key)
        except DataError:
            return None  # the input cannot be read: computing the unit will report it
        if file is None:
            return None
        try:
            if unit.regions:
                return from_json(RegionFlicker, read_sealed(file), file)
            record = from_json(Record, read_sealed(file), file)
        except DataError:
            logger.warning("%s: damaged; the unit is computed again", file)
            return None
        return record if self._is_whole(unit, record) else None

    def save(self, work: Work) -> None:
        """Store a finished unit."""
        assert work.record is not None
        self.save_files(work)
        key = unit_key(work.unit.identity, work.record.input)
        write_sealed(self.path / UNITS / f"{key}.json", work.record)
        shutil.rmtree(self.path / TILES / key, ignore_errors=True)
        with contextlib.suppress(OSError):
            (self.path / TILES).rmdir()  # where nothing of other units is left

    def save_files(self, work: Work) -> None:
        """Write what a worker that does not see the folder sent; the last file says that the others are there."""
        for name, file in work.files.items():
            with atomic_path(self.path / name) as temporary:
                temporary.write_bytes(file)

    def clear(self, unit: Unit, keep: Collection[str]) -> None:
        """Remove what was left of a unit's voxels, truth and log, a file or tiles, but for these files."""
        slug = unit.name.slug
        for name in (VOXELS, TRUTH, EVENTS) if unit.stored else ():
            tiles = self.path.glob(f"{name}/{glob.escape(slug)}/*.parquet")
            for file in (self.path / f"{name}/{slug}.parquet", *tiles):
                if file.relative_to(self.path).as_posix() not in keep:
                    file.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                (self.path / name / slug).rmdir()  # if it is empty

    def save_trace(self, work: Work) -> None:
        """Add where a unit's error was raised to failures.log of this start."""
        if work.trace:
            with (self.path / FAILURES).open("a", encoding="utf-8") as log:
                log.write(f"{work.error}\n{work.trace}\n")

    def record(self, unit: Unit, record: Record) -> Record:
        """Return the record of a unit as a result has it: under its variation, with its files, and what is wanted."""
        suffix = "" if _in_tiles(record) else ".parquet"
        voxels, truth = (f"{name}/{unit.name.slug}{suffix}" for name in (VOXELS, TRUTH))
        has_truth = any(name.startswith(truth) for name in record.files)
        return dataclasses.replace(
            record.without_own(),
            variation=unit.variation,
            image_space=record.image_space if unit.image_space else ImageSpace(),
            quality=record.quality if unit.image_space else None,
            video_measures=record.video_measures if unit.image_space else None,
            voxels_file=self.path / voxels if unit.stored and unit.fuses else None,
            series=self.path / FRAMES / f"{unit.name.slug}.csv" if unit.stored else None,
            truth_file=self.path / truth if unit.image_space and has_truth else None,
        )

    def save_result(self, result: Result, saved: Iterable[Record]) -> None:
        """Write summary.json, manifest.json, and the digests of the settings and the units' files.

        Raises:
            DataError: If one of these files is gone.
        """
        digests = {name: digest for record in saved for name, digest in record.files.items()}
        if lost := next((name for name in digests if not (self.path / name).exists()), None):
            raise DataError(f"{self.path / lost}: was written, and is gone; run the same command again")
        if gone := sorted(_models_in(self.path) - {record.unit.model for record in result.records}):
            logger.warning("%s: %s no longer in the summary; name them, too, to have them back", self.path, _are(gone))
        records = _with_files(result.records, lambda file: file.relative_to(self.path))
        content = to_json(dataclasses.replace(result, records=records, manifest={}))
        runs = content.pop("records")
        for run, name in itertools.product(runs, OF_THE_UNIT):
            del run[name]
        del content["manifest"]
        write_sealed(self.path / "summary.json", {"schema": SCHEMA, "runs": runs, **content})
        write_sealed(self.path / "manifest.json", result.manifest)
        write_digests(self.path, digests | {SETTINGS: file_digest(self.path / SETTINGS).hex()})

    @contextlib.contextmanager
    def started(self, config: Config) -> Iterator[Start]:
        """Begin a start, by whose name workers know the folder while the block lasts."""
        start = Start(uuid.uuid4().hex, self.path, config.threads)
        for name in WRITTEN:
            for folder in (self.path / name, *self.path.glob(f"{name}/*/")):
                remove_leftovers(folder)
        (self.path / FAILURES).unlink(missing_ok=True)
        (self.path / DIGESTS).unlink(missing_ok=True)  # until this start has ended, files are of this one or the last
        start.marker.touch()
        try:
            yield start
        finally:
            start.marker.unlink(missing_ok=True)

    def _is_whole(self, unit: Unit, record: Record) -> bool:
        """Return whether the record has all that is wanted of the unit, and its files are unchanged."""
        return (
            (record.statistics is not None or not unit.assessed)
            and (record.checked is not None or not unit.sampled)
            and self.are_whole({name: record.files.get(name) for name in _wanted(unit, record)})
            and (not unit.stored or self.are_whole(record.files))
        )

    def are_whole(self, files: Mapping[str, str | None]) -> bool:
        """Return whether files are there, with these digests; the first one that differs is reported."""
        for name, digest in files.items():
            path = self.path / name
            if digest is None:
                return False
            if not path.exists():
                logger.warning("%s: is missing; its unit is computed again", path)
                return False
            if file_digest(path).hex() != digest:
                logger.warning("%s: has changed since it was written; its unit is computed again", path)
                return False
        return True


def _wanted(unit: Unit, record: Record) -> list[str]:
    """Return the files that a unit must have."""
    name, required = unit.name, list[str]()
    if unit.stored:
        required += (_in_tiles(record) or [f"{VOXELS}/{name.slug}.parquet"]) if unit.fuses else []
        required.append(f"{FRAMES}/{name.slug}.csv")
    if unit.stored and unit.assessed:
        required.append(f"{SUMS}/{name.slug}.parquet")
    if unit.stored and unit.config.events and keeps_log(name.backend):
        required += _in_tiles(record, EVENTS) or [f"{EVENTS}/{name.slug}.parquet"]
    return required + ([f"{OVERVIEW}/{slug(name.scene, name.model)}.npz"] if unit.image_space else [])


def _models_in(folder: Path) -> set[str]:
    """Return the models of the summary in a folder, or an empty set if the summary cannot be read."""
    try:
        content = read_json(folder / "summary.json")
        return {str(run["model"]) for run in content["runs"]}
    except (DataError, KeyError, TypeError):
        return set()


def _are(names: Sequence[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}"


def _in_tiles(record: Record, kind: str = VOXELS) -> list[str]:
    """Return the files of a record's tiles; none of a map that is in one file."""
    return [name for name in record.files if name.startswith(f"{kind}/{record.unit.slug}/")]


def run_and_model(location: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Return the folder of a run, and the model of 'FOLDER:MODEL' where the text names no folder or file itself."""
    text = os.fspath(location)
    folder, _, model = text.rpartition(":")
    return (Path(text), None) if Path(text).exists() or not folder else (Path(folder), model)


def model_of(location: str | os.PathLike[str], model: str | None) -> tuple[Path, str | None]:
    """Return the folder of a run, and the model that 'FOLDER:MODEL' or else `model` names.

    Raises:
        ConfigError: If both name one, and not the same.
    """
    folder, stated = run_and_model(location)
    if stated is not None and model not in (None, stated):
        raise ConfigError(f"{folder}:{stated}: --model {model} names another model; use one of the two")
    return folder, model if stated is None else stated


def load_result(folder: str | Path) -> Result:
    """Return the result of a finished run or study from its folder.

    Args:
        folder: Its --out.

    Raises:
        DataError: If it is not there or damaged.

    Examples:
        >>> semstab.load_result("run").scenes
        ('scene0',)
    """
    folder = Path(folder)
    path = folder / "summary.json"
    if not os.path.lexists(folder):
        raise DataError(f"{folder}: there is no such folder; give the folder of a finished run")
    if _is_earlier(folder):
        raise DataError(f"{folder}: holds results of an earlier version of semstab; run it again, into another folder")
    content = read_json(path)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise DataError(f"{path}: is not a summary of this version of semstab; run it again, into another folder")
    content = require_seal(path, content)
    result = from_json(Result, {**content, "records": content.get("runs")}, path)
    if problem := _contradiction(result):
        raise DataError(f"{path}: {problem}; it is damaged, or of another version; run it again")
    records = _with_files(result.records, lambda file: folder / file)
    manifest = read_sealed(folder / "manifest.json")
    return dataclasses.replace(result, records=records, manifest=manifest)


def _contradiction(result: Result) -> str | None:
    """Return the first part of a result that refers to something outside of it, or None without such a part."""
    if other := [record.unit.backend for record in result.select() if record.unit.backend != result.backend]:
        return f"a run at the base settings is fused by '{other[0]}', not by '{result.backend}'"
    for record in result.records:
        table = record.map_summary
        if not table.strata or (table.voxels and not table.classes):
            return f"{record.unit} has no {'classes' if table.strata else 'strata'}"
    for row in result.agreement:
        if lost := {"op", "evidence"} - row.differences.keys():
            return f"the agreement on {row.scene} has no {min(lost)}"
    files = (file for record in result.records for name in FILES if (file := getattr(record, name)) is not None)
    outside = (file for file in files if file.is_absolute() or ".." in file.parts)
    return next((f"{file} is not in the folder" for file in outside), None)


FILES = ("voxels_file", "truth_file", "series")
"""Fields of a record that are paths."""


def without_files(record: Record) -> Record:
    """Return a record of which no file is kept."""
    nothing: dict[str, Any] = dict.fromkeys(FILES)
    return dataclasses.replace(record, **nothing)


def _with_files(records: Sequence[Record], change: Callable[[Path], Path]) -> tuple[Record, ...]:
    """Return the records with other paths of their files: in summary.json as they are called in the folder."""

    def files(record: Record) -> dict[str, Any]:
        return {name: (path := getattr(record, name)) and change(path) for name in FILES}

    return tuple(dataclasses.replace(record, **files(record)) for record in records)


def _claimed(path: Path) -> dict[str, Any] | None:
    """Return the settings of an earlier start, or None without an earlier start. Changes nothing."""
    if not path.exists():
        return None
    if not path.is_dir():
        raise ConfigError(f"{path}: is a file; name a folder")
    if _is_earlier(path):
        raise ConfigError(f"{path}: holds results of an earlier version of semstab; choose another folder")
    if (path / SETTINGS).exists():
        return read_yaml(path / SETTINGS)
    entries = [*path.iterdir(), *path.glob(f"{UNITS}/*")]
    if any(entry.name != UNITS and not entry.name.startswith(TEMPORARY) for entry in entries):  # a birth's beginnings
        raise ConfigError(f"{path}: is not empty and holds no run or study; choose another folder")
    return None


def _is_earlier(folder: Path) -> bool:
    if not (folder / SETTINGS).exists():
        return False
    with (folder / SETTINGS).open(encoding="utf-8", errors="replace") as lines:
        return lines.readline(200).rstrip("\n") != LAYOUT


def _first_change(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> str | None:
    """Return the first setting that differs, with both values; not what a run may add: scenes, models, ..."""
    left_out = set() if prefix else {"name", "description", "scenes", "models", "backends", "sweeps"}
    for key in (key for key in old if key in new and key not in left_out):
        old_value, new_value, name = old[key], new[key], f"{prefix}{key}"
        if isinstance(old_value, list) and isinstance(new_value, list):
            old_value, new_value = (
                {str(k): item for k, item in enumerate(values)} for values in (old_value, new_value)
            )
            if len(old_value) != len(new_value):
                return f"{name}: {len(old_value)} there, {len(new_value)} here"
        if isinstance(old_value, dict) and isinstance(new_value, dict):
            if change := _first_change(old_value, new_value, f"{name}."):
                return change
        elif old_value != new_value:
            return f"{name}: {old_value} there, {new_value} here"
    return None
