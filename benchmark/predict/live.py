"""A dataset whose labels a model predicts when they are asked for: model to voxels with nothing on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field, field_validator

from semstab.backbones import Backbone, Prediction
from semstab.config import Config, DatasetConfig, Settings, merge, read_yaml
from semstab.datasets import GROUND_TRUTH, Timed, Tracked
from semstab.errors import ConfigError
from semstab.frames import Frame
from semstab.labels import LabelSpace
from semstab.predict.predictor import PredictorConfig, load_predictor
from semstab.predict.sources import ImageScene, open_images
from semstab.settings import load_config, resolve

NAME = "predicted"

KEPT_BYTES = 1 << 28
"""Memory for predictions that are kept in case a frame is asked for again; what does not fit is predicted again."""


class PredictedOptions(Settings):
    """The dataset whose images are predicted on, and who predicts."""

    dataset: DatasetConfig = Field(description="a dataset with its options")
    backbones: list[PredictorConfig] = Field(min_length=1, description="each predicts every frame")

    @field_validator("dataset")
    @classmethod
    def _with_every_option(cls, value: DatasetConfig) -> DatasetConfig:
        return resolve(Config(dataset=value)).dataset

    @field_validator("backbones")
    @classmethod
    def _names_of_their_own(cls, value: list[PredictorConfig]) -> list[PredictorConfig]:
        names = [source_name(predictor) for predictor in value]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two backbones are called '{repeated[0]}'; give one a name")
        return [predictor.resolved() for predictor in value]


def source_name(predictor: PredictorConfig) -> str:
    """The label source that a predictor is: as in folders, one that gives scores is 'NAME-scores'."""
    return f"{predictor.label_name}-scores" if predictor.scores else predictor.label_name


class PredictedDataset:
    """The scenes of another dataset with predicted labels; the ground truth stays what it is there.

    Models are loaded when their classes are first asked for, once for all scenes.
    """

    Options: type[BaseModel] = PredictedOptions

    def __init__(self, options: PredictedOptions) -> None:
        self._dataset = open_images(options.dataset)
        self._configs = {source_name(predictor): predictor for predictor in options.backbones}
        self._loaded: dict[str, Backbone] = {}
        self._lock = threading.Lock()

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def scene(self, name: str) -> PredictedScene:
        """Open one; raises what the inner dataset raises."""
        return PredictedScene(self._dataset.images(name), self)

    @property
    def predictors(self) -> Mapping[str, PredictorConfig]:
        """By label source."""
        return self._configs

    def model(self, source: str) -> Backbone:
        """The model behind a label source. Raises ConfigError where there is none of that name."""
        if source not in self._configs:
            raise ConfigError(f"backbone '{source}' does not predict here; there is {', '.join(self._configs)}")
        with self._lock:
            if source not in self._loaded:
                self._loaded[source] = load_predictor(self._configs[source])
            return self._loaded[source]


class PredictedScene:
    """One scene; see `semstab.datasets.Scene`. One image is predicted at a time, whoever asks."""

    def __init__(self, images: ImageScene, dataset: PredictedDataset) -> None:
        self.name = images.name
        self.backbones: tuple[str, ...] = tuple(dataset.predictors)
        self.ground_truth = images.ground_truth
        self.up = images.up
        self._images = images
        self._dataset = dataset
        self._fitted: dict[str, Backbone] = {}
        self._digests: dict[int, bytes] = {}
        self._kept: dict[tuple[str, int], Prediction] = {}
        self._room = KEPT_BYTES
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._images)

    @property
    def timestamps(self) -> npt.NDArray[np.float64] | None:
        """The inner scene's, where it has any."""
        scene = self._images.scene()
        return scene.timestamps if isinstance(scene, Timed) else None

    def tracked(self, index: int) -> bool:
        """Whether the frame has a pose."""
        scene = self._images.scene()
        return scene.tracked(index) if isinstance(scene, Tracked) else True

    def label_space(self, backbone: str) -> LabelSpace:
        """The classes that the model predicts. Raises ConfigError for a model without classes."""
        if backbone == GROUND_TRUTH:
            space: LabelSpace | None = self._images.scene().label_space(GROUND_TRUTH)
        else:
            space = self._dataset.model(backbone).label_space
        if space is None:
            raise ConfigError(f"backbone '{backbone}' finds regions without classes, which cannot be fused")
        return space

    def frame(self, index: int, backbone: str, *, color: bool = True) -> Frame:
        """The frame with what the model says about its image. Raises what the inner scene and the model raise."""
        if backbone == GROUND_TRUTH:
            return self._images.scene().frame(index, backbone, color=color)
        image = self._images.image(index)
        prediction = self._predict(index, backbone, image)
        soft = prediction.scores is not None
        frame = self._images.predicted(
            index, **({"scores": prediction.scores} if soft else {"labels": prediction.labels})
        )
        self._digests[index] = _digest(image, frame)
        return dataclasses.replace(frame, color=image if color else None)

    def digest(self, indices: list[int], backbone: str) -> str:
        """A hash of the model, its settings, and the image, depth and pose of those frames."""
        if backbone == GROUND_TRUTH:
            return self._images.scene().digest(indices, backbone)
        with self._lock:
            identity = self._model(backbone).identity()
        scores = self._dataset.predictors[backbone].scores
        digest = hashlib.blake2b(json.dumps([identity, scores], sort_keys=True).encode(), digest_size=16)
        for index in indices:
            if index not in self._digests:
                image = self._images.image(index)
                nothing = np.full(image.shape[:2], 255, dtype=np.uint8)
                self._digests[index] = _digest(image, self._images.predicted(index, labels=nothing))
            digest.update(self._digests[index])
        return digest.hexdigest()

    def _predict(self, index: int, backbone: str, image: npt.NDArray[np.uint8]) -> Prediction:
        """What the model says about a frame's image; scores where they are wanted."""
        with self._lock:
            if (backbone, index) in self._kept:
                return self._kept[backbone, index]
            model = self._model(backbone)
            (prediction,) = model.predict([image], scores=self._dataset.predictors[backbone].scores)
            size = prediction.labels.nbytes + (0 if prediction.scores is None else prediction.scores.nbytes)
            if size <= self._room:
                self._kept[backbone, index] = prediction
                self._room -= size
            return prediction

    def _model(self, backbone: str) -> Backbone:
        """The model, fitted to this sequence's first images."""
        if backbone not in self._fitted:
            model = self._dataset.model(backbone)
            first = range(min(model.fit_frames, len(self)))
            self._fitted[backbone] = model.fit([self._images.image(k) for k in first])
        return self._fitted[backbone]


def predicted_config(
    predictors: Sequence[PredictorConfig], path: str | Path | None, overrides: Mapping[str, Any]
) -> Config:
    """The configuration of a file with overrides on top, its dataset's labels replaced by predictions.

    Without a list of backbones in `overrides` all predictors are used.
    """
    content = merge(read_yaml(path) if path is not None else {}, overrides)
    inner = content.pop("dataset", {"name": "city"})
    content["backbones"] = overrides.get("backbones")
    content["dataset"] = {
        "name": NAME,
        "options": {"dataset": inner, "backbones": [predictor.model_dump(mode="json") for predictor in predictors]},
    }
    return load_config(None, content)


def _digest(image: npt.NDArray[np.uint8], frame: Frame) -> bytes:
    """Of all that a frame holds but its labels."""
    digest = hashlib.blake2b(repr((image.shape, frame.shape, frame.intrinsics)).encode(), digest_size=16)
    for array in (image, frame.depth, frame.T_wc):
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()
