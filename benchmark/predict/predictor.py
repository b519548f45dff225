"""A backbone as a user asks for it: its options, the name of its predictions, the taxonomy they are given in."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, Field, field_validator, model_validator

from semstab.backbones import Backbone, create, options_model
from semstab.backbones.class_names import InTaxonomy
from semstab.backbones.outside.border import Checked
from semstab.backbones.outside.code import absolute
from semstab.backbones.outside.network import is_network
from semstab.backbones.outside.own import is_path
from semstab.config import Settings, validated
from semstab.datasets import GROUND_TRUTH, Scene
from semstab.errors import ConfigError
from semstab.model.labels import LabelSpace
from semstab.predict.filters import parse
from semstab.predict.filters.filtered import Filtered
from semstab.predict.kept import Kept
from semstab.predict.stored import NAME as STORED
from semstab.predict.stored import Stored, StoredOptions, StoredSequence
from semstab.runtime.files import parse_yaml


class PredictorConfig(Settings):
    """Which backbone predicts, and how its predictions are called and given."""

    backbone: str = Field(description="a name from `semstab-bench list`; or FILE.py:NAME, net.onnx")
    name: str | None = Field(None, description="what its predictions are called; the backbone's name by default")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that backbone")
    scores: bool = Field(False, description="soft scores, not labels alone")
    taxonomy: str | None = Field(None, description="give labels in this taxonomy; the model's own classes by default")
    mapping: Literal["strict", "lenient"] = Field(
        "strict",
        description="which of the model's classes count as a class of the taxonomy: certain ones, or near ones",
    )
    filters: list[str] = Field(
        default_factory=list, description="what steadies its labels, in this order: ema:0.6, vote:5, ... (`list`)"
    )

    @field_validator("name")
    @classmethod
    def _names_a_folder(cls, value: str | None) -> str | None:
        if value is not None and (value in ("", ".", "..", GROUND_TRUTH) or set(value) & set("/\\\0")):
            raise ValueError("it names a folder; use letters, digits, '-' and '_'")
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
        """What its label maps are called."""
        if self.name is not None:
            return self.name
        stem = Path(self.backbone).stem if is_network(self.backbone) else self.backbone.rpartition(":")[2]
        if self.backbone == STORED:
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
        """Whether its filters look at images."""
        return any(parse(text).kind.wants_color for text in self.filters)

    @property
    def looks_at(self) -> dict[str, Any]:
        """What of a scene's frames must be there, as `select_frames` takes it."""
        stored = self.backbone == STORED
        return {"sources": [self.options["source"]] if stored else [], "color": not stored or self.wants_color}

    def resolved(self) -> PredictorConfig:
        """With every default of the backbone's options, and absolute paths.

        Raises ConfigError for an option that cannot be used, MissingDependencyError.
        """
        options = validated(options_model(self.backbone), self.options, f"backbone '{self.backbone}': ")
        network = is_network(self.backbone)
        backbone = str(Path(self.backbone).expanduser().absolute()) if network else absolute(self.backbone)
        full = {"backbone": backbone, "options": _absolute(options).model_dump(mode="json")}
        return self.model_copy(update=full)


def load_predictor(config: PredictorConfig) -> Backbone:
    """The backbone, in its taxonomy where one is named, behind its filters. Raises what `create` raises.

    Raises ConfigError where scores are wanted of a backbone that has none, or classes map nowhere.
    """
    return completed(config, create(config.backbone, **config.options))


def stored_labels(config: PredictorConfig, scene: Scene) -> tuple[StoredSequence, Backbone]:
    """The same of a scene's own labels, and the frames that it is shown. Raises ConfigError where there are none."""
    options = validated(StoredOptions, config.options, f"backbone '{config.backbone}': ")
    sequence = StoredSequence(scene, options.source, config.wants_color)
    return sequence, completed(config, Stored(options, sequence))


def completed(config: PredictorConfig, model: Backbone, kept: Path | None = None) -> Backbone:
    """A model with all that is asked for around it; what it said of an image is looked up in the folder `kept`."""
    backbone: Backbone = Checked(model, config.label_name)
    if kept is not None and not backbone.sequential:
        backbone = Kept(backbone, kept)
    if config.taxonomy is not None:
        backbone = InTaxonomy(backbone, LabelSpace.load(config.taxonomy), config.mapping)
    if config.filters:
        backbone = Filtered(backbone, [parse(text) for text in config.filters], config.unfiltered.label_name)
    if config.scores and not backbone.gives_scores:
        raise ConfigError(f"backbone '{config.unfiltered.label_name}' gives labels, no scores; leave scores out")
    return backbone


OWN = ("name", "scores", "taxonomy", "mapping", "filters")
"""Settings of a predictor, which are not its backbone's options."""


def parse_predictor(text: str, more: Mapping[str, Any] | None = None, filters: Sequence[str] = ()) -> PredictorConfig:
    """'segformer,model=FOLDER,taxonomy=uavid3': the backbone, then settings of the predictor, or its own options.

    `more` are options, and `filters` come after its own, that are said elsewhere.

    Raises ConfigError for anything else.
    """
    backbone, *settings = re.split(r",(?![^\[{]*[\]}])", text)  # not at the commas of a list
    own: dict[str, Any] = {}
    options: dict[str, Any] = {**(more or {})}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--predict {text}: write NAME,KEY=VALUE,...; '{setting}' has no '='")
        group = own if key in OWN else options
        group[key] = parse_yaml(value, f"--predict {text}")
    own["filters"] = [*own.get("filters", ()), *filters]
    return validated(PredictorConfig, {"backbone": backbone, "options": options, **own}, f"--predict {text}: ")


def _absolute(options: BaseModel) -> BaseModel:
    """Paths, what names a file, and a model that is a folder, from the root of the file system."""
    paths: dict[str, Any] = {key: value.absolute() for key, value in options if isinstance(value, Path)}
    paths |= {key: str(Path(value).expanduser().absolute()) for key, value in options if is_path(value)}
    model = getattr(options, "model", None)
    if isinstance(model, str) and Path(model).expanduser().is_dir():
        paths["model"] = str(Path(model).expanduser().absolute())
    return options.model_copy(update=paths)
