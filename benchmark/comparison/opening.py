"""Runs that are compared are opened: folders of runs, one label source of a folder, and small summaries."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from semstab.comparison.entries import Entry, RunHandle
from semstab.comparison.small_summary import load_summary
from semstab.config import nearest
from semstab.data.labels import sharing_classes
from semstab.data.records import Result
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import load_result, run_and_model
from semstab.errors import ConfigError


def open_compared(sources: Sequence[str | os.PathLike[str]]) -> tuple[RunHandle, ...]:
    """Open runs that are compared, or the models of one run; also such as have features and no labels.

    Raises:
        ConfigError: If there are fewer than two, and as `open_runs` does.
        DataError: As `open_runs` does.
    """
    handles = open_models(sources[0]) if len(sources) == 1 else open_runs(sources)
    if len(handles) < 2:
        raise ConfigError("there is nothing to compare the run with; name two runs or more, the base first")
    return handles


def open_runs(sources: Sequence[str | os.PathLike[str]]) -> tuple[RunHandle, ...]:
    """Open folders of runs or studies, 'FOLDER:MODEL', and small summaries, under the shortest distinct names.

    Raises:
        ConfigError, DataError: As `open_run` does.
    """
    runs = [open_run(source) for source in sources]
    folders = ["" if run.source is None else run.source.resolve().name for run in runs]
    models = [run.model for run in runs]
    folder_and_model = [f"{folder}:{model}" for folder, model in zip(folders, models, strict=True)]
    full_names = [f"{run.source}:{run.model}" for run in runs]
    names = next(
        (naming for naming in (models, folders, folder_and_model) if len({*naming}) == len({*full_names})), full_names
    )
    names = [run.model if run.source is None else name for name, run in zip(names, runs, strict=True)]
    in_memory = [name for name, run in zip(names, runs, strict=True) if run.source is None]
    if twice := next((name for name in in_memory if names.count(name) > 1), None):
        raise ConfigError(f"two results are named '{twice}'; give each a name: semstab.fuse(frames, model=NAME)")
    times = [names[: i + 1].count(name) for i, name in enumerate(names)]
    names = [name if nth == 1 else f"{name} ({nth})" for name, nth in zip(names, times, strict=True)]
    return tuple(replace(run, name=name) for run, name in zip(runs, names, strict=True))


def open_models(location: str | os.PathLike[str]) -> tuple[RunHandle, ...]:
    """Open all label sources of one run that have the classes that most of them have; ground truth is left out.

    Models that give features alone are left out, too, unless there are no others.

    Raises:
        ConfigError, DataError: As `open_run` does.
    """
    path, model_named = run_and_model(location)
    if model_named is not None or not path.is_dir():
        return (open_run(location),)
    return models_of(load_result(path), path if isinstance(location, str | Path) else None)


def models_of(result: Result, source: Path | None = None) -> tuple[RunHandle, ...]:
    """Return the label sources of a run that have the classes that most of them have, without the ground truth.

    Models that give features alone are left out, unless there are no others.
    """
    names = [model for model in result.models if model != GROUND_TRUTH]
    of_models = [handle_of(result, model, source) for model in names]
    handles = [handle for handle in of_models if not handle.features_alone] or of_models
    scenes = set.intersection(*({*handle.scenes} for handle in handles)) if handles else set()
    if not scenes:
        return tuple(handles)
    scene = min(scenes)
    shared = sharing_classes({handle.model: handle.scenes[scene].classes for handle in handles})
    return tuple(handle for handle in handles if handle.model in shared)


def open_run(location: str | os.PathLike[str]) -> RunHandle:
    """Open a run's only label source, or the one that 'FOLDER:MODEL' selects, at the base settings and backend.

    Raises:
        ConfigError: If there is no such folder or label source, or several.
        DataError: If it is damaged.
    """
    path, model_named = run_and_model(location)
    model = model_named or ""
    if not path.exists():
        raise ConfigError(f"{path}: there is no such folder; give the folder of a run, or FOLDER:MODEL")
    if path.is_file():
        small = load_summary(path)
        _chosen(path, [small.model], model)
        return small
    result = load_result(path)
    source = path if isinstance(location, str | Path) else None
    return handle_of(result, _chosen(path, result.models, model), source)


def handle_of(result: Result, model: str, source: Path | None = None) -> RunHandle:
    """Return one label source of a run, at the base settings and backend; `source` is its folder, if it has one."""
    seed = result.manifest.get("seed")
    scenes = {
        scene: Entry(
            record=record, georeference=result.georeference.get(scene), up=result.up.get(scene),
            seed=seed if isinstance(seed, int) else None, where=str(source or model),
        )
        for record in result.select(model=model)
        for scene in [record.unit.scene]
    }  # fmt: skip
    return RunHandle(model, source, model, scenes)


def _chosen(path: Path, models: Sequence[str], model: str) -> str:
    if model:
        if model not in models:
            raise ConfigError(f"{path}: no model '{model}'; {nearest(model, models)}")
        return model
    predicted = [name for name in models if name != GROUND_TRUTH] or list(models)
    if not predicted:
        raise ConfigError(f"{path}: it holds no finished unit")
    if len(predicted) > 1:
        listed = ", ".join(predicted[:4]) + (", ..." if len(predicted) > 4 else "")
        raise ConfigError(f"{path}: it holds several label sources ({listed}); name one: {path}:{predicted[0]}")
    return predicted[0]
