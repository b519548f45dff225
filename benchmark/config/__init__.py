"""Every setting, typed, with its default; a run is a study that varies nothing."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from semstab.config.settings import (
    Counts,
    Deviation,
    FrameSelection,
    Lengths,
    Noise,
    Part,
    ScopeSetting,
    Settings,
    Sweeps,
    as_range,
    explain,
    merge,
    read_yaml,
    validated,
)
from semstab.core.types import THIS_SCENE
from semstab.errors import ConfigError, nearest

__all__ = [
    "BackendConfig",
    "Config",
    "Counts",
    "DatasetConfig",
    "Deviation",
    "Exclusion",
    "FrameSelection",
    "Lengths",
    "Noise",
    "Part",
    "Perturbation",
    "Settings",
    "Sweeps",
    "as_range",
    "explain",
    "merge",
    "nearest",
    "read_yaml",
    "validated",
]

BASE = "base"
"""The units at the configuration's own settings, fused by its first backend."""

SHARED = "shared_taxonomy"
"""The units fused in the taxonomy that backbones are compared in."""

BACKENDS = "backends"
"""The base units fused by the other backends."""

LEAST_TILE = 8
"""Voxels along the edge of the smallest tiles."""

SAMPLE = "sample"
"""The check that follows a random set of voxels, not all of them."""


class DatasetConfig(Settings):
    """Which dataset, with the options of its own."""

    name: str = Field("city", description="a name from `semstab-bench list`")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that dataset")


class BackendConfig(Part):
    """Which fusion backend, with the options of its own; where it fuses, and whether it must agree with the others."""

    name: str = Field(description="a name from `semstab-bench list`")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that backend")
    check: bool | None = Field(
        None, description="whether it must agree with the others; not if it associates otherwise than pixel by pixel"
    )


class Perturbation(Settings):
    """Noise on depth and poses, to see what geometry alone does to the numbers; see `semstab.pixels.preparation`.

    Standard deviations, of each axis where there are three. 0 adds nothing.
    """

    depth_noise: Deviation = Field(0.0, description="of depth, relative to it, of each pixel by itself")
    translation_noise: Deviation = Field(0.0, description="of the camera's position, metres, anew in every frame")
    rotation_noise: Deviation = Field(0.0, description="of the camera's rotation, degrees, anew in every frame")
    translation_drift: Deviation = Field(0.0, description="of a step of the position's random walk, metres a frame")
    rotation_drift: Deviation = Field(0.0, description="of a step of the rotation's random walk, degrees a frame")
    seed: int = Field(0, ge=0, description="of a unit; a configuration leaves it out, its own `seed` counts")

    @property
    def adds_noise(self) -> bool:
        """Whether it changes a frame at all."""
        return any(value for name, value in self if name != "seed")


class Exclusion(Settings):
    """What is left out of maps by the class of a location, or of fusion because it moves (`pixels.preparation`)."""

    classes: tuple[str, ...] = Field(
        (), description="locations whose fused class is one of these, by its name in the run's taxonomy"
    )
    predicted_classes: tuple[str, ...] = Field(
        (),
        description="pixels that are predicted as one of these moving things, by a name of the backbone's or of the"
        " run's taxonomy; it also removes what is predicted so by mistake",
    )
    masks: bool = Field(True, description="pixels under the masks of the dataset, where it has some")


class VerdictSettings(Settings):
    """What a verdict asks for; see docs/metrics.md, The verdict."""

    stable: float = Field(0.8, gt=0, lt=1, description="share of the ceiling from which labels may be relied on")
    usable: float = Field(2 / 3, gt=0, lt=1, description="and from which on they may be acted on with care")
    labelled: float = Field(0.9, ge=0, le=1, description="part of the locations that a stable model labels at least")
    class_locations: float = Field(
        100.0, ge=1, description="voxels that a class dominates from which on it is judged, and named in the verdict"
    )


