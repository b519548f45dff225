"""Vocabularies over features: the label of a cell is the name whose embedding its feature is most like."""

from __future__ import annotations

import functools
import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator, model_validator

from semstab.config import Settings, read_yaml, validated
from semstab.core.files import read_limited
from semstab.core.types import Float32, Float64, Int64, UInt8, UInt16
from semstab.data.features import Features
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.errors import ConfigError, DataError, MissingDependencyError, nearest
from semstab.predict.prompts import EACH, VocabularyChanges

MOST_BYTES = 1 << 28
"""The largest file of embeddings."""

CELLS = 1 << 22
"""Most cosines that are in memory at a time."""


class NameEntry(Settings):
    """A name with its synonyms, which count as one."""

    name: str = Field(min_length=1, description="the class")
    synonyms: list[str] = Field(default_factory=list, description="other words for it, with embeddings of their own")
    group: str = Field("", description="group of the class, from which distances follow: vehicle/two wheels")

    @property
    def words(self) -> tuple[str, ...]:
        """The name and its synonyms."""
        return (self.name, *self.synonyms)


class EncoderSettings(Settings):
    """A text encoder of transformers, as CLIP's."""

    checkpoint: str = Field(description="a folder that save_pretrained wrote, or an id on the Hugging Face hub")
    templates: list[str] = Field(["a photo of a {}."], min_length=1, description="sentences; {} stands for the name")

    @field_validator("templates")
    @classmethod
    def _templates_hold_a_name(cls, value: list[str]) -> list[str]:
        if lacking := [text for text in value if "{}" not in text]:
            raise ValueError(f"'{lacking[0]}' lacks {{}}, which stands for the name")
        return value


