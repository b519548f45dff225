"""The statistics of a run: each map by itself and against the ground truth's, a scene's backbones beside each other."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping

from semstab.backends import FusionBackend, create, takes_option
from semstab.config import Config
from semstab.datasets import GROUND_TRUTH
from semstab.errors import ConfigError, DataError
from semstab.frames import Frame
from semstab.plan import Task, read
from semstab.prefetch import prefetch
from semstab.results import Unit
from semstab.statistics import Analysis, BackboneComparison, analyse, compare_backbones
from semstab.voxels import Events, VoxelTable


def truth_task(task: Task) -> Task | None:
    """The ground truth in the unit's label space; None where there is none, or where it does not map to that."""
    if not task.scene.ground_truth or task.backbone == GROUND_TRUTH:
        return None
    try:
        mapping = task.scene.label_space(GROUND_TRUTH).mapping_to(task.mapping.target)
    except ConfigError:
        return None
    return dataclasses.replace(task, backbone=GROUND_TRUTH, mapping=mapping)


def logged_by(config: Config) -> str | None:
    """The backend that keeps its log of observations for the statistics: the first one that is asked to, and can."""
    names = (backend.name for backend in config.fused_by() if takes_option(backend.name, "history"))
    return next(names, None) if config.statistics else None


def analyse_map(
    task: Task, config: Config, table: VoxelTable, events: Events | None = None, truth: VoxelTable | None = None
) -> Analysis:
    """What the statistics say of one map; `truth` is what is right, and how far geometry lets labels agree."""
    return analyse(table, events, truth, limit=truth, name=task.backbone, edges=config.strata)


class Evaluation:
    """The statistics of a run's maps, task after task; what a scene's tasks share is kept while they last."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._tasks: list[Task] = []
        self._maps: dict[str, VoxelTable] = {}
        self._truths: dict[tuple[str, ...], VoxelTable | None] = {}  # by the classes of the label space

    def analyses(
        self, task: Task, maps: Mapping[Unit, FusionBackend], tables: Mapping[Unit, VoxelTable]
    ) -> dict[Unit, Analysis]:
        """Of the first backend's map; with `statistics` also of the first one that has a log of its observations."""
        first = next(iter(maps))
        if not self.config.statistics:
            return {first: analyse_map(task, self.config, tables[first])}
        self.add(task, tables[first])
        truth = self._truth(task)
        logs = ((unit, backend.events()) for unit, backend in maps.items())
        logged, events = next(((unit, log) for unit, log in logs if log is not None), (first, None))
        found = {logged: analyse_map(task, self.config, tables[logged], events, truth)}
        return found if first in found else found | {first: analyse_map(task, self.config, tables[first], None, truth)}

    def add(self, task: Task, table: VoxelTable) -> None:
        """A backbone's map, to be compared with the others of its scene."""
        if self._tasks and task.scene is not self._tasks[0].scene:
            self._tasks, self._maps, self._truths = [], {}, {}
        self._tasks.append(task)
        self._maps[task.backbone] = table

    def comparisons(self) -> list[BackboneComparison]:
        """The backbones of the scene at hand beside each other; none where there are not two to compare."""
        backbones = {name: table for name, table in self._maps.items() if name != GROUND_TRUTH}
        if not comparable(backbones):
            return []
        truth = next(self._truth(task) for task in self._tasks if task.backbone != GROUND_TRUTH)
        return [compare_backbones(backbones, truth=truth, scene=self._tasks[0].scene.name)]

    def _truth(self, task: Task) -> VoxelTable | None:
        """The map of the ground truth of the task's frames, fused once for all backbones of the scene."""
        if task.backbone == GROUND_TRUTH:
            return None
        classes = task.mapping.target.classes
        if classes not in self._truths:
            self._truths[classes] = _fused_truth(task, self.config)
        return self._truths[classes]


def comparable(maps: Mapping[str, VoxelTable]) -> bool:
    """Whether these are two maps or more, in one label space."""
    return len(maps) > 1 and len({table.classes for table in maps.values()}) == 1


def _fused_truth(task: Task, config: Config) -> VoxelTable | None:
    """By the run's first backend; None where there is no ground truth."""
    true = truth_task(task)
    if true is None:
        return None
    backend, K = config.backends[0], len(true.mapping.target)
    fused = create(backend.name, voxel_size=config.voxel_size, num_classes=K, **backend.options)

    def decode(index: int) -> Frame | None:
        try:
            return read(true, index, config.pixel_stride)
        except DataError:  # not every frame of a scene needs to have ground truth
            return None

    frames = prefetch(decode, true.indices, threads=config.threads, size=lambda frame: frame.nbytes if frame else 0)
    with contextlib.closing(frames):
        for fetched in frames:
            if fetched.item is not None:
                fused.integrate(fetched.item)
    return dataclasses.replace(fused.table(), classes=true.mapping.target.classes)
