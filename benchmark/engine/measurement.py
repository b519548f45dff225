"""The end of a work: its map is measured, assessed by the statistics, and written."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import Config
from semstab.core.files import atomic_path
from semstab.core.process import Stopwatch, trim_malloc
from semstab.core.types import Float64
from semstab.data.features import OF_FEATURES
from semstab.data.frames import LeftOut
from semstab.data.image_measures import FrameQuality, PixelStatistics
from semstab.data.measures import dominant, mean, measures
from semstab.data.parquet import Tile
from semstab.data.records import EVENTS, FRAMES, OBSERVATIONS, OVERVIEW, SUMS, TRUTH, VOXELS, Record
from semstab.data.results import STAGES, ReducedScores, slug
from semstab.data.voxels import VoxelTable
from semstab.datasets import Scene
from semstab.engine.fused_map import SMALL, FusedMap, fused_map
from semstab.engine.live_maps import LiveMap, Stream
from semstab.engine.place_pictures import PICTURED as PICTURED_PLACES
from semstab.engine.place_pictures import pictures_of_places
from semstab.engine.series import Series
from semstab.engine.tiles import TILE_FEATURES, TILE_OBSERVATIONS, TileResult
from semstab.engine.unit_files import Files, Savers
from semstab.engine.units import Unit, unit_key
from semstab.engine.work import UnitTile, Work
from semstab.errors import DataError
from semstab.metrics.image_space import PICTURED, ImageSpaceMeter, LonePicture, lone_picture, picture_arrays
from semstab.metrics.summary import TableSums
from semstab.metrics.up_axis import estimate_up
from semstab.metrics.video_flicker import VideoFlickerMeter, video_picture
from semstab.statistics import Analysis, MapSample, SpotObservations, analyse
from semstab.statistics.agreement import alpha_of, ratio_of
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.frame_disagreement import LoneDisagreement, by_frame, outlying_frames
from semstab.statistics.places import worst_places
from semstab.statistics.verdict import Limits
from semstab.task import Task, read

OfFrames = dict[int, dict[str, float]]
"""How often each frame stands alone, by its index; see `semstab.statistics.frame_disagreement.by_frame`."""


def finish(live: LiveMap, stream: Stream, watch: Stopwatch) -> Work:
    """Measure what a work has fused, and write its files: a unit, a tile of one, or the pass over the frames of tiles.

    Raises:
        DataError: If no pixel of a unit was valid.
    """
    finished = _finished_unit if live.work.tile is None else _finished_tile
    live.drain()
    with live.threads(), contextlib.closing(Files(live.work.start)) as files:
        return finished(live, stream, files, watch)


def _finished_unit(live: LiveMap, stream: Stream, files: Files, watch: Stopwatch) -> Work:
    """Return the work of a unit with its record."""
    work, config = live.work, live.config
    fused = fused_map(live, watch) if work.fuses else None
    if fused is not None and not len(fused.table):
        raise no_voxels(live.task, config)
    observations, features = live.sampled_observations(), live.sampled_features()
    if work.unit.stored:
        files.write_ahead(observation_savers(live.task, observations))
    if not config.statistics:
        files.write_ahead(_map_savers(live, fused))
    up = live.sampling.submit(partial(_up_axis, live, stream, fused))
    places = live.sampling.submit(partial(_pictured_places, live, stream, fused, observations))
    with watch("statistics"):
        sample, analysis = _sample(live, fused), None
        if sample is not None:
            analysis = analyse_sample(live.task, config, sample, observations, features)
        trim_malloc(least=SMALL)
    result = _result(live, stream, fused, sample)
    with watch("measure"):
        record, of_frames = _record(live, stream, result, analysis, up.result())
    with watch("write"):
        files.write(_unit_savers(live, stream, analysis, of_frames, places.result()))
        if config.statistics:
            files.write(_map_savers(live, fused, analysis))
    table = fused.table if fused is not None and work.watched else None
    return replace(work, record=replace(record, files=files.digests), files=files.returned, table=table)


def _finished_tile(live: LiveMap, stream: Stream, files: Files, watch: Stopwatch) -> Work:
    """Return the work of a tile, or of the pass over the frames of tiles; its result is one of the files."""
    work, tile = live.work, live.work.tile
    assert tile is not None
    fused = fused_map(live, watch) if work.fuses else None
    observations, features = live.sampled_observations(), live.sampled_features()
    with watch("statistics"):
        sample = _sample(live, fused)
        trim_malloc(least=0)
    result = _result(live, stream, fused, sample)
    with watch("write"):
        files.write(_map_savers(live, fused) | _tile_savers(tile, stream, observations, features, sample))
        files.write({f"{tile.folder}/{tile.name}.npz": replace(result, files={**files.digests}).save})
    return replace(work, files=files.returned)


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
        sums = (TableSums.from_table(fused.table, strata) if sample is None else sample.summary).arrays()
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
    live: LiveMap, stream: Stream, result: TileResult, analysis: Analysis | None, up: UpAxis | None
) -> tuple[Record, OfFrames]:
    """Return the record of a unit, and how often each of its frames stands alone."""
    record = record_of(live.work.unit, live.task, live.rows, result, analysis, up)
    if stream.pixels is None:
        return record, OfFrames({} if analysis is None else analysis.of_frames())
    pixels, of_frames = pixel_statistics(live.task, stream.pixels)
    return replace(record, pixels=pixels), of_frames


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


def record_of(
    unit: Unit,
    task: Task,
    rows: Series,
    result: TileResult,
    analysis: Analysis | None,
    up: UpAxis | None,
) -> Record:
    """Return the record of a unit from its time series, its result, the statistics of its map and its up axis."""
    config, target = unit.config, task.mapping.target
    of_map = TableSums.read(result.sums).summary(
        config.voxel_size if unit.fuses else math.nan, target.classes, config.strata
    )
    of_features = target == OF_FEATURES
    cut, most = rows.column("scores_left_out"), rows.column("most_scores_left_out")
    record = Record(
        unit=unit.name,
        taxonomy=target.name,
        frames=len(task.indices),
        map_summary=of_map.without_classes() if of_features else of_map,
        flicker_percent=math.nan if of_features else mean(rows.column("flicker_percent")),
        fuse_ms_per_frame=mean(1e3 * rows.column("seconds")),
        key=unit_key(unit.identity, task.digest),
        variation=unit.variation,
        stages_ms={stage: mean(1e3 * rows.column(f"{stage}_seconds")) for stage in STAGES},
        left_out=int(rows.column("left_out").sum()),
        frames_left_out=task.left_out,
        frames_empty=int(np.count_nonzero(rows.column("points") == 0)),
        scores_left_out=None if np.isnan(cut).all() else LeftOut(mean(cut), float(np.nanmax(most))),
        statistics=None if analysis is None else analysis.summary,
        reduced=_reduced(result.reduced) if len(result.reduced) else None,
        input=task.digest,
        files=result.files,
        checked=result.checked,
    )
    if not unit.image_space:
        return record
    image_space = ImageSpaceMeter(result.image).result(record.flicker_percent)
    if of_features:
        image_space = image_space.without_classes()
    return replace(record, image_space=image_space, up=up, quality=result.quality, video_measures=result.video_measures)


def _reduced(sums: Float64) -> ReducedScores:
    return ReducedScores(float(ratio_of(sums[:2])), float(ratio_of(sums[2:4])), float(alpha_of(sums[4:])))


UpAxis = tuple[float, float, float]


def _up_axis(live: LiveMap, stream: Stream, fused: FusedMap | None) -> UpAxis | None:
    """Return the up axis of the scene, where the unit states it."""
    if not live.work.unit.image_space or not live.task.scene.posed:
        return None
    return up_axis(live.task.scene, np.zeros((0, 3)) if fused is None else fused.table, stream.poses)


def up_axis(scene: Scene, points: VoxelTable | Float64, poses: Float64) -> UpAxis | None:
    """Return the scene's up axis, given or estimated from its points (n, 3); None if the estimate fails."""
    try:
        x, y, z = (float(value) for value in (estimate_up(points, poses) if scene.up is None else scene.up))
    except DataError:
        return None
    return x, y, z


