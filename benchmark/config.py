"""Every setting of a run, typed, with its default; unknown keys are refused with the nearest known one."""

from __future__ import annotations

import difflib
import itertools
import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from semstab.errors import ConfigError
from semstab.files import MAX_YAML_BYTES, parse_yaml, read_limited


class Settings(BaseModel):
    """A group of settings: frozen, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DatasetConfig(Settings):
    """Which dataset, with the options of its own."""

    name: str = Field("city", description="a name from `semstab-bench list`")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that dataset")


class BackendConfig(Settings):
    """Which fusion backend, with the options of its own."""

    name: str = Field(description="a name from `semstab-bench list`")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that backend")


Deviation = Annotated[float, Field(ge=0, allow_inf_nan=False)]

Indices = list[int]
"""Frames of a sequence, counted from 0, in ascending order."""


class FrameSelection(Settings):
    """Which frames of a sequence: those of a list; or each stride-th from start to before stop, in a range of time.

    Of these at most `count`: the first ones, or with `spacing: even` evenly spaced ones, the first and last included.
    """

    start: int = Field(0, ge=0)
    stop: int | None = Field(None, ge=1)
    stride: int = Field(1, ge=1)
    count: int | None = Field(None, ge=1)
    spacing: Literal["stride", "even"] = Field(
        "stride", description="which `count` frames: stride, the first ones; even, from the first to the last one"
    )
    list: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        None, min_length=1, description="these frames, ascending from 0, and no others"
    )
    from_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock")
    to_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock, included")

    @model_validator(mode="after")
    def _one_way_to_say_it(self) -> Self:
        said = [name for name, field in type(self).model_fields.items() if getattr(self, name) != field.default]
        if self.list is not None and said != ["list"]:
            raise ValueError(f"list says which frames; leave out {', '.join(said[:-1])}")
        if self.list is not None and any(a >= b for a, b in itertools.pairwise(self.list)):
            raise ValueError("the frames of a list must ascend, each once")
        if self.spacing == "even" and self.count is None:
            raise ValueError("spacing: even needs count, the number of frames")
        if self.from_time is not None and self.to_time is not None and self.from_time > self.to_time:
            raise ValueError("from_time lies after to_time")
        return self

    @property
    def needs_time(self) -> bool:
        """Whether frames are chosen by the time they were taken at."""
        return self.from_time is not None or self.to_time is not None

    def indices(self, length: int, timestamps: Sequence[float] | None = None) -> Indices:
        """The selected indices of a sequence of that length, whose frames were taken at `timestamps` (seconds).

        A frame whose time is not known (NaN) lies in no range of time. Raises ConfigError for a listed frame that is
        not there, or a range of time where the sequence has none.
        """
        if self.list is not None:
            if self.list[-1] >= length:
                raise ConfigError(f"frames.list: there is no frame {self.list[-1]}; the sequence has {length}, from 0")
            return [*self.list]
        extent = [*range(length)][self.start : self.stop]
        if self.needs_time:
            extent = self._in_time(extent, timestamps)
        chosen = extent[:: self.stride]
        return chosen[: self.count] if self.spacing == "stride" else _evenly(chosen, self.count or len(chosen))

    def _in_time(self, extent: Indices, timestamps: Sequence[float] | None) -> Indices:
        if timestamps is None:
            raise ConfigError("frames: from_time and to_time need time stamps, which this sequence has not; use start")
        first = -math.inf if self.from_time is None else self.from_time
        last = math.inf if self.to_time is None else self.to_time
        return [index for index in extent if first <= timestamps[index] <= last]


def _evenly(items: Indices, count: int) -> Indices:
    """At most `count` of the items, the first and the last included, at equal distances to within one."""
    count, last = min(count, len(items)), len(items) - 1
    return [items[round(k * last / max(1, count - 1))] for k in range(count)]


class Perturbation(Settings):
    """Noise added to depth and poses, to see what geometry alone does to the numbers; see `semstab.perturbation`.

    Standard deviations, of each axis where there are three. 0 adds nothing.
    """

    depth_noise: Deviation = Field(0.0, description="of depth, relative to it, of each pixel by itself")
    translation_noise: Deviation = Field(0.0, description="of the camera's position, metres, anew in every frame")
    rotation_noise: Deviation = Field(0.0, description="of the camera's rotation, degrees, anew in every frame")
    translation_drift: Deviation = Field(0.0, description="of a step of the position's random walk, metres a frame")
    rotation_drift: Deviation = Field(0.0, description="of a step of the rotation's random walk, degrees a frame")
    seed: int = Field(0, ge=0, description="of all of them")

    @property
    def adds_noise(self) -> bool:
        """Whether it changes a frame at all."""
        return any(value for name, value in self if name != "seed")


class Exclusion(Settings):
    """What is left out of fusion because it moves; see `semstab.exclusion`."""

    classes: tuple[str, ...] = Field((), description="classes, by their name in a backbone's or in the run's taxonomy")
    masks: bool = Field(True, description="pixels under the masks of the dataset, where it has some")


class Config(Settings):
    """What determines a run's numbers."""

    dataset: DatasetConfig = DatasetConfig()
    scenes: list[str] | None = Field(None, description="scenes of the dataset; all of them where not given")
    backbones: list[str] | None = Field(None, description="label sources; all but the ground truth where not given")
    backends: list[BackendConfig] = Field(
        [BackendConfig(name="numba")], min_length=1, description="fusion backends, each fuses the same frames"
    )
    check: str | None = Field("numpy", description="backend that the others are checked against; null for none")
    tolerance: float = Field(1e-9, ge=0, description="largest difference at which two backends agree")
    taxonomy: str | None = Field(None, description="label space to fuse in; the dataset's own where not given")
    voxel_size: float = Field(0.2, gt=0, allow_inf_nan=False, description="edge of a voxel, metres")
    pixel_stride: int = Field(1, ge=1, description="use every n-th pixel of each axis")
    frames: FrameSelection = FrameSelection()
    exclude: Exclusion = Exclusion()
    perturbation: Perturbation | None = Field(None, description="noise added to depth and poses; null for none")
    strata: list[int] = Field([1, 2, 5], min_length=1, description="upper OP edges of the persistence strata")
    threads: int | None = Field(
        None, ge=1, exclude=True, description="threads that decode frames ahead; changes no number, so it is not kept"
    )
    memory_gb: float | None = Field(
        None,
        gt=0,
        exclude=True,
        description="memory that maps may take, GB; what is free where not given; not kept",
    )
    check_geometry: bool = Field(
        True, exclude=True, description="refuse data whose depth and poses contradict each other; not kept"
    )
    events: bool = Field(False, description="also write the log of observations, where a backend keeps one")
    statistics: bool = Field(
        False,
        description="statistics also of the order of observations, of right and wrong, and of backbones beside each"
        " other; keeps every observation, fuses the ground truth too",
    )

    @field_validator("backends", mode="before")
    @classmethod
    def _names_are_backends(cls, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return [{"name": item} if isinstance(item, str) else item for item in value]

    @field_validator("backends")
    @classmethod
    def _each_backend_once(cls, value: list[BackendConfig]) -> list[BackendConfig]:
        if len({backend.name for backend in value}) < len(value):
            raise ValueError("each backend can be named once")
        return value

    @field_validator("perturbation")
    @classmethod
    def _noise_or_none(cls, value: Perturbation | None) -> Perturbation | None:
        """Settings that add no noise are none, so that they are compared as such."""
        return value if value is not None and value.adds_noise else None

    @field_validator("strata")
    @classmethod
    def _edges_ascend(cls, value: list[int]) -> list[int]:
        if value[0] < 1 or any(low >= high for low, high in itertools.pairwise(value)):
            raise ValueError("edges must be ascending whole numbers from 1")
        return value

    @classmethod
    def build(cls, content: Mapping[str, Any], where: str = "configuration") -> Self:
        """Validate settings. Raises ConfigError that names `where`, the setting, the nearest known one."""
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise ConfigError(f"{where}: {explain(error, cls)}") from error

    def fused_by(self) -> list[BackendConfig]:
        """The backends that fuse: those named, and the one they are checked against."""
        named = [backend.name for backend in self.backends]
        extra = [BackendConfig(name=self.check)] if self.check and self.check not in named else []
        return [*self.backends, *extra]

    def to_yaml(self) -> str:
        """YAML that `load` reads back to the same settings."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError in one line where there is none."""
    try:
        text = read_limited(path, MAX_YAML_BYTES).decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error
    content = parse_yaml(text, str(path))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected settings ('key: value' lines), found a {type(content).__name__}")
    return content


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of `over` on top of `base`, group by group."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem of a pydantic error as one line: the setting, what is wrong, the nearest known key."""
    problem = error.errors()[0]
    name = ".".join(" ".join(str(part).split()) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        unknown = name.rpartition(".")[2]
        known = sorted(_keys_at(model, problem["loc"][:-1]))
        near = difflib.get_close_matches(unknown, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        return f"unknown setting '{name}'; {hint}"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{name}: {message[0].lower()}{message[1:]} (got {reprlib.repr(problem['input'])})"


def _keys_at(model: type[BaseModel], path: tuple[int | str, ...]) -> Iterator[str]:
    for part in path:
        field = model.model_fields.get(str(part))
        inner = list(_models_in(field.annotation)) if field else []
        model = inner[0] if inner else model
    yield from model.model_fields


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in getattr(annotation, "__args__", ()):
        yield from _models_in(inner)
