"""Export a finished run for other programs: point clouds, rasters, meshes, tables and places, in global coordinates."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from semstab.config import nearest
from semstab.core.files import only_writer, remove_abandoned
from semstab.data.records import Record
from semstab.engine.folder import load_result, model_of, require_output
from semstab.errors import ConfigError
from semstab.exports import clouds, coco, maps
from semstab.exports import join as joining
from semstab.exports import voxels as tabular
from semstab.exports.annotation import annotation_tasks
from semstab.exports.coco import MOST, TaskFile, write_tasks
from semstab.exports.moving import holds_masks, write_masks
from semstab.exports.places import GEOJSON, holds_places, write_places
from semstab.exports.relabel import task_of
from semstab.exports.taxonomy import TAXONOMY, holds_taxonomy, write_taxonomy
from semstab.exports.voxels import ExportedUnit, ExportedVoxels
from semstab.statistics.acceptance import AcceptanceThresholds
from semstab.task import Task

__all__ = ["SUFFIXES", "Exported", "export"]


logger = logging.getLogger("semstab")

MOST_NAMED = 40
"""The most classes that a note names."""

FEW_MET = 0.5
"""The share of a cloud's points with a voxel below which cloud and map may lie in different areas."""


@dataclass(frozen=True)
class Exported:
    """A file that was written, its content in a line, and notes for its reader."""

    path: Path
    content: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExportSettings:
    """The settings of some formats: the cell of a raster in voxels, a table of ASPRS codes."""

    cell: int = 1
    asprs: Path | None = None


Writer = Callable[[ExportedUnit, Path, ExportSettings], int]

WRITERS: Mapping[str, Writer] = {
    ".ply": lambda chosen, path, settings: clouds.write_ply(chosen, path, sum(len(part.table) for part in chosen)),
    ".las": lambda chosen, path, settings: clouds.write_las(chosen, path, settings.asprs),
    ".laz": lambda chosen, path, settings: clouds.write_las(chosen, path, settings.asprs),
    ".tif": lambda chosen, path, settings: maps.write_raster(chosen, path, settings.cell),
    ".glb": lambda chosen, path, settings: maps.write_mesh(chosen, path),
    ".parquet": lambda chosen, path, settings: tabular.write_parquet(chosen, path),
    ".csv": lambda chosen, path, settings: tabular.write_csv(chosen, path),
}
"""The writers by suffix; each takes a map tile by tile and returns the number of voxels."""

SUFFIXES = (*WRITERS, GEOJSON, *TAXONOMY)


def export(
    run: str | Path,
    to: str | Path | Sequence[str | Path],
    *,
    scene: str | None = None,
    model: str | None = None,
    backend: str | None = None,
    measures: Sequence[str] | None = None,
    min_op: int = 1,
    classes: Sequence[str] = (),
    thresholds: str | Path | None = None,
    cell: int = 1,
    asprs: str | Path | None = None,
    classify: str | Path | None = None,
    radius: float | None = None,
    join: str | Path | None = None,
    task_format: str | None = None,
    most: int = MOST,
    code: Sequence[str] = (),
) -> list[Exported]:
    """Write a unit of the run in a folder to files, in the format that each one's suffix names (`SUFFIXES`).

    A .geojson file, or one that is called places.csv, gets the worst places instead: where frames disagree most. A
    .yaml file gets a taxonomy: the finest groups of the unit's classes on which views agree. A folder that is called
    moving gets masks of what moves in each frame, as the option `masks` of datasets takes them.

    Args:
        run: Folder of the run, or FOLDER:MODEL.
        to: Files to write, one or several.
        scene: Scene of the unit; not needed with a single scene.
        model: Model of the unit; not needed with a single model.
        backend: Backend of the unit, by default the base backend.
        measures: Columns to write: measures, op, category, psa, or columns of the run's Parquet file.
        min_op: Only voxels seen that often are written.
        classes: Only voxels of these dominant classes are written; empty for all classes.
        thresholds: A file of `AcceptanceThresholds`: only voxels whose label has the required evidence are written.
        cell: Edge of a raster's cell, in voxels.
        asprs: YAML file CLASS: CODE for LAS; else the table that ships for the taxonomy.
        classify: A cloud: write this cloud, classified; a point outside of all voxels takes the nearest one within
            `radius`.
        radius: Metres, by default a voxel's edge.
        join: A Parquet file with further columns of the same voxels, such as `compare` writes.
        task_format: 'coco': write annotation tasks, the locations where frames disagree, instead of the map.
        most: The largest number of annotation tasks, or of places.
        code: Code that the run's settings name and that may run for annotation tasks, FILE.py:NAME each; other code is
            refused.

    Returns:
        Each file that was written, with its content.

    Raises:
        ConfigError, DataError, MissingDependencyError: If a file cannot be written; the message names it.

    Examples:
        >>> [file] = semstab.export("run:sim-steady", "map.ply", min_op=3)
        >>> file.path.name
        'map.ply'
    """
    run, model = model_of(run, model)
    files = [Path(file) for file in ([to] if isinstance(to, str | Path) else to)]
    _require_writable(files, (asprs, join, thresholds), task_format)
    result = load_result(run)
    record = result.record(scene=scene, model=model, backend=backend)
    settings = ExportSettings(cell, None if asprs is None else Path(asprs))
    accepted = None if thresholds is None else AcceptanceThresholds.load(thresholds)

    @functools.cache
    def chosen(usual: tuple[str, ...] | None) -> ExportedUnit:
        return ExportedUnit(
            result, record, columns=measures or usual, min_op=min_op, classes=classes, thresholds=accepted,
            join=None if join is None else Path(join),
        )  # fmt: skip

    with contextlib.ExitStack() as held:
        for file in dict(sorted((file.resolve(), file) for file in files)).values():
            held.enter_context(only_writer(file))
        if task_format is not None:
            task, _ = held.enter_context(task_of(run, record, result.manifest["inputs"], code))
            tasks = annotation_tasks(chosen(("op",)), task, most)
            unit_names = task.mapping.target, task.scene.name, task.model
            return [_tasks_written(TaskFile(tasks, *unit_names, file), task) for file in files]
        if any(map(holds_masks, files)):
            unit, _ = held.enter_context(task_of(run, record, result.manifest["inputs"], code))
        if classify is not None:
            return [_classified(chosen(joining.MEASURES), Path(classify), file, radius, settings) for file in files]

        def written(file: Path) -> Exported:
            if holds_taxonomy(file):
                return _taxonomy_written(Path(run), record, file)
            if holds_masks(file):
                return _masks_written(unit, file)
            if holds_places(file):
                return _places_written(chosen(("op",)), record, file, most)
            usual = maps.RASTER_MEASURES if file.suffix.lower() == ".tif" else None
            return _written(chosen(usual), file, settings)

        return [written(file) for file in files]


