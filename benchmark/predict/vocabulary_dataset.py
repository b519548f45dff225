"""A dataset whose features get labels from vocabularies: a model NET with vocabulary V is the label source NET@V."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, Field, field_validator

from semstab.config import DatasetConfig, Settings
from semstab.core.types import Float64
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets import Dataset, Filtering, Scene, open_dataset, resolved
from semstab.datasets.relabelled import RelabelledScene
from semstab.errors import ConfigError
from semstab.predict.vocabulary import Vocabulary, vocabularies_by_name

NAME = "vocabularies"


class VocabularyOptions(Settings):
    """The dataset whose models give features, and vocabularies over these."""

    title: ClassVar[str] = NAME
    dataset: DatasetConfig = Field(description="a dataset with its options")
    vocabularies: list[Path] = Field(
        min_length=1, description="files of vocabularies, with changes (docs/open-vocabulary.md)"
    )

    @field_validator("dataset")
    @classmethod
    def _with_every_option(cls, value: DatasetConfig) -> DatasetConfig:
        return resolved(value)

    @field_validator("vocabularies")
    @classmethod
    def _from_the_root(cls, value: list[Path]) -> list[Path]:
        return [path.expanduser().absolute() for path in value]


class VocabularyDataset(Dataset):
    """The scenes of another dataset, with a label source for each model that gives features and each vocabulary."""

    Options: type[BaseModel] = VocabularyOptions

    def __init__(self, options: VocabularyOptions) -> None:
        self._dataset = open_dataset(options.dataset.name, options.dataset.options)
        self._vocabularies = vocabularies_by_name(options.vocabularies)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def scene(self, name: str) -> VocabularyScene:
        """Open a scene; raises what the inner dataset raises, and ConfigError if no model gives features."""
        self._dataset.run_folder = self.run_folder
        return VocabularyScene(self._dataset.scene(name), self._vocabularies)


class VocabularyScene(RelabelledScene):
    """A scene of another dataset, with labels of vocabularies; a model's features are read or predicted once.

    Raises:
        ConfigError: If no model gives features.
    """

    def __init__(self, inner: Scene, vocabularies: Mapping[str, Vocabulary]) -> None:
        super().__init__(inner)
        self._sources = {
            f"{model}@{name}": (model, vocabulary)
            for model in inner.with_features
            for name, vocabulary in vocabularies.items()
            if vocabulary.is_for(model)
        }
        if not self._sources:
            raise ConfigError(
                f"{inner.name}: a vocabulary needs features, and no model gives some; put them into"
                " features/MODEL/NAME.npy, or let --predict FILE.py:NAME give them (docs/open-vocabulary.md)"
            )
        self.models = (*inner.models, *self._sources)

    def _base(self, model: str) -> str:
        """Return the label source of the scene below that a source is of."""
        return self._sources[model][0] if model in self._sources else model

    def label_space(self, model: str) -> LabelSpace:
        """Return the names of a vocabulary, or the classes of a model of the scene below."""
        return self._sources[model][1].space if model in self._sources else self._inner.label_space(model)

    def distances(self, model: str) -> Float64 | None:
        """Return the distances (K, K) between names by their embeddings."""
        return self._sources[model][1].distances if model in self._sources else self._inner.distances(model)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return a frame with the labels of a vocabulary in place of its features, or with those of a model."""
        frame = self._inner.frame(index, self._base(model), color=color)
        if model not in self._sources:
            return frame
        assert frame.features is not None
        labels = self._sources[model][1].frame_labels(frame.features, frame.shape, frame.where("features"))
        return dataclasses.replace(frame, labels=labels, scores=None, features=None)

    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of the content behind those frames, the vocabulary included."""
        below = self._inner.digest(indices, self._base(model))
        if model not in self._sources:
            return below
        return hashlib.blake2b(f"{below}-{self._sources[model][1].digest}".encode(), digest_size=16).hexdigest()

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame."""
        return self._inner.missing(index, [*dict.fromkeys(map(self._base, sources))], color=color)

    def reading(self, indices: Sequence[int], model: str) -> contextlib.AbstractContextManager[None]:
        """Return a block in which these frames are going to be read."""
        return self._inner.reading(indices, self._base(model))

    def filtering(self, model: str) -> Filtering:
        """Return what was done to a label source before it is read."""
        return Filtering(model) if model in self._sources else self._inner.filtering(model)

    def prediction_seconds(self, index: int, model: str) -> float:
        """Return the seconds that a network took on a frame; NaN of a vocabulary, over features that are there."""
        return math.nan if model in self._sources else self._inner.prediction_seconds(index, model)
