"""The end of a work: its map is measured, assessed by the statistics, and written."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.backends.numpy_reference import NumpySample, in_sample
from semstab.config import Config
from semstab.core.background import Background
from semstab.core.files import ScratchFolder, atomic_path, file_digest
from semstab.core.process import Stopwatch, trim_malloc
from semstab.core.types import Float64
from semstab.data.events import Events
from semstab.data.evidence import stretches
from semstab.data.features import OF_FEATURES
from semstab.data.frames import LeftOut
from semstab.data.measures import RECURRENT, dominant, mean, measures, vss
from semstab.data.parquet import Tile
from semstab.data.records import (
    EVENTS,
    FRAMES,
    OBSERVATIONS,
    OVERVIEW,
    SUMS,
    TRUTH,
    VOXELS,
    FrameQuality,
    PixelStatistics,
    Record,
)
from semstab.data.results import STAGES, Agreement, ReducedScores, UnitName, UnitSummary, slug
from semstab.data.voxels import VoxelTable
from semstab.datasets import Scene
from semstab.engine.live_maps import LiveMap, Stream
from semstab.engine.place_pictures import PICTURED as PICTURED_PLACES
from semstab.engine.place_pictures import pictures_of_places
from semstab.engine.series import Series
from semstab.engine.tiles import TILE_FEATURES, TILE_OBSERVATIONS, TileResult
from semstab.engine.units import Unit, unit_key
from semstab.engine.work import Start, Work
from semstab.errors import DataError
from semstab.metrics import compare
from semstab.metrics.agreement import rows_of
from semstab.metrics.image_space import PICTURED, ImageSpaceMeter, LonePicture, lone_picture, picture_arrays
from semstab.metrics.summary import TableSums
from semstab.metrics.up_axis import estimate_up
from semstab.metrics.video_flicker import VideoFlickerMeter, video_picture
from semstab.statistics import Analysis, MapSample, SpotObservations, analyse
from semstab.statistics.agreement import alpha_of, alpha_sums, ratio_of
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.frame_disagreement import LoneDisagreement, by_frame, outlying_frames
from semstab.statistics.places import worst_places
from semstab.statistics.verdict import Limits
from semstab.task import Task, read

SMALL = 1 << 30
"""A process with fewer bytes keeps freed memory for the next table, but between tiles: there memory is short."""

OfFrames = dict[int, dict[str, float]]
"""How often each frame stands alone, by its index; see `semstab.statistics.frame_disagreement.by_frame`."""

Savers = dict[str, Callable[[Path], None]]
"""A function that writes each file of a unit, by the file's path in the folder."""


def finish(live: LiveMap, stream: Stream, watch: Stopwatch) -> Work:
    """Measure a map, a tile of one or the pass over the frames of tiles, and write its files.

    Raises:
        DataError: If no pixel of a whole map was valid.
    """
    work, config, tile, files = live.work, live.config, live.work.tile, Files(live.work.start)
    live.drain()
    fused = _fused_map(live, watch) if work.fuses else None
    observations, features = live.sampled_observations(), live.sampled_features()
    with contextlib.closing(Background("semstab-files", 1)) as writer, live.threads():
        if fused is not None and tile is None and not len(fused.table):
            raise no_voxels(live.task, config)
        if fused is not None and not config.statistics:  # else columns of the statistics go along
            writer.submit(partial(files.write, _map_savers(live, fused, None)))
        with watch("statistics"):
            sample = _sample(live, fused)
            analysis = None
            if sample is not None and tile is None:
                analysis = analyse_sample(live.task, config, sample, observations, features)
            trim_malloc(least=SMALL if tile is None else 0)
        result = _result(live, stream, fused, sample)
        record, of_frames = None, OfFrames()
        if tile is None:
            with watch("measure"):
                record, of_frames = _record(live, stream, fused, result, analysis)
        with watch("write"):
            writer.drain()
            files.write(_savers(live, stream, fused, observations, features, sample, analysis, of_frames))
            if fused is not None and config.statistics:
                files.write(_map_savers(live, fused, analysis))
            if tile is not None:
                files.write({f"{tile.folder}/{tile.name}.npz": replace(result, files={**files.digests}).save})
    if record is None:
        return replace(work, files=files.returned)
    table = fused.table if fused is not None and work.watched else None
    return replace(work, record=replace(record, files=files.digests), files=files.returned, table=table)