def _require_writable(files: Sequence[Path], inputs: Sequence[str | Path | None], task_format: str | None) -> None:
    """Raise ConfigError for a file that is an input or whose format is not known; remove what a killed export left."""
    for file in files:
        require_output(file, inputs)
        if task_format is not None:
            coco.check(task_format, file)
        elif not holds_masks(file) and file.suffix.lower() not in SUFFIXES:
            raise ConfigError(f"{file}: format '{file.suffix}' is not known; {nearest(file.suffix, SUFFIXES)}")
    for folder in {file.parent for file in files if file.parent.is_dir()}:
        remove_abandoned(folder)


def _written(chosen: ExportedUnit, file: Path, settings: ExportSettings) -> Exported:
    voxels, part = WRITERS[file.suffix.lower()](chosen, file, settings), chosen.first
    return Exported(file, f"{voxels:,} voxels, {_where(part)}", tuple(_notes(part, file, settings)))


def _where(part: ExportedVoxels) -> str:
    """Return what coordinates are in, in words."""
    if part.georeference is None:
        return "coordinates of the scene, which has no georeference"
    return part.georeference.name


def _places_written(chosen: ExportedUnit, record: Record, file: Path, most: int) -> Exported:
    places, part = write_places(chosen, record, file, most)
    content = f"{places} place{'' if places == 1 else 's'} where frames disagree, {_where(part)}"
    notes = []
    if file.suffix.lower() == GEOJSON:
        degrees = "longitude and latitude, WGS 84; x, y, z of its properties are in the projection"
        notes.append("local metres, no degrees: lay no map under it" if part.georeference is None else degrees)
    if record.observations_file is None or not record.observations_file.exists():
        notes.append("the frames that see them are not known: the run stored no sampled observations")
    return Exported(file, content, tuple(notes))


def _taxonomy_written(run: Path, record: Record, file: Path) -> Exported:
    grouping = write_taxonomy(run, record, file)
    content = f"{grouping.groups} groups of classes, {grouping.level}: alpha {grouping.alpha.text()}"
    return Exported(file, content, ())


def _masks_written(task: Task, folder: Path) -> Exported:
    masks, share = write_masks(task, folder)
    content = f"{masks} masks, {share:.1%} of the pixels with depth move"
    return Exported(folder, content, (f"leave them out: --option masks={folder.resolve()}/{{name}}.png",))


def _tasks_written(file: TaskFile, task: Task) -> Exported:
    note, images = write_tasks(file, task), len(file.sizes())
    bits = sum(annotation.score for annotation in file.tasks)
    return Exported(file.path, f"{len(file.tasks)} tasks in {images} images, {bits:,.0f} bits of entropy", (note,))


def _classified(
    chosen: ExportedUnit, cloud: Path, file: Path, radius: float | None, settings: ExportSettings
) -> Exported:
    part = chosen.first
    tally = joining.classify(chosen, cloud, file, part.table.voxel_size if radius is None else radius, settings.asprs)
    share = tally.classified / tally.points
    if chosen.whole and share < FEW_MET:
        logger.warning("%s: %s", cloud, _few_met(tally, part))
    content = f"{tally.points:,} points, {share:.1%} of them classified"
    return Exported(file, content, tuple(_notes(part, file, settings)))


def _few_met(tally: joining.JoinTally, part: ExportedVoxels) -> str:
    """Return the possible reasons why few points of a cloud have a voxel."""
    text = f"only {tally.classified / tally.points:.1%} of its points lie in or next to a voxel"
    within = tally.classified / max(1, tally.over)
    if within >= FEW_MET:
        return f"{text}: the cloud is larger than the map; of the points over the map {within:.1%} do"
    where = "has no georeference" if part.georeference is None else "may be shifted or turned"
    return (
        f"{text} ({within:.1%} of those over the map): the map {where}, or the cloud is of another"
        " area or height; run semstab-bench check to see the position of the project, or set a larger --radius"
    )


def _notes(voxels: ExportedVoxels, file: Path, settings: ExportSettings) -> Iterator[str]:
    kind = file.suffix.lower()
    if kind == ".tif":
        yield f"the classes, with their colours, are in {file.with_suffix(f'.class{file.suffix}').name}"
    if kind in (".las", ".laz") and (names := clouds.without_code(voxels, settings.asprs)):
        listed = ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
        yield f"without ASPRS code (--asprs): {listed}; their classification is 1, their number is in dimension 'class'"
