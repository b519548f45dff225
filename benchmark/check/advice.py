"""Which voxel size suits the data, and where a given one lies."""

from __future__ import annotations

import contextlib
import math

from semstab.check.coverage import Coverage, suggested_size
from semstab.check.reprojection import Sample
from semstab.check.scene_check import CLUSTERS, POINTS, Look
from semstab.check.views import clusters, evenly
from semstab.config import Config
from semstab.datasets import GROUND_TRUTH, Scene, open_dataset
from semstab.errors import DataError
from semstab.model.results import VoxelAdvice
from semstab.task import frame_indices, selected

SCENES = 3
"""Of more scenes some are looked at; the largest size suits all of them."""

MADE = "city"
"""The dataset that is made, not measured: nothing is to be told of its voxels."""


def with_voxel_size(config: Config) -> tuple[Config, dict[str, VoxelAdvice]]:
    """The configuration, with the voxel size that `check` suggests for data of files where it says none.

    And why, scene by scene. Raises ConfigError or DataError where there is no such scene.
    """
    if config.sets_voxel_size or config.dataset.name == MADE:
        return config, {}
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    names = selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name)
    some = [names[k] for k in evenly(len(names), SCENES)]
    seen = {name: found for name in some if (found := _coverage(config, dataset.scene(name))) is not None}
    sizes = [size for found in seen.values() if (size := suggested_size(found)) is not None]
    if not sizes:
        return config, {}
    size = max(sizes)
    advice = {name: VoxelAdvice(size, found.stays(size), size, chosen=True) for name, found in seen.items()}
    return config.model_copy(update={"voxel_size": size}), advice


def advise(sample: Sample | None, config: Config) -> VoxelAdvice | None:
    """Where the configured voxel size lies; None where nothing can be told of it."""
    if sample is None or not sample.pairs or config.dataset.name == MADE:
        return None
    coverage = Coverage(sample)
    stays = coverage.stays(config.voxel_size)
    return None if math.isnan(stays) else VoxelAdvice(config.voxel_size, stays, suggested_size(coverage), chosen=False)


def _coverage(config: Config, scene: Scene) -> Coverage | None:
    """What a scene's frames share; None where they cannot be read: whoever needs them says so."""
    extra = (GROUND_TRUTH,) if scene.ground_truth else ()
    backbones = selected(config.backbones, scene.backbones, extra, "backbone", scene.name)
    with contextlib.suppress(DataError):
        indices = frame_indices(scene, config, backbones)
        look = Look(scene, indices, None, clusters(len(indices), CLUSTERS), POINTS, passing_over=True)
        return Coverage(look.sample(config.dataset.options)) if len(look.views) > 1 else None
    return None
