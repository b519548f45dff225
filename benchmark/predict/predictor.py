"""A model as a user asks for it: its options, the name of its predictions, the taxonomy they are given in."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, Field, field_validator, model_validator

from semstab.config import Settings, validated
from semstab.core.code import absolute
from semstab.core.files import parse_yaml
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace, ignore_id
from semstab.datasets import Scene
from semstab.datasets.geometry.lenses import Scores, require_same_view
from semstab.errors import ConfigError
from semstab.models import Image, Labels, Model, Prediction, create, narrowed, options_model
from semstab.models.custom import is_path
from semstab.models.names import InTaxonomy
from semstab.models.network import is_network
from semstab.models.validation import Checked
from semstab.predict.filters import Filtered, parse
from semstab.predict.folder import NO_FOLDER_NAME, names_a_folder

# Labels that a scene has already, as a model: what filters take where nothing is to be predicted.

NAME = "stored"

NEAR = 4
"""Frames that are in memory: each is asked for its image, its geometry and its labels."""


class StoredOptions(Settings):
    """The settings that name stored labels."""

    source: str = Field(min_length=1, description="a label source of the scene: a folder of labels/, NAME-scores, ...")


class Stored(Model):
    """A model that gives the scene's own labels or scores of each frame; `StoredSequence` shows it its images.

    gives_scores is that of the scene's first frame that has such labels.

    Raises:
        ConfigError: If there are none.
    """

    Options = StoredOptions
    wants_geometry = True

    def __init__(self, options: StoredOptions, sequence: StoredSequence | None = None) -> None:
        if sequence is None:
            raise ConfigError(f"model '{NAME}' takes the labels of a scene; choose one with --data or --dataset")
        self.label_space = sequence.scene.label_space(options.source)
        self.gives_scores = sequence.has_scores
        self._source = options.source

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`."""
        return [Prediction(self._labels(frame), shares(frame) if scores else None) for frame in geometry]

    def _labels(self, frame: Frame) -> Labels:
        """Return the class ids; of scores the likeliest class's."""
        if frame.labels is not None:
            return frame.labels
        assert self.label_space is not None
        ids = narrowed(np.array(self.label_space.ids), max(self.label_space.ids) + 1)
        ignored = frame.predicted == frame.ignore_id
        labels: Labels = ids[np.where(ignored, 0, frame.predicted)]
        labels[ignored] = ignore_id(labels)
        return labels

    def identity(self) -> dict[str, Any]:
        """Return the source of the labels; their content is in the digest of each frame."""
        assert self.label_space is not None
        return {NAME: self._source, "classes": self.label_space.to_dict()}


