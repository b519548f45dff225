"""A unit in tiles, once all of its portions are finished: their sums and series make what a unit leaves."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.rows import Rows
from semstab.core.types import Float64
from semstab.datasets.formats.disk import file_digest
from semstab.engine.evaluation import analyse_map
from semstab.engine.series import NUMBERS, Series
from semstab.engine.tiling.portion import PART, PORTIONS, STRETCH, TRUE_LOOKS, Finished, joined_series
from semstab.engine.units import PlannedUnit
from semstab.engine.work.finish import SAMPLE, no_voxels, reduced_of, save_voxels, unit_summary
from semstab.engine.work.image_space import COLUMNS, image_space_of
from semstab.engine.work.stream import AXES, some_poses
from semstab.engine.work.up_axis import estimate_up
from semstab.errors import DataError
from semstab.metrics.agreement import together
from semstab.metrics.summary import TableSums
from semstab.model.parquet import tile_of
from semstab.model.records import FRAMES, INFLUENCE, LOOKS, TRUTH, VOXELS, UnitContent
from semstab.model.results import Agreement
from semstab.model.voxels import VoxelTable
from semstab.statistics import Analysis, CellObservations, MapSample, ObservationSample
from semstab.statistics.sampler import merged_observations

UP_VOXELS = 1 << 20
"""Of more voxels every n-th is looked at for the up axis."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """What was sampled of the frames of a unit, cell by cell and as observations; None where nothing was."""

    looks: CellObservations | None
    sample: ObservationSample | None

    @classmethod
    def of(cls, finished: Iterable[Finished], folder: Path) -> Sampled:
        """From the stretches of frames among these portions."""
        stretches = [each for each in finished if each.about.kind == STRETCH]
        looks, true_looks = (_looks(stretches, folder, true=true) for true in (False, True))
        sample = None if looks is None else looks.sample()
        if sample is not None and true_looks is not None:
            sample = sample.against(true_looks.sample())
        return cls(looks, sample)


@dataclass(frozen=True, eq=False)
class Joined:
    """What becomes of a unit's portions without a second look at its parts.

    sums     over all voxels
    rows     its time series, image (F, C) what its frames tell in image coordinates
    reduced  sums of the map of labels that soft scores were reduced to; None where there are none
    up       the scene's up axis
    files    digests of what is in the folder by now, by path
    """

    sums: TableSums
    rows: Series
    image: Rows
    reduced: Float64 | None
    up: tuple[float, float, float] | None
    files: Mapping[str, str]


def joined(
    planned: PlannedUnit,
    finished: Mapping[str, Finished],
    load: Callable[[str], Finished],
    folder: Path,
    sampled: Sampled,
) -> Joined:
    """What the portions of a unit come to, by name; its series and its looks are written.

    load  a portion with what it has of each frame: those are not together in memory

    Raises DataError where no pixel was valid, or a portion is no longer there.
    """
    unit, parts = planned.unit, _of_kind(finished, PART)
    sums = functools.reduce(operator.add, (TableSums.read(part.sums) for part in parts))
    if not sums.total[2]:
        raise no_voxels(planned.task, planned.config)
    of_frames, of_parts = _rows(load, finished, STRETCH), _rows(load, finished, PART)
    rows = joined_series(of_frames.series, of_parts.series, of_parts.sizes)
    reduced = [part.reduced for part in parts if len(part.reduced)]
    files = {name: digest for each in finished.values() for name, digest in each.about.files.items()}
    files = {name: digest for name, digest in files.items() if not name.startswith(f"{PORTIONS}/")}
    tiles = [folder / name for name in files if name.startswith(f"{VOXELS}/")]
    if planned.kept:
        files |= _saved(folder, f"{FRAMES}/{unit.slug}.csv", rows.save_csv)
        if sampled.looks is not None:
            files |= _saved(folder, f"{LOOKS}/{unit.slug}.parquet", sampled.looks.save)
    return Joined(
        sums,
        rows,
        of_frames.image,
        np.sum(reduced, axis=0) if reduced else None,
        _up(planned, tiles, int(sums.total[2]), some_poses(of_frames.poses)) if planned.image_space else None,
        files,
    )


def assembled(
    planned: PlannedUnit,
    finished: Mapping[str, Finished],
    joined: Joined,
    folder: Path,
    sampled: Sampled,
) -> UnitContent:
    """The unit's content, from what its portions come to."""
    task, config, files = planned.task, planned.config, {**joined.files}
    classes, strata = task.mapping.target.classes, config.strata
    own = [name for each in finished.values() for name in each.about.files if name.startswith(f"{PORTIONS}/")]
    found = _analysed(planned, own, folder, sampled)
    if found is not None and planned.kept:
        files |= _saved(folder, f"{INFLUENCE}/{planned.unit.slug}.parquet", found.sums.save)
        if config.statistics:
            files |= _write_tiles(planned, own, found, folder, files)
    summary = unit_summary(
        task,
        joined.rows,
        joined.sums.summary(config.voxel_size, classes, strata),
        None if found is None else found.summary,
        None if joined.reduced is None else reduced_of(joined.reduced),
        next((each.about.sizes for each in finished.values() if each.about.sizes), ()),
    )
    checked = _checked([part.about.checked for part in _of_kind(finished, PART)])
    content = UnitContent(planned.digest, summary, files=files, checked=checked)
    if not planned.image_space:
        return content
    image_space = image_space_of(joined.image, summary.flicker_percent)
    quality = _of_kind(finished, STRETCH)[0].about.quality
    return replace(content, image_space=image_space, quality=quality, up=joined.up)