# --- Files ------------------------------------------------------------------------------------------------------------


Pictures = dict[str, npt.NDArray[Any]]


def _pictured_places(
    live: LiveMap, stream: Stream, fused: FusedMap | None, observations: SpotObservations | None
) -> Pictures:
    """Return pictures of the worst places of a map; of scans there are none."""
    task, pictured = live.task, live.work.unit.image_space and stream.overview
    if not pictured or fused is None or observations is None or task.scene.of_scans:
        return {}
    places = worst_places((fused.table,), observations, PICTURED_PLACES)
    return pictures_of_places(task, places, live.config.pixel_stride)


def _unit_savers(
    live: LiveMap, stream: Stream, analysis: Analysis | None, of_frames: OfFrames, places: Pictures
) -> Savers:
    """Return the files of a unit except those of its map."""
    task, unit, savers = live.task, live.work.unit, Savers()
    if unit.image_space and stream.overview:
        pictures = pictures_of_outlying(task, live.config, of_frames) | places
        savers[overview_file(task)] = partial(save_overview, stream.overview | pictures)
    return savers | unit_savers(task, live.rows, analysis, of_frames) if unit.stored else savers


def _tile_savers(
    tile: UnitTile,
    stream: Stream,
    observations: SpotObservations | None,
    features: FeatureObservations | None,
    sample: MapSample | None,
) -> Savers:
    """Return what the whole unit is made of: of a tile its sample, of the pass over the frames all others."""
    savers = Savers()
    if stream.overview:
        savers[overview_file(stream.task)] = partial(save_overview, stream.overview)
    if observations is not None:
        savers[f"{tile.folder}/{tile.size}_{TILE_OBSERVATIONS}"] = observations.save
    if features is not None:
        savers[f"{tile.folder}/{tile.size}_{TILE_FEATURES}"] = features.save
    if sample is not None and len(sample.table):
        savers[f"{tile.folder}/{tile.name}.sample"] = sample.below(tile.bound).save
    return savers