class StoredSequence:
    """A scene's frames at the pixels of the depth, with labels of one source; colour is read on demand."""

    labels_like_depth = True

    def __init__(self, scene: Scene, source: str, color: bool) -> None:
        if source not in (*scene.models, *scene.by_name):
            names = ", ".join(scene.models) or "none"
            raise ConfigError(f"{scene.name}: there are no labels '{source}' for filters to take; there is {names}")
        self.scene, self.source, self.name, self._color = scene, source, scene.name, color
        self._frame = functools.lru_cache(maxsize=NEAR)(partial(scene.frame, model=source, color=False))

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def has_scores(self) -> bool:
        """Return whether the first frame that has these labels has scores."""
        first = next((index for index in range(len(self)) if not self.missing(index)), 0)
        return self.scene.frame(first, self.source, color=False).scores is not None

    def image(self, index: int) -> Image:
        """Return (H, W, 3) uint8 RGB at the depth's pixels; black where nobody looks at it."""
        import cv2

        if not self._color:
            return np.zeros((*self._frame(index).shape, 3), dtype=np.uint8)
        image, shape = self.scene.color(index), self._frame(index).shape
        if image is None:
            raise ConfigError(f"{self.name}, {self.image_name(index)}: has no colour, which a filter looks at")
        require_same_view(
            image.shape, shape, f"{self.name}, {self.image_name(index)}", "the image is {} but depth is {}"
        )
        if image.shape[:2] == shape:
            return image
        return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def image_name(self, index: int) -> str:
        """Return the name of the frame's files."""
        return self.scene.image_name(index)

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame, its labels among them."""
        return self.scene.missing(index, [*sources, self.source], color=self._color)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with other labels or scores."""
        return dataclasses.replace(self._frame(index), labels=labels, scores=scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return the frame, with its labels."""
        return self._frame(index)


def shares(frame: Frame) -> Any:
    """Return scores (H, W, K) float32 that sum to 1 where they can be used, else to 0; None of labels."""
    if frame.scores is None:
        return None
    labelled = (frame.predicted != ignore_id(frame.predicted))[..., None]
    scores = np.where(labelled, frame.scores, 0).astype(np.float32)
    return np.divide(scores, scores.sum(axis=2, keepdims=True), out=scores, where=labelled)


class PredictorConfig(Settings):
    """The settings that name a model, and say how its predictions are called and given."""

    model: str = Field(description="a name from `semstab-bench list`; or FILE.py:NAME, net.onnx")
    name: str | None = Field(None, description="the name of its predictions; the model's by default")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that model")
    scores: bool = Field(False, description="soft scores, not labels alone")
    taxonomy: str | None = Field(None, description="give labels in this taxonomy; the model's own classes by default")
    mapping: Literal["strict", "lenient"] = Field(
        "strict",
        description="which of the model's classes count as a class of the taxonomy: certain ones, or near ones",
    )
    filters: list[str] = Field(
        default_factory=list, description="filters that steady its labels, in this order: ema:0.6, vote:5, ... (`list`)"
    )

    @field_validator("name")
    @classmethod
    def _names_a_folder(cls, value: str | None) -> str | None:
        if value is not None and not names_a_folder(value):
            raise ValueError(NO_FOLDER_NAME)
        return value

    @field_validator("filters")
    @classmethod
    def _filters_with_numbers(cls, value: list[str]) -> list[str]:
        return [str(parse(text)) for text in value]

    @model_validator(mode="after")
    def _mapping_needs_a_taxonomy(self) -> Self:
        if self.mapping == "lenient" and self.taxonomy is None:
            raise ValueError("mapping: lenient needs a taxonomy to map to")
        return self

    @property
    def label_name(self) -> str:
        """Return the name of its label maps."""
        if self.name is not None:
            return self.name
        stem = Path(self.model).stem if is_network(self.model) else self.model.rpartition(":")[2]
        if self.model == NAME:
            source = str(self.options.get("source", stem))
            stem = source.removesuffix("-scores") if self.scores else source
        return "-".join([stem, *(text.replace(":", "-") for text in self.filters)])

    @property
    def source_name(self) -> str:
        """The label source that it is: as in folders, one that gives scores is 'NAME-scores'."""
        return f"{self.label_name}-scores" if self.scores else self.label_name

    @property
    def unfiltered(self) -> PredictorConfig:
        """The same without filters and without a name of its own."""
        return self.model_copy(update={"filters": [], "name": None})

    @property
    def wants_color(self) -> bool:
        """Return whether its filters look at images."""
        return any(parse(text).kind.wants_color for text in self.filters)

    @property
    def looks_at(self) -> dict[str, Any]:
        """Return the parts of a scene's frames that must be there, as `select_frames` takes them."""
        stored = self.model == NAME
        return {"sources": [self.options["source"]] if stored else [], "color": not stored or self.wants_color}

    def resolved(self) -> PredictorConfig:
        """Return the settings with every default of the model's options, and absolute paths.

        Raises ConfigError for an option that cannot be used, MissingDependencyError.
        """
        options = validated(options_model(self.model), self.options, f"model '{self.model}': ")
        network = is_network(self.model)
        model = str(Path(self.model).expanduser().absolute()) if network else absolute(self.model)
        full = {"model": model, "options": _absolute(options).model_dump(mode="json")}
        return self.model_copy(update=full)


def load_predictor(config: PredictorConfig) -> Model:
    """Return the model, in its taxonomy where one is named, behind its filters. Raises what `create` raises.

    Raises:
        ConfigError: If scores are wanted of a model that has none, or classes map nowhere.
    """
    return completed(config, create(config.model, **config.options))


def stored_labels(config: PredictorConfig, scene: Scene) -> tuple[StoredSequence, Model]:
    """Return the same of a scene's own labels, and the frames that it is shown.

    Raises:
        ConfigError: If there are none.
    """
    options = validated(StoredOptions, config.options, f"model '{config.model}': ")
    sequence = StoredSequence(scene, options.source, config.wants_color)
    return sequence, completed(config, Stored(options, sequence))


def completed(config: PredictorConfig, inner: Model) -> Model:
    """Return a model with all that is asked for around it.

    Raises:
        ConfigError: If classes map nowhere, and what `filtered` raises.
    """
    model: Model = Checked(inner, config.label_name)
    if config.taxonomy is not None:
        model = InTaxonomy(model, LabelSpace.load(config.taxonomy), config.mapping)
    return filtered(config, model)


def filtered(config: PredictorConfig, model: Model) -> Model:
    """Return a model of its taxonomy behind the filters that are asked for.

    Raises:
        ConfigError: If scores are wanted of a model that has none.
    """
    if config.filters:
        model = Filtered(model, [parse(text) for text in config.filters], config.unfiltered.label_name)
    if config.scores and not model.gives_scores:
        raise ConfigError(f"model '{config.unfiltered.label_name}' gives labels, no scores; leave scores out")
    return model


OWN = ("name", "scores", "taxonomy", "mapping", "filters")
"""Settings of a predictor, which are not its model's options."""


def parse_predictor(text: str, more: Mapping[str, Any] | None = None, filters: Sequence[str] = ()) -> PredictorConfig:
    """Parse 'segformer,checkpoint=FOLDER,taxonomy=uavid3': the model, then settings of the predictor or the model.

    `more` are options, and `filters` follow its own; both are set elsewhere.

    Raises:
        ConfigError: For anything else.
    """
    model, *settings = _parts(text)
    predictor_settings: dict[str, Any] = {}
    options: dict[str, Any] = {**(more or {})}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--predict {text}: write NAME,KEY=VALUE,...; '{setting}' has no '='")
        group = predictor_settings if key in OWN else options
        group[key] = parse_yaml(value, f"--predict {text}")
    predictor_settings["filters"] = [*predictor_settings.get("filters", ()), *filters]
    return validated(PredictorConfig, {"model": model, "options": options, **predictor_settings}, f"--predict {text}: ")


def parse_predictors(
    texts: Sequence[str], more: Mapping[str, Any] | None = None, filters: Sequence[str] = ()
) -> list[PredictorConfig]:
    """Parse several of them; those that would have one name are named after the settings in which they differ.

    net.py:net,scale=2.0 and net.py:net,scale=0.5 are 'net scale=2.0' and 'net scale=0.5'.

    Raises:
        ConfigError: As `parse_predictor`, and where two are the same.
    """
    parsed = [parse_predictor(text, more, filters) for text in texts]
    called: dict[str, list[int]] = {}
    for position, config in enumerate(parsed):
        called.setdefault(config.source_name, []).append(position)
    for same_named in (group for group in called.values() if len(group) > 1):
        by_themselves = [position for position in same_named if parsed[position].name is None]
        for position, more_name in zip(by_themselves, _differences([texts[p] for p in by_themselves]), strict=True):
            config = parsed[position]
            name = " ".join([config.label_name, *more_name])
            if not names_a_folder(name):
                raise ConfigError(f"--predict {texts[position]}: has the name of another one; give it one: name=NAME")
            parsed[position] = config.model_copy(update={"name": name})
    names = [config.source_name for config in parsed]
    for name, text in zip(names, texts, strict=True):
        if names.count(name) > 1:
            raise ConfigError(f"--predict {text}: two models are called '{name}'; give one a name: name=NAME")
    return parsed


def _differences(texts: Sequence[str]) -> list[list[str]]:
    """Return of each text the settings that not all of them have, as KEY=VALUE; of different files also the file.

    A path is given by its last part where these differ, and characters that file systems do not take become '-'.
    """
    split = [_parts(text) for text in texts]
    files = [_stem(model) for model, *_ in split]
    settings = [dict(part.partition("=")[::2] for part in parts[1:]) for parts in split]
    keys = dict.fromkeys(key for of_text in settings for key in of_text if key != "name")
    varied = [key for key in keys if len({of_text.get(key) for of_text in settings}) > 1]
    printed = {key: _last_parts([of_text.get(key) for of_text in settings]) for key in varied}
    return [
        [*([file] if len(set(files)) > 1 else []), *(f"{key}={printed[key][k]}" for key in varied if key in of_text)]
        for k, (file, of_text) in enumerate(zip(files, settings, strict=True))
    ]


def _parts(text: str) -> list[str]:
    """Return what stands between commas, but for those of a list."""
    return re.split(r",(?![^\[{]*[\]}])", text)


def _stem(model: str) -> str:
    return Path(model.rpartition(":")[0] or model).stem


def _last_parts(values: Sequence[str | None]) -> list[str]:
    """Return values as a folder's name may hold them, paths by their last part where these tell them apart."""
    texts = ["" if value is None else value for value in values]
    last = [value.rstrip("/").rpartition("/")[2] for value in texts]
    chosen = last if len(set(last)) == len(set(texts)) else texts
    return [re.sub(r'[/\\:*?"<>|\x00-\x1f]+', "-", re.sub(r"\s*,\s*", "x", value.strip("[]{}"))) for value in chosen]


def _absolute(options: BaseModel) -> BaseModel:
    """Return paths, what names a file, and a model that is a folder, from the root of the file system."""
    paths: dict[str, Any] = {key: value.absolute() for key, value in options if isinstance(value, Path)}
    paths |= {key: str(Path(value).expanduser().absolute()) for key, value in options if is_path(value)}
    checkpoint = getattr(options, "checkpoint", None)
    if isinstance(checkpoint, str) and Path(checkpoint).expanduser().is_dir():
        paths["checkpoint"] = str(Path(checkpoint).expanduser().absolute())
    return options.model_copy(update=paths)
