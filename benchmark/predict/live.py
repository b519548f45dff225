"""A dataset whose labels a model predicts when they are asked for: model to voxels with nothing on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field, field_validator

from semstab.config import DatasetConfig, FrameSelection, Settings
from semstab.core.types import Float64, UInt8
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets import GROUND_TRUTH, Dataset, Filtering, Scene, open_dataset, resolved
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError
from semstab.models import Image, Model, Prediction, ask, create
from semstab.predict.filters import Filtered, parse
from semstab.predict.images import ImageSequence, first_images, geometry_of
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import InOrder, PredictorConfig, StoredSequence, completed, size_of, stored_labels

NAME = "predicted"

CACHE_BYTES = 1 << 28
"""Memory for predictions that are cached in case a frame is asked for again; what does not fit is predicted again."""


class PredictedOptions(Settings):
    """The dataset whose images are predicted on, and the models that predict."""

    earlier: ClassVar[Mapping[str, str]] = {"backbones": "models", "remedies": "try_filters", "kept": "cache"}
    dataset: DatasetConfig = Field(description="a dataset with its options")
    models: list[PredictorConfig] = Field(min_length=1, description="each predicts every frame")
    frames: FrameSelection = Field(
        FrameSelection(), description="frames that sequential models are shown, in order; those of the run by default"
    )
    scene_frames: dict[str, FrameSelection] = Field(
        default_factory=dict, description="frames of single scenes, instead of `frames`"
    )

    try_filters: list[str] = Field(
        default_factory=list, description="filters, each is put over each of the models, which also predict without"
    )
    cache: Path | None = Field(None, description="folder in which predictions are cached; in memory by default")

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
        return [predictor.resolved() for predictor in value]


class PredictedDataset(Dataset):
    """The scenes of another dataset with predicted labels; the ground truth stays what it is there.

    Models are loaded when their classes are first asked for, once for all scenes. One image is predicted at a time,
    whoever asks: `lock`.
    """

    Options: type[BaseModel] = PredictedOptions

    def __init__(self, options: PredictedOptions) -> None:
        self._dataset = open_dataset(options.dataset.name, options.dataset.options)
        self._configs = {predictor.source_name: predictor for predictor in _with_filters(options)}
        self._options = options
        self._loaded: dict[str, Model] = {}
        self._models: dict[str, Model] = {}
        self._shown_by: dict[str, object] = {}
        self.lock = threading.RLock()

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def scene(self, name: str) -> PredictedScene:
        """Open a scene; raises what the inner dataset raises."""
        return PredictedScene(self._dataset.scene(name), self)

    @property
    def predictors(self) -> Mapping[str, PredictorConfig]:
        """The predictors by label source."""
        return self._configs

    def model(self, source: str) -> Model:
        """Return the model behind a label source.

        Raises:
            ConfigError: If there is none of that name.
        """
        if source not in self._configs:
            raise ConfigError(f"model '{source}' does not predict here; there is {', '.join(self._configs)}")
        with self.lock:
            if source not in self._loaded:
                config = self._configs[source]
                self._loaded[source] = completed(config, self._shared(config), self._options.cache)
            return self._loaded[source]

    def _shared(self, config: PredictorConfig) -> Model:
        """Return the model itself, loaded once for all that is put around it, unless it remembers what it was shown."""
        what = json.dumps([config.model, config.options], sort_keys=True)
        model = self._models.get(what) or create(config.model, **config.options)
        if not getattr(model, "sequential", False):
            self._models[what] = model
        return model

    def frames_of(self, scene: Scene, source: str) -> list[int]:
        """Return the frames that a sequential model is shown of a scene: selected ones that have what it looks at."""
        selection = self._options.scene_frames.get(scene.name, self._options.frames)
        return select_frames(scene, selection, **self._configs[source].looks_at).indices

    def claim(self, source: str, who: object) -> bool:
        """Return whether the model was last shown a sequence by somebody else; from now on it is `who` that shows."""
        before, self._shown_by[source] = self._shown_by.get(source), who
        return before is not who


class PredictedScene(Scene):
    """One scene of another dataset, with predicted labels.

    A sequential model is shown the dataset's `frames` of the scene in order, whichever of them is asked for.
    """

    def __init__(self, inner: Scene, dataset: PredictedDataset) -> None:
        self.name = inner.name
        self.models = tuple(dataset.predictors)
        self.ground_truth = inner.ground_truth
        self.up = inner.up
        self.georeference = inner.georeference
        self.placed = inner.placed
        self.surface = inner.surface
        self.depth_from = inner.depth_from
        self.sources = inner.sources
        self.folder = inner.folder
        self.settings_file = inner.settings_file
        self.skips_incomplete = inner.skips_incomplete
        self._inner = inner
        self._dataset = dataset
        self._fitted: dict[str, Model] = {}
        self._digests: dict[int, bytes] = {}
        self._cache: dict[tuple[str, int], Prediction] = {}
        self._room = CACHE_BYTES
        self._seconds: dict[tuple[str, int], float] = {}
        self._lock = dataset.lock
        self._in_order: dict[str, InOrder] = {}
        self._of_labels: dict[str, tuple[StoredSequence, Model]] = {}

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._inner)

    @property
    def timestamps(self) -> Float64 | None:
        """The inner scene's, where it has any."""
        return self._inner.timestamps

    def frame_name(self, index: int) -> str:
        """Return the inner scene's."""
        return self._inner.frame_name(index)

    def tracked(self, index: int) -> bool:
        """Return whether the frame has a pose."""
        return self._inner.tracked(index)

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame; it needs its colour where a model is among the sources."""
        wanted = [self._dataset.predictors[source].looks_at for source in sources if source in self.models]
        stored = [*{source: None for each in wanted for source in each["sources"]}]
        truth = [source for source in sources if source == GROUND_TRUTH]
        return self._inner.missing(index, [*stored, *truth], color=color or any(each["color"] for each in wanted))

    def filtering(self, model: str) -> Filtering:
        """Return what was done to a label source before it is read."""
        if model == GROUND_TRUTH:
            return Filtering(model)
        known, one = self._dataset.predictors, self._dataset.predictors[model]
        same = (name for name, other in known.items() if other.model_copy(update={"name": None}) == one.unfiltered)
        predictor = self._fitted.get(model)
        took = predictor.seconds if isinstance(predictor, Filtered) else []
        return Filtering(next(same, model), "+".join(one.filters), 1e3 * float(np.median(took)) if took else 0.0)

    def prediction_seconds(self, index: int, model: str) -> float:
        """Return the seconds that a model took to predict on a frame since they were last asked for; else NaN."""
        return math.nan if self._takes_stored(model) else self._seconds.pop((model, index), math.nan)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which its files are read, by name of option."""
        return self._inner.settings

    @property
    def depth_scale(self) -> float | None:
        """Units of stored depth in a metre."""
        return self._inner.depth_scale

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with what was predicted on its image."""
        return self._inner.predicted(index, labels=labels, scores=scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return depth and pose at the pixels of the colour image, of shape (H, W)."""
        return self._inner.view(index, shape)

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels; nothing is predicted for it."""
        return self._inner.geometry(index, color=color)

    def color(self, index: int) -> UInt8 | None:
        """Colour (H, W, 3) uint8 RGB, None where the frame has none."""
        return self._inner.color(index)

    def image_name(self, index: int) -> str:
        """Return the name of the frame's files."""
        return self._inner.image_name(index)

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes that the model predicts.

        Raises:
            ConfigError: For a model without classes.
        """
        if model == GROUND_TRUTH:
            space: LabelSpace | None = self._inner.label_space(GROUND_TRUTH)
        else:
            space = self._unfitted(model).label_space
        if space is None:
            raise ConfigError(f"model '{model}' finds regions without classes, which cannot be fused")
        return space

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return the frame with the model's prediction on its image.

        Raises what the inner scene and the model raise.
        """
        if model == GROUND_TRUTH:
            return self._inner.frame(index, model, color=color)
        sequence = self._sequence(model)
        image = sequence.image(index)
        prediction = self._predict(index, model, image)
        labels = prediction.labels if prediction.scores is None else None
        frame = sequence.predicted(index, labels=labels, scores=prediction.scores)
        assert frame is not None
        if sequence is self._inner:
            self._digests[index] = _digest(image, frame)
        else:
            image = self._inner.color(index) if color else image  # type: ignore[assignment]
        shown = self._inner.color(index) if color and self._inner.on_photographs else image
        return dataclasses.replace(frame, color=shown if color else None)

    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of the model, its settings, and the image, depth and pose of those frames.

        A sequential model's is of all frames that it is shown.

        Raises:
            ConfigError: For a frame that is not.
        """
        if model == GROUND_TRUTH:
            return self._inner.digest(indices, model)
        with self._lock:
            predictor = self._predictor(model)
            shown = self._ordered(model, predictor).shown_for(indices) if predictor.sequential else None
        config = self._dataset.predictors[model]
        about = [predictor.identity(), config.scores, *([] if shown is None else [shown])]
        digest = hashlib.blake2b(json.dumps(about, sort_keys=True).encode(), digest_size=16)
        if config.model == STORED:
            digest.update(self._inner.digest(shown or indices, config.options["source"]).encode())
            if not config.wants_color:
                return digest.hexdigest()
        for index in shown or indices:
            if index not in self._digests:
                image = self._inner.image(index)
                nothing = np.full(image.shape[:2], 255, dtype=np.uint8)
                self._digests[index] = _digest(image, self._inner.predicted(index, labels=nothing))
            digest.update(self._digests[index])
        return digest.hexdigest()

    def _predict(self, index: int, model: str, image: Image) -> Prediction:
        """Return the model's prediction on a frame, with scores where they are wanted."""
        with self._lock:
            predictor = self._predictor(model)
            if (model, index) in self._cache:
                return self._cache[model, index]
            started = time.perf_counter()
            if predictor.sequential:
                prediction = self._ordered(model, predictor).at(index)
                self._seconds[model, index] = time.perf_counter() - started
                return prediction
            geometry = geometry_of(self._sequence(model), index, image, predictor)
            scores = self._dataset.predictors[model].scores
            (prediction,) = ask(predictor, [image], scores=scores, geometry=geometry)
            self._seconds[model, index] = time.perf_counter() - started
            if (size := size_of(prediction)) <= self._room:
                self._cache[model, index] = prediction
                self._room -= size
            return prediction

    def _ordered(self, model: str, predictor: Model) -> InOrder:
        if model not in self._in_order:
            while len(self._in_order) > 1:  # the memory of the others takes space, and their turn is over
                over = next(iter(self._in_order))
                del self._in_order[over], self._fitted[over]
            scores = self._dataset.predictors[model].scores
            shown = self._dataset.frames_of(self._inner, model)
            self._in_order[model] = InOrder(
                predictor, self._sequence(model), shown, scores, partial(self._dataset.claim, model)
            )
        return self._in_order[model]

    def _predictor(self, model: str) -> Model:
        """Return the model, fitted to this sequence's first images."""
        if model not in self._fitted:
            predictor = self._unfitted(model)
            self._fitted[model] = predictor.fit(first_images(self._inner, predictor.fit_frames))
        return self._fitted[model]

    def _unfitted(self, model: str) -> Model:
        """Return the model as it is loaded; the scene's own labels are a model of this scene alone."""
        return self._stored(model)[1] if self._takes_stored(model) else self._dataset.model(model)

    def _sequence(self, model: str) -> ImageSequence:
        """Return the images that the model is shown."""
        return self._stored(model)[0] if self._takes_stored(model) else self._inner

    def _takes_stored(self, model: str) -> bool:
        config = self._dataset.predictors.get(model)
        return config is not None and config.model == STORED

    def _stored(self, model: str) -> tuple[StoredSequence, Model]:
        with self._lock:
            if model not in self._of_labels:
                self._of_labels[model] = stored_labels(self._dataset.predictors[model], self._inner)
            return self._of_labels[model]


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