class Config(Settings):
    """What determines the numbers of a run or a study: scenes x backbones x backends x variations."""

    name: str = Field("run", min_length=1, description="what the report calls it; a study's is its file's by default")
    description: str = Field("", description="one line")
    dataset: DatasetConfig = DatasetConfig()
    scenes: list[str] | None = Field(None, description="scenes of the dataset; all of them where not given")
    backbones: list[str] | None = Field(None, description="label sources; all but the ground truth where not given")
    region_maps: list[str] = Field(
        default_factory=list,
        description="label sources whose ids mean nothing across frames (raw SAM); only their flicker is measured",
    )
    backends: list[BackendConfig] = Field(
        [BackendConfig(name="numba")],
        min_length=1,
        description="fusion backends: the first one fuses every unit, the others the same frames of the base units",
    )
    check: str | None = Field(
        SAMPLE,
        description="what the backends are checked against: sample, the numpy reference on one in 16 voxels; or a"
        " backend that fuses all base units beside them, numpy for one; null for nothing",
    )
    tolerance: float = Field(1e-9, ge=0, description="largest difference at which two backends agree")
    taxonomy: str | None = Field(None, description="label space to fuse in; the dataset's own where not given")
    shared_taxonomy: str | None = Field(None, description="label space in which backbones are compared; null: none")
    voxel_size: float = Field(
        0.2,
        ge=1e-9,
        le=1e9,
        description="edge of a voxel, metres; where it is not given, what `check` suggests for data of files",
    )
    pixel_stride: int = Field(1, ge=1, description="use every n-th pixel of each axis")
    top_k: int | None = Field(
        None, ge=1, description="fuse the so many largest scores of each pixel; null: all, without loss"
    )
    frames: FrameSelection = FrameSelection()
    scene_frames: dict[str, FrameSelection] = Field(
        default_factory=dict, description="frames of single scenes, instead of `frames`"
    )
    exclude: Exclusion = Exclusion()
    perturbation: Perturbation | None = Field(None, description="noise in every unit; null for none")
    strata: list[int] = Field([1, 2, 5], min_length=1, description="upper OP edges of the persistence strata")
    sweeps: Sweeps = Sweeps()
    seed: int = Field(0, ge=0, description="of the noise; the n-th repeat of a sweep takes seed + n")
    events: bool = Field(False, description="also write the log of observations, where a backend keeps one")
    statistics: bool = Field(
        False,
        description="statistics also of the order of observations, of right and wrong, and of backbones beside each"
        " other; keeps every observation, fuses the ground truth too",
    )
    frame_quality: bool = Field(
        False, description="also judge each frame's labels: right, foreseen, late; `remedies` does"
    )
    critical_classes: list[str] = Field(
        default_factory=list,
        description="classes that the verdict depends on; all that have enough places where none is named",
    )
    scope: ScopeSetting = Field(
        THIS_SCENE, description="of the verdict and its intervals: 'this scene' flown again, or 'other scenes' like it"
    )
    verdict: VerdictSettings = VerdictSettings()
    threads: int | None = Field(
        None, ge=1, exclude=True, description="threads that decode frames ahead; changes no number, so it is not kept"
    )
    memory_gb: float | None = Field(
        None,
        gt=0,
        le=1e9,
        exclude=True,
        description="memory that maps may take, GB; what is free where not given; not kept",
    )
    tile_size: int | Literal["off"] | None = Field(
        None,
        exclude=True,
        description="edge of a tile, voxels, a power of 2: maps are fused tile by tile; where not given, only those"
        " that would not fit, in tiles of a chosen size; off: such a map is refused; not kept",
    )
    svg: bool = Field(False, exclude=True, description="also write figures as SVG, for print; not kept")
    check_geometry: bool = Field(
        True, exclude=True, description="refuse data whose depth and poses contradict each other; not kept"
    )

    if not TYPE_CHECKING:

        def __init__(self, **settings):
            """Raises ConfigError in one line, as `build` does."""
            try:
                super().__init__(**settings)
            except ValidationError as error:
                raise ConfigError(explain(error, type(self))) from error

    @field_validator("dataset", mode="before")
    @classmethod
    def _a_name_is_a_dataset(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("scenes", "backbones", mode="before")
    @classmethod
    def _one_is_a_list(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, content: Any) -> Any:
        """Say what to write instead of a study's settings of version 0.1."""
        if isinstance(content, Mapping):
            others = content.get("backends")
            if "backend" in content:
                raise ValueError("'backend' is now the first of 'backends'; write backends: [numba, open3d, ...]")
            if isinstance(others, Mapping):
                raise ValueError(
                    "'backends' is now a list, the base backend first;"
                    " write backends: [numba, {name: open3d, scenes: [...]}]"
                )
        return content

    @field_validator("backends", mode="before")
    @classmethod
    def _names_are_backends(cls, value: Any) -> Any:
        if not isinstance(value, list | tuple):
            return value if not isinstance(value, str) else [{"name": value}]
        return [{"name": item} if isinstance(item, str) else item for item in value]

    @field_validator("backends")
    @classmethod
    def _one_fuses_everything(cls, value: list[BackendConfig]) -> list[BackendConfig]:
        if len({backend.name for backend in value}) < len(value):
            raise ValueError("each backend can be named once")
        if value[0].scenes is not None or value[0].backbones is not None:
            raise ValueError("the first backend fuses every unit; leave out its scenes and backbones")
        return value

    @field_validator("perturbation")
    @classmethod
    def _noise_or_none(cls, value: Perturbation | None) -> Perturbation | None:
        """Settings that add no noise are none, so that they are compared as such."""
        if value is not None and value.seed:
            raise ValueError("leave its seed out; 'seed' counts, which stands beside 'perturbation'")
        return value if value is not None and value.adds_noise else None

    @field_validator("region_maps")
    @classmethod
    def _regions_are_not_fused(cls, value: list[str], info: ValidationInfo) -> list[str]:
        if both := [name for name in value if name in (info.data.get("backbones") or ())]:
            raise ValueError(f"'{both[0]}' is named among the backbones too; use one of the two")
        return value

    @field_validator("tile_size", mode="before")
    @classmethod
    def _off_is_no_switch(cls, value: Any) -> Any:
        return "off" if value is False else value  # YAML reads the bare word so

    @field_validator("tile_size")
    @classmethod
    def _a_power_of_two(cls, value: int | str | None) -> int | str | None:
        if isinstance(value, int) and (value < LEAST_TILE or value & (value - 1)):
            raise ValueError(f"use a power of 2 from {LEAST_TILE}, or off")
        return value

    @field_validator("strata")
    @classmethod
    def _edges_ascend(cls, value: list[int]) -> list[int]:
        if value[0] < 1 or any(low >= high for low, high in itertools.pairwise(value)):
            raise ValueError("edges must be ascending whole numbers from 1")
        return value

    @classmethod
    def build(cls, content: Mapping[str, Any], where: str = "configuration") -> Self:
        """Validate settings. Raises ConfigError that names `where`, the setting, the nearest known one."""
        return validated(cls, content, f"{where}: ")

    @property
    def sets_voxel_size(self) -> bool:
        """Whether it says a voxel size, or leaves it to the data."""
        return "voxel_size" in self.model_fields_set

    def fused_by(self) -> list[BackendConfig]:
        """The backends that fuse the base units: those named, and the one they are checked against."""
        named = [backend.name for backend in self.backends]
        extra = [BackendConfig(name=self.check)] if self.check not in (None, SAMPLE, *named) else []
        return [*self.backends, *extra]

    def only(self, parts: Sequence[str]) -> Config:
        """The base units and these parts alone: sweeps, 'shared_taxonomy', 'backends'.

        Raises ConfigError for a part that there is not.
        """
        known = {name for name, _ in self.sweeps.given()} | {BASE, SHARED, BACKENDS}
        for part in parts:
            if part not in known:
                raise ConfigError(f"study {self.name}: no part '{part}'; {nearest(part, sorted(known))}")
        dropped = {name: None for name, _ in self.sweeps.given() if name not in parts}
        return self.model_copy(
            update={
                "sweeps": self.sweeps.model_copy(update=dropped),
                "shared_taxonomy": self.shared_taxonomy if SHARED in parts else None,
                "backends": self.backends if BACKENDS in parts else self.backends[:1],
                "check": self.check if BACKENDS in parts else None,
            }
        )

    def to_yaml(self) -> str:
        """YAML that reads back to the same settings."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
