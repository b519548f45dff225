"""The second look at the voxels of a part, taken by a job."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from semstab.datasets.formats.disk import file_digest
from semstab.engine.tiling.again import Again, SeenAgain
from semstab.engine.tiling.portion import PORTIONS
from semstab.engine.work.finish import Savers, further_columns, save_voxels
from semstab.engine.work.jobs import Job, Outcome, Request, shared_marker
from semstab.model.records import TRUTH, VOXELS
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.parquet import tile_of
from semstab.statistics import Truth, join_truth
from semstab.statistics.kinds import Kinds, spread
from semstab.statistics.sums import SecondSums, second_look


def looked_again(job: Job, request: Request) -> Outcome:
    """What was found; nothing where the folder is not to be seen from here, so that who sees it has to look."""
    assert request.again is not None
    shared = shared_marker(job.folder, job.start).exists()
    found = look_again(request.again, job.folder) if shared else None
    return Outcome(request.identity, portion=request.again.name, again=found)


def look_again(again: Again, folder: Path) -> SeenAgain:
    """Tile by tile."""
    files, found = dict[str, str](), list[SecondSums]()
    for name in again.tiles:
        file, table = folder / name, VoxelTable.load(folder / name)
        true = file.parents[1] / "truth" / file.name
        truth = VoxelTable.load(true) if name.startswith(f"{PORTIONS}/") and true.exists() else None
        kinds = Kinds.found(table, truth=_known(table, truth) if again.overall.true else None)
        sums, more = second_look(kinds, again.overall, truth)
        found.append(sums)
        if again.written:
            maps = VoxelTable.columns(file, further_columns(file))
            columns, tile = {**maps, **spread(more, kinds.of), **again.overall.maps(table, maps)}, tile_of(file)
            savers: Savers = {
                f"{VOXELS}/{again.slug}/{file.name}": partial(save_voxels, table, columns=columns, tile=tile)
            }
            if truth is not None and again.true:
                savers[f"{TRUTH}/{again.slug}/{file.name}"] = partial(truth.save, tile=tile)
            for path, save in savers.items():
                save(folder / path)
                files[path] = file_digest(folder / path).hex()
    return SeenAgain(SecondSums.merged(found), files)


def _known(table: VoxelTable, truth: VoxelTable | None) -> Truth:
    """The true classes of a tile; none where the ground truth saw nothing of it."""
    if truth is None:
        return Truth(np.zeros(len(table), np.bool_), np.full(len(table), -1, np.int64))
    return join_truth(table, truth)