def _sample(live: LiveMap, fused: FusedMap | None) -> MapSample | None:
    """Return the sample of a map that its statistics are of; None without a map or statistics."""
    if fused is None or not live.work.unit.assessed:
        return None
    log = fused.events if live.config.statistics else None
    return MapSample.draw(fused.table, log, fused.truth, edges=live.config.strata)


def _result(live: LiveMap, stream: Stream, fused: FusedMap | None, sample: MapSample | None) -> TileResult:
    """Return what a map, a tile or a pass over frames adds up to."""
    sums, strata = dict[str, Float64](), live.config.strata
    if not live.work.unit.fuses:
        sums = TableSums.nothing(len(live.task.mapping.target), strata).arrays()
    elif fused is not None:
        sums = (TableSums.of(fused.table, strata) if sample is None else sample.summary).arrays()
    return TileResult(
        {},
        None if fused is None or fused.checked is None else fused.checked.result(),
        _quality(stream),
        live.origin,
        None if stream.video is None else stream.video.result(),
        series=live.rows.numbers,
        sums=sums,
        reduced=np.zeros(0) if fused is None else fused.reduced,
        image=np.zeros((0, 0)) if stream.image_space is None else stream.image_space.rows.table(),
        poses=stream.poses,
        seen=np.concatenate([np.zeros((0, 3), np.int32), *live.tiles]),
    )


def _record(
    live: LiveMap, stream: Stream, fused: FusedMap | None, result: TileResult, analysis: Analysis | None
) -> tuple[Record, OfFrames]:
    """Return the record of a unit, and how often each of its frames stands alone."""
    unit = live.work.unit
    record = record_of(unit, live.task, live.rows, result, analysis)
    of_frames = OfFrames({} if analysis is None else analysis.of_frames())
    if unit.image_space:
        points = np.zeros((0, 3)) if fused is None else fused.table
        record = in_image_space(record, live.task, result, points)
    if stream.pixels is not None:
        pixels, of_frames = pixel_statistics(live.task, stream.pixels)
        record = replace(record, pixels=pixels)
    return record, of_frames


class FusedMap(NamedTuple):
    """A map at its end, without the locations whose fused class is left out; reduced: `reduced_sums`, or empty.

    It is checked against the reference in parallel with the statistics.
    """

    table: VoxelTable
    events: Events | None
    truth: VoxelTable | None
    reduced: Float64
    checked: Future[Agreement] | None


def _fused_map(live: LiveMap, watch: Stopwatch) -> FusedMap:
    """Return the tables of a map, whose backend is let go: the statistics have its memory."""
    assert live.backend is not None
    config, classes = live.config, live.task.mapping.target.classes
    with watch("table"):
        table = replace(live.backend.table(), classes=classes)
        _check_evidence(table, live.name)
        events = live.backend.events() if config.statistics or config.events else None
        truth = None if live.truth is None else replace(live.truth.table(), classes=classes)
        reduced = np.zeros(0) if live.hard is None else reduced_sums(_left(live, live.hard.table())[0])
        live.backend = live.truth = live.hard = None
    checked = None
    if live.reference is not None:
        checked = live.background.submit(partial(_checked, live, table, live.reference, watch))
    trim_malloc(least=SMALL if live.work.tile is None else 0)
    events = None if events is None else replace(events, classes=classes)
    return FusedMap(*_left(live, table, events), truth, reduced, checked)


OF_OP = 1e-6
"""Largest difference of a voxel's summed evidence from its OP or weight, divided by that."""


def _check_evidence(table: VoxelTable, name: UnitName) -> None:
    """Raise DataError where a backend's evidence of a voxel does not sum to its OP, or to the weight that it states."""
    stated, what = (table.op, "OP") if table.weight is None else (table.weight, "weight")
    starts, _, weight = table.evidence.entries
    for rows in stretches(len(table)):
        first, op = starts[rows], stated[rows]
        total, filled = np.zeros(len(op)), starts[rows.start + 1 : rows.stop + 1] > first
        total[filled] = np.add.reduceat(weight[: starts[rows.stop]], first[filled]) if filled.any() else 0.0
        wrong = np.flatnonzero(~((np.abs(total - op) <= OF_OP * op) & (op > 0)))
        if len(wrong):
            row = rows.start + wrong[0]
            voxel = ", ".join(str(axis[row]) for axis in (table.ix, table.iy, table.iz))
            raise DataError(
                f"{name.scene}, {name.model}: backend '{name.backend}': the evidence of voxel ({voxel}) sums to"
                f" {total[wrong[0]]:g}, and its {what} is {op[wrong[0]]:g}; add one distribution over the classes for"
                " each frame that sees a voxel, or state in the column `weight` what a row sums to"
                " (semstab.testing.BackendConformance finds the mistake)"
            )


