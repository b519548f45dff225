"""Load the configuration of a run or a study: a file, options over it, and the defaults of its dataset below it."""

from __future__ import annotations

import contextlib
import importlib.resources
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from semstab.config import Config, DatasetConfig, merge, nearest, read_yaml, validated
from semstab.config.groups import in_full
from semstab.core.code import only_named, require_named
from semstab.datasets import GROUND_TRUTH, open_dataset, resolved
from semstab.errors import ConfigError
from semstab.predict.dataset import NAME as PREDICTED
from semstab.predict.filters import parse
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import PredictorConfig, StoredSequence
from semstab.predict.vocabulary import vocabularies_by_name
from semstab.predict.vocabulary_dataset import NAME as VOCABULARIES


def load_config(
    settings: str | Path | Mapping[str, Any] | None = None, overrides: Mapping[str, Any] | None = None
) -> Config:
    """Return the configuration of a file, or of settings by name, over the defaults in configs/datasets/.

    Args:
        settings: A YAML file, or settings by name; the built-in defaults by default.
        overrides: Settings that come last.

    Raises:
        ConfigError: If a setting cannot be used.

    Examples:
        >>> semstab.load_config({"voxel_size": 0.5}, {"voxel_size": 0.25}).voxel_size
        0.25
    """
    base = settings if isinstance(settings, Mapping) else _of_file(settings)
    content = _over(base, overrides or {})
    where = "configuration" if settings is None or isinstance(settings, Mapping) else str(settings)
    return Config.build(merge(dataset_defaults(content), content), where)


@contextlib.contextmanager
def settings_of_folder(run: Path, code: Collection[str] = ()) -> Iterator[Config]:
    """Yield the configuration in a run's folder; code that it names is refused, but for what the user names as `code`.

    Raises:
        ConfigError: If a setting cannot be used; in the block also where code that is not named would start.
    """
    file = run / "config.yaml"
    with only_named(file, code):
        yield load_config(file)


def require_named_code(run: Path) -> None:
    """Require, within `settings_of_folder`, that the user named all code that the settings name; imports nothing.

    Raises:
        ConfigError: With the first field whose code the user did not name.
    """
    for field, name in _named_in(read_yaml(run / "config.yaml")):
        require_named(name, field)


CODE_KEYS = ("model", "code", "rule")
"""Settings that may name code."""


def _named_in(content: Any, field: str = "") -> Iterator[tuple[str, str]]:
    """Yield each field of settings that may name code, and its name."""
    items: Any = enumerate(content) if isinstance(content, list) else getattr(content, "items", tuple)()
    for key, value in items:
        field_path = f"{field}.{key}" if field else str(key)
        of_backends = field_path in ("backends", "check") or (field == "backends" and isinstance(content, list))
        of_dataset = re.search(r"(^|\.)dataset(\.name)?$", field_path) is not None
        if isinstance(value, str) and (of_backends or of_dataset or key in CODE_KEYS):
            yield field_path, value
        yield from _named_in(value, field_path)


def as_config(settings: Config | Mapping[str, Any] | str | Path) -> Config:
    """Return a configuration, as it is or made by `load_config` from a file or a dict."""
    return settings if isinstance(settings, Config) else load_config(settings)


def load_study(study: str | Path, overrides: Mapping[str, Any] | None = None) -> Config:
    """Return the configuration of a study's file, or of a shipped study by its name.

    Its name is the file's, and only backends that it names check it.

    Args:
        study: A YAML file, or the name of a study that ships.
        overrides: Settings that come last.

    Raises:
        ConfigError: For an unknown study.

    Examples:
        >>> semstab.load_study("paper").models
        ['sim-steady', 'sim-flicker', 'sim-soft']
    """
    path = _shipped("studies") / f"{study}.yaml" if str(study) in shipped_studies() else Path(study)
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(
            f"'{study}' is neither a study that ships nor a .yaml file; {nearest(str(study), shipped_studies())}"
        )
    content = _over(read_yaml(path), overrides or {})
    defaults = {"name": path.stem, "check": None}
    return Config.build(merge(merge(dataset_defaults(content), defaults), content), str(path))


def shipped_studies() -> tuple[str, ...]:
    """Return the names of the studies that ship with semstab."""
    return tuple(sorted(path.stem for path in _shipped("studies").glob("*.yaml")))


def shipped_benchmarks() -> dict[str, Path]:
    """Return the definitions of the benchmarks that ship, by NAME@VERSION, the versions of a name in order."""
    files = {path.stem: path for path in _shipped("benchmarks").glob("*.yaml")}
    order = sorted(files, key=lambda name: (name.partition("@")[0], int(name.partition("@")[2])))
    return {name: files[name] for name in order}


