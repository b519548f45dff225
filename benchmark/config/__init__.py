"""Every setting, typed, with its default; a run is a study that varies nothing."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_validator

from semstab.config.groups import (
    Deviation,
    FrameSelection,
    NoiseLevels,
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
from semstab.core.code import absolute, is_code
from semstab.core.registry import BY_RULE, name_code
from semstab.core.types import THIS_SCENE
from semstab.errors import ConfigError, nearest

__all__ = [
    "BackendConfig", "Config", "DatasetConfig", "Deviation", "Exclusion", "FrameSelection", "NamedBenchmark",
    "NoiseLevels", "Part", "Perturbation", "Settings", "Sweeps", "as_range", "explain", "merge", "nearest",
    "read_yaml", "validated",
]  # fmt: skip

BASE, SHARED, BACKENDS = "base", "shared_taxonomy", "backends"
"""Units at the configuration's own settings by its first backend; in the shared taxonomy; by the other backends."""

SAMPLE = "sample"
"""The check that follows a random set of voxels, not all of them."""

LEAST_TILE = 8
"""Voxels along the edge of the smallest tiles."""


class DatasetConfig(Settings):
    """The settings that name a dataset, with the options of its own."""

    name: str = Field("city", description="a name from `semstab-bench list`, FILE.py:NAME or package.module:NAME")
    options: dict[str, Any] = Field(default_factory=dict, description="options of that dataset")

    @field_validator("name")
    @classmethod
    def _is_no_folder(cls, name: str) -> str:
        if "/" in name and ":" not in name:
            raise ValueError(
                f"must name a dataset, not a folder; write {{name: posed_folder, options: {{root: {name}}}}}"
            )
        return absolute(name)


class BackendConfig(Part):
    """The settings that name a fusion backend: its class, its options, and whether it must agree with the others."""

    name: str = Field(description="a name from `semstab-bench list`, or the name of a custom class")
    code: str | None = Field(None, description="a custom class, as FILE.py:NAME or package.module:NAME")
    options: dict[str, Any] = Field(default_factory=dict, description="options of the backend")
    check: bool | None = Field(None, description="whether it must agree; by default if it associates by pixel")

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the backend of a name, or of FILE.py:NAME."""
        if not is_code(text):
            return cls(name=text)
        return cls(name=text.rpartition(":")[2].removesuffix(".py"), code=absolute(text))

    def fusing_by(self, rule: str) -> BackendConfig:
        """Return the same backend with a rule, of that name or FILE.py:NAME; its own name then has the rule's."""
        base_name, options = (
            self.name.partition(BY_RULE)[0],
            {k: v for k, v in self.options.items() if k not in self.ruled},
        )
        if rule == "mean":
            return self.model_copy(update={"name": base_name, "options": options})
        name = f"{base_name}{BY_RULE}{rule.rpartition(':')[2].removesuffix('.py')}"
        rule_options = {key: value for key, value in self.ruled.items() if key == "rule_options"}
        by = {"rule": absolute(rule)} | rule_options
        return self.model_copy(update={"name": name, "options": options | by})

    def like(self, other: BackendConfig) -> BackendConfig:
        """Return the same backend with the rule of another one, and the rule's options."""
        name = "".join([self.name, *other.name.partition(BY_RULE)[1:]])
        return self.model_copy(update={"name": name, "options": self.options | other.ruled})

    @property
    def ruled(self) -> dict[str, Any]:
        """Options that name the rule of fusion; empty for the backend's own rule."""
        rule = self.name.partition(BY_RULE)[2]
        by_name = {"rule": rule} if rule else {}
        return by_name | {key: self.options[key] for key in ("rule", "rule_options") if key in self.options}

    def model_post_init(self, _: Any) -> None:
        """Let the registry know the class behind the name."""
        if self.code is not None:
            name_code("backend", self.name.partition(BY_RULE)[0], self.code)

    def __setstate__(self, state: dict[Any, Any]) -> None:
        """Let the registry of another process know it, too."""
        super().__setstate__(state)
        self.model_post_init(None)


class Perturbation(Settings):
    """Noise on depth and poses, to see what geometry alone does to the numbers; see `semstab.pixels.preparation`.

    Standard deviations; positions and rotations have them for each axis. 0 adds nothing.
    """

    depth_noise: Deviation = Field(0.0, description="of depth, relative to it, of each pixel by itself")
    translation_noise: Deviation = Field(0.0, description="of the camera's position, metres, of each frame by itself")
    rotation_noise: Deviation = Field(0.0, description="of the camera's rotation, degrees, of each frame by itself")
    translation_drift: Deviation = Field(0.0, description="of a step of the position's random walk, metres a frame")
    rotation_drift: Deviation = Field(0.0, description="of a step of the rotation's random walk, degrees a frame")
    seed: int = Field(0, ge=0, description="of a unit; a configuration leaves it out, its own `seed` counts")

    @property
    def adds_noise(self) -> bool:
        """Return whether it changes a frame at all."""
        return any(value for name, value in self if name != "seed")