def _left(live: LiveMap, table: VoxelTable, events: Events | None = None) -> tuple[VoxelTable, Events | None]:
    """Return the map and its log without the locations whose fused class is left out."""
    if not live.left_out:
        return table, events
    keep = np.flatnonzero(~np.isin(dominant(table), live.left_out))
    return table.rows(keep), None if events is None else events.rows(keep)


CAST = "what moved cannot be told: depth is cast at a surface, which has no movers in it"
"""Why spots that moved are not found."""


def analyse_sample(
    task: Task,
    config: Config,
    sample: MapSample,
    observations: SpotObservations | None,
    features: FeatureObservations | None = None,
) -> Analysis:
    """Return the statistics of a map; its true labels are right, and bound how far geometry lets labels agree."""
    why = CAST if config.moving == "tell" and task.scene.surface is not None else ""
    return analyse(
        sample, observations, features=features, name=task.model, edges=config.strata, critical=config.critical_classes,
        scope=config.scope, limits=Limits(**config.verdict.model_dump()), frame_name=task.scene.frame_name,
        moving_untold=why,
    )  # fmt: skip


def pixel_statistics(task: Task, meter: VideoFlickerMeter) -> tuple[PixelStatistics, OfFrames]:
    """Return the statistics of a video's pixels, and how often each frame stands alone.

    Raises:
        DataError: If no pixel has a label.
    """
    classes, total = task.mapping.target.classes, meter.pixels.sum()
    if not total:
        raise DataError(
            f"{task.scene.name}, {task.model}: no pixel of {len(task.indices)} frames has a label; check the ignore id"
            " and the taxonomy"
        )
    share, largest = meter.pixels / total, int(meter.pixels.argmax())
    rows = [row for row in meter.lone if row.pixels]
    lone_shares = np.array([row.share for row in rows], np.float64)
    frames, places = (np.array([*column], np.int64) for column in ((o.frame for o in rows), (o.pixels for o in rows)))
    disagreement = LoneDisagreement(frames, places, lone_shares, np.full(len(lone_shares), mean(lone_shares)))
    outlying = outlying_frames(disagreement, len(rows), name=task.scene.frame_name)
    statistics = PixelStatistics(
        meter.size, tuple(classes), outlying, classes[largest], float(share[largest]), float(1 / (share**2).sum())
    )
    return statistics, by_frame(disagreement, outlying)


def _quality(stream: Stream) -> FrameQuality | None:
    if stream.quality is None:
        return None
    made = stream.task.scene.filtering(stream.task.model)
    return stream.quality.result(made.model, made.filters, made.milliseconds)


def no_voxels(task: Task, config: Config) -> DataError:
    """Return the error of an empty map: it says what is missing in the first frame."""
    frame = read(task, task.indices[0], config.pixel_stride)
    depth = np.mean(np.isfinite(frame.depth) & (frame.depth > 0))
    labelled = np.mean(frame.predicted != frame.ignore_id)
    return DataError(
        f"{task.scene.name}, {task.model}: no pixel of {len(task.indices)} frames is valid (first frame: depth in"
        f" {depth:.0%} of the pixels, a label in {labelled:.0%}); check depth_scale, the ignore id and the taxonomy"
    )


def _checked(live: LiveMap, table: VoxelTable, reference: NumpySample, watch: Stopwatch) -> Agreement:
    with watch("reference"):
        expected, one_in = replace(reference.table(), classes=table.classes), reference.one_in
        some_in = [in_sample(np.stack([table.ix[s], table.iy[s], table.iz[s]]), one_in) for s in stretches(len(table))]
        sampled_table = rows_of(table, np.concatenate(some_in))
        units = (live.name, replace(live.name, backend="numpy"))
        return replace(compare(sampled_table, expected, units, tolerance=live.config.tolerance), one_in=one_in)


