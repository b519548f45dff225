"""A unit in tiles, once all of its portions are finished: their sums and series make what a unit leaves."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import file_digest
from semstab.engine.tiling.portion import PART, PORTIONS, STRETCH, TRUE_LOOKS, Finished, joined_series
from semstab.engine.units import PlannedUnit
from semstab.engine.work.finish import Savers, further_columns, no_voxels, reduced_of, save_voxels, unit_summary
from semstab.engine.work.image_space import image_space_of
from semstab.engine.work.up_axis import estimate_up
from semstab.errors import DataError
from semstab.metrics.agreement import together
from semstab.metrics.summary import TableSums
from semstab.model.records import FRAMES, INFLUENCE, LOOKS, TRUTH, VOXELS, UnitContent
from semstab.model.results import Agreement
from semstab.model.statistics import MapStatistics
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.parquet import tile_of
from semstab.statistics import Looks, Sample, Truth, join_truth
from semstab.statistics.description import concluded
from semstab.statistics.looks.sampler import merged
from semstab.statistics.sampling import InfluenceSums
from semstab.statistics.sums import FirstSums, SecondSums, Whole, second_look

UP_VOXELS = 1 << 20
"""Of more voxels every n-th is looked at for the up axis."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """What was sampled of the frames of a unit, cell by cell and as observations; None where nothing was."""

    looks: Looks | None
    sample: Sample | None

    @classmethod
    def of(cls, finished: Iterable[Finished], folder: Path) -> Sampled:
        """From the stretches of frames among these portions."""
        stretches = [each for each in finished if each.about.kind == STRETCH]
        looks, true_looks = (_looks(stretches, folder, true=true) for true in (False, True))
        sample = None if looks is None else looks.sample()
        if sample is not None and true_looks is not None:
            sample = sample.against(true_looks.sample())
        return cls(looks, sample)


def assembled(
    planned: PlannedUnit, finished: Mapping[str, Finished], folder: Path, sampled: Sampled | None = None
) -> UnitContent:
    """The unit's content, from its portions by name, in order; its series is written.

    sampled  of its frames, where that is known already

    Raises DataError where no pixel was valid.
    """
    task, unit, config = planned.task, planned.unit, planned.config
    stretches = [each for each in finished.values() if each.about.kind == STRETCH]
    parts = [each for each in finished.values() if each.about.kind == PART]
    sums = functools.reduce(operator.add, (TableSums.read(part.sums) for part in parts))
    if not sums.total[2]:
        raise no_voxels(task, config)
    files = {name: digest for each in finished.values() for name, digest in each.about.files.items()}
    sampled = sampled or Sampled.of(stretches, folder)
    looks, sample = sampled.looks, sampled.sample
    found = _statistics(planned, parts, sample, folder, files) if planned.judged and sample is not None else None
    rows = joined_series(np.concatenate([each.series for each in stretches]), [part.series for part in parts])
    reduced = [part.reduced for part in parts if len(part.reduced)]
    summary = unit_summary(
        task,
        rows,
        sums.summary(config.voxel_size, task.mapping.target.classes, config.strata),
        None if found is None else found[0],
        reduced_of(np.sum(reduced, axis=0)) if reduced else None,
        next((each.about.sizes for each in finished.values() if each.about.sizes), ()),
    )
    files = {name: digest for name, digest in files.items() if not name.startswith(f"{PORTIONS}/")}
    savers: Savers = {}
    if planned.kept:
        savers[f"{FRAMES}/{unit.slug}.csv"] = rows.save_csv
        if found is not None:
            savers[f"{INFLUENCE}/{unit.slug}.parquet"] = found[1].save
            files |= found[2]
        if looks is not None:
            savers[f"{LOOKS}/{unit.slug}.parquet"] = looks.save
    files |= {name: _saved(save, folder / name) for name, save in savers.items()}
    content = UnitContent(
        planned.digest, summary, files=files, checked=_checked([part.about.checked for part in parts])
    )
    if not planned.image_space:
        return content
    image_space = image_space_of(np.concatenate([each.image for each in stretches]), summary.flicker_percent)
    tiles = [folder / name for name in files if name.startswith(f"{VOXELS}/")]
    poses = np.concatenate([each.poses for each in stretches])
    up = _up(planned, tiles, int(sums.total[2]), poses)
    return replace(content, image_space=image_space, quality=stretches[0].about.quality, up=up)


def _saved(save: Callable[[Path], None], path: Path) -> str:
    """The digest of a file that was written."""
    save(path)
    return file_digest(path).hex()


def _looks(stretches: Sequence[Finished], folder: Path, *, true: bool) -> Looks | None:
    """What was sampled of all frames, or of their ground truth; None where nothing was."""
    names = [name for each in stretches for name in each.about.files if name.startswith(f"{PORTIONS}/")]
    chosen = [name for name in names if name.endswith(TRUE_LOOKS) == true]
    return merged([Looks.load(folder / name) for name in chosen]) if chosen else None


def _statistics(
    planned: PlannedUnit, parts: Sequence[Finished], sample: Sample, folder: Path, files: Iterable[str]
) -> tuple[MapStatistics, InfluenceSums, dict[str, str]]:
    """What the statistics say of all parts together, with the looks that were sampled of the frames.

    Then each tile is looked at again, and written once more where the whole map tells more of its voxels: the digests
    of these files.
    """
    classes, config = planned.task.mapping.target.classes, planned.config
    whole = Whole(FirstSums.merged([FirstSums.read(part.sums, classes) for part in parts]))
    second, written = _second_looks(planned, whole, folder, files)
    summary, sums = concluded(
        whole,
        second,
        voxel_size=config.voxel_size,
        classes=classes,
        sample=sample,
        name=planned.task.backbone,
        edges=config.strata,
        critical=config.critical_classes,
    )
    return summary, sums, written


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
    return together(there) if there and len(there) == len(found) else None


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