class Exclusion(Settings):
    """Locations left out of maps by their class, or pixels left out of fusion because they move."""

    classes: tuple[str, ...] = Field((), description="locations whose fused class is one of these, in the taxonomy")
    predicted_classes: tuple[str, ...] = Field(
        (), description="pixels predicted as one of these moving things, by a name of the model's or of the taxonomy"
    )
    masks: bool = Field(True, description="pixels under the masks of the dataset, if it has masks")


class VerdictSettings(Settings):
    """Thresholds of the verdict; see docs/metrics.md, The verdict."""

    stable: float = Field(0.8, gt=0, lt=1, description="alpha from which labels may be relied on")
    usable: float = Field(2 / 3, gt=0, lt=1, description="and from which on they may be acted on with care")
    labelled: float = Field(0.9, ge=0, le=1, description="part of the locations that a stable model labels at least")
    class_locations: float = Field(100.0, ge=1, description="voxels that a class must dominate to be assessed")


FlowName = Literal["depth", "dis"]
"""The motion from a frame to the next one: by depth and pose, or OpenCV's dense inverse search on the images."""


class NamedBenchmark(Settings):
    """The benchmark that a run is of, as `semstab-bench benchmark` sets it."""

    id: str = Field(description="NAME@VERSION")
    digest: str = Field(description="hash of the definition")
    file: str | None = Field(None, description="the definition, if it does not ship with semstab")

    def __str__(self) -> str:
        return f"{self.id} ({self.digest})"


