"""The end of a unit: its map is measured, judged by the statistics, and written."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend
from semstab.backends.numpy_reference import ONE_IN, NumpySample, in_sample
from semstab.config import Config
from semstab.datasets import Scene
from semstab.datasets.formats.disk import file_digest
from semstab.engine.evaluation import analyse_map
from semstab.engine.observer import Observers
from semstab.engine.series import FrameRow, to_csv
from semstab.engine.tiling.portion import PORTIONS, About, Finished, Portion, series_array
from semstab.engine.work.image_space import COLUMNS
from semstab.engine.work.jobs import Job, Outcome, shared_marker
from semstab.engine.work.stream import Stream, UnitMap
from semstab.engine.work.up_axis import estimate_up
from semstab.errors import DataError
from semstab.metrics import compare, macro_mean, summarise
from semstab.metrics.matching import rows_of
from semstab.metrics.summary import TableSums
from semstab.model.measures import dominant, measures, vss
from semstab.model.records import EVENTS, FRAMES, INFLUENCE, LOOKS, OVERVIEW, TRUTH, VOXELS, FrameQuality, UnitContent
from semstab.model.results import (
    RECURRENT,
    STAGES,
    Agreement,
    FrameDrift,
    ReducedScores,
    SizeAlpha,
    TableSummary,
    UnitSummary,
    slug,
)
from semstab.model.statistics import MapStatistics
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.parquet import Tile
from semstab.runtime.files import atomic_path, write_text
from semstab.runtime.stopwatch import Stopwatch
from semstab.statistics import Analysis, Sample
from semstab.statistics.agreement import alpha_columns, alpha_of, ratio_of
from semstab.statistics.map_sums import MapSums
from semstab.task import Task, read

WORST = 3
"""So many frames are named that moved the map most."""

Savers = dict[str, Callable[[Path], None]]
"""What writes each file of a unit, by its path in the folder."""


def finish(job: Job, stream: Stream, one: UnitMap, observers: Observers, watch: Stopwatch) -> Outcome:
    """Measure a finished map and write its files. Raises DataError where no pixel was valid."""
    task, config, unit = one.task, one.request.config, one.task.units[0]
    kept = one.request.kept
    with watch("measure"):
        table = _table(one.backend, task)
        _require_voxels(task, config, table)
    if kept:
        with watch("observe"):
            observers.tell(lambda observer: observer.unit_fused(unit, table))
    with watch("statistics"):
        truth = None if one.truth is None else _table(one.truth, task)
        events = one.backend.events() if config.statistics else None
        found = analyse_map(task, config, table, events, truth, sample_of(one)) if one.request.judged else None
    with watch("measure"):
        summary = _summary(one, table, found)
    with watch("write"):
        saved, returned = written(job, _savers(stream, one, table, truth, found))
    with watch("reference"):
        checked = None if one.reference is None else _checked(one, table, one.reference)
    content = UnitContent(task.digest, summary, files=saved, checked=checked)
    if one.request.image_space and stream.image_space is not None:
        image_space = stream.image_space.result(summary.flicker_percent)
        content = dataclasses.replace(content, image_space=image_space, up=_up(task.scene, table, stream.poses))
        content = dataclasses.replace(content, quality=_quality(stream))
    if kept:
        with watch("observe"):
            observers.tell(lambda observer: observer.unit_finished(unit, table, summary))
    return Outcome(one.request.identity, content, files=returned)


def _quality(stream: Stream) -> FrameQuality | None:
    """What the labels of single frames are worth, where that is asked for."""
    if stream.judge is None:
        return None
    made = stream.task.scene.filtering(stream.task.backbone)
    return stream.judge.result(made.model, made.filters, made.milliseconds)


def _table(backend: FusionBackend, task: Task) -> VoxelTable:
    return dataclasses.replace(backend.table(), classes=task.mapping.target.classes)


def sample_of(one: UnitMap) -> Sample | None:
    """What was sampled of a unit's frames; its limit is the ground truth's where that was fused as well."""
    if one.sampler is None:
        return None
    sample = one.sampler.sample()
    return sample if one.truth_sampler is None else sample.against(one.truth_sampler.sample())


def _require_voxels(task: Task, config: Config, table: VoxelTable) -> None:
    if not len(table):
        raise no_voxels(task, config)


def no_voxels(task: Task, config: Config) -> DataError:
    """What to raise where a map is empty: it says what is missing in the first frame."""
    frame = read(task, task.indices[0], config.pixel_stride)
    depth = np.mean(np.isfinite(frame.depth) & (frame.depth > 0))
    labelled = np.mean(frame.predicted != frame.ignore_id)
    return DataError(
        f"{task.scene.name}, {task.backbone}: no pixel of {len(task.indices)} frames is valid (first frame: depth in"
        f" {depth:.0%} of the pixels, a label in {labelled:.0%}); check depth_scale, the ignore id and the taxonomy"
    )


def _checked(one: UnitMap, table: VoxelTable, sample: NumpySample) -> Agreement:
    """How far the map agrees with the reference on the voxels of the sample."""
    unit, found = one.task.units[0], _table(sample, one.task)
    drawn = rows_of(table, in_sample(table.index.T.astype(np.int64)))
    units = (unit, dataclasses.replace(unit, backend="numpy"))
    return dataclasses.replace(compare(drawn, found, units, tolerance=one.request.config.tolerance), one_in=ONE_IN)


def _summary(one: UnitMap, table: VoxelTable, found: Analysis | None) -> UnitSummary:
    return unit_summary(
        one.task,
        one.rows,
        summarise(table, one.request.config.strata),
        None if found is None else found.summary,
        None if one.hard is None else reduced_of(reduced_sums(one.hard.table())),
        () if one.sizes is None else one.sizes.alphas(),
    )


def unit_summary(
    task: Task,
    rows: Sequence[FrameRow],
    table: TableSummary,
    statistics: MapStatistics | None,
    reduced: ReducedScores | None,
    sizes: tuple[SizeAlpha, ...],
) -> UnitSummary:
    """What is reported of a unit, from its map, its time series and what the statistics say of the map."""
    stages = [row.stage_ms() for row in rows]
    return UnitSummary(
        unit=task.units[0],
        taxonomy=task.mapping.target.name,
        frames=len(task.indices),
        table=table,
        flicker_percent=macro_mean([row.flicker_percent for row in rows]),
        fuse_ms_per_frame=macro_mean([row.report.seconds * 1e3 for row in rows]),
        stages_ms={stage: macro_mean([row[stage] for row in stages]) for stage in STAGES},
        left_out=sum(row.left_out for row in rows),
        frames_left_out=task.left_out,
        frames_empty=sum(row.report.points == 0 for row in rows),
        statistics=statistics,
        reduced=reduced,
        worst_frames=tuple(_worst(rows)),
        sizes=sizes,
    )


def reduced_sums(table: VoxelTable) -> npt.NDArray[np.float64]:
    """What `reduced_of` is a function of: sums over voxels."""
    values, recurrent = vss(table), table.op >= RECURRENT
    means = [values.sum(), len(values), values[recurrent].sum(), np.count_nonzero(recurrent)]
    alpha = sum((alpha_columns(table.rows(some)).sum(axis=0) for some in table.evidence.chunks()), np.zeros(()))
    return np.concatenate([means, np.atleast_1d(alpha)])


def reduced_of(sums: npt.NDArray[np.float64]) -> ReducedScores:
    """What soft scores come to as labels, from the sums of their map."""
    return ReducedScores(float(ratio_of(sums[:2])), float(ratio_of(sums[2:4])), float(alpha_of(sums[4:])))


def _worst(rows: Sequence[FrameRow]) -> list[FrameDrift]:
    """The frames that moved the map most, of those that met as many known voxels as half of the frames do."""
    found = [FrameDrift(r.frame, r.drift, r.voxels - r.new_voxels) for r in (row.report for row in rows)]
    usual = np.median([frame.voxels for frame in found]) if found else 0
    met = [frame for frame in found if frame.voxels >= max(1, usual)]
    return sorted(met, key=lambda frame: -frame.drift)[:WORST]


def finish_portion(job: Job, stream: Stream, one: UnitMap, watch: Stopwatch) -> Outcome:
    """Write what is left of a portion of a unit in tiles: of the map its voxels, tile by tile, and sums."""
    portion = one.request.portion
    assert portion is not None
    with watch("measure"):
        table = _table(one.backend, one.task) if one.request.fuses else None
        sums = {} if table is None else _sums_of(table, one.request.config.strata, judged=portion.judged)
    with watch("reference"):
        checked = None if table is None or one.reference is None else _checked(one, table, one.reference)
    with watch("write"):
        saved, returned = written(job, _portion_savers(stream, one, portion, table))
        rows = [] if stream.image_space is None else stream.image_space.rows[stream.lead :]
        finished = Finished(
            About(portion.kind, saved, checked, () if one.sizes is None else one.sizes.alphas(), _quality(stream)),
            series_array(one.rows),
            sums,
            np.zeros(0) if one.hard is None else reduced_sums(one.hard.table()),
            np.zeros((0, 4, 4)) if one.request.fuses else np.array(stream.poses),
            np.array(rows).reshape(-1, len(COLUMNS)),
        )
        _, left = written(job, {f"{PORTIONS}/{portion.key}/{portion.name}.npz": finished.save})
    return Outcome(one.request.identity, portion=portion.name, files=returned | left)


def _sums_of(table: VoxelTable, edges: Sequence[int], *, judged: bool) -> dict[str, npt.NDArray[Any]]:
    if not judged:
        return TableSums.of(table, edges).arrays()
    return MapSums.of(table, edges).arrays()


def _portion_savers(stream: Stream, one: UnitMap, portion: Portion, table: VoxelTable | None) -> Savers:
    unit = one.task.units[0]
    savers: Savers = {}
    if stream.overview:
        savers[f"{OVERVIEW}/{slug(unit.scene, unit.backbone)}.npz"] = partial(_save_arrays, stream.overview)
    if one.sampler is not None:
        savers[portion.looks_file] = one.sampler.looks(one.task.mapping.target.classes).save
    if table is not None and portion.part is not None and portion.kept:
        for tile, rows in tiles_of(table, portion.part.size, portion.key):
            savers[f"{VOXELS}/{unit.slug}/{tile.name}"] = partial(save_voxels, rows, tile=tile)
    return savers


def tiles_of(table: VoxelTable, size: int, key: str) -> Iterator[tuple[Tile, VoxelTable]]:
    """The voxels of a table by tile of that edge, of the map of that key."""
    shift = size.bit_length() - 1
    place = np.stack([table.ix >> shift, table.iy >> shift], axis=1)
    tiles, of = np.unique(place, axis=0, return_inverse=True)
    order = np.argsort(of.ravel(), kind="stable")
    bounds = np.concatenate([[0], np.cumsum(np.bincount(of.ravel(), minlength=len(tiles)))])
    for (x, y), first, last in zip(tiles.tolist(), bounds, bounds[1:], strict=False):
        yield Tile(x, y, size, key), table.rows(order[first:last])


def _savers(
    stream: Stream, one: UnitMap, table: VoxelTable, truth: VoxelTable | None, found: Analysis | None
) -> Savers:
    """What is to be written of a unit beside its summary."""
    config, unit = one.request.config, one.task.units[0]
    savers: Savers = {}
    if one.request.image_space:
        savers[f"{OVERVIEW}/{slug(unit.scene, unit.backbone)}.npz"] = partial(_save_arrays, stream.overview)
    if not one.request.kept:
        return savers
    savers[f"{VOXELS}/{unit.slug}.parquet"] = partial(
        save_voxels, table, columns=found.maps if config.statistics and found is not None else {}
    )
    if found is not None:
        savers[f"{INFLUENCE}/{unit.slug}.parquet"] = found.sums.save
    savers[f"{FRAMES}/{unit.slug}.csv"] = partial(_save_text, to_csv(one.rows))
    if one.sampler is not None:
        savers[f"{LOOKS}/{unit.slug}.parquet"] = one.sampler.looks(table.classes).save
    events = one.backend.events() if config.events else None
    if events is not None:
        savers[f"{EVENTS}/{unit.slug}.parquet"] = dataclasses.replace(events, classes=table.classes).save
    if truth is not None and one.request.image_space:
        savers[f"{TRUTH}/{unit.slug}.parquet"] = truth.save
    return savers


def written(job: Job, savers: Savers) -> tuple[dict[str, str], dict[str, bytes]]:
    """Write files into the folder where it is shared; their digests, and their bytes where it is not."""
    digests, returned = {}, {}
    shared = shared_marker(job.folder, job.start).exists()
    with tempfile.TemporaryDirectory() as elsewhere:
        for name, save in savers.items():
            path = (job.folder if shared else Path(elsewhere)) / name
            save(path)
            digests[name] = file_digest(path).hex()
            if not shared:
                returned[name] = path.read_bytes()
    return digests, returned


def save_voxels(
    table: VoxelTable,
    path: Path,
    columns: Mapping[str, npt.NDArray[Any]] | None = None,
    tile: Tile | None = None,
) -> None:
    """Write a voxel table together with its measures, and further columns (n,) by name."""
    own = {measure.key: measure.of for measure in measures()}
    table.save(path, columns, {**own, "label": dominant}, tile)


def _save_text(text: str, path: Path) -> None:
    write_text(path, text)


def _save_arrays(arrays: Mapping[str, Any], path: Path) -> None:
    named: dict[str, Any] = dict(arrays)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **named)


def _up(scene: Scene, table: VoxelTable, poses: Sequence[Any]) -> tuple[float, float, float] | None:
    """The scene's up axis, said or estimated; None where neither works."""
    try:
        up = estimate_up(table, poses) if scene.up is None else scene.up
    except (DataError, ImportError, OSError):
        return None
    x, y, z = (float(value) for value in up)
    return x, y, z
