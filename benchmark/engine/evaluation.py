"""The statistics of maps: each by itself and against the ground truth's, a scene's backbones beside each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from semstab.config import Config
from semstab.datasets import GROUND_TRUTH
from semstab.errors import ConfigError
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics import Analysis, BackboneComparison, Looks, Sample, analyse, compare_backbones
from semstab.task import Task


def truth_task(task: Task) -> Task | None:
    """The ground truth in the unit's label space; None where there is none, or where it does not map to that."""
    if not task.scene.ground_truth or task.backbone == GROUND_TRUTH:
        return None
    try:
        mapping = task.scene.label_space(GROUND_TRUTH).mapping_to(task.mapping.target)
    except ConfigError:
        return None
    return dataclasses.replace(task, backbone=GROUND_TRUTH, mapping=mapping)


def analyse_map(
    task: Task,
    config: Config,
    table: VoxelTable,
    events: Events | None = None,
    truth: VoxelTable | None = None,
    sample: Sample | None = None,
) -> Analysis:
    """What the statistics say of one map; `truth` is what is right, and how far geometry lets labels agree."""
    critical = config.critical_classes
    return analyse(
        table, events, truth, limit=truth, sample=sample, name=task.backbone, edges=config.strata, critical=critical
    )


def comparison(
    scene: str,
    maps: Mapping[str, VoxelTable],
    truth: VoxelTable | None = None,
    logs: Mapping[str, Events] | None = None,
    looks: Mapping[str, Looks] | None = None,
) -> BackboneComparison | None:
    """Maps of a scene beside each other; None where there are not two or more of them in one label space.

    With the logs of all of them, also under other rules of fusion; with the sampled looks of all, on common ones.
    """
    if len(maps) < 2 or len({table.classes for table in maps.values()}) > 1:
        return None
    if truth is not None and truth.classes != next(iter(maps.values())).classes:
        truth = None
    sampled = looks if looks is not None and looks.keys() == maps.keys() else None
    return compare_backbones(maps, logs, truth, looks=sampled, scene=scene)
