"""A backbone as a user asks for it: its options, the name of its predictions, the taxonomy they are given in."""

from __future__ import annotations

import re
from collections.abc import Mapping
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
from semstab.datasets import GROUND_TRUTH
from semstab.errors import ConfigError
from semstab.model.labels import LabelSpace
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

    @field_validator("name")
    @classmethod
    def _names_a_folder(cls, value: str | None) -> str | None:
        if value is not None and (value in ("", ".", "..", GROUND_TRUTH) or set(value) & set("/\\\0")):
            raise ValueError("it names a folder; use letters, digits, '-' and '_'")
        return value

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
        return Path(self.backbone).stem if is_network(self.backbone) else self.backbone.rpartition(":")[2]

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
    """The backbone, in its taxonomy where one is named. Raises what `semstab.backbones.create` raises.

    Raises ConfigError where scores are wanted of a backbone that has none, or classes map nowhere.
    """
    backbone = Checked(create(config.backbone, **config.options), config.label_name)
    if config.scores and not backbone.gives_scores:
        raise ConfigError(f"backbone '{config.backbone}' gives labels, no scores; leave scores out")
    if config.taxonomy is None:
        return backbone
    return InTaxonomy(backbone, LabelSpace.load(config.taxonomy), config.mapping)


def parse_predictor(text: str, more: Mapping[str, Any] | None = None) -> PredictorConfig:
    """'segformer,model=FOLDER,taxonomy=uavid3': the backbone, then settings of the predictor, or its own options.

    `more` are options that are said elsewhere.

    Raises ConfigError for anything else.
    """
    backbone, *settings = re.split(r",(?![^\[{]*[\]}])", text)  # not at the commas of a list
    own: dict[str, Any] = {}
    options: dict[str, Any] = {**(more or {})}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--predict {text}: write NAME,KEY=VALUE,...; '{setting}' has no '='")
        group = own if key in ("name", "scores", "taxonomy", "mapping") else options
        group[key] = parse_yaml(value, f"--predict {text}")
    return validated(PredictorConfig, {"backbone": backbone, "options": options, **own}, f"--predict {text}: ")


def _absolute(options: BaseModel) -> BaseModel:
    """Paths, what names a file, and a model that is a folder, from the root of the file system."""
    paths: dict[str, Any] = {key: value.absolute() for key, value in options if isinstance(value, Path)}
    paths |= {key: str(Path(value).expanduser().absolute()) for key, value in options if is_path(value)}
    model = getattr(options, "model", None)
    if isinstance(model, str) and Path(model).expanduser().is_dir():
        paths["model"] = str(Path(model).expanduser().absolute())
    return options.model_copy(update=paths)