class Config(Settings):
    """Settings that determine the numbers of a run or a study: scenes x models x backends x variations.

    Examples:
        >>> config = semstab.load_config({"dataset": {"name": "city"}, "voxel_size": 0.5})
        >>> config.voxel_size, config.backends[0].name
        (0.5, 'numba')
    """

    name: str = Field("run", min_length=1, description="the title of the report; a study's is its file's by default")
    description: str = Field("", description="one line")
    dataset: DatasetConfig = Field(DatasetConfig(), description="name and options of the dataset")
    scenes: list[str] | None = Field(None, description="scenes of the dataset; all by default")
    models: list[str] | None = Field(None, description="label sources; by default all but the ground truth")
    region_maps: list[str] = Field([], description="label sources whose ids mean nothing across frames (raw SAM)")
    backends: list[BackendConfig] = Field(
        [BackendConfig(name="numba")], min_length=1, description="the first fuses every unit, others the base units"
    )
    check: str | None = Field(
        SAMPLE,
        description="sample: the numpy reference on some voxels; a backend that fuses all base units; null",
    )
    tolerance: float = Field(1e-9, ge=0, description="largest difference at which two backends agree")
    taxonomy: str | None = Field(None, description="label space to fuse in; the dataset's own by default")
    distances: str | None = Field(
        None, description="distances between classes: .csv or .npy; by default from the taxonomy's groups"
    )
    shared_taxonomy: str | None = Field(None, description="label space in which models are compared; null: none")
    voxel_size: float = Field(
        0.2, ge=1e-9, le=1e9, description="edge, metres; by default the suggestion of `check` for data of files"
    )
    pixel_stride: int = Field(1, ge=1, description="use every n-th pixel of each axis")
    top_k: int | None = Field(
        None, ge=1, description="number of the largest scores of each pixel that are fused; null: all"
    )
    frames: FrameSelection = Field(FrameSelection(), description="frames that are fused; all by default")
    scene_frames: dict[str, FrameSelection] = Field({}, description="frames of single scenes, instead of `frames`")
    exclude: Exclusion = Field(Exclusion(), description="classes and pixels that are left out")
    moving: Literal["tell", "keep"] = Field(
        "tell", description="tell: spots that moved are found, and the verdict is of the others; keep: all count"
    )
    perturbation: Perturbation | None = Field(None, description="noise in every unit; null for none")
    strata: list[int] = Field([1, 2, 5], min_length=1, description="upper OP edges of the persistence strata")
    sweeps: Sweeps = Field(Sweeps(), description="settings of which a study tries several values")
    seed: int = Field(0, ge=0, description="of the noise; the n-th repeat of a sweep takes seed + n")
    events: bool = Field(False, description="also write the log of observations, where a backend keeps one")
    statistics: bool = Field(
        False, description="also statistics of order, and of the geometry's part in the disagreement"
    )
    truth: bool = Field(True, description="compare labels with the ground truth of the scene, if it has one")
    frame_quality: bool = Field(False, description="also assess each frame's labels; the filters study does")
    video_measures: FlowName | None = Field(
        None, description="also VC and TC as published, by flow: 'depth' and pose, or 'dis' (OpenCV, of the images)"
    )
    critical_classes: list[str] = Field([], description="classes of the verdict; all frequent ones if none is named")
    scope: ScopeSetting = Field(THIS_SCENE, description="of intervals: 'these frames', 'this scene', 'other scenes'")
    verdict: VerdictSettings = Field(VerdictSettings(), description="thresholds of the levels")
    benchmark: NamedBenchmark | None = Field(None, description="the benchmark that these settings are of; null: none")

    # These change no number, so they are not stored with a run.
    threads: int | None = Field(None, ge=1, exclude=True, description="threads that decode frames ahead")
    memory_gb: float | None = Field(
        None, gt=0, le=1e9, exclude=True, description="memory that maps may take, GB; by default all free memory"
    )
    tile_size: int | Literal["off"] | None = Field(
        None, exclude=True, description="edge of tiles, voxels, a power of 2; by default only where a map needs them"
    )
    check_geometry: bool = Field(True, exclude=True, description="refuse data whose depth and poses contradict")

    if not TYPE_CHECKING:

        def __init__(self, **settings):
            """Check the settings. Raises ConfigError in one line, as `build` does."""
            try:
                super().__init__(**settings)
            except ValidationError as error:
                raise ConfigError(explain(error, type(self))) from error

    @field_validator("dataset", mode="before")
    @classmethod
    def _a_name_is_a_dataset(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("scenes", "models", mode="before")
    @classmethod
    def _one_is_a_list(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value

    @field_validator("backends", mode="before")
    @classmethod
    def _names_are_backends(cls, value: Any) -> Any:
        listed = [value] if isinstance(value, str) else value
        if not isinstance(listed, list | tuple):
            return value
        return [BackendConfig.parse(item) if isinstance(item, str) else item for item in listed]

    @field_validator("backends")
    @classmethod
    def _rules_are_named(cls, value: list[BackendConfig]) -> list[BackendConfig]:
        """Name the rule that a backend has among its options only, so that several stand side by side."""
        unnamed = [backend.options.get("rule") if BY_RULE not in backend.name else None for backend in value]
        return [
            backend.fusing_by(rule) if isinstance(rule, str) else backend
            for backend, rule in zip(value, unnamed, strict=True)
        ]

    @field_validator("backends")
    @classmethod
    def _one_fuses_everything(cls, value: list[BackendConfig]) -> list[BackendConfig]:
        if len({backend.name for backend in value}) < len(value):
            raise ValueError("each backend can be named once")
        if value[0].scenes is not None or value[0].models is not None:
            raise ValueError("the first backend fuses every unit; leave out its scenes and models")
        return value

    @field_validator("perturbation")
    @classmethod
    def _noise_or_none(cls, value: Perturbation | None) -> Perturbation | None:
        """Treat settings that add no noise as none, so that they are compared as such."""
        if value is not None and value.seed:
            raise ValueError("leave its seed out; 'seed' counts, which stands beside 'perturbation'")
        return value if value is not None and value.adds_noise else None

    @field_validator("region_maps")
    @classmethod
    def _regions_are_not_fused(cls, value: list[str], info: ValidationInfo) -> list[str]:
        if duplicates := [name for name in value if name in (info.data.get("models") or ())]:
            raise ValueError(f"'{duplicates[0]}' is named among the models too; use one of the two")
        return value

    @field_validator("tile_size", mode="wrap")
    @classmethod
    def _a_power_of_two(cls, value: Any, validate: Callable[[Any], Any]) -> int | str | None:
        size: int | str | None = validate("off" if value is False else value)  # YAML reads the bare word as false
        if isinstance(size, int) and (size < LEAST_TILE or size & (size - 1)):
            raise ValueError(f"use a power of 2 from {LEAST_TILE}, or off")
        return size

    @field_validator("strata")
    @classmethod
    def _edges_ascend(cls, value: list[int]) -> list[int]:
        if value[0] < 1 or any(low >= high for low, high in itertools.pairwise(value)):
            raise ValueError("edges must be ascending whole numbers from 1")
        return value

    @classmethod
    def build(cls, content: Mapping[str, Any], where: str = "configuration") -> Self:
        """Validate settings.

        Raises:
            ConfigError: If that fails; the message names `where`, the setting, the nearest known one.
        """
        return validated(cls, content, f"{where}: ")

    @property
    def sets_voxel_size(self) -> bool:
        """Return whether it says a voxel size, or leaves it to the data."""
        return "voxel_size" in self.model_fields_set

    def fused_by(self) -> list[BackendConfig]:
        """Return the backends that fuse the base units: those named, and the one they are checked against."""
        if self.check is None or self.check in (SAMPLE, *(backend.name for backend in self.backends)):
            return [*self.backends]
        checking, fusing = BackendConfig.parse(self.check), {backend.name: backend for backend in self.backends}
        by_rule = [checking.like(backend) for backend in self.backends]
        return [*self.backends, *{backend.name: backend for backend in by_rule if backend.name not in fusing}.values()]

    def only(self, parts: Sequence[str]) -> Config:
        """Return the base units and these parts alone: sweeps, 'shared_taxonomy', 'backends'.

        Raises:
            ConfigError: For a part that there is not.
        """
        available = {name for name, _ in self.sweeps.given()} | {BASE, SHARED, BACKENDS}
        for part in parts:
            if part not in available:
                raise ConfigError(f"study {self.name}: no part '{part}'; {nearest(part, sorted(available))}")
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
        """Return YAML that reads back to the same settings."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
