"""Build the study of filters that make a model more stable: the shipped grid of filters over any model and scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from semstab.check import with_voxel_size
from semstab.config import Config, merge
from semstab.configure import dataset_defaults, load_config, load_study, predicted_config, resolve
from semstab.core.arrays import evenly
from semstab.data.measures import mean
from semstab.datasets import Scene
from semstab.errors import ConfigError
from semstab.pixels.warp import density
from semstab.predict.filters import parse, too_sparse
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import PredictorConfig
from semstab.task import frame_indices, open_scenes

STUDY = "filters"

DENSITY_FRAMES = 8
"""Frames whose depth is looked at before filters are chosen."""


def filter_study_config(
    models: Sequence[PredictorConfig],
    sources: Sequence[str],
    filters: Sequence[str],
    content: Mapping[str, Any],
) -> tuple[Config, list[str]]:
    """Return the study `filters` with these models, and filters over the scenes' label sources, as dataset settings.

    Without models or sources all sources are taken; without filters those of the shipped study. Also returns notes on
    the shipped filters that warp, which are left out if depth is sparse.

    Raises:
        ConfigError: For an unknown name, and a filter that warps where depth is sparse.
        DataError: For a scene that cannot be read.
    """
    content = merge(dataset_defaults(content), content)
    config = resolve(load_config(None, {key: value for key, value in content.items() if key != "models"}))
    scenes = open_scenes(config)
    scene = next(iter(scenes.values()))
    names = sources or ([] if models else config.models or scene.models)
    predictors = [*models, *(PredictorConfig(model=STORED, options={"source": name}) for name in names)]
    config, _ = with_voxel_size(config, scenes)
    shipped = load_study(STUDY).dataset.options["try_filters"]
    grid = ["+".join(str(parse(text)) for text in chain.split("+")) for chain in filters or shipped]
    grid, left_out = _warpable(grid, scene, frame_indices(scene, config), requested=bool(filters))
    settings = {**content, "voxel_size": config.voxel_size, "frame_quality": True, "check": None, "name": STUDY}
    study = predicted_config(predictors, None, {**settings, "models": None})
    dataset_config = study.dataset.model_copy(update={"options": {**study.dataset.options, "try_filters": grid}})
    return study.model_copy(update={"dataset": dataset_config}), left_out


def _warpable(
    grid: Sequence[str], scene: Scene, frames: Sequence[int], *, requested: bool
) -> tuple[list[str], list[str]]:
    """Return the filters that the scene's depth allows, and a note on the others, which is an error if they are named.

    Raises:
        ConfigError: If they are.
    """
    warping = [text for text in grid if any(parse(part).kind.warps for part in text.split("+"))]
    if not warping:
        return list(grid), []
    densities = [density(scene.depth(frames[position])) for position in evenly(len(frames), DENSITY_FRAMES)]
    reason = too_sparse([parse(part) for text in warping for part in text.split("+")], mean(np.array(densities)))
    if reason is None:
        return list(grid), []
    if requested:
        raise ConfigError(f"{scene.name}: {reason}")
    return [text for text in grid if text not in warping], [f"{scene.name}: left out, because {reason}"]
