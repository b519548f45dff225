"""The voxel size that suits the data, and how a given one compares with it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

from semstab.check.coverage import Coverage, Covers, suggested_size
from semstab.check.inspection import Inspection
from semstab.check.reprojection import Sample, clusters
from semstab.check.scan_sample import quick_sample_of_scans
from semstab.check.scene_check import CLUSTERS, POINTS
from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.data.results import VoxelAdvice
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.predict.dataset import NAME as PREDICTED
from semstab.task import frame_indices, models_of

SCENES = 3
"""The most scenes that are looked at; the largest size suits all of them."""

MADE = "city"
"""The simulated dataset, for which no voxel size is suggested."""


def with_voxel_size(config: Config, scenes: Mapping[str, Scene]) -> tuple[Config, dict[str, VoxelAdvice]]:
    """Return the configuration, with the voxel size that `check` suggests for files if none is set, and the advice.

    The advice says scene by scene why that size was suggested.
    """
    if config.sets_voxel_size or _is_made(config):
        return config, {}
    sampled = [[*scenes.values()][k] for k in evenly(len(scenes), SCENES)]
    coverages = {scene.name: coverage for scene in sampled if (coverage := _coverage(config, scene)) is not None}
    sizes = [size for coverage in coverages.values() if (size := suggested_size(coverage)) is not None]
    if not sizes:
        return config, {}
    size = max(sizes)
    advice = {name: VoxelAdvice(size, coverage.stays(size), size, chosen=True) for name, coverage in coverages.items()}
    return config.model_copy(update={"voxel_size": size}), advice


def advise(sample: Sample | None, config: Config) -> VoxelAdvice | None:
    """Return how the configured voxel size compares with the suggested size, or None if the data do not tell."""
    if sample is None or not sample.pairs or _is_made(config):
        return None
    coverage = Coverage(sample)
    stays = coverage.stays(config.voxel_size)
    return None if math.isnan(stays) else VoxelAdvice(config.voxel_size, stays, suggested_size(coverage), chosen=False)


def faces_in_surface(sample: Sample | None, config: Config) -> list[str]:
    """Return the line on faces of voxels of the configured size that lie in a surface, if they do."""
    if sample is None or not sample.pairs or _is_made(config):
        return []
    faces = Coverage(sample).faces(config.voxel_size)
    return [] if faces is None else [str(faces)]


def _is_made(config: Config) -> bool:
    """Return whether the scenes are simulated, also where models predict on their images."""
    dataset = config.dataset
    return (dataset.options["dataset"]["name"] if dataset.name == PREDICTED else dataset.name) == MADE


def _coverage(config: Config, scene: Scene) -> Covers | None:
    """Return the overlap of a scene's frames, or None if they cannot be read."""
    models = models_of(scene, config)
    with contextlib.suppress(DataError):
        indices = frame_indices(scene, config, models)
        if scene.of_scans:
            return scans if (scans := quick_sample_of_scans(scene, indices)).pairs else None
        inspection = Inspection(scene, indices, None, clusters(len(indices), CLUSTERS), POINTS, passing_over=True)
        return Coverage(inspection.sample(config.dataset.options)) if len(inspection.views) > 1 else None
    return None
