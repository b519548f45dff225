"""A dataset whose features get labels from vocabularies: a model NET with vocabulary V is the label source NET@V."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, Field, field_validator

from semstab.config import DatasetConfig, Settings
from semstab.core.types import Float32, Float64, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets import Dataset, Filtering, Scene, open_dataset, resolved
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.errors import ConfigError
from semstab.predict.vocabulary import Vocabulary, named

NAME = "vocabularies"

TAKEN = (
    "name", "ground_truth", "further", "regions", "unread", "up", "georeference", "placed", "folder", "label_paths",
    "settings_file", "labels_like_depth", "surface", "depth_from", "sources", "on_photographs", "skips_incomplete",
    "images_elsewhere", "of_scans", "made", "posed", "replaced", "in_program", "usual",
)  # fmt: skip
"""Attributes that a scene takes from the scene below."""


class VocabularyOptions(Settings):
    """The dataset whose models give features, and vocabularies over these."""

    title: ClassVar[str] = NAME
    dataset: DatasetConfig = Field(description="a dataset with its options")
    vocabularies: list[Path] = Field(min_length=1, description="files of vocabularies (docs/open-vocabulary.md)")

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
        self._vocabularies = named(options.vocabularies)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def scene(self, name: str) -> VocabularyScene:
        """Open a scene; raises what the inner dataset raises, and ConfigError if no model gives features."""
        self._dataset.run_folder = self.run_folder
        return VocabularyScene(self._dataset.scene(name), self._vocabularies)


class VocabularyScene(Scene):
    """A scene of another dataset, with labels of vocabularies; a model's features are read or predicted once.

    Raises:
        ConfigError: If no model gives features.
    """

    def __init__(self, inner: Scene, vocabularies: Mapping[str, Vocabulary]) -> None:
        for name in TAKEN:
            setattr(self, name, getattr(inner, name))
        self._inner = inner
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
        self.with_features = inner.with_features
        self.models = (*inner.models, *self._sources)

    def _base(self, model: str) -> str:
        """Return the label source of the scene below that a source is of."""
        return self._sources[model][0] if model in self._sources else model

    def __len__(self) -> int:
        return len(self._inner)

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

    # --- All else is the inner scene's --------------------------------------------------------------------------------

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return the inner scene's."""
        return self._inner.fingerprints(index)

    @property
    def timestamps(self) -> Float64 | None:
        """Time stamps of the inner scene, if any."""
        return self._inner.timestamps

    def require_one_size(self, indices: Sequence[int]) -> None:
        """Raise DataError where depth images of these frames are of a size that the intrinsics are not for."""
        self._inner.require_one_size(indices)

    def tracked(self, index: int) -> bool:
        """Return whether the frame has a pose."""
        return self._inner.tracked(index)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which its files are read, by name of option."""
        return self._inner.settings

    @property
    def depth_scale(self) -> float | None:
        """Units of stored depth in a metre."""
        return self._inner.depth_scale

    def frame_name(self, index: int) -> str:
        """Return the inner scene's."""
        return self._inner.frame_name(index)

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels."""
        return self._inner.geometry(index, color=color)

    def depth(self, index: int) -> Float32:
        """Return depth (H, W) float32 in metres along the optical axis."""
        return self._inner.depth(index)

    def T_wc(self, index: int) -> Float64:
        """Return pose (4, 4) camera-to-world in metres."""
        return self._inner.T_wc(index)

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Return the intrinsics of the frame's depth image."""
        return self._inner.intrinsics(index, shape)

    def color(self, index: int) -> UInt8 | None:
        """Return the colour (H, W, 3) uint8 RGB, or None for a frame without colour."""
        return self._inner.color(index)

    def image(self, index: int) -> UInt8:
        """Return the image that models predict on."""
        return self._inner.image(index)

    def image_name(self, index: int) -> str:
        """Return the name of the frame's files."""
        return self._inner.image_name(index)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with what was predicted on its image."""
        return self._inner.predicted(index, labels=labels, scores=scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return depth and pose at the pixels of the colour image, of shape (H, W)."""
        return self._inner.view(index, shape)
