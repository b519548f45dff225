"""What scene.yaml can say about a posed folder, with the options on top."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, PositiveInt, ValidationError, model_validator

from semstab.config import Settings, explain, read_yaml
from semstab.errors import ConfigError
from semstab.labels import LabelSpace

SETTINGS_FILE = "scene.yaml"

CAMERA_AXES: Mapping[str, npt.NDArray[np.float64]] = {
    "opencv": np.eye(3),
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ned": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
"""From OpenCV camera axes (x right, y down, z forward) to the named ones: opengl has x right, y up, z backward;
ned has x forward, y right, z down, as TartanAir."""

UP_AXES: Mapping[str, tuple[float, float, float]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip


class SceneSettings(Settings):
    """What scene.yaml can say, and the options override; None is 'not said'."""

    depth_scale: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="depth units per metre; 1000 for PNG, 1 for float files"
    )
    depth_kind: Literal["planar", "ray"] | None = Field(
        None, description="depth along the optical axis (planar, the default), or along the ray through the pixel"
    )
    pose_convention: Literal["camera_to_world", "world_to_camera"] | None = Field(
        None, description="what the matrices in pose/ map; camera_to_world where not given"
    )
    camera_axes: Literal["opencv", "opengl", "ned"] | None = Field(
        None, description="axes of the camera: opencv, opengl, or ned (x forward, y right, z down); opencv by default"
    )
    up_axis: Literal["x", "y", "z", "-x", "-y", "-z"] | None = Field(None, description="the world's up axis")
    taxonomy: str | None = Field(
        None,
        description="a shipped taxonomy or a YAML file, relative to the scene.yaml (as an option: to where you are)",
    )
    classes: tuple[str, ...] | None = Field(None, description="class names in id order, instead of a taxonomy")
    scores_layout: Literal["KHW", "HWK"] | None = Field(None, description="axes of score arrays; KHW by default")
    intrinsics_size: tuple[PositiveInt, PositiveInt] | None = Field(
        None, description="[width, height] that intrinsics.txt is for, where that is not the depth's"
    )

    @model_validator(mode="after")
    def _one_label_space(self) -> Self:
        if self.classes is not None and self.taxonomy is not None:
            raise ValueError("give classes or taxonomy, not both")
        return self

    def label_space(self) -> LabelSpace | None:
        """The classes, where they are said. Raises ConfigError for a taxonomy or classes that cannot be used."""
        if self.classes is not None:
            return LabelSpace(name="classes of the scene", classes=self.classes)
        return LabelSpace.load(self.taxonomy) if self.taxonomy else None


def read_settings(folder: Path, options: SceneSettings) -> SceneSettings:
    """scene.yaml, where there is one, with the options on top; a taxonomy file in it is relative to the folder.

    Raises ConfigError that names the file and the setting.
    """
    path = folder / SETTINGS_FILE
    said = _read_file(path) if path.is_file() else SceneSettings()
    if said.taxonomy and Path(said.taxonomy).suffix in (".yaml", ".yml"):
        said = said.model_copy(update={"taxonomy": str(folder / said.taxonomy)})
    over = {key: value for key in SceneSettings.model_fields if (value := getattr(options, key)) is not None}
    if "taxonomy" in over or "classes" in over:  # one of the two is enough to replace either
        over = {"taxonomy": None, "classes": None} | over
    return said.model_copy(update=over)


def _read_file(path: Path) -> SceneSettings:
    try:
        return SceneSettings.model_validate(read_yaml(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error, SceneSettings)}") from error