def dataset_defaults(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that ship for the dataset which the content names, or for the built-in one."""
    dataset = content.get("dataset")
    name = dataset.get("name") if isinstance(dataset, Mapping) else dataset
    files = {path.stem: path for path in _shipped("datasets").glob("*.yaml")}
    return read_yaml(files[key]) if (key := str(name or "city")) in files else {}


def predicted_config(
    predictors: Sequence[PredictorConfig], path: str | Path | None, overrides: Mapping[str, Any]
) -> Config:
    """Return the configuration of a file with overrides on top, its dataset's labels replaced by predictions.

    Without a list of models in `overrides` all predictors are used.
    """
    content = _over(_of_file(path), overrides)
    inner = content.pop("dataset", {"name": "city"})
    content["models"] = overrides.get("models")
    content["dataset"] = {
        "name": PREDICTED,
        "options": {"dataset": inner, "models": [predictor.model_dump(mode="json") for predictor in predictors]},
    }
    return load_config(None, content)


def filtered_config(filters: Sequence[str], path: str | Path | None, overrides: Mapping[str, Any]) -> Config:
    """Return the configuration of a file with overrides on top, filters over the label sources that it selects.

    Sources with scores give scores. Raises what opening the dataset raises.
    """
    config = resolve(load_config(path, overrides))
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    scene = dataset.scene((config.scenes or dataset.scenes)[0])
    names = config.models or [name for name in scene.models if name not in config.region_maps]
    predictors = []
    for name in names:
        if name != GROUND_TRUTH:
            scores = StoredSequence(scene, name, False).has_scores
            stored = {"model": STORED, "options": {"source": name}, "scores": scores, "filters": filters}
            if scores and name.removesuffix("-scores") in names:  # next to the labels of this name
                stored["name"] = "-".join([name, *(str(parse(text)).replace(":", "-") for text in filters)])
            predictors.append(validated(PredictorConfig, stored))
    content = merge(dataset_defaults({"dataset": config.dataset.model_dump()}), _over(_of_file(path), overrides))
    selected = [*(predictor.source_name for predictor in predictors), *(name for name in names if name == GROUND_TRUTH)]
    return predicted_config(predictors, None, {**content, "models": selected})


def resolve(config: Config) -> Config:
    """Return the configuration with every default of its dataset's options filled in, paths absolute.

    Sequential models that predict in a run are shown the frames that it selects.
    """
    return config.model_copy(update={"dataset": resolved(_shown_frames(config, config.dataset))})


def _shown_frames(config: Config, dataset: DatasetConfig) -> DatasetConfig:
    """Return a dataset whose sequential models are shown the frames of the configuration."""
    more: dict[str, Any] = {}
    if dataset.name == PREDICTED:
        more = config.model_dump(mode="json", include={"frames", "scene_frames"})
    if dataset.name == VOCABULARIES:
        inner = validated(DatasetConfig, dataset.options["dataset"])
        more = {"dataset": _shown_frames(config, inner).model_dump(mode="json")}
    return dataset.model_copy(update={"options": {**dataset.options, **more}})


def with_vocabularies(config: Config, files: Sequence[Path]) -> Config:
    """Return the configuration with labels that vocabularies give to the features of its models.

    Raises:
        ConfigError: If a file is no vocabulary.
    """
    vocabularies = vocabularies_by_name(files)
    options = {"dataset": config.dataset.model_dump(mode="json"), "vocabularies": [str(file) for file in files]}
    models = config.models
    if models is not None:
        over = [
            (model, name) for model in models for name, vocabulary in vocabularies.items() if vocabulary.is_for(model)
        ]
        models = [*models, *(f"{model}@{name}" for model, name in over if model != GROUND_TRUTH)]
    dataset = DatasetConfig(name=VOCABULARIES, options=options)
    return config.model_copy(update={"dataset": dataset, "models": models})


def _of_file(path: str | Path | None) -> dict[str, Any]:
    return {} if path is None else read_yaml(path)


def _over(content: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return overrides on top of a file, short forms written out.

    Empty `scene_frames` clear the file's. Another dataset than the file's has none of the options in the file.
    """
    long = [dict(content), dict(overrides)]
    for settings in long:
        if isinstance(dataset := settings.get("dataset"), str):
            settings["dataset"] = {"name": dataset}
        if "frames" in settings:
            settings["frames"] = in_full(settings["frames"])
    below, above = (settings.get("dataset") for settings in long)
    if isinstance(below, Mapping) and isinstance(above, Mapping) and above.get("name") not in (None, below.get("name")):
        long[0]["dataset"] = {key: value for key, value in below.items() if key != "options"}
    return merge(*long) | ({"scene_frames": {}} if overrides.get("scene_frames") == {} else {})


def _shipped(kind: str) -> Path:
    return Path(str(importlib.resources.files("semstab.configs") / kind))
