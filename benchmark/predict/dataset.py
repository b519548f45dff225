"""A dataset whose labels models predict while it is fused: their maps go to disk, and are read as others are."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field, field_validator

from semstab.config import DatasetConfig, FrameSelection, Settings
from semstab.core.files import ScratchFolder
from semstab.core.types import UInt8
from semstab.data.features import Features
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets import GROUND_TRUTH, Dataset, Filtering, Scene, open_dataset, resolved
from semstab.datasets.geometry.lenses import require_same_view
from semstab.datasets.relabelled import RelabelledScene
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError, DataError
from semstab.models import Model, Prediction, create
from semstab.predict.filters import Filtered, parse
from semstab.predict.images import ImageSequence, first_images
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import PredictorConfig, completed, filtered, stored_labels
from semstab.predict.producer import Producer, Written

NAME = "predicted"

PREDICTIONS = "predictions"
"""Folder of the predicted maps in a run's folder."""


class PredictedOptions(Settings):
    """The dataset whose images are predicted on, and the models that predict."""

    title: ClassVar[str] = "predictions"
    dataset: DatasetConfig = Field(description="a dataset with its options")
    models: list[PredictorConfig] = Field(min_length=1, description="each predicts every frame")
    frames: FrameSelection = Field(
        FrameSelection(), description="frames that sequential models see, in order; by default the frames of the run"
    )
    scene_frames: dict[str, FrameSelection] = Field(
        default_factory=dict, description="frames of single scenes, instead of `frames`"
    )

    try_filters: list[str] = Field(
        default_factory=list, description="filters, each is put over each of the models, which also predict without"
    )
    folder: Path | None = Field(None, description="folder of the predicted maps; OUT/predictions by default")

    @field_validator("dataset")
    @classmethod
    def _with_every_option(cls, value: DatasetConfig) -> DatasetConfig:
        return resolved(value)

    @field_validator("try_filters")
    @classmethod
    def _filters_with_numbers(cls, value: list[str]) -> list[str]:
        return ["+".join(str(parse(text)) for text in chain.split("+")) for chain in value]

    @field_validator("models")
    @classmethod
    def _names_of_their_own(cls, value: list[PredictorConfig]) -> list[PredictorConfig]:
        names = [predictor.source_name for predictor in value]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two models are called '{repeated[0]}'; give one a name")
        models = dict[str, PredictorConfig]()
        for predictor in value:  # labels and scores of one name are of one model: they lie side by side
            of_labels = predictor.model_copy(update={"scores": False})
            if models.setdefault(predictor.label_name, of_labels) != of_labels:
                raise ValueError(f"two models are called '{predictor.label_name}'; give one a name")
        return [predictor.resolved() for predictor in value]