def _of_kind(finished: Mapping[str, Finished], kind: str) -> list[Finished]:
    return [each for each in finished.values() if each.about.kind == kind]


@dataclass(frozen=True, eq=False)
class _Rows:
    """What portions have of each frame, one portion after the other, of so many frames each; see `Finished`."""

    sizes: list[int] = field(default_factory=list)
    series: Rows = field(default_factory=lambda: Rows(len(NUMBERS)))
    image: Rows = field(default_factory=lambda: Rows(len(COLUMNS)))
    poses: Rows = field(default_factory=lambda: Rows(AXES))


def _rows(load: Callable[[str], Finished], finished: Mapping[str, Finished], kind: str) -> _Rows:
    """Of all portions of a kind, of which one at a time is in memory."""
    rows = _Rows()
    for name in (name for name, each in finished.items() if each.about.kind == kind):
        found = load(name)
        rows.sizes.append(len(found.series))
        rows.series.extend(found.series)
        rows.image.extend(found.image)
        rows.poses.extend(found.poses.reshape(-1, AXES))
    return rows


def _saved(folder: Path, name: str, save: Callable[[Path], None]) -> dict[str, str]:
    """The digest of a file of the folder that was written, by its path there."""
    save(folder / name)
    return {name: file_digest(folder / name).hex()}


def _looks(stretches: Sequence[Finished], folder: Path, *, true: bool) -> CellObservations | None:
    """What was sampled of all frames, or of their ground truth; None where nothing was."""
    names = [name for each in stretches for name in each.about.files if name.startswith(f"{PORTIONS}/")]
    chosen = [name for name in names if name.endswith(TRUE_LOOKS) == true]
    return merged_observations([CellObservations.load(folder / name) for name in chosen]) if chosen else None


def _analysed(planned: PlannedUnit, portions: Sequence[str], folder: Path, sampled: Sampled) -> Analysis | None:
    """The statistics of the whole map, whose tiles are written once more with its columns; None where unjudged."""
    samples = [name for name in portions if name.endswith(SAMPLE)]
    if not planned.judged or sampled.sample is None or not samples:
        return None
    whole = MapSample.merged([MapSample.load(folder / name) for name in samples])
    if not len(whole.table):
        return None
    return analyse_map(planned.task, planned.config, whole, sampled.sample)


def _write_tiles(
    planned: PlannedUnit, portions: Sequence[str], found: Analysis, folder: Path, files: Mapping[str, str]
) -> dict[str, str]:
    """Write the tiles of the map with the columns of the statistics; their digests."""
    written: dict[str, str] = {}
    truths = {Path(name).name: folder / name for name in portions if Path(name).parent.name == "truth"}
    for name in (name for name in files if name.startswith(f"{VOXELS}/")):
        file, table = folder / name, VoxelTable.load(folder / name)
        truth = VoxelTable.load(truths[file.name]) if file.name in truths else None
        tile = tile_of(file)
        written |= _saved(folder, name, partial(save_voxels, table, columns=found.columns(table, truth), tile=tile))
        if truth is not None and planned.image_space:
            path = f"{TRUTH}/{planned.unit.slug}/{file.name}"
            written |= _saved(folder, path, partial(truth.save, tile=tile))
    return written


def _checked(found: Sequence[Agreement | None]) -> Agreement | None:
    """The agreement on all parts, from that on each; None where it was not checked."""
    there = [each for each in found if each is not None]
    return together(there) if there and len(there) == len(found) else None


def _up(planned: PlannedUnit, tiles: Sequence[Path], voxels: int, poses: Float64) -> tuple[float, float, float] | None:
    """The scene's up axis, said, or estimated from some voxels of each tile; None where neither works."""
    scene, step = planned.task.scene, -(-voxels // UP_VOXELS)
    try:
        up = scene.up if scene.up is not None else estimate_up(_centers(tiles, planned.config.voxel_size, step), poses)
    except (DataError, ImportError, OSError):
        return None
    x, y, z = (float(value) for value in up)
    return x, y, z


def _centers(tiles: Sequence[Path], voxel_size: float, step: int) -> Float64:
    """(n, 3) of every n-th voxel, metres, in the order of a whole table."""
    found: list[Mapping[str, npt.NDArray[Any]]] = [VoxelTable.columns(file, ("ix", "iy", "iz")) for file in tiles]
    index = np.concatenate([np.stack([*part.values()], axis=1)[::step] for part in found])
    return (index[np.lexsort(index.T[::-1])] + 0.5) * voxel_size
