"""The statistics of maps: each by itself and against the ground truth's, a scene's backbones beside each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from semstab.config import Config
from semstab.datasets import GROUND_TRUTH
from semstab.errors import ConfigError
from semstab.statistics import Analysis, BackboneComparison, CellObservations, MapSample, ObservationSample, analyse
from semstab.statistics.model_comparison import Regions, compare_regions
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


def analyse_map(task: Task, config: Config, sample: MapSample, observations: ObservationSample | None) -> Analysis:
    """Return the statistics of one map, from a sample of its voxels and of its observations."""
    critical = config.critical_classes
    return analyse(sample, observations, name=task.backbone, edges=config.strata, critical=critical)


def comparison(
    scene: str, regions: Regions, looks: Mapping[str, CellObservations] | None = None
) -> BackboneComparison | None:
    """Maps of a scene beside each other; None where there are not two or more of them in one label space.

    With the logs of all of them, also under other rules of fusion; with the sampled looks of all, on common ones.
    """
    first = next(iter(regions()))
    classes = {table.classes for table in first.tables.values()}
    if len(first.tables) < 2 or len(classes) > 1:
        return None
    if first.truth is not None and first.truth.classes not in classes:
        return comparison(scene, lambda: (dataclasses.replace(own, truth=None) for own in regions()), looks)
    return compare_regions(regions, looks=looks, scene=scene)
