"""A unit in tiles: what is still to be computed of it, and how its tiles make the unit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.data.parquet import tile_of
from semstab.data.records import TRUTH, VOXELS, Record
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import VoxelTable
from semstab.engine.folder import Folder
from semstab.engine.measurement import (
    analyse_sample,
    no_voxels,
    observation_savers,
    overview_file,
    pictures_of_outlying,
    record_of,
    save_overview,
    save_voxels,
    unit_savers,
    up_axis,
)
from semstab.engine.series import Series
from semstab.engine.tiles import TILE_FEATURES, TILE_OBSERVATIONS, TileResult, joined_series
from semstab.engine.unit_files import Savers, written
from semstab.engine.units import Unit
from semstab.engine.work import Job, Start, UnitTile, Work
from semstab.errors import SemstabError
from semstab.metrics.summary import TableSums
from semstab.statistics import Analysis, MapSample, SpotObservations
from semstab.statistics.feature_spots import FeatureObservations
from semstab.statistics.sample import MOST_VOXELS

GUESS = 4
"""Tiles that a unit is expected to have, for the progress, until they are known."""

UP_VOXELS = 1 << 20
"""The up axis of more voxels is estimated from every n-th."""


class TiledUnit:
    """A unit while its tiles are computed: first a pass over its frames, which gives the frames of each tile.

    The results of an earlier start are taken over where they are as they were.
    """

    def __init__(self, unit: Unit, size: int, folder: Folder, start: Start) -> None:
        self._folder, self._work = folder, Work.from_unit(unit, start)
        self._frames = UnitTile(unit.key, size)
        self._results: dict[UnitTile, TileResult] = {}
        self._samples: list[MapSample] = []
        self._bound: int | None = None
        self._tiles: dict[UnitTile, list[int]] | None = None  # the frames that meet each
        self._waiting = [self._work.in_tile(self._frames)]
        self._advanced, self._failed = 0, False
        if self._take_over(self._frames):
            self._begin_tiles()

    @property
    def name(self) -> str:
        """Its name in the progress."""
        return self._work.unit.name.stated

    def next_job(self) -> Job | None:
        """Return the next tile, or None without one, or before the pass over the frames has ended."""
        if self._failed or not self._waiting:
            return None
        return (self._waiting.pop(0).bounded(self._bound),)

    def take(self, work: Work) -> Work | None:
        """Take a tile that a worker gave back; return the unit if it is complete."""
        if self._failed:
            return None
        if work.error is not None or work.tile is None:
            self._failed = True
            return work
        self._folder.save_files(work)
        if not self._take_over(work.tile):
            self._failed = True
            return self._work.failed(f"{self.name}: tile {work.tile.name} is not in the folder; start it again")
        if self._tiles is None:
            self._begin_tiles()
        return self.ended()

    def ended(self) -> Work | None:
        """Return the unit with its record once all of its tiles are there."""
        if self._tiles is None or len(self._results) < 1 + len(self._tiles):
            return None
        tiles = {tile: self._results[tile] for tile in self._tiles}
        sample = MapSample.merged(self._samples) if self._samples else None
        self._samples.clear()
        try:
            record = assembled(self._work, self._results[self._frames], tiles, sample)
        except SemstabError as error:
            return self._work.failed(error)
        return dataclasses.replace(self._work, record=record)

    def step(self) -> int:
        """Return the frames by which the progress advances now: all of the unit's once all tiles are there."""
        parts = 1 + (GUESS if self._tiles is None else len(self._tiles))
        reached = len(self._work.frames) * len(self._results) // parts
        step, self._advanced = max(0, reached - self._advanced), max(reached, self._advanced)
        return step

    def _begin_tiles(self) -> None:
        """Queue the tiles that are still to be computed; files of the unit that belong to none of them are removed."""
        met = self._results[self._frames]
        any_tile = dataclasses.replace(self._frames, origin=met.origin)
        self._tiles = {dataclasses.replace(any_tile, index=index): frames for index, frames in met.tiles().items()}
        missing = {tile: frames for tile, frames in self._tiles.items() if not self._take_over(tile)}
        self._waiting = [self._work.in_tile(tile, frames) for tile, frames in missing.items()]
        self._folder.clear(self._work.unit, {name for result in self._results.values() for name in result.files})

    def _take_over(self, tile: UnitTile) -> bool:
        """Take a result from the folder, if its files are there as they were."""
        result = TileResult.load(self._folder.path / tile.folder / f"{tile.name}.npz")
        if result is None or not self._folder.are_whole(result.files):
            return False
        self._results[tile] = result
        if (name := f"{tile.folder}/{tile.name}.sample") in result.files:
            self._samples.append(MapSample.load(self._folder.path / name))
            if sum(len(sample.table) for sample in self._samples) > 2 * MOST_VOXELS:
                self._samples = [MapSample.merged(self._samples)]
                self._bound = self._samples[0].bound()
        return True


