"""What an open-vocabulary model is asked: classes, their other names, and sentences around them."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import Self

from pydantic import Field, field_validator, model_validator

from semstab.config import Settings, read_yaml, validated
from semstab.model.labels import LabelSpace

SHIPPED = importlib.resources.files("semstab.configs") / "backbones" / "segearth_uavid.yaml"


class Prompts(Settings):
    """See configs/backbones/segearth_uavid.yaml."""

    name: str = Field("prompts", description="of the taxonomy that the classes make")
    classes: list[str] = Field(min_length=2, description="a class an entry; after commas its other names")
    background: str | None = Field(None, description="the class of a pixel of which nothing is likely")
    prob_threshold: float = Field(0.0, ge=0, le=1, description="likelihood below which a pixel is background")
    templates: list[str] = Field(["a photo of a {}."], min_length=1, description="sentences; {} stands for the name")

    @field_validator("classes")
    @classmethod
    def _names_are_there(cls, value: list[str]) -> list[str]:
        if empty := [entry for entry in value if not all(part.strip() for part in entry.split(","))]:
            raise ValueError(f"'{empty[0]}' has an empty name")
        return value

    @field_validator("templates")
    @classmethod
    def _templates_have_a_place(cls, value: list[str]) -> list[str]:
        if wrong := [template for template in value if template.count("{}") != 1]:
            raise ValueError(f"'{wrong[0]}' must hold {{}} once")
        return value

    @model_validator(mode="after")
    def _background_is_a_class(self) -> Self:
        if self.background is not None and self.background not in self.names:
            raise ValueError(f"the background '{self.background}' is none of the classes")
        if self.background is None and self.prob_threshold > 0:
            raise ValueError("prob_threshold needs a background class")
        return self

    @property
    def names(self) -> list[str]:
        """The classes' own names, in id order."""
        return [entry.split(",")[0].strip() for entry in self.classes]

    @property
    def queries(self) -> list[tuple[int, str]]:
        """Class id and name of everything that is asked for."""
        return [(k, part.strip()) for k, entry in enumerate(self.classes) for part in entry.split(",")]

    def label_space(self) -> LabelSpace:
        """The classes. Raises ConfigError for a name that repeats."""
        return LabelSpace(self.name, tuple(self.names))


def read_prompts(path: Path | None) -> Prompts:
    """The prompts of a file, those for UAVid where none is named. Raises ConfigError that names file and setting."""
    path = path or Path(str(SHIPPED))
    return validated(Prompts, read_yaml(path), f"{path}: ")