class PredictedDataset(Dataset):
    """The scenes of another dataset with predicted labels; the ground truth stays what it is there.

    Models are loaded when their classes are first asked for, once for all scenes. Maps are written into the option
    `folder`, else into the run's folder, else into a folder that goes with the dataset.
    """

    Options: type[BaseModel] = PredictedOptions

    def __init__(self, options: PredictedOptions) -> None:
        self._dataset = open_dataset(options.dataset.name, options.dataset.options)
        self.predictors: Mapping[str, PredictorConfig] = {
            predictor.source_name: predictor for predictor in _with_filters(options)
        }
        self._hidden: dict[str, PredictorConfig] = {}
        self._options = options
        self._loaded: dict[str, Model] = {}
        self._models: dict[str, Model] = {}
        self.lock = threading.RLock()

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def scene(self, name: str) -> PredictedScene:
        """Open a scene; raises what the inner dataset raises."""
        return PredictedScene(self._dataset.scene(name), self)

    @functools.cached_property
    def folder(self) -> Path:
        """The folder of the predicted maps: SCENE/labels/NAME and SCENE/scores/NAME."""
        if self._options.folder is not None:
            return self._options.folder
        if self.run_folder is not None:
            return self.run_folder / PREDICTIONS
        self._scratch = ScratchFolder()
        return self._scratch.path

    def predictor(self, source: str) -> PredictorConfig:
        """Return the settings of a label source.

        Raises:
            ConfigError: If no label source has this name.
        """
        if source not in {**self.predictors, **self._hidden}:
            raise ConfigError(f"model '{source}' does not predict here; there is {', '.join(self.predictors)}")
        return self.predictors.get(source) or self._hidden[source]

    def model(self, source: str) -> Model:
        """Return the model behind a label source, its filters included.

        Raises:
            ConfigError: If no label source has this name.
        """
        config = self.predictor(source)
        with self.lock:
            if source not in self._loaded:
                self._loaded[source] = completed(config, self._shared(config))
            return self._loaded[source]

    def _shared(self, config: PredictorConfig) -> Model:
        """Return the model itself, loaded once for all that is put around it, unless it remembers what it was shown."""
        settings = json.dumps([config.model, config.options], sort_keys=True)
        model = self._models.get(settings) or create(config.model, **config.options)
        if not getattr(model, "sequential", False):
            self._models[settings] = model
        return model

    def without_filters(self, source: str) -> str | None:
        """Return the source whose maps the filters of a source take, or None without filters, or for stored labels.

        It is one of the models, if one is the same without filters. Else it has a name of its own.
        """
        config = self.predictor(source)
        if not config.filters or config.model == STORED:
            return None
        unfiltered = config.unfiltered.model_copy(update={"scores": False})
        with self.lock:
            for name, other in {**self.predictors, **self._hidden}.items():
                if not other.filters and other.model_copy(update={"name": None, "scores": False}) == unfiltered:
                    return name
            hidden = unfiltered.model_copy(update={"name": f"{config.label_name}-unfiltered"})
            self._hidden[hidden.source_name] = hidden
        return hidden.source_name

    def wants_scores(self, label_name: str) -> bool:
        """Return whether the scores of that model are read, too: by the run, or by filters."""
        sources = [source for source, config in self.predictors.items() if config.label_name == label_name]
        if any(self.predictors[source].scores for source in sources):
            return True
        over = [base for source in self.predictors if (base := self.without_filters(source)) is not None]
        return any(self.predictor(base).label_name == label_name and self.model(base).gives_scores for base in over)

    def frames_of(self, scene: Scene, source: str) -> list[int]:
        """Return the frames that a sequential model is shown of a scene: selected ones that have what it looks at."""
        selection = self._options.scene_frames.get(scene.name, self._options.frames)
        return select_frames(scene, selection, **self.predictor(source).looks_at).indices