class VocabularySettings(Settings):
    """The content of a vocabulary's file."""

    name: str | None = Field(None, min_length=1, description="its name; by default the name of the file")
    names: list[NameEntry] = Field(description="names, or name, synonyms, group")
    embeddings: Path | None = Field(
        None, description=".npy (n, D): a row for each name and then for each of its synonyms, in order"
    )
    encoder: EncoderSettings | None = Field(None, description="a text encoder that makes the embeddings")
    normalise: bool = Field(True, description="bring embeddings to unit length; false for a classifier's weights")
    threshold: float | None = Field(None, description="cosine below which a cell has no label; none by default")
    models: list[str] | None = Field(None, description="models whose features it is for; all by default")

    @field_validator("names", mode="before")
    @classmethod
    def _plain_names(cls, value: Any) -> Any:
        return (
            [{"name": item} if isinstance(item, str) else item for item in value] if isinstance(value, list) else value
        )

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if len(self.names) < 2:
            raise ValueError(
                f"has {len(self.names)} name; at least 2 are needed, so that there is something to tell apart"
            )
        if (self.embeddings is None) == (self.encoder is None):
            raise ValueError("give embeddings or encoder, one of the two")
        return self


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Names with embeddings.

    Attributes:
        space: The names as classes; synonyms are their members.
        embeddings: (n, D) float32 of names and synonyms.
        of: (n,) the class of each of them.
        threshold: Product of embedding and feature below which a cell has no label; None for none.
        where: Its file, for messages.
        models: Models whose features it is for; None for all.
    """

    space: LabelSpace
    embeddings: Float32
    of: Int64
    threshold: float | None
    where: str
    models: tuple[str, ...] | None = None

    @classmethod
    def load(cls, path: Path) -> Vocabulary:
        """Read a vocabulary's file; raises what `VocabularyFile.load` and `VocabularyFile.vocabulary` raise."""
        return VocabularyFile.load(path).vocabulary()

    def is_for(self, model: str) -> bool:
        """Return whether it is for the features of a model."""
        return self.models is None or model in self.models

    @functools.cached_property
    def digest(self) -> str:
        """A hash of all that labels depend on."""
        content = hashlib.blake2b(repr((self.space.to_dict(), self.threshold)).encode(), digest_size=16)
        content.update(np.ascontiguousarray(self.embeddings).data)
        content.update(self.of.tobytes())
        return content.hexdigest()

    @property
    def distances(self) -> Float64:
        """(K, K) 1 - cosine of names, each the mean of its words' embeddings of unit length."""
        unit = self.embeddings.astype(np.float64)
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        means = np.stack([unit[self.of == k].mean(axis=0) for k in range(len(self.space))])
        means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12)
        distances = np.clip(1 - means @ means.T, 0.0, None)
        np.fill_diagonal(distances, 0.0)
        symmetric: Float64 = (distances + distances.T) / 2
        return symmetric

    def labels(self, features: Features, where: str) -> UInt8 | UInt16:
        """Return ids (h, w) of the likeliest name of each cell, the ignore id below the threshold.

        Raises:
            DataError: If features have another number of components than embeddings.
        """
        if self.embeddings.shape[1] != features.D:
            raise DataError(
                f"{self.where}: embeddings have {self.embeddings.shape[1]} components, and features {features.D}"
                f" ({where}); take embeddings of the network that gives the features"
            )
        vectors = features.vectors.reshape(-1, features.D)
        dtype, ignored = (np.uint8, IGNORE_8BIT) if len(self.space) <= IGNORE_8BIT else (np.uint16, IGNORE_16BIT)
        ids: npt.NDArray[Any] = np.empty(len(vectors), dtype)
        step = max(1, CELLS // len(self.embeddings))
        for start in range(0, len(vectors), step):
            likeness = vectors[start : start + step].astype(np.float32) @ self.embeddings.T
            best = likeness.argmax(axis=1)
            name_ids = self.of[best].astype(dtype)
            if self.threshold is not None:
                name_ids[np.take_along_axis(likeness, best[:, None], axis=1)[:, 0] < self.threshold] = ignored
            ids[start : start + step] = name_ids
        return ids.reshape(features.vectors.shape[:2])

    def frame_labels(self, features: Features, shape: tuple[int, int], where: str) -> UInt8 | UInt16:
        """Return ids (H, W) at the pixels of the depth: each pixel has the label of the cell that it falls into."""
        ids = self.labels(features, where)
        ignored = IGNORE_8BIT if ids.dtype == np.uint8 else IGNORE_16BIT
        image: npt.NDArray[Any] = features.image(ids, shape, ignored)
        return image


@dataclass(frozen=True, eq=False)
class VocabularyFile:
    """The content of a vocabulary's file, from which vocabularies with other names are made.

    Attributes:
        embeddings: Embeddings (1 + s, D) of each name and its s synonyms, as they are stored or encoded.
    """

    path: Path
    settings: VocabularySettings
    embeddings: tuple[Float32, ...]

    @classmethod
    def load(cls, path: Path) -> VocabularyFile:
        """Read a file.

        Raises:
            ConfigError: If the file is not a vocabulary.
            DataError: If its embeddings cannot be used.
            MissingDependencyError: If its text encoder needs packages that are not installed.
        """
        settings = validated(VocabularySettings, read_yaml(path), f"{path}: ")
        words = [word for entry in settings.names for word in entry.words]
        if settings.encoder is not None:
            embeddings = _encoded(settings.encoder, words, path)
        else:
            assert settings.embeddings is not None
            embeddings = _stored(path.parent / settings.embeddings, words)
        length = np.linalg.norm(embeddings, axis=1)
        if not (right := np.isfinite(length) & (length > 0)).all():
            word = words[int(np.flatnonzero(~right)[0])]
            raise DataError(f"{path}: the embedding of '{word}' has no length or is not finite")
        ends = np.cumsum([len(entry.words) for entry in settings.names])
        return cls(path, settings, tuple(np.split(embeddings, ends[:-1])))

    def changed(self, changes: VocabularyChanges) -> VocabularyFile:
        """Return what the file would hold with other names; a new name is encoded like the names of the file.

        Raises:
            ConfigError: If it has no such name, fewer than two are left, or there is no encoder for a new one.
        """
        where, names = f"{self.path},{changes}", [entry.name for entry in self.settings.names]
        for name in (*changes.without, *(old for old, _ in changes.rename)):
            if name not in names:
                raise ConfigError(f"{where}: no name '{name}'; {nearest(name, names)}")
        new_names = dict(changes.rename)
        entries: list[NameEntry] = []
        embeddings: list[Float32] = []
        for entry, rows in zip(self.settings.names, self.embeddings, strict=True):
            if entry.name in changes.without:
                continue
            new = new_names.get(entry.name)
            entries.append(entry if new is None else entry.model_copy(update={"name": new}))
            embeddings.append(rows if new is None else np.concatenate([self._encode(new, where), rows[1:]]))
        for name in changes.add:
            entries.append(NameEntry(name=name))
            embeddings.append(self._encode(name, where))
        if len(entries) < 2:
            raise ConfigError(f"{where}: leaves {len(entries)} name; at least 2 are needed")
        name = f"{self.settings.name or self.path.stem},{changes}"
        return VocabularyFile(
            self.path, self.settings.model_copy(update={"names": entries, "name": name}), tuple(embeddings)
        )

    def _encode(self, name: str, where: str) -> Float32:
        """Return the embedding (1, D) of a new name."""
        if self.settings.encoder is None:
            raise ConfigError(
                f"{where}: {self.path.name} holds embeddings, of its own names alone; give it an encoder, or"
                f" put '{name}' into the file and leave names out (without=NAME)"
            )
        return _encoded(self.settings.encoder, [name], self.path)

    def vocabulary(self) -> Vocabulary:
        """Return the vocabulary.

        Raises:
            ConfigError: If two names are the same.
        """
        settings = self.settings
        try:
            space = LabelSpace(
                settings.name or self.path.stem,
                tuple(entry.name for entry in settings.names),
                members=tuple(tuple(entry.synonyms) for entry in settings.names),
                groups=tuple(entry.group for entry in settings.names),
            )
        except ConfigError as error:
            raise ConfigError(f"{self.path}: {str(error).replace('taxonomy', 'vocabulary', 1)}") from error
        embeddings = np.concatenate(self.embeddings)
        if settings.normalise:
            embeddings = (embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)).astype(np.float32)
        name_of_word = np.repeat(np.arange(len(settings.names)), [len(rows) for rows in self.embeddings])
        models = None if settings.models is None else tuple(settings.models)
        return Vocabulary(space, embeddings, name_of_word.astype(np.int64), settings.threshold, str(self.path), models)


