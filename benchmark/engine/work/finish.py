"""The end of a unit: its map is measured, judged by the statistics, and written."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend
from semstab.backends.numpy_reference import ONE_IN, NumpySample, in_sample
from semstab.config import Config
from semstab.core.files import atomic_path
from semstab.core.process import Stopwatch, give_back
from semstab.core.types import Float64, Int64
from semstab.datasets import Scene
from semstab.datasets.formats.disk import file_digest
from semstab.engine.evaluation import analyse_map
from semstab.engine.series import Series
from semstab.engine.tiling.portion import About, Finished, Portion
from semstab.engine.work.image_space import COLUMNS
from semstab.engine.work.jobs import Job, Outcome, shared_marker
from semstab.engine.work.stream import NoMap, Stream, UnitMap
from semstab.engine.work.up_axis import estimate_up
from semstab.errors import DataError
from semstab.metrics import compare, summarise
from semstab.metrics.agreement import rows_of
from semstab.metrics.summary import TableSums
from semstab.model.events import Events
from semstab.model.frames import LeftOut
from semstab.model.measures import dominant, mean, measures, vss
from semstab.model.parquet import Tile, names_in
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
from semstab.statistics import Analysis, Sample
from semstab.statistics.agreement import alpha_columns, alpha_of, ratio_of
from semstab.statistics.correctness import join_truth
from semstab.statistics.kinds import Kinds, spread
from semstab.statistics.map_sums import maps_of
from semstab.statistics.sums import first_look
from semstab.task import Task, read

WORST = 3
"""So many frames are named that moved the map most."""

SMALL = 1 << 30
"""A process with fewer bytes keeps what was freed for what is measured next."""

Savers = dict[str, Callable[[Path], None]]
"""What writes each file of a unit, by its path in the folder."""


def finish(job: Job, stream: Stream, one: UnitMap, watch: Stopwatch) -> Outcome:
    """Measure a finished map and write its files. Raises DataError where no pixel was valid."""
    task, config = one.task, one.request.config
    with watch("table"):
        table = _table(one.backend, task)
        _require_voxels(task, config, table)
        if not (config.statistics or config.events):
            one.backend = NoMap()  # what comes next has its memory
        give_back(least=SMALL)
    with watch("voxel sizes"):
        sizes = () if one.sizes is None else one.sizes.alphas()
        give_back(least=SMALL)
    with watch("statistics"):
        truth = None if one.truth is None else _table(one.truth, task)
        events = one.backend.events() if config.statistics else None
        found = analyse_map(task, config, table, events, truth, sample_of(one)) if one.request.judged else None
        give_back(least=SMALL)
    with watch("measure"):
        summary = _summary(one, table, found, sizes)
    with watch("write"):
        saved, returned = written(job, _savers(stream, one, table, truth, found))
    with watch("reference"):
        checked = None if one.reference is None else _checked(one, table, one.reference)
    content = UnitContent(task.digest, summary, files=saved, checked=checked)
    if one.request.image_space and stream.image_space is not None:
        image_space = stream.image_space.result(summary.flicker_percent)
        content = dataclasses.replace(content, image_space=image_space, up=_up(task.scene, table, stream.poses))
        content = dataclasses.replace(content, quality=_quality(stream))
    return Outcome(one.request.identity, content, files=returned, table=table if one.request.kept else None)


def _quality(stream: Stream) -> FrameQuality | None:
    """What the labels of single frames are worth, where that is asked for."""
    if stream.judge is None:
        return None
    made = stream.task.scene.filtering(stream.task.backbone)
    return stream.judge.result(made.model, made.filters, made.milliseconds)


def _table(backend: FusionBackend | NoMap, task: Task) -> VoxelTable:
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
    drawn = rows_of(table, in_sample(table.index.T))
    units = (unit, dataclasses.replace(unit, backend="numpy"))
    return dataclasses.replace(compare(drawn, found, units, tolerance=one.request.config.tolerance), one_in=ONE_IN)


def _summary(one: UnitMap, table: VoxelTable, found: Analysis | None, sizes: tuple[SizeAlpha, ...]) -> UnitSummary:
    return unit_summary(
        one.task,
        one.rows,
        summarise(table, one.request.config.strata) if found is None else found.table,
        None if found is None else found.summary,
        None if one.hard is None else reduced_of(reduced_sums(one.hard.table())),
        sizes,
    )


def unit_summary(
    task: Task,
    rows: Series,
    table: TableSummary,
    statistics: MapStatistics | None,
    reduced: ReducedScores | None,
    sizes: tuple[SizeAlpha, ...],
) -> UnitSummary:
    """What is reported of a unit, from its map, its time series and what the statistics say of the map."""
    return UnitSummary(
        unit=task.units[0],
        taxonomy=task.mapping.target.name,
        frames=len(task.indices),
        table=table,
        flicker_percent=mean(rows.column("flicker_percent")),
        fuse_ms_per_frame=mean(1e3 * rows.column("seconds")),
        stages_ms={stage: mean(1e3 * rows.column(f"{stage}_seconds")) for stage in STAGES},
        left_out=int(rows.column("left_out").sum()),
        frames_left_out=task.left_out,
        frames_empty=int(np.count_nonzero(rows.column("points") == 0)),
        scores_left_out=_scores_left_out(rows),
        statistics=statistics,
        reduced=reduced,
        worst_frames=tuple(_worst(rows)),
        sizes=sizes,
    )


def _scores_left_out(rows: Series) -> LeftOut | None:
    """Over all frames that were cut to their largest scores; None where none was."""
    left_out, most = rows.column("scores_left_out"), rows.column("most_scores_left_out")
    return None if np.isnan(left_out).all() else LeftOut(mean(left_out), float(np.nanmax(most)))


def reduced_sums(table: VoxelTable) -> Float64:
    """What `reduced_of` is a function of: sums over voxels."""
    values, recurrent = vss(table), table.op >= RECURRENT
    means = [values.sum(), len(values), values[recurrent].sum(), np.count_nonzero(recurrent)]
    alpha = sum((alpha_columns(table.rows(some)).sum(axis=0) for some in table.evidence.chunks()), np.zeros(()))
    return np.concatenate([means, np.atleast_1d(alpha)])


def reduced_of(sums: Float64) -> ReducedScores:
    """What soft scores come to as labels, from the sums of their map."""
    return ReducedScores(float(ratio_of(sums[:2])), float(ratio_of(sums[2:4])), float(alpha_of(sums[4:])))


def _worst(rows: Series) -> list[FrameDrift]:
    """The frames that moved the map most, of those that met as many known voxels as half of the frames do."""
    known, drift = rows.column("voxels") - rows.column("new_voxels"), rows.drift
    met = np.flatnonzero(known >= max(1, np.median(known) if len(known) else 0))
    worst = met[np.argsort(-drift[met], kind="stable")][:WORST]
    frames = rows.column("frame")
    return [FrameDrift(int(frames[k]), float(drift[k]), int(known[k])) for k in worst]


def finish_portion(job: Job, stream: Stream, one: UnitMap, watch: Stopwatch) -> Outcome:
    """Write what is left of a portion of a unit in tiles: of the map its voxels, tile by tile, and sums."""
    portion = one.request.portion
    assert portion is not None
    with watch("table"):
        table = _table(one.backend, one.task) if one.request.fuses else None
    with watch("statistics"):
        found = None if table is None else _looked_at(one, table, judged=portion.judged)
    with watch("reference"):
        checked = None if table is None or one.reference is None else _checked(one, table, one.reference)
    with watch("write"):
        saved, returned = written(job, _portion_savers(stream, one, portion, found))
        image = (
            np.zeros((0, len(COLUMNS))) if stream.image_space is None else stream.image_space.rows.table(stream.lead)
        )
        sizes, voxels = () if one.sizes is None else one.sizes.alphas(), 0 if table is None else len(table)
        finished = Finished(
            About(portion.kind, saved, voxels, checked, sizes, _quality(stream)),
            one.rows.numbers,
            {} if found is None else found.sums,
            np.zeros(0) if one.hard is None else reduced_sums(one.hard.table()),
            stream.poses,
            image,
        )
        _, left = written(job, {f"{portion.folder}/{portion.name}.npz": finished.save})
    return Outcome(one.request.identity, portion=portion.name, files=returned | left)


@dataclasses.dataclass(frozen=True, eq=False)
class _Part:
    """The voxels of a part, its sums, and what statistics know of each voxel; its log, and the truth, where wanted."""

    table: VoxelTable
    sums: Mapping[str, npt.NDArray[Any]]
    maps: Mapping[str, npt.NDArray[Any]] = dataclasses.field(default_factory=dict)
    events: Events | None = None
    truth: VoxelTable | None = None


def _looked_at(one: UnitMap, table: VoxelTable, *, judged: bool) -> _Part:
    config = one.request.config
    log = one.backend.events() if config.statistics or config.events else None
    events = None if log is None else dataclasses.replace(log, classes=table.classes)
    one.backend = NoMap()  # what comes next has its memory
    give_back()
    if not judged:
        return _Part(table, TableSums.of(table, config.strata).arrays(), events=events)
    if not config.statistics:
        return _Part(table, first_look(Kinds.found(table), edges=config.strata)[0].arrays(), events=events)
    truth = None if one.truth is None else _table(one.truth, one.task)
    kinds = Kinds.found(table, events, None if truth is None else join_truth(table, truth)).measured()
    sums, further, null = first_look(kinds, truth, edges=config.strata)
    maps = spread(further | maps_of(kinds.one.table, null), kinds.of)
    return _Part(table, sums.arrays(), maps, events, truth)


def _portion_savers(stream: Stream, one: UnitMap, portion: Portion, found: _Part | None) -> Savers:
    """Where the whole map has still to be waited for, voxels are written so that they are looked at again."""
    unit, config = one.task.units[0], one.request.config
    savers: Savers = {}
    if stream.overview:
        savers[f"{OVERVIEW}/{slug(unit.scene, unit.backbone)}.npz"] = partial(_save_arrays, stream.overview)
    for sampler, file in ((one.sampler, portion.looks_file), (one.truth_sampler, portion.true_looks_file)):
        if sampler is not None:
            savers[file] = sampler.looks(one.task.mapping.target.classes).save
    if found is None or portion.part is None:
        return savers
    again = portion.judged and (config.statistics or not portion.kept)
    voxels = f"{portion.folder}/voxels" if again else f"{VOXELS}/{unit.slug}"
    for tile, rows in tiles_of(found.table, portion.part.size, portion.key):
        if portion.kept or again:
            savers[f"{voxels}/{tile.name}"] = partial(_save_tile, found, rows, tile)
        if found.events is not None and config.events and portion.kept:
            savers[f"{EVENTS}/{unit.slug}/{tile.name}"] = partial(_save_events, found.events, rows, tile)
    if found.truth is not None:
        for tile, rows in tiles_of(found.truth, portion.part.size, portion.key):
            savers[f"{portion.folder}/truth/{tile.name}"] = partial(_save_truth, found.truth, rows, tile)
    return savers


def _save_tile(found: _Part, voxels: Int64, tile: Tile, path: Path) -> None:
    columns = {name: values[voxels] for name, values in found.maps.items()}
    save_voxels(found.table.rows(voxels), path, columns, tile)


def _save_truth(truth: VoxelTable, voxels: Int64, tile: Tile, path: Path) -> None:
    truth.rows(voxels).save(path, tile=tile)


def _save_events(events: Events, voxels: Int64, tile: Tile, path: Path) -> None:
    events.rows(voxels).save(path, tile)


def tiles_of(table: VoxelTable, size: int, key: str) -> Iterator[tuple[Tile, Int64]]:
    """The rows of a table by tile of that edge, of the map of that key."""
    shift = size.bit_length() - 1
    place = (table.ix >> shift).astype(np.int64) << 32
    place += table.iy >> shift
    order = np.argsort(place, kind="stable")
    first = np.flatnonzero(np.diff(place[order], prepend=-(2**63)))
    for rows in np.split(order, first[1:]):
        yield Tile(int(table.ix[rows[0]]) >> shift, int(table.iy[rows[0]]) >> shift, size, key), rows


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
    savers[f"{FRAMES}/{unit.slug}.csv"] = one.rows.save_csv
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


def further_columns(path: Path) -> list[str]:
    """The columns of a file that `save_voxels` wrote that neither belong to the table nor are computed from it."""
    own = {field.name for field in dataclasses.fields(VoxelTable)} | {measure.key for measure in measures()} | {"label"}
    return [name for name in names_in(path) if name not in own]


def _save_arrays(arrays: Mapping[str, Any], path: Path) -> None:
    named: dict[str, Any] = dict(arrays)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **named)


def _up(scene: Scene, table: VoxelTable, poses: Float64) -> tuple[float, float, float] | None:
    """The scene's up axis, said or estimated; None where neither works."""
    try:
        up = estimate_up(table, poses) if scene.up is None else scene.up
    except DataError:
        return None
    x, y, z = (float(value) for value in up)
    return x, y, z
