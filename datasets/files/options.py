"""Options that every dataset of files has: where its label maps are, its units and its conventions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveInt, model_validator

from semstab.config import Settings
from semstab.datasets import GROUND_TRUTH

Positive = Annotated[float, Field(gt=0, le=1e30)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Id = Annotated[int, Field(ge=0, le=65535)]

Taxonomy = Annotated[str | None, Field(description="taxonomy of the label maps: a name or a YAML file")]
ScoresLayout = Annotated[Literal["KHW", "HWK"] | None, Field(description="axes of score arrays")]
DepthKind = Annotated[
    Literal["planar", "ray"] | None,
    Field(description="depth is measured along the optical axis, or along the ray of the pixel"),
]
MetresPerUnit = Annotated[Positive | None, Field(description="metres in a unit of the poses")]
DepthScale = Annotated[Positive | None, Field(description="units of the depth files in a metre")]
InvalidDepth = Annotated[tuple[Finite, ...], Field(description="stored values that mean 'no depth', besides 0")]
MaxDepth = Annotated[Positive | None, Field(description="metres from which depth is not valid, the sky for example")]
PoseConvention = Annotated[
    Literal["camera_to_world", "world_to_camera"] | None, Field(description="what the poses map")
]
CameraAxes = Annotated[
    Literal["opencv", "opengl", "ned"] | None,
    Field(description="axes of the camera: opencv, opengl, or ned (x forward, y right, z down)"),
]
UpAxis = Annotated[Literal["x", "y", "z", "-x", "-y", "-z"] | None, Field(description="the world's up axis")]
Crs = Annotated[
    str | None,
    Field(description="projected reference system of the world in metres: EPSG:32615, a PROJ string or WKT"),
]
PixelCentre = Annotated[
    float | None, Field(ge=0, le=1, description="where the intrinsics have the centre of the first pixel: 0 or 0.5")
]
FourIntrinsics = Annotated[
    tuple[Positive, Positive, Finite, Finite] | None,
    Field(description="[fx, fy, cx, cy] in pixels; those of the dataset where not given"),
]
Offset = Annotated[
    tuple[Finite, Finite, Finite] | None,
    Field(description="[east, north, up] in metres that makes scene coordinates those of crs"),
]
Size = Annotated[
    tuple[PositiveInt, PositiveInt] | None,
    Field(description="[width, height] that the intrinsics are for, where that is not the depth's"),
]
GroundTruth = Annotated[
    str | None, Field(description="template of ground truth label maps, relative to the scene's folder")
]
VoidIds = Annotated[
    dict[str, tuple[Id, ...]], Field(description="ids that mean 'no label', by label source; gt is the ground truth")
]


def zero_is_void() -> dict[str, tuple[int, ...]]:
    """`void_ids` of a dataset whose ground truth has 0 where there is no label."""
    return {GROUND_TRUTH: (0,)}


class FileSettings(Settings):
    """How files are read; a reader replaces the defaults that its format fixes.

    Templates hold {scene} (the scene's folder below root), {backbone} and {name} (the frame's name); without a suffix
    they find any that can be read.
    """

    labels: str | dict[str, str] | None = Field(
        None,
        description="template of label maps: labels/{backbone}/{name}, or in a labels_root {scene}/{backbone}/{name};"
        " or a template for each backbone",
    )
    scores: str | dict[str, str] | None = Field(
        None, description="the same of soft scores: scores/{backbone}/{name}; none in a labels_root unless given"
    )
    scores_layout: ScoresLayout = "KHW"
    ground_truth: GroundTruth = None
    taxonomy: Taxonomy = None
    classes: tuple[str, ...] | None = Field(None, description="class names in id order, instead of a taxonomy")
    taxonomies: dict[str, str] = Field(
        default_factory=dict, description="taxonomies of single label sources; gt is the ground truth"
    )
    void_ids: VoidIds = Field(default_factory=dict)
    masks: str | None = Field(
        None, description="template of masks, PNGs with 0 where a thing moves and is left out, relative to the scene"
    )

    depth_scale: DepthScale = None
    depth_kind: DepthKind = "planar"
    invalid_depth: InvalidDepth = ()
    max_depth: MaxDepth = None

    pose_convention: PoseConvention = "camera_to_world"
    camera_axes: CameraAxes = "opencv"
    up_axis: UpAxis = None
    metres_per_unit: MetresPerUnit = 1.0
    crs: Crs = None
    offset: Offset = None

    intrinsics_size: Size = None
    pixel_centre: PixelCentre = 0
    frames_per_second: Positive | None = Field(
        None, description="gives frames time stamps, from 0 s, where the dataset has none"
    )

    @model_validator(mode="after")
    def _one_label_space(self) -> Self:
        if self.classes is not None and self.taxonomy is not None:
            raise ValueError("give classes or taxonomy, not both")
        if self.offset is not None and self.crs is None:
            raise ValueError("give crs with offset")
        return self


Surface = Annotated[
    Path | None,
    Field(description="mesh, cloud (LAS, LAZ, PLY) or height raster (GeoTIFF) that depth is cast from, not from files"),
]
SurfaceCell = Annotated[
    Positive | None, Field(description="metres of a cell of the grid that a cloud or a raster becomes, seen from above")
]


class FileOptions(FileSettings):
    """What can be said of any dataset of files: where they are, and how they are read."""

    root: Path = Field(description="a scene's folder, or the folder above scenes")
    incomplete: Literal["error", "skip"] = Field(
        "error", description="a selected frame without depth, pose or labels is an error, or is left out and counted"
    )
    labels_root: Path | None = Field(
        None, description="folder of label maps and scores; the scene's own where not given"
    )
    surface: Surface = None
    surface_cell: SurfaceCell = None
    casts: Path | Literal[False] | None = Field(
        None, description="folder where cast depth is kept, or false; semstab/casts in the user's cache by default"
    )