def record_of(unit: Unit, task: Task, rows: Series, result: TileResult, analysis: Analysis | None) -> Record:
    """Return the record of a unit from its time series, its result and the statistics of its map."""
    config = unit.config
    sums = TableSums.read(result.sums)
    table = sums.summary(config.voxel_size if unit.fuses else math.nan, task.mapping.target.classes, config.strata)
    of_features = task.mapping.target == OF_FEATURES
    cut, most = rows.column("scores_left_out"), rows.column("most_scores_left_out")
    summary = UnitSummary(
        unit=unit.name,
        taxonomy=task.mapping.target.name,
        frames=len(task.indices),
        table=table.without_classes() if of_features else table,
        flicker_percent=math.nan if of_features else mean(rows.column("flicker_percent")),
        fuse_ms_per_frame=mean(1e3 * rows.column("seconds")),
        stages_ms={stage: mean(1e3 * rows.column(f"{stage}_seconds")) for stage in STAGES},
        left_out=int(rows.column("left_out").sum()),
        frames_left_out=task.left_out,
        frames_empty=int(np.count_nonzero(rows.column("points") == 0)),
        scores_left_out=None if np.isnan(cut).all() else LeftOut(mean(cut), float(np.nanmax(most))),
        statistics=None if analysis is None else analysis.summary,
        reduced=_reduced(result.reduced) if len(result.reduced) else None,
    )
    return Record(
        unit_key(unit.identity, task.digest),
        unit.variation,
        summary,
        input=task.digest,
        files=result.files,
        checked=result.checked,
    )


def in_image_space(record: Record, task: Task, result: TileResult, points: VoxelTable | Float64) -> Record:
    """Return the record with what is measured in image coordinates, and the scene's up axis."""
    image_space = ImageSpaceMeter(result.image).result(record.summary.flicker_percent)
    if task.mapping.target == OF_FEATURES:
        image_space = image_space.without_classes()
    up = up_axis(task.scene, points, result.poses) if task.scene.posed else None
    return replace(record, image_space=image_space, up=up, quality=result.quality, video_measures=result.video_measures)


def reduced_sums(table: VoxelTable) -> Float64:
    """Return the sums over voxels of a map of labels that soft scores were reduced to."""
    values, recurrent = vss(table), table.op >= RECURRENT
    means = [values.sum(), len(values), values[recurrent].sum(), np.count_nonzero(recurrent)]
    return np.concatenate([means, alpha_sums(table)])


def _reduced(sums: Float64) -> ReducedScores:
    return ReducedScores(float(ratio_of(sums[:2])), float(ratio_of(sums[2:4])), float(alpha_of(sums[4:])))


def up_axis(scene: Scene, points: VoxelTable | Float64, poses: Float64) -> tuple[float, float, float] | None:
    """Return the scene's up axis, given or estimated, or None if the estimate fails."""
    try:
        x, y, z = (float(value) for value in (estimate_up(points, poses) if scene.up is None else scene.up))
    except DataError:
        return None
    return x, y, z


# --- Files ------------------------------------------------------------------------------------------------------------


def _savers(
    live: LiveMap,
    stream: Stream,
    fused: FusedMap | None,
    observations: SpotObservations | None,
    features: FeatureObservations | None,
    sample: MapSample | None,
    analysis: Analysis | None,
    of_frames: OfFrames,
) -> Savers:
    """Return the files of a unit, of a tile, or of the pass over the frames of tiles, but for those of its map."""
    work, config, tile, savers = live.work, live.config, live.work.tile, Savers()
    unit = work.unit
    if unit.image_space and stream.overview:
        pictures = pictures_of_outlying(live.task, config, of_frames)
        if fused is not None and tile is None and observations is not None and not live.task.scene.of_scans:
            places = worst_places((fused.table,), observations, PICTURED_PLACES)
            pictures |= pictures_of_places(live.task, places, config.pixel_stride)
        savers[overview_file(live.task)] = partial(save_overview, stream.overview | pictures)
    if tile is not None and observations is not None:
        savers[f"{tile.folder}/{tile.size}_{TILE_OBSERVATIONS}"] = observations.save
    if tile is not None and features is not None:
        savers[f"{tile.folder}/{tile.size}_{TILE_FEATURES}"] = features.save
    if tile is None and unit.stored:
        savers |= unit_savers(live.task, live.rows, observations, analysis, of_frames)
    if fused is not None and len(fused.table) and tile is not None and sample is not None:
        savers[f"{tile.folder}/{tile.name}.sample"] = sample.below(tile.bound).save
    return savers


