"""The settings of a study: one run's, and what is varied."""

from __future__ import annotations

import difflib
import importlib.resources
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from semstab.backends import REGISTRY
from semstab.config import (
    BackendConfig,
    Config,
    DatasetConfig,
    Deviation,
    Exclusion,
    FrameSelection,
    Perturbation,
    Settings,
    explain,
    merge,
    read_yaml,
)
from semstab.errors import ConfigError
from semstab.plan import dataset_defaults, resolve
from semstab.study.results import BACKENDS, BASE, SHARED

BASE_SETTINGS = (
    "dataset", "scenes", "backbones", "taxonomy", "voxel_size", "pixel_stride", "frames", "exclude", "perturbation",
    "strata", "tolerance", "statistics",
)  # fmt: skip
"""What a study shares with `semstab.Config`, by the same names."""


class Part(Settings):
    """One of the things that are varied, on all of the study's scenes and backbones or on some."""

    scenes: list[str] | None = Field(None, min_length=1, description="of the study's; all of them where not given")
    backbones: list[str] | None = Field(None, min_length=1, description="of the study's; all of them where not given")

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


class Lengths(Part):
    """Values in metres."""

    values: list[Annotated[float, Field(gt=0, allow_inf_nan=False)]] = Field(min_length=1)


class Counts(Part):
    """Whole numbers from 1."""

    values: list[Annotated[int, Field(ge=1)]] = Field(min_length=1)


class Noise(Part):
    """Standard deviations; each but 0 is drawn `repeats` times, with seeds of their own."""

    values: list[Deviation] = Field(min_length=1)
    repeats: int = Field(1, ge=1)


class Sweeps(Settings):
    """What is varied one by one, all else as in the study's base settings."""

    voxel_size: Lengths | None = Field(None, description="edges of a voxel, metres")
    depth_noise: Noise | None = Field(None, description="see `semstab.config.Perturbation`, like the next four")
    translation_noise: Noise | None = None
    rotation_noise: Noise | None = None
    translation_drift: Noise | None = None
    rotation_drift: Noise | None = None
    frame_count: Counts | None = Field(None, description="so many frames, evenly over the extent of `frames`")
    pixel_stride: Counts | None = Field(None, description="use every n-th pixel of each axis")

    def given(self) -> Iterator[tuple[str, Lengths | Counts | Noise]]:
        """The sweeps of the study, by name."""
        for name, part in self:
            if part is not None:
                yield name, part


class ComparedBackend(BackendConfig):
    """A fusion backend beside the base one."""

    check: bool | None = Field(
        None, description="whether it must agree with the base one; not if it associates otherwise than pixel by pixel"
    )

    @property
    def checked(self) -> bool:
        """Whether it must agree with the base one."""
        return getattr(REGISTRY.load(self.name), "pointwise", True) if self.check is None else self.check


