"""Options that every dataset of files has, path templates, and the files of a frame."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveInt, model_validator

from semstab.config import Settings
from semstab.core.files import file_digest
from semstab.core.types import Float32, UInt16
from semstab.data.labels import LabelSpace
from semstab.datasets import GROUND_TRUTH
from semstab.datasets.formats.disk import natural, read_bytes, subfolders
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.cameras import Camera, Poses
from semstab.datasets.geometry.lenses import Labels, Lens
from semstab.errors import ConfigError, DataError

Positive = Annotated[float, Field(gt=0, le=1e30)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Id = Annotated[int, Field(ge=-(2**31), le=65535)]

Taxonomy = Annotated[str | None, Field(description="taxonomy of the label maps: a name or a YAML file")]
ScoresLayout = Annotated[Literal["KHW", "HWK"] | None, Field(description="axes of score arrays")]
DepthKind = Annotated[
    Literal["planar", "ray", "inverse"] | None,
    Field(description="depth along the optical axis, along the ray of the pixel, or 1 over the first"),
]
MetresPerUnit = Annotated[Positive | None, Field(description="metres in a unit of the poses")]
DepthScale = Annotated[Positive | None, Field(description="units of the depth files in a metre")]
InvalidDepth = Annotated[tuple[Finite, ...], Field(description="stored values that mean 'no depth', besides 0")]
MaxDepth = Annotated[Positive | None, Field(description="metres from which depth is not valid, the sky for example")]
PoseConvention = Annotated[Literal["camera_to_world", "world_to_camera"] | None, Field(description="map of the poses")]
CameraAxes = Annotated[
    Literal["opencv", "opengl", "ned"] | None, Field(description="camera axes; ned: x forward, y right, z down")
]
UpAxis = Annotated[Literal["x", "y", "z", "-x", "-y", "-z"] | None, Field(description="the world's up axis")]
PixelCentre = Annotated[float | None, Field(ge=0, le=1, description="centre of the first pixel, as in the intrinsics")]
FourIntrinsics = Annotated[
    tuple[Positive, Positive, Finite, Finite] | None, Field(description="[fx, fy, cx, cy] in pixels, or the dataset's")
]
Offset = Annotated[
    tuple[Finite, Finite, Finite] | None, Field(description="[east, north, up], metres, from the scene to crs")
]
Linear = Annotated[
    tuple[tuple[Finite, Finite, Finite], tuple[Finite, Finite, Finite], tuple[Finite, Finite, Finite]] | None,
    Field(description="3x3 rows from the scene to crs, before offset is added; axes that are not those of crs"),
]
Size = Annotated[tuple[PositiveInt, PositiveInt] | None, Field(description="[width, height] of the intrinsics' image")]
TimeOffset = Annotated[
    float, Field(ge=-1e9, le=1e9, description="seconds by which the time stamps of the poses are late")
]
LeastConfidence = Annotated[
    int, Field(ge=0, le=255, description="depth of pixels with less confidence, as stored, is left out; 0 keeps all")
]
GroundTruth = Annotated[str | None, Field(description="template of ground truth label maps, in the scene's folder")]
VoidIds = Annotated[dict[str, tuple[Id, ...]], Field(description="ids that mean 'no label', by label source, or gt")]


ZERO_IS_VOID: dict[str, tuple[int, ...]] = {GROUND_TRUTH: (0,)}
"""`void_ids` of a dataset whose ground truth has 0 for pixels without a label."""


class LabelSettings(Settings):
    """The settings by which label maps are read.

    Templates hold {scene} (the scene's folder below root), {model} and {name} (the frame's name); without a suffix
    they find any that can be read.
    """

    labels: str | dict[str, str] | None = Field(
        None, description="template of label maps, or one for each model: labels/{model}/{name} by default"
    )
    scores: str | dict[str, str] | None = Field(
        None, description="the same of soft scores: scores/{model}/{name}; none in a labels_root unless given"
    )
    scores_layout: ScoresLayout = "KHW"
    ground_truth: GroundTruth = None
    taxonomy: Taxonomy = None
    classes: tuple[str, ...] | None = Field(None, description="class names in id order, instead of a taxonomy")
    taxonomies: dict[str, str] = Field({}, description="taxonomies of single label sources; gt is the ground truth")
    void_ids: VoidIds = Field({})
    masks: str | None = Field(None, description="template of masks of the scene: PNGs with 0 where a thing moves")

    @model_validator(mode="after")
    def _one_label_space(self) -> Self:
        if self.classes is not None and self.taxonomy is not None:
            raise ValueError("give classes or taxonomy, not both")
        return self


class LabelOptions(LabelSettings):
    """Options of label maps of a dataset of files."""

    labels_root: Path | None = Field(None, description="folder of label maps and scores, if not the scene's own")


class FileSettings(LabelSettings):
    """The settings by which files are read; a reader replaces the defaults that its format fixes."""

    depth_scale: DepthScale = None
    depth_kind: DepthKind = "planar"
    invalid_depth: InvalidDepth = ()
    max_depth: MaxDepth = None

    pose_convention: PoseConvention = "camera_to_world"
    camera_axes: CameraAxes = "opencv"
    up_axis: UpAxis = None
    metres_per_unit: MetresPerUnit = 1.0
    pose_shift: int | None = Field(
        None, description="frames by which the poses are late: frame k has the pose of frame k + pose_shift"
    )
    crs: str | None = Field(None, description="projected reference system in metres: EPSG:32615, PROJ string or WKT")
    offset: Offset = None
    linear: Linear = None

    intrinsics_size: Size = None
    pixel_centre: PixelCentre = 0
    frames_per_second: Positive | None = Field(None, description="for time stamps from 0 s, if frames have none")

    @model_validator(mode="after")
    def _placed_in_a_system(self) -> Self:
        if self.offset is not None and self.crs is None:
            raise ValueError("give crs with offset")
        if self.linear is not None and self.crs is None:
            raise ValueError("give crs with linear")
        return self


class FileOptions(FileSettings, LabelOptions):
    """Options of any dataset of files: their paths, and the conventions by which they are read."""

    root: Path = Field(description="a scene's folder, or the folder above scenes")
    incomplete: Literal["error", "skip"] = Field("error", description="a selected frame without depth, pose or labels")
    surface: Path | None = Field(
        None, description="mesh, cloud (LAS, LAZ, PLY) or height raster (GeoTIFF) that depth is cast from"
    )
    surface_cell: Positive | None = Field(None, description="metres of a cell of the grid of a cloud or raster")
    casts: Path | Literal[False] | None = Field(
        None, description="folder where cast depth is stored, or false; semstab/casts in the user's cache by default"
    )


# Path templates such as 'labels/{model}/{name}.png', and paths that stay inside a folder.

LONGEST = 400
"""Characters of a path inside a dataset."""
PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
UNSAFE = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029\ud800-\udfff]")


@dataclass(frozen=True)
class Template:
    """A path, relative to a folder and inside it, with {placeholders}.

    Raises ConfigError, which names the option, for an absolute path, '..', or a placeholder that is not known.
    """

    option: str
    text: str
    known: tuple[str, ...]
    required: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names, where = PLACEHOLDER.findall(self.text), f"{self.option}: {self.text[:200]!r}"
        placeholders = ", ".join(f"{{{name}}}" for name in self.known)
        if unknown := next((name for name in names if name not in self.known), None):
            raise ConfigError(f"{where}: unknown {{{unknown}}}; known: {placeholders}")
        if lacking := next((name for name in self.required if name not in names), None):
            raise ConfigError(f"{where}: needs {{{lacking}}}")
        if any(brace in PLACEHOLDER.sub("", self.text) for brace in "{}"):
            raise ConfigError(f"{where}: a brace is not closed; placeholders are {placeholders}")
        path = PurePosixPath(self.text)
        if path.is_absolute() or ".." in path.parts or UNSAFE.search(self.text) or not path.parts:
            raise ConfigError(
                f"{where}: leaves its folder; write a path inside it, and set root, or labels_root for labels that"
                " are elsewhere"
            )

    def filled(self, **values: str) -> str:
        """Return the path with the placeholders that are given replaced."""
        return PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), self.text)


def matching_folders(base: Path, template: Template, placeholder: str, **values: str) -> dict[str, str]:
    """Return the folders on disk that fit the part of a template with `placeholder`: its value to the template with it.

    Raises:
        ConfigError: If the placeholder is not in the name of a folder, or after one that is still open.
    """
    parts = PurePosixPath(template.filled(**values)).parts
    hole = f"{{{placeholder}}}"
    k = next(k for k, part in enumerate(parts) if hole in part)
    if k == len(parts) - 1 or any(PLACEHOLDER.search(part) for part in parts[:k]):
        raise ConfigError(f"{template.option}: {hole} must be in the name of a folder, before the other placeholders")
    before, _, after = parts[k].partition(hole)
    pattern = re.compile(f"{re.escape(before)}(?P<value>.+){re.escape(after.replace(hole, ''))}", re.DOTALL)
    matches = (pattern.fullmatch(name) for name in subfolders(base.joinpath(*parts[:k])))
    names = sorted((match["value"] for match in matches if match), key=natural)
    return {value: "/".join(parts).replace(hole, value) for value in names}


def inside(root: Path, folder: Path, relative: str, where: str) -> Path:
    """Return `folder / relative`, which must lie in `root`, as `folder` does.

    Raises:
        DataError: If it does not, or no path can be called so, with `where` (the file that names the path).
    """
    if UNSAFE.search(relative) or len(relative) > LONGEST:
        raise DataError(f"{where}: {relative[:40]!r} cannot be the path of a file")
    path = folder / relative
    if ".." not in relative and not relative.startswith("/"):
        return path
    if not Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)):  # noqa: PTH100  symlinks may lead out
        raise DataError(
            f"{where}: the path {relative[:200]!r} leaves {root}; set root to the folder that holds all files"
        )
    return path if ".." not in path.parts else Path(os.path.normpath(path))


class Folders:
    """The contents of folders, each listed once, and of the files in them. Several threads may ask."""

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}
        self._small: dict[str, Mapping[str, str]] = {}

    def has(self, path: Path) -> bool:
        """Return whether there is a file or folder of that path."""
        folder, name = os.path.split(path)
        if folder not in self._names:
            try:
                self._names[folder] = frozenset(os.listdir(folder or "."))  # noqa: PTH208  names, not paths
            except OSError:
                self._names[folder] = frozenset()
        return name in self._names[folder]

    def read(self, path: Path) -> bytes:
        """Return the content of a file; raises what `read_bytes` raises."""
        return read_bytes(path)

    def digest(self, path: Path) -> bytes:
        """Return a hash of a file's content; raises what `file_digest` raises."""
        return file_digest(path)

    def one_of(self, path: Path, suffixes: Collection[str]) -> Path | None:
        """Return the file of a path that has one of the suffixes, else of that with the first suffix there is one of.

        A suffix may be in small or in capital letters.
        """
        if path.suffix.lower() in suffixes:
            return path if self.has(path) else self._alike(path)
        candidates = (path.with_name(path.name + suffix) for suffix in suffixes)
        return next((file for file in map(self._alike, candidates) if file is not None), None)

    def _alike(self, path: Path) -> Path | None:
        """Return the file of a path in whose name the case of the suffix does not count."""
        if self.has(path):
            return path
        folder, name = os.path.split(path)
        if folder not in self._small:
            self._small[folder] = {_small_suffix(entry): entry for entry in self._names.get(folder, ())}
        match = self._small[folder].get(_small_suffix(name))
        return None if match is None else path.with_name(match)


