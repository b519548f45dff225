"""What a configuration varies: one thing at a time, all else as in its base settings."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from semstab.config.settings import Settings

Deviation = Annotated[float, Field(ge=0, le=1e9)]


class Part(Settings):
    """One of the things that are varied, on all scenes and backbones of the configuration or on some."""

    scenes: list[str] | None = Field(None, min_length=1, description="some of the scenes; all where not given")
    backbones: list[str] | None = Field(None, min_length=1, description="some of the backbones; all where not given")


class Values(Part):
    """Values of a swept setting; a bare list is its values."""

    @model_validator(mode="before")
    @classmethod
    def _a_list_is_values(cls, content: Any) -> Any:
        return {"values": content} if isinstance(content, list) else content

    @field_validator("values", mode="after", check_fields=False)
    @classmethod
    def _each_value_once(cls, values: list[Any]) -> list[Any]:
        if any(a == b for a, b in itertools.combinations(values, 2)):
            raise ValueError("name each value once")
        return values


class Lengths(Values):
    """Values in metres."""

    values: list[Annotated[float, Field(ge=1e-9, le=1e9)]] = Field(min_length=1)


class Counts(Values):
    """Whole numbers from 1."""

    values: list[Annotated[int, Field(ge=1)]] = Field(min_length=1)


class Noise(Values):
    """Standard deviations; each but 0 is drawn `repeats` times, with seeds of their own."""

    values: list[Deviation] = Field(min_length=1)
    repeats: int = Field(1, ge=1)


class Sweeps(Settings):
    """What is varied one by one."""

    voxel_size: Lengths | None = Field(None, description="edges of a voxel, metres")
    depth_noise: Noise | None = Field(None, description="see `semstab.config.Perturbation`, like the next four")
    translation_noise: Noise | None = None
    rotation_noise: Noise | None = None
    translation_drift: Noise | None = None
    rotation_drift: Noise | None = None
    frame_count: Counts | None = Field(None, description="so many frames, evenly over the extent of `frames`")
    pixel_stride: Counts | None = Field(None, description="use every n-th pixel of each axis")

    def given(self) -> Iterator[tuple[str, Lengths | Counts | Noise]]:
        """The sweeps that there are, by name."""
        for name, part in self:
            if part is not None:
                yield name, part
