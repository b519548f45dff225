"""A unit in tiles, once all of its portions are finished: their sums and series make what a unit leaves."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import file_digest
from semstab.engine.series import to_csv
from semstab.engine.tiling.portion import PORTIONS, Finished, joined_series
from semstab.engine.units import PlannedUnit
from semstab.engine.work.finish import Savers, further_columns, no_voxels, reduced_of, save_voxels, unit_summary
from semstab.engine.work.up_axis import estimate_up
from semstab.errors import DataError
from semstab.metrics.summary import TableSums
from semstab.model.records import FRAMES, INFLUENCE, LOOKS, TRUTH, VOXELS, UnitContent
from semstab.model.results import Agreement, Deviation
from semstab.model.statistics import MapStatistics
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.parquet import tile_of
from semstab.runtime.files import write_text
from semstab.statistics import Looks, Truth, join_truth
from semstab.statistics.description import concluded
from semstab.statistics.sampling import InfluenceSums
from semstab.statistics.sums import FirstSums, SecondSums, Whole, second_look

UP_VOXELS = 1 << 20
"""Of more voxels every n-th is looked at for the up axis."""


def assembled(planned: PlannedUnit, frames: Finished, parts: Sequence[Finished], folder: Path) -> UnitContent:
    """The unit's content; its series is written. Raises DataError where no pixel was valid."""
    task, unit, config = planned.task, planned.unit, planned.config
    sums = functools.reduce(operator.add, (TableSums.read(part.sums) for part in parts))
    if not sums.total[2]:
        raise no_voxels(task, config)
    files = {name: digest for each in (frames, *parts) for name, digest in each.about.files.items()}
    found = _statistics(planned, parts, folder, files) if planned.judged else None
    rows = joined_series(frames.series, [part.series for part in parts])
    reduced = [part.reduced for part in parts if len(part.reduced)]
    summary = unit_summary(
        task,
        rows,
        sums.summary(config.voxel_size, task.mapping.target.classes, config.strata),
        None if found is None else found[0],
        reduced_of(np.sum(reduced, axis=0)) if reduced else None,
        frames.about.sizes,
    )
    files = {name: digest for name, digest in files.items() if not name.startswith(f"{PORTIONS}/")}
    if planned.kept:
        savers: Savers = {f"{FRAMES}/{unit.slug}.csv": lambda path: write_text(path, to_csv(rows))}
        if found is not None:
            savers[f"{INFLUENCE}/{unit.slug}.parquet"] = found[1].save
            files |= found[2]
        files |= {name: _saved(save, folder / name) for name, save in savers.items()}
    content = UnitContent(
        planned.digest, summary, files=files, checked=_checked([part.about.checked for part in parts])
    )
    if not planned.image_space or frames.about.image_space is None:
        return content
    image_space = replace(frames.about.image_space, flicker_percent=summary.flicker_percent)
    tiles = [folder / name for name in files if name.startswith(f"{VOXELS}/")]
    content = replace(content, quality=frames.about.quality)
    return replace(content, image_space=image_space, up=_up(planned, tiles, int(sums.total[2]), frames.poses))


def _saved(save: Callable[[Path], None], path: Path) -> str:
    """The digest of a file that was written."""
    save(path)
    return file_digest(path).hex()


def _statistics(
    planned: PlannedUnit, parts: Sequence[Finished], folder: Path, files: Collection[str]
) -> tuple[MapStatistics, InfluenceSums, dict[str, str]]:
    """What the statistics say of all parts together, with the looks that were sampled of the frames.

    Then each tile is looked at again, and written once more where the whole map tells more of its voxels: the digests
    of these files.
    """
    classes, config = planned.task.mapping.target.classes, planned.config
    whole = Whole(FirstSums.merged([FirstSums.read(part.sums, classes) for part in parts]))
    looks = {Path(name).stem: Looks.load(folder / name) for name in files if _is_looks(name)}
    true_looks = looks.pop("true-looks", None)
    (sample,) = (own.sample() for own in looks.values())
    second, written = _second_looks(planned, whole, folder, files)
    summary, sums = concluded(
        whole,
        second,
        voxel_size=config.voxel_size,
        classes=classes,
        sample=sample if true_looks is None else sample.against(true_looks.sample()),
        name=planned.task.backbone,
        edges=config.strata,
        critical=config.critical_classes,
    )
    return summary, sums, written


