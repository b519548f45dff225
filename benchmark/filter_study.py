"""Build the study of filters that make a model more stable: the shipped grid of filters over any model and scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from semstab.check import with_voxel_size
from semstab.config import Config, merge
from semstab.datasets import Scene
from semstab.models import create
from semstab.predict.filters import parse
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import PredictorConfig, StoredSequence
from semstab.settings import dataset_defaults, load_config, load_study, predicted_config, resolve
from semstab.task import open_scenes

STUDY = "filters"


def filter_study_config(
    models: Sequence[PredictorConfig],
    sources: Sequence[str],
    filters: Sequence[str],
    content: Mapping[str, Any],
) -> tuple[Config, list[str]]:
    """Return the study `filters` with these models, and filters over the scenes' label sources, as dataset settings.

    Without models or sources all sources are taken; without filters those of the shipped study, with its map prior in
    voxels of the run. Also returns a note on the filters that are
    left out because a model gives no scores.

    Raises:
        ConfigError: For an unknown name.
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
    grid = [_in_voxels(text, config.voxel_size) for text in filters or shipped]
    able, left_out = _able(grid, predictors, scene)
    settings = {**content, "voxel_size": config.voxel_size, "frame_quality": True, "check": None, "name": STUDY}
    study = predicted_config(predictors, None, {**settings, "models": None})
    dataset_config = study.dataset.model_copy(update={"options": {**study.dataset.options, "try_filters": able}})
    return study.model_copy(update={"dataset": dataset_config}), left_out


def _in_voxels(chain: str, size: float) -> str:
    """Return a chain with the numbers of its filters; the map prior has the run's voxel size by default."""
    texts = (f"map-prior:{size:g}" if text == "map-prior" else text for text in chain.split("+"))
    return "+".join(str(parse(text)) for text in texts)


def _able(grid: Sequence[str], predictors: Sequence[PredictorConfig], scene: Scene) -> tuple[list[str], list[str]]:
    """Return the filters that all models can use, and a note on the others."""
    needing = [text for text in grid if parse(text.partition("+")[0]).kind.needs_scores]
    without = [each.label_name for each in predictors if needing and not _gives_scores(each, scene)]
    if not without:
        return list(grid), []
    note = f"{', '.join(needing)}: left out, because {', '.join(without)} gives labels without scores"
    return [text for text in grid if text not in needing], [note]


def _gives_scores(predictor: PredictorConfig, scene: Scene) -> bool:
    if predictor.model == STORED:
        return StoredSequence(scene, predictor.options["source"], False).has_scores
    return create(predictor.model, **predictor.resolved().options).gives_scores