def _small_suffix(name: str) -> str:
    stem, suffix = os.path.splitext(name)  # noqa: PTH122  of a hundred thousand names
    return stem + suffix.lower()


# The files of a frame.

DepthReader = Callable[[Path, float | None, Read], Float32]
"""Gives depth (H, W) in metres of a file, of units in a metre, and of what reads its content."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameSource:
    """The files and numbers that one frame comes from.

    Attributes:
        name: Name of the frame in path templates.
        depth: The file.
        pose_file: The file that holds its pose, or all poses.
        camera: Intrinsics of the depth image.
        pose: (4, 4) in the dataset's convention, or None if a file has the pose.
        label_camera: Intrinsics of the images of label maps, if they differ from `camera`.
        label_lens: Lens of the images of label maps, if they are distorted photographs.
        depth_lens: Lens of the depth image, if it is distorted.
        color_lens: Lens of the colour image, if it is distorted.
        photograph: The distorted photograph, if label maps belong to it.
        aliases: Other names that its label maps may have.
        color: The file of the colour image, which may be missing, or None if its name is unknown.
        depth_scale: Units of depth in a metre, if the dataset's own files state it.
        depth_reader: Reads the depth file, if its suffix does not tell the format.
        timestamp: Seconds.
        confidence: Image of how sure each pixel's depth is; pixels below `least_confidence` have none.
    """

    name: str
    depth: Path
    pose_file: Path
    camera: Camera
    pose: Poses | None = None
    label_camera: Camera | None = None
    label_lens: Lens | None = None
    depth_lens: Lens | None = None
    color_lens: Lens | None = None
    photograph: Path | None = None
    aliases: tuple[str, ...] = ()
    color: Path | None = None
    depth_scale: float | None = None
    depth_reader: DepthReader | None = None
    timestamp: float | None = None
    confidence: Path | None = None
    least_confidence: int = 0


LabelReader = Callable[[FrameSource, Path, Read], Labels]
"""Gives stored ids (H, W) at the pixels of a frame's depth of a file, and of what reads its content."""


@dataclass(frozen=True, eq=False)
class TruthSource:
    """Description of ground truth that a format brings in files that are not label maps of a taxonomy's ids.

    Attributes:
        read: Reads the stored ids of a file that is not a label map.
        ids: Table (65536,) from stored ids to class ids, `NO_ID` for an id without a class.
        space: The classes, unless an option names other classes for the ground truth.
        moving: Stored ids of moving objects; their pixels are masked unless an option names other masks.
    """

    read: LabelReader | None = None
    ids: UInt16 | None = None
    space: LabelSpace | None = None
    moving: Collection[int] = ()


NO_TRUTH = TruthSource()