def _is_looks(name: str) -> bool:
    return name.startswith(f"{LOOKS}/") or name.endswith("looks.parquet")


def _second_looks(
    planned: PlannedUnit, whole: Whole, folder: Path, files: Iterable[str]
) -> tuple[SecondSums, dict[str, str]]:
    unit, written = planned.unit, dict[str, str]()
    found: list[SecondSums] = []
    for name in (name for name in files if Path(name).parent.name in ("voxels", unit.slug)):
        if not name.startswith((f"{VOXELS}/", f"{PORTIONS}/")):
            continue
        file, table = folder / name, VoxelTable.load(folder / name)
        true = file.parents[1] / "truth" / file.name
        truth = VoxelTable.load(true) if name.startswith(f"{PORTIONS}/") and true.exists() else None
        known = None if whole.first.truth is None else _known(table, truth)
        second, more = second_look(table, whole, known, truth)
        found.append(second)
        if planned.kept and planned.config.statistics:
            maps = VoxelTable.columns(file, further_columns(file))
            columns, tile = {**maps, **more, **whole.maps(table, maps)}, tile_of(file)
            savers: Savers = {
                f"{VOXELS}/{unit.slug}/{file.name}": partial(save_voxels, table, columns=columns, tile=tile)
            }
            if truth is not None and planned.image_space:
                savers[f"{TRUTH}/{unit.slug}/{file.name}"] = partial(truth.save, tile=tile)
            written |= {path: _saved(save, folder / path) for path, save in savers.items()}
    return SecondSums.merged(found), written


def _known(table: VoxelTable, truth: VoxelTable | None) -> Truth:
    """The true classes of a tile; none where the ground truth saw nothing of it."""
    if truth is None:
        return Truth(np.zeros(len(table), np.bool_), np.full(len(table), -1, np.int64))
    return join_truth(table, truth)


def _checked(found: Sequence[Agreement | None]) -> Agreement | None:
    """The agreement on all parts, from that on each; None where it was not checked."""
    there = [each for each in found if each is not None]
    if not there or len(there) < len(found):
        return None
    shared = [each.voxels[0] - each.only_in[0] for each in there]
    return replace(
        there[0],
        voxels=(sum(each.voxels[0] for each in there), sum(each.voxels[1] for each in there)),
        only_in=(sum(each.only_in[0] for each in there), sum(each.only_in[1] for each in there)),
        differences=dict(_deviations(there, shared)),
        agrees=all(each.agrees for each in there),
    )


def _deviations(there: Sequence[Agreement], shared: Sequence[int]) -> Iterator[tuple[str, Deviation]]:
    total = sum(shared)
    for name in there[0].differences:
        own = [(each.differences[name], n) for each, n in zip(there, shared, strict=True) if n]
        largest = max((each.max for each, _ in own), default=math.nan)
        yield name, Deviation(largest, sum(each.mean * n for each, n in own) / total if total else math.nan)


def _up(
    planned: PlannedUnit, tiles: Sequence[Path], voxels: int, poses: npt.NDArray[np.float64]
) -> tuple[float, float, float] | None:
    """The scene's up axis, said, or estimated from some voxels of each tile; None where neither works."""
    scene, step = planned.task.scene, -(-voxels // UP_VOXELS)
    try:
        up = scene.up if scene.up is not None else estimate_up(_centers(tiles, planned.config.voxel_size, step), poses)
    except (DataError, ImportError, OSError):
        return None
    x, y, z = (float(value) for value in up)
    return x, y, z


def _centers(tiles: Sequence[Path], voxel_size: float, step: int) -> npt.NDArray[np.float64]:
    """(n, 3) of every n-th voxel, metres, in the order of a whole table."""
    found: list[Mapping[str, npt.NDArray[Any]]] = [VoxelTable.columns(file, ("ix", "iy", "iz")) for file in tiles]
    index = np.concatenate([np.stack([*part.values()], axis=1)[::step] for part in found])
    return (index[np.lexsort(index.T[::-1])] + 0.5) * voxel_size