def _map_savers(live: LiveMap, fused: FusedMap | None, analysis: Analysis | None = None) -> Savers:
    """Return the files of a map: its voxels, with the columns of its statistics, log and truth; none without voxels.

    A tile's voxels to which statistics add columns wait in its folder until the whole map is there.
    """
    config, unit, tile, savers = live.config, live.work.unit, live.work.map_tile, Savers()
    if fused is None or not unit.stored or not len(fused.table):
        return savers
    columns = {} if analysis is None or not config.statistics else analysis.columns(fused.table, fused.truth)
    voxels = _map_file(live.work, VOXELS, waits=config.statistics and unit.assessed)
    savers[voxels] = partial(save_voxels, fused.table, columns=columns, tile=tile)
    if fused.events is not None and config.events:
        savers[_map_file(live.work, EVENTS, waits=False)] = partial(fused.events.save, tile=tile)
    if fused.truth is not None and (unit.image_space if tile is None else len(fused.truth)):
        savers[_map_file(live.work, TRUTH, waits=not unit.image_space)] = partial(fused.truth.save, tile=tile)
    return savers


def _map_file(work: Work, folder: str, *, waits: bool) -> str:
    """Return the path of a file of a map; a tile's file `waits` for the whole map in the tile's own folder."""
    tile, slug = work.map_tile, work.unit.name.slug
    if work.tile is None or tile is None:
        return f"{folder}/{slug}.parquet"
    return f"{work.tile.folder}/{folder}/{tile.name}" if waits else f"{folder}/{slug}/{tile.name}"


def observation_savers(task: Task, observations: SpotObservations | None) -> Savers:
    """Return the file of what views say of spots, on which statistics rest."""
    return {} if observations is None else {f"{OBSERVATIONS}/{task.units[0].slug}.parquet": observations.save}


def unit_savers(task: Task, rows: Series, analysis: Analysis | None, of_frames: OfFrames) -> Savers:
    """Return the files of a unit that do not depend on tiles: its time series, and sums of its statistics."""
    slug = task.units[0].slug
    series = partial(rows.save_csv, names=task.scene.frame_name, of_frames=of_frames, maps=task.scene.posed)
    savers: Savers = {f"{FRAMES}/{slug}.csv": series}
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


def save_voxels(
    table: VoxelTable, path: Path, columns: Mapping[str, npt.NDArray[Any]] | None = None, tile: Tile | None = None
) -> None:
    """Write a voxel table together with its measures, and further columns (n,) by name."""
    measure_columns = {measure.key: measure.of for measure in measures()}
    table.save(path, columns, {**measure_columns, "label": dominant}, tile)