def assembled(
    work: Work, frames: TileResult, results: Mapping[UnitTile, TileResult], sample: MapSample | None
) -> Record:
    """Return the record of a unit from the pass over its frames, its tiles, and the sample of their voxels.

    Raises:
        DataError: If no pixel was valid.
    """
    unit, task, folder, tiles = work.unit, work.unit.task, work.start.folder, [*results]
    whole = frames.with_tiles([*results.values()])
    sums = TableSums.read(whole.sums) if tiles else None
    if sums is None or not sums.total[2]:
        raise no_voxels(task, unit.config)
    rows = joined_series(frames.series, [result.series for result in results.values()])
    observations, features = _of_frames(folder, tiles[0])
    analysis = None
    if sample is not None:  # sums in the order of the tiles, not in that of their ends
        sample = dataclasses.replace(sample, summary=sums)
        analysis = analyse_sample(task, unit.config, sample, observations, features)
    savers = _savers(work, tiles, rows, observations, analysis, pictured=overview_file(task) in whole.files)
    files = {name: digest for name, digest in whole.files.items() if not name.startswith(tiles[0].folder)}
    files |= written(work.start, savers)[0]
    up = None
    if unit.image_space:
        up = up_axis(task.scene, _centers(folder, files, unit.config.voxel_size, int(sums.total[2])), whole.poses)
    return record_of(unit, task, rows, dataclasses.replace(whole, files=files), analysis, up)


def _savers(
    work: Work,
    tiles: Sequence[UnitTile],
    rows: Series,
    observations: SpotObservations | None,
    analysis: Analysis | None,
    *,
    pictured: bool,
) -> Savers:
    """Return the files of a unit that need all of its tiles: pictures are added to the overview if there is one."""
    unit, task, folder, savers = work.unit, work.unit.task, work.start.folder, Savers()
    of_frames = {} if analysis is None else analysis.of_frames()
    if pictured and (pictures := pictures_of_outlying(task, unit.config, of_frames)):
        savers[overview_file(task)] = partial(_save_with_pictures, folder / overview_file(task), pictures)
    if not unit.stored:
        return savers
    savers |= observation_savers(task, observations) | unit_savers(task, rows, analysis, of_frames)
    if unit.config.statistics and analysis is not None:
        for tile in tiles:
            savers |= _with_columns(tile, unit.name.slug, analysis, folder)
    return savers


def _of_frames(folder: Path, tile: UnitTile) -> tuple[SpotObservations | None, FeatureObservations | None]:
    """Return what the pass over the frames sampled: observations, and features if the model has some."""
    observations, features = (
        folder / tile.folder / f"{tile.size}_{name}" for name in (TILE_OBSERVATIONS, TILE_FEATURES)
    )
    if not observations.exists():
        return None, None
    spots = SpotObservations.load(observations)
    return spots, FeatureObservations.load(features, spots) if features.exists() else None


def _save_with_pictures(overview: Path, pictures: dict[str, npt.NDArray[Any]], path: Path) -> None:
    """Save the pictures that are there, and further ones."""
    with np.load(overview) as content:
        arrays = {name: content[name] for name in content.files}
    save_overview(arrays | pictures, path)


def _with_columns(task: UnitTile, slug: str, analysis: Analysis, folder: Path) -> Savers:
    """Return the file of a tile's voxels, again with the columns of the statistics."""
    assert task.index is not None
    waiting = folder / task.folder / VOXELS / f"tile={task.index[0]}_{task.index[1]}.parquet"

    def save(path: Path) -> None:
        truths = (folder / TRUTH / slug / waiting.name, folder / task.folder / TRUTH / waiting.name)
        truth = next((VoxelTable.load(file) for file in truths if file.exists()), None)
        table = VoxelTable.load(waiting)
        save_voxels(table, path, analysis.columns(table, truth), tile_of(waiting))

    return {f"{VOXELS}/{slug}/{waiting.name}": save} if waiting.exists() else {}


def _centers(folder: Path, files: Iterable[str], voxel_size: float, voxels: int) -> Float64:
    """Return (n, 3) of at most UP_VOXELS of a map's voxels, evenly drawn, metres, in the order of a whole table."""
    step = -(-voxels // UP_VOXELS)
    tables = [folder / name for name in files if name.startswith(f"{VOXELS}/")]
    if not tables:
        return np.zeros((0, 3))
    parts = [VoxelTable.columns(file, ("ix", "iy", "iz")) for file in tables]
    index = np.concatenate([np.stack([*part.values()], axis=1)[::step] for part in parts])
    return (index[in_order(index)] + 0.5) * voxel_size
