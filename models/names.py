"""A mapping from a model's own classes to a taxonomy's by name, from those of Cityscapes and ADE20K to UAVid's."""

from __future__ import annotations

import dataclasses
import functools
import importlib.resources
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from semstab.core.files import MAX_YAML_BYTES, parse_yaml, read_limited
from semstab.core.types import Float32, Mask
from semstab.data.frames import Frame
from semstab.data.labels import LEFT_OUT, LabelMapping, LabelSpace, ignore_id, name_key
from semstab.errors import ConfigError, summarize_error
from semstab.models import Image, Model, Prediction, Streamed
from semstab.models.validation import Wrapped

logger = logging.getLogger("semstab")

Leniency = Literal["strict", "lenient"]


@dataclass(frozen=True)
class ModelClassNames:
    """The names that one family of models has for the classes of UAVid; see configs/models/class_names.yaml.

    Attributes:
        recognised_by: Names that only this vocabulary has, and always has.
        rest: The class of names that no class takes.
        strict: Class to the names that certainly are it; `lenient` to the names that are it on a generous view.
    """

    recognised_by: Sequence[str]
    rest: str
    strict: Mapping[str, Sequence[str]]
    lenient: Mapping[str, Sequence[str]]

    def matches(self, space: LabelSpace) -> bool:
        """Return whether a model's classes come from this vocabulary."""
        keys = {name_key(part) for name in space.classes for part in _names(name)}
        return {name_key(name) for name in self.recognised_by} <= keys

    def target_of(self, name: str, leniency: Leniency) -> str | None:
        """Return the class of UAVid with this name, or None if the name is not a class of UAVid."""
        tables = (self.strict, self.lenient) if leniency == "lenient" else (self.strict,)
        targets = {
            name_key(synonym): target for table in tables for target, names in table.items() for synonym in names
        }
        return next((targets[key] for key in map(name_key, _names(name)) if key in targets), None)


@functools.cache
def vocabularies() -> Mapping[str, ModelClassNames]:
    """Return the vocabularies that ship, by name."""
    file = importlib.resources.files("semstab.configs") / "models" / "class_names.yaml"
    content = parse_yaml(file.read_text(encoding="utf-8"), file.name)
    return {name: ModelClassNames(**entry) for name, entry in content.items()}


def class_mapping(source: LabelSpace, target: LabelSpace, leniency: Leniency = "strict") -> LabelMapping:
    """Map a model's classes to a taxonomy by name.

    A class goes to the class that its vocabulary names, or to the class of `target` with its name or with it as a
    member. Another class of a vocabulary goes to the vocabulary's rest. If `target` has none of these, strict raises
    ConfigError and names the class; lenient leaves the class out, and warns if most classes are left out.
    """
    vocabulary = next((entry for entry in vocabularies().values() if entry.matches(source)), None)
    rows_by_name, rows, lost = target.row_of, [], []
    for name in source.classes:
        candidates = _candidates(name, vocabulary, leniency)
        row = next((rows_by_name[key] for key in map(name_key, candidates) if key in rows_by_name), None)
        if row is None:
            lost.append(name)
        rows.append(None if row == LEFT_OUT else row)
    if lost and leniency == "strict":
        raise ConfigError(
            f"taxonomy {target.name}: no class takes '{', '.join(lost)}' of {source.name}; add the names to a class's"
            " members or to ignored, or leave them out with the lenient mapping"
        )
    if 2 * len(lost) > len(source):
        logger.warning(
            "taxonomy %s does not have %d of the %d classes of %s; they are left out, among them %s; does the taxonomy"
            " fit? Its members and its ignored list take names",
            target.name, len(lost), len(source), source.name, ", ".join(lost[:3]),
        )  # fmt: skip
    return LabelMapping(source, target, tuple(rows))


def _candidates(name: str, vocabulary: ModelClassNames | None, leniency: Leniency) -> Sequence[str]:
    """Return the names of a class in the target, the best first."""
    target = None if vocabulary is None else vocabulary.target_of(name, leniency)
    if vocabulary is None or target is not None:
        return [*([target] if target else []), *_names(name)]
    return [*_names(name), vocabulary.rest]


class InTaxonomy(Wrapped):
    """A model whose labels and scores are given in the classes of a taxonomy, ids 0 to K - 1.

    Labels are the mapped classes of the model's own decision; scores of classes that fall together are added up.

    Raises:
        ConfigError: For a model without classes, and what `class_mapping` raises.
    """

    def __init__(self, model: Model, target: LabelSpace, leniency: Leniency) -> None:
        if model.label_space is None:
            raise ConfigError("regions without classes cannot be brought into a taxonomy; leave it out")
        super().__init__(model)
        self.streams = model.streams
        self._mapping = class_mapping(model.label_space, target, leniency)
        self.label_space = dataclasses.replace(target, ids=tuple(range(len(target))))

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`."""
        predictions = []
        for prediction in self.ask(images, scores, geometry):
            labels, mapped = self._mapping.labels(prediction.labels, "prediction"), None
            if prediction.scores is not None:
                mapped = np.array(
                    self._mapping.scores(prediction.scores.astype(np.float32, copy=False), "prediction"),
                    dtype=np.float32,
                )
                mapped[labels == ignore_id(labels)] = 0
            predictions.append(Prediction(labels, mapped, prediction.features))
        return predictions

    def stream(self, image: Image) -> Streamed:
        """See `Model`; the target's maps are in memory at once."""
        streamed = self.inner.stream(image)
        labels = self._mapping.labels(streamed.labels, "prediction")
        return Streamed(labels, lambda: self._maps(streamed, labels != ignore_id(labels)))

    def identity(self) -> dict[str, Any]:
        """Return the identity of the inner model, and the mapping of its classes."""
        rows = list(self._mapping.rows)
        return {**self.inner.identity(), "taxonomy": self._mapping.target.to_dict(), "rows": rows}

    def _maps(self, streamed: Streamed, labelled: Mask) -> Iterator[Float32]:
        """Yield the maps with those of classes that fall together added up, 0 where the label is ignored."""
        totals = np.zeros((len(self._mapping.target), *labelled.shape), dtype=np.float32)
        for row, scores in zip(self._mapping.rows, streamed.maps(), strict=True):
            if row is not None:
                totals[row] += scores
        yield from (total * labelled for total in totals)


def _names(name: str) -> list[str]:
    """Return the name, and the synonyms in one like 'door;double door' or 'building, edifice'."""
    parts = [part.strip() for part in re.split(r"[;,]", name)]
    return [name, *parts] if len(parts) > 1 else [name]


# Names of classes as a user says them.


def class_names(classes: Sequence[str] | str) -> Sequence[str] | LabelSpace:
    """Return 'a,b,c', a list, a text file with a name a line, or a taxonomy's YAML.

    Raises:
        ConfigError: If they are none, or cannot be read.
    """
    if not isinstance(classes, str):
        return classes
    path = Path(classes).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return LabelSpace.load(path)
    if path.suffix and path.is_file():
        try:
            text = read_limited(path, MAX_YAML_BYTES).decode("utf-8")
        except (OSError, ValueError) as error:
            raise ConfigError(f"classes {classes}: cannot be read ({summarize_error(error)})") from error
        names = [line.strip() for line in text.splitlines()]
    else:
        names = [name.strip() for name in classes.split(",")]
    if not (names := [name for name in names if name]):
        raise ConfigError(f"classes {classes}: holds no name")
    return names