def _stored(path: Path, words: list[str]) -> Float32:
    """Return embeddings (n, D) of a file, a row for each of the words."""
    try:
        values = np.load(io.BytesIO(read_limited(path, MOST_BYTES)), allow_pickle=False).astype(np.float32)
    except (OSError, ValueError, TypeError, EOFError) as error:
        raise DataError(f"{path}: it is no .npy of numbers ({type(error).__name__})") from error
    if values.ndim != 2 or len(values) != len(words):
        raise DataError(
            f"{path}: it has the shape {values.shape}; there are {len(words)} names and synonyms, so ({len(words)}, D)"
            " is needed"
        )
    return np.asarray(values, np.float32)


def _encoded(encoder: EncoderSettings, words: list[str], path: Path) -> Float32:
    """Return embeddings (n, D) of words by a text encoder; raises MissingDependencyError without transformers."""
    try:
        from semstab.models.text import text_embeddings
    except ImportError as error:
        raise MissingDependencyError(
            f"{path}: a text encoder cannot be used ({error}); pip install 'semstab[segearth]', or give embeddings"
        ) from error
    checkpoint = path.parent / encoder.checkpoint
    where = str(checkpoint) if checkpoint.is_dir() else encoder.checkpoint
    return text_embeddings(where, words, encoder.templates)


def vocabularies_by_name(vocabularies: Sequence[Path]) -> dict[str, Vocabulary]:
    """Return vocabularies by their names, with the changes that follow their files.

    'FILE,without=each' stands for the vocabulary of the file, and for the same without each of its names.

    Raises:
        ConfigError: If two have one name, and what `VocabularyChanges.parse` and `VocabularyFile` raise.
    """
    wanted = dict.fromkeys(VocabularyChanges.parse(str(path)) for path in vocabularies)
    files = {file: VocabularyFile.load(file) for file in dict.fromkeys(file for file, _ in wanted)}
    listed: dict[tuple[Path, VocabularyChanges], None] = {}
    for file, changes in wanted:
        if EACH in changes.without:
            removals = (VocabularyChanges(without=(entry.name,)) for entry in files[file].settings.names)
            listed |= dict.fromkeys((file, variant) for variant in (VocabularyChanges(), *removals))
        else:
            listed[file, changes] = None
    by_name: dict[str, Vocabulary] = {}
    for file, changes in listed:
        vocabulary = (files[file].changed(changes) if changes else files[file]).vocabulary()
        if vocabulary.space.name in by_name:
            raise ConfigError(
                f"{file}: two vocabularies are called '{vocabulary.space.name}'; give one a name (name: NAME)"
            )
        by_name[vocabulary.space.name] = vocabulary
    return by_name