class PredictedScene(RelabelledScene):
    """One scene of another dataset, with predicted labels.

    A sequential model is shown the dataset's `frames` of the scene in order, whichever of them is asked for.
    """

    def __init__(self, inner: Scene, dataset: PredictedDataset) -> None:
        if inner.of_scans:
            raise DataError(
                f"{inner.name}: holds scans, and models and filters work on images; write the labels of a model's"
                " points into predictions/MODEL (docs/tutorials/scans.md)"
            )
        super().__init__(inner)
        self.models, self.replaced = tuple(dataset.predictors), inner.models
        self.further, self.regions, self.unread, self.label_paths = (), (), None, ()  # of labels that are not read
        self._dataset = dataset
        self._producers: dict[str, Producer] = {}
        self._digests: dict[int, bytes] = {}
        self.with_features = tuple(
            name for name, predictor in dataset.predictors.items()
            if predictor.model != STORED and not predictor.filters and dataset.model(name).gives_features
        )  # fmt: skip

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame; it needs its colour where a model is among the sources."""
        requirements = [self._dataset.predictors[source].looks_at for source in sources if source in self.models]
        stored = [*{source: None for requirement in requirements for source in requirement["sources"]}]
        truth = [source for source in sources if source == GROUND_TRUTH]
        return self._inner.missing(
            index, [*stored, *truth], color=color or any(requirement["color"] for requirement in requirements)
        )

    def filtering(self, model: str) -> Filtering:
        """Return what was done to a label source before it is read."""
        if model == GROUND_TRUTH:
            return Filtering(model)
        predictors, predictor = self._dataset.predictors, self._dataset.predictors[model]
        unfiltered_names = (
            name
            for name, other in predictors.items()
            if other.model_copy(update={"name": None}) == predictor.unfiltered
        )
        producer = self._producers.get(predictor.label_name)
        took = producer.model.seconds if producer is not None and isinstance(producer.model, Filtered) else []
        return Filtering(
            next(unfiltered_names, model), "+".join(predictor.filters), 1e3 * float(np.median(took)) if took else 0.0
        )

    def prediction_seconds(self, index: int, model: str) -> float:
        """Return the seconds that a model took to predict on a frame since they were last asked for; else NaN."""
        stored = model == GROUND_TRUTH or self._dataset.predictors[model].model == STORED
        return math.nan if stored else self._producer(model).seconds(index)

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes that the model predicts.

        Raises:
            ConfigError: For a model without classes.
        """
        if model == GROUND_TRUTH:
            return self._inner.label_space(GROUND_TRUTH)
        config = self._dataset.predictor(model)
        if config.model == STORED:
            space = self._producer(model).model.label_space
        else:
            space = self._dataset.model(model).label_space
        if space is None:
            raise ConfigError(f"model '{model}' finds regions without classes, which cannot be fused")
        return space

    def reading(self, indices: Sequence[int], model: str) -> contextlib.AbstractContextManager[None]:
        """Predict these frames ahead of the loop that reads them in the block."""
        return contextlib.nullcontext() if model == GROUND_TRUTH else self._producer(model).ahead(indices)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return the frame with the model's prediction on its image.

        Raises what the inner scene and the model raise.
        """
        if model == GROUND_TRUTH:
            return self._inner.frame(index, model, color=color)
        producer, scores = self._producer(model), self._dataset.predictor(model).scores
        prediction = producer.read(index, scores=scores)
        labels = None if scores else prediction.labels
        frame = producer.sequence.predicted(index, labels=labels, scores=prediction.scores)
        assert frame is not None
        color_image = self._inner.color(index) if color else None
        return dataclasses.replace(frame, color=color_image, features=self._features(frame, prediction))

    def _features(self, frame: Frame, prediction: Prediction) -> Features | None:
        """Return features that were predicted on an image with the view of the depth; None without any."""
        if prediction.features is None:
            return None
        if getattr(self._inner, "on_photographs", False):
            raise DataError(f"{self.name}: features on photographs with another camera than the depth are not read")
        require_same_view(prediction.labels.shape, frame.shape, frame.where("depth"), "the image is {} but depth is {}")
        return Features.over(prediction.features, frame.shape)

    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of the model, its settings, and the image, depth and pose of those frames.

        A sequential model's is of all frames that it is shown.

        Raises:
            ConfigError: For a frame that is not.
        """
        if model == GROUND_TRUTH:
            return self._inner.digest(indices, model)
        producer, config = self._producer(model), self._dataset.predictor(model)
        predicted_frames = producer.shown_for(indices) if producer.model.sequential else None
        about = [producer.model.identity(), config.scores, *([] if predicted_frames is None else [predicted_frames])]
        digest = hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16)
        if config.model == STORED:
            digest.update(self._inner.digest(predicted_frames or indices, config.options["source"]).encode())
            if not config.wants_color:
                return digest.hexdigest()
        for index in predicted_frames or indices:
            if index not in self._digests:
                image = self._inner.image(index)
                nothing = np.full(image.shape[:2], 255, dtype=np.uint8)
                self._digests[index] = _digest(image, self._inner.predicted(index, labels=nothing))
            digest.update(self._digests[index])
        return digest.hexdigest()

    def _producer(self, source: str) -> Producer:
        """Return the producer of a source's maps; labels and scores of one model have one."""
        config = self._dataset.predictor(source)
        with self._dataset.lock:
            if config.label_name not in self._producers:
                self._producers[config.label_name] = self._new_producer(source, config)
            return self._producers[config.label_name]

    def _new_producer(self, source: str, config: PredictorConfig) -> Producer:
        sequence: ImageSequence = self._inner
        model, before, unfiltered = None, None, self._dataset.without_filters(source)
        if config.model == STORED:
            sequence, model = stored_labels(config, self._inner)
        elif unfiltered is not None and not self._dataset.model(unfiltered).sequential:
            before = self._producer(unfiltered)
            model = filtered(config, Written(before))
        else:
            model = self._dataset.model(source)
            model = model.fit(first_images(self._inner, model.fit_frames))
        return Producer(
            sequence, model, self._dataset.folder / self.name, config.label_name,
            scores=self._dataset.wants_scores(config.label_name),
            frames=self._dataset.frames_of(self._inner, source) if model.sequential else None, before=before,
        )  # fmt: skip


def _with_filters(options: PredictedOptions) -> Iterator[PredictorConfig]:
    """Yield the models, each followed by itself behind each of the filters to try."""
    for predictor in options.models:
        yield predictor
        for chain in options.try_filters:
            filters = chain.split("+")
            name = (
                None if predictor.name is None else "-".join([predictor.name, *(f.replace(":", "-") for f in filters)])
            )
            yield predictor.model_copy(update={"filters": [*predictor.filters, *filters], "name": name})


def _digest(image: UInt8, frame: Frame) -> bytes:
    """Return the hash of all that a frame holds but its labels."""
    digest = hashlib.blake2b(repr((image.shape, frame.shape, frame.intrinsics)).encode(), digest_size=16)
    for array in (image, frame.depth, frame.T_wc):
        digest.update(np.ascontiguousarray(array).data)
    return digest.digest()
