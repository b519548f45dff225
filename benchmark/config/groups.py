"""Groups of settings: closed to unknown keys, read from YAML, explained in one line; sweeps; frame selections."""

from __future__ import annotations

import itertools
import math
import operator
import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from semstab.core.files import MAX_YAML_BYTES, parse_yaml, read_limited
from semstab.core.types import THIS_SCENE, Scope
from semstab.errors import ConfigError, nearest, summarize_error

Model = TypeVar("Model", bound=BaseModel)
V = TypeVar("V")


class Settings(BaseModel):
    """A group of settings: frozen, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        ConfigError: If there is none; the message is one line.
    """
    try:
        text = read_limited(path, MAX_YAML_BYTES).decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error
    content = parse_yaml(text, str(path))
    if content is not None and not isinstance(content, dict):
        raise ConfigError(f"{path}: expected settings ('key: value' lines), found a {type(content).__name__}")
    return content or {}


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of `over` on top of `base`, group by group."""
    merged = dict(base)
    for key, value in over.items():
        are_groups = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if are_groups else value
    return merged


ScopeSetting = Annotated[
    Scope, BeforeValidator(lambda value: value.replace("-", " ") if isinstance(value, str) else value)
]
"""'this scene', or 'this-scene'."""


class ScopeOption(BaseModel):
    """The option --scope of a command."""

    scope: ScopeSetting = THIS_SCENE


def validated(model: type[Model], content: Any, where: str = "") -> Model:
    """Return the settings that a content holds. Raises ConfigError in one line, which begins with `where`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{where}{explain(error, model)}") from error
    except (UnicodeEncodeError, TypeError) as error:  # YAML's "\\ud800" is half a character, names may be numbers
        raise ConfigError(f"{where}a name or a text is no text ({summarize_error(error)})") from error


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """Return the first problem of a pydantic error as one line: the setting, what is wrong, the nearest known key."""
    problem = error.errors()[0]
    name = ".".join(" ".join(str(part).split()) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        *groups, unknown = map(str, problem["loc"])
        for group in groups:
            field = model.model_fields.get(group)
            model = next(_models_in(field.annotation), model) if field else model
        return f"unknown setting '{name}'; {nearest(unknown, sorted(model.model_fields))}"
    message = problem["msg"].removeprefix("Value error, ")
    if not name:  # of the settings as a whole
        return message
    value = problem["input"]
    plain = all(isinstance(item, str | int | float) for item in (value if isinstance(value, list | tuple) else [value]))
    return f"{name}: {message[0].lower()}{message[1:]}{f' (got {reprlib.repr(value)})' if plain else ''}"


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in getattr(annotation, "__args__", ()):
        yield from _models_in(inner)


# Variations of a configuration: one thing at a time, all else as in its base settings.

Deviation = Annotated[float, Field(ge=0, le=1e9)]


class Part(Settings):
    """One of the things that are varied, on all scenes and models of the configuration or on some."""

    scenes: list[str] | None = Field(None, min_length=1, description="some of the scenes; all by default")
    models: list[str] | None = Field(None, min_length=1, description="some of the models; all by default")


class Values(Part, Generic[V]):
    """Values of a swept setting; a bare list is its values."""

    values: list[V] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _a_list_is_values(cls, content: Any) -> Any:
        if not isinstance(content, list | dict | Values):
            raise ValueError("write a list of values, for example [0.1, 0.2]")
        return {"values": content} if isinstance(content, list) else content

    @field_validator("values")
    @classmethod
    def _each_value_once(cls, values: list[V]) -> list[V]:
        if any(a == b for a, b in itertools.combinations(values, 2)):
            raise ValueError("name each value once")
        return values


class NoiseLevels(Values[Deviation]):
    """Standard deviations; each but 0 is drawn `repeats` times, with seeds of their own."""

    repeats: int = Field(1, ge=1)


Lengths = Values[Annotated[float, Field(ge=1e-9, le=1e9)]]
Counts = Values[Annotated[int, Field(ge=1)]]


class Sweeps(Settings):
    """The settings that are varied one by one."""

    voxel_size: Lengths | None = Field(None, description="edges of a voxel, metres")
    depth_noise: NoiseLevels | None = Field(None, description="see `semstab.config.Perturbation`, like the next four")
    translation_noise: NoiseLevels | None = None
    rotation_noise: NoiseLevels | None = None
    translation_drift: NoiseLevels | None = None
    rotation_drift: NoiseLevels | None = None
    frame_count: Counts | None = Field(None, description="number of frames, evenly over the extent of `frames`")
    pixel_stride: Counts | None = Field(None, description="use every n-th pixel of each axis")

    def given(self) -> Iterator[tuple[str, Values[Any]]]:
        """Yield the sweeps that there are, by name."""
        return ((name, part) for name, part in self if part is not None)


# Which frames of a sequence are fused.

Indices = list[int]
"""Frames of a sequence, counted from 0, in ascending order."""


def in_full(selection: Any) -> Any:
    """Return a selection of frames as settings, also of START:STOP:STRIDE (parts may be empty) or a list of frames.

    Raises:
        ConfigError: For another text.
    """
    if not isinstance(selection, str | int):
        return {"list": selection} if isinstance(selection, Sequence) else selection
    parts = str(selection).split(":")
    if len(parts) > 3 or not all(re.fullmatch(r"\s*[0-9]{0,18}\s*", part) for part in parts):
        raise ConfigError(f"write START:STOP:STRIDE, for example 0:80:4 or ::4, not {selection}")
    if len(parts) == 1:
        number = int(parts[0] or 0)
        raise ConfigError(f"write {number}:{number + 1} for one frame, :{number} for the first {number}")
    return {key: int(part) for key, part in zip(("start", "stop", "stride"), parts, strict=False) if part.strip()}


class FrameSelection(Settings):
    """The frames of a sequence to use: a list; or each stride-th from start to before stop, in a range of time.

    Of these at most `count`: the first ones, or with `spacing: even` evenly spaced ones, the first and last included.
    """

    start: int = Field(0, ge=0)
    stop: int | None = Field(None, ge=1)
    stride: int = Field(1, ge=1)
    count: int | None = Field(None, ge=1)
    spacing: Literal["stride", "even"] = "stride"
    list: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(None, min_length=1, description="ascending, from 0")
    from_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock")
    to_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock, included")

    @model_validator(mode="before")
    @classmethod
    def _a_slice_or_a_list(cls, content: Any) -> Any:
        return in_full(content)

    @model_validator(mode="after")
    def _one_way_to_say_it(self) -> Self:
        changed = [name for name, field in type(self).model_fields.items() if getattr(self, name) != field.default]
        if self.list is not None and changed != ["list"]:
            raise ValueError(f"list says which frames; leave out {', '.join(changed[:-1])}")
        if self.list is not None and any(a >= b for a, b in itertools.pairwise(self.list)):
            raise ValueError("the frames of a list must ascend, each once")
        if self.spacing == "even" and self.count is None:
            raise ValueError("spacing: even needs count, the number of frames")
        if self.from_time is not None and self.to_time is not None and self.from_time > self.to_time:
            raise ValueError("from_time lies after to_time")
        return self

    @classmethod
    def from_indices(cls, indices: Sequence[int]) -> Self:
        """Select exactly these frames, ascending; in a few numbers where they are a range."""
        if isinstance(indices, range):
            return cls(start=indices.start, stop=indices.stop, stride=indices.step)
        return cls(list=tuple(indices))

    def indices(self, length: int, timestamps: Sequence[float] | None = None) -> Indices:
        """Return the selected indices of a sequence of that length, whose frames were taken at `timestamps` (seconds).

        A frame whose time is not known (NaN) lies in no range of time.

        Raises:
            ConfigError: For a listed frame that is not there, or a range of time where the sequence has none.
        """
        if self.list is not None:
            if self.list[-1] >= length:
                raise ConfigError(f"frames.list: there is no frame {self.list[-1]}; the sequence has {length}, from 0")
            return [*self.list]
        chosen = [*range(length)][self.start : self.stop]
        if self.from_time is not None or self.to_time is not None:
            if timestamps is None:
                raise ConfigError("frames: from_time and to_time need time stamps; this sequence has none; use start")
            first = -math.inf if self.from_time is None else self.from_time
            last = math.inf if self.to_time is None else self.to_time
            chosen = [index for index in chosen if first <= timestamps[index] <= last]
        chosen = chosen[:: self.stride]
        if self.spacing == "stride" or not chosen:
            return chosen[: self.count]
        count, end = min(self.count or len(chosen), len(chosen)), len(chosen) - 1
        return [chosen[round(k * end / max(1, count - 1))] for k in range(count)]  # at equal distances to within one


def as_range(indices: Sequence[int]) -> Sequence[int]:
    """Return evenly spaced indices as a range: a hundred thousand numbers in lists and sets take 15 MB."""
    if len(indices) < 2:
        return indices
    even = range(indices[0], indices[-1] + 1, max(1, indices[1] - indices[0]))
    return even if len(even) == len(indices) and all(map(operator.eq, even, indices)) else indices