class Backends(Part):
    """Fusion backends that take the same frames as the base one."""

    values: list[ComparedBackend] = Field(default_factory=list)

    @field_validator("values", mode="before")
    @classmethod
    def _names_are_backends(cls, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        return [{"name": item} if isinstance(item, str) else item for item in value]


class StudyConfig(Settings):
    """What determines a study's numbers: base settings, by the names of `semstab.Config`, and what is varied."""

    name: str = Field("study", min_length=1, description="of the study; the file's by default")
    description: str = Field("", description="one line")
    dataset: DatasetConfig = DatasetConfig()
    scenes: list[str] | None = Field(None, description="scenes of the dataset; all of them where not given")
    backbones: list[str] | None = Field(None, description="label sources; all but the ground truth where not given")
    region_maps: list[str] = Field(
        default_factory=list,
        description="label sources whose ids mean nothing across frames (raw SAM); only their flicker is measured",
    )
    backend: BackendConfig = Field(BackendConfig(name="numba"), description="fuses every unit but those of `backends`")
    taxonomy: str | None = Field(None, description="label space to fuse in; the dataset's own where not given")
    shared_taxonomy: str | None = Field(None, description="label space in which backbones are compared; null: none")
    voxel_size: float = Field(0.2, gt=0, allow_inf_nan=False, description="edge of a voxel, metres")
    pixel_stride: int = Field(1, ge=1, description="use every n-th pixel of each axis")
    frames: FrameSelection = FrameSelection()
    scene_frames: dict[str, FrameSelection] = Field(
        default_factory=dict, description="frames of single scenes, instead of `frames`"
    )
    exclude: Exclusion = Exclusion()
    perturbation: Perturbation | None = Field(None, description="noise in every unit; null for none")
    strata: list[int] = Field([1, 2, 5], min_length=1, description="upper OP edges of the persistence strata")
    tolerance: float = Field(1e-9, ge=0, description="largest difference at which two backends agree")
    sweeps: Sweeps = Sweeps()
    backends: Backends = Field(Backends(), description="other fusion backends, on the base units' frames")
    seed: int = Field(0, ge=0, description="of the noise; the n-th repeat takes seed + n")
    statistics: bool = Field(
        False,
        description="statistics also of the order of observations, of right and wrong, and of backbones beside each"
        " other; keeps every observation, fuses the ground truth too",
    )
    threads: int | None = Field(None, ge=1, exclude=True, description="threads that decode frames ahead, in all jobs")
    memory_gb: float | None = Field(
        None, gt=0, exclude=True, description="for maps at a time; half of what is free where not given"
    )
    check_geometry: bool = Field(
        True, exclude=True, description="refuse scenes whose depth and poses contradict each other; not kept"
    )

    @field_validator("backend", mode="before")
    @classmethod
    def _a_name_is_a_backend(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("perturbation")
    @classmethod
    def _one_seed(cls, value: Perturbation | None) -> Perturbation | None:
        if value is not None and value.seed:
            raise ValueError("leave its seed out; the study's own 'seed' counts")
        return value

    @field_validator("region_maps")
    @classmethod
    def _regions_are_not_fused(cls, value: list[str], info: ValidationInfo) -> list[str]:
        if both := [name for name in value if name in (info.data.get("backbones") or ())]:
            raise ValueError(f"'{both[0]}' is named among the backbones too; use one of the two")
        return value

    @field_validator("backends")
    @classmethod
    def _other_backends_are_others(cls, value: Backends, info: ValidationInfo) -> Backends:
        names = [backend.name for backend in (info.data.get("backend"), *value.values) if backend is not None]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"'{repeated[0]}' is named twice; the base backend is '{names[0]}'")
        return value

    @classmethod
    def build(cls, content: Mapping[str, Any], where: str = "study") -> Self:
        """Validate settings. Raises ConfigError that names `where`, the setting, the nearest known one."""
        try:
            config = cls.model_validate(content)
            config.base()
        except ValidationError as error:
            raise ConfigError(f"{where}: {explain(error, cls)}") from error
        return config

    def base(self, scene: str | None = None) -> Config:
        """The base settings as a run's, with the frames of a scene where it is named."""
        settings = {name: getattr(self, name) for name in BASE_SETTINGS}
        settings |= {
            "backends": [self.backend],
            "check": None,
            "statistics": self.statistics,
            "memory_gb": self.memory_gb,
        }
        if self.perturbation is not None:
            settings["perturbation"] = self.perturbation.model_copy(update={"seed": self.seed})
        if scene is not None:
            settings |= {"scenes": [scene], "frames": self.scene_frames.get(scene, self.frames)}
        return Config(**settings)

    def resolved(self) -> StudyConfig:
        """With every default of its dataset's options filled in, paths absolute."""
        return self.model_copy(update={"dataset": resolve(self.base()).dataset})

    def only(self, parts: Sequence[str]) -> StudyConfig:
        """The study with its base units and these parts alone: sweeps, 'shared_taxonomy', 'backends'.

        Raises ConfigError for a part that it does not have.
        """
        known = {name for name, _ in self.sweeps.given()} | {BASE, SHARED, BACKENDS}
        for part in parts:
            if part not in known:
                raise ConfigError(f"study {self.name}: no part '{part}'; {_nearest(part, sorted(known))}")
        dropped = {name: None for name, _ in self.sweeps.given() if name not in parts}
        return self.model_copy(
            update={
                "sweeps": self.sweeps.model_copy(update=dropped),
                "shared_taxonomy": self.shared_taxonomy if SHARED in parts else None,
                "backends": self.backends if BACKENDS in parts else Backends(),
            }
        )

    def to_yaml(self) -> str:
        """YAML that `load_study` reads back to the same settings."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def load_study(study: str | Path, overrides: Mapping[str, Any] | None = None) -> StudyConfig:
    """The settings of a study file, or of a shipped study by its name, with overrides on top.

    Below them are the defaults that ship for its dataset. Raises ConfigError where there is no such study.
    """
    path = _find(str(study))
    content = merge(read_yaml(path), overrides or {})
    defaults = {key: value for key, value in dataset_defaults(content).items() if key in BASE_SETTINGS}
    return StudyConfig.build({"name": path.stem, **merge(defaults, content)}, str(path))


def shipped_studies() -> tuple[str, ...]:
    """Names of the studies that ship with semstab."""
    return tuple(sorted(path.stem for path in _shipped().glob("*.yaml")))


def _find(study: str) -> Path:
    if study in shipped_studies():
        return _shipped() / f"{study}.yaml"
    path = Path(study)
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"study '{study}' is not known; {_nearest(study, shipped_studies())}, or name a .yaml file")
    return path


def _shipped() -> Path:
    return Path(str(importlib.resources.files("semstab.configs") / "studies"))


def _nearest(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