def _map_savers(live: LiveMap, fused: FusedMap, analysis: Analysis | None) -> Savers:
    """Return the files of a map: its voxels, with the columns of the statistics where they are wanted, log and truth.

    A tile's voxels to which statistics add columns wait in its folder until the whole map is there.
    """
    config, tile, unit, of_unit, savers = live.config, live.work.tile, live.work.unit, live.name.slug, Savers()
    if not unit.stored or not len(fused.table):
        return savers
    map_tile = None if tile is None or tile.index is None else Tile(*tile.index, tile.size, tile.key)

    def path(folder: str, *, waits: bool) -> str:
        if tile is None or map_tile is None:
            return f"{folder}/{of_unit}.parquet"
        return f"{tile.folder}/{folder}/{map_tile.name}" if waits else f"{folder}/{of_unit}/{map_tile.name}"

    columns = analysis.columns(fused.table, fused.truth) if config.statistics and analysis is not None else {}
    voxels = path(VOXELS, waits=config.statistics and unit.assessed)
    savers[voxels] = partial(save_voxels, fused.table, columns=columns, tile=map_tile)
    if fused.events is not None and config.events:
        savers[path(EVENTS, waits=False)] = partial(fused.events.save, tile=map_tile)
    if fused.truth is not None and (unit.image_space if map_tile is None else len(fused.truth)):
        savers[path(TRUTH, waits=not unit.image_space)] = partial(fused.truth.save, tile=map_tile)
    return savers


def unit_savers(
    task: Task, rows: Series, observations: SpotObservations | None, analysis: Analysis | None, of_frames: OfFrames
) -> Savers:
    """Return the files of a unit that do not depend on tiles: its time series, and what statistics rest on."""
    slug = task.units[0].slug
    series = partial(rows.save_csv, names=task.scene.frame_name, of_frames=of_frames, maps=task.scene.posed)
    savers: Savers = {f"{FRAMES}/{slug}.csv": series}
    if observations is not None:
        savers[f"{OBSERVATIONS}/{slug}.parquet"] = observations.save
    if analysis is not None:
        savers[f"{SUMS}/{slug}.parquet"] = analysis.sums.save
    return savers


def overview_file(task: Task) -> str:
    """Return the path of the pictures of a model on a scene, in the folder of the run."""
    return f"{OVERVIEW}/{slug(task.scene.name, task.model)}.npz"


def save_overview(arrays: Mapping[str, Any], path: Path) -> None:
    """Save a frame of the sequence, and pictures of those that stand out."""
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def pictures_of_outlying(task: Task, config: Config, of_frames: OfFrames) -> dict[str, npt.NDArray[Any]]:
    """Return pictures of the first frames that stand out, which are read again, as arrays by name; none of scans.

    A frame is held against those of the run before and after it, the first and the last one against the two nearest.
    """
    excess = {k: row["lone_percent"] - row["lone_null_percent"] for k, row in of_frames.items() if row.get("outlying")}
    outlying = sorted(excess, key=lambda frame: -excess[frame])
    pictures, posed = list[LonePicture](), task.scene.posed
    for frame in () if task.scene.of_scans else outlying[:PICTURED]:
        position = task.indices.index(frame)
        start = min(max(position - 1, 0), len(task.indices) - 3)
        neighbours = [task.indices[k] for k in range(start, start + 3) if k != position]
        neighbour_frames = [read(task, index, config.pixel_stride, color=not posed) for index in neighbours]
        hold = lone_picture if posed else video_picture
        pictures.append(hold(read(task, frame, config.pixel_stride, color=True), neighbour_frames))
    return picture_arrays(pictures)


class Files:
    """The files of a work.

    Attributes:
        digests: Their digests by their path in the folder.
        returned: Their bytes, where the folder is not shared.
    """

    def __init__(self, start: Start) -> None:
        self._start, self.digests, self.returned = start, dict[str, str](), dict[str, bytes]()

    def write(self, savers: Savers) -> None:
        """Write some of them."""
        digests, returned = written(self._start, savers)
        self.digests |= digests
        self.returned |= returned


def written(start: Start, savers: Savers) -> tuple[dict[str, str], dict[str, bytes]]:
    """Write files into a shared folder, and return their digests; without a shared folder, also return their bytes."""
    if start.marker.exists():
        for name, save in savers.items():
            save(start.folder / name)
        return {name: file_digest(start.folder / name).hex() for name in savers}, {}
    digests, returned = {}, {}
    with ScratchFolder() as elsewhere:
        for name, save in savers.items():
            path = elsewhere / name
            save(path)
            digests[name], returned[name] = file_digest(path).hex(), path.read_bytes()
    return digests, returned


def save_voxels(
    table: VoxelTable, path: Path, columns: Mapping[str, npt.NDArray[Any]] | None = None, tile: Tile | None = None
) -> None:
    """Write a voxel table together with its measures, and further columns (n,) by name."""
    measure_columns = {measure.key: measure.of for measure in measures()}
    table.save(path, columns, {**measure_columns, "label": dominant}, tile)
