"""transforms.json of nerfstudio and instant-ngp, with depth maps.

Sources: Tancik et al., Nerfstudio, SIGGRAPH 2023, its data conventions and its dataparser; Müller et al., Instant
Neural Graphics Primitives, SIGGRAPH 2022, and its nerf_loader.
"""

from __future__ import annotations

import math
import os
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from semstab.datasets.files.options import CameraAxes, FileOptions, Folders, FrameSource, PixelCentre, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import matrix, natural, number, pixels, read_object
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES, MILLIMETRES, color_size
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
PINHOLES = (None, "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "perspective")
"""Camera models that do not distort if the coefficients are zero."""


FILES = ("transforms.json", "transforms_train.json")
"""Files of the cameras, the first that is there: Blender's exports for NeRF have one for each part of their images."""


class TransformsOptions(FileOptions):
    """Options with the defaults of the format; the depth scale is the file's own, else 1000."""

    camera_axes: CameraAxes = "opengl"
    pixel_centre: PixelCentre = 0.5
    transforms: str | None = Field(
        None,
        description="file of the cameras in the scene's folder; by default transforms.json, or transforms_train.json",
    )
    depth: str | None = Field(None, description="template with {name}, for frames without depth_file_path")


class TransformsJson(FileDataset[TransformsOptions]):
    """{name} is the image's name without suffix, from the folder that all images share: frame_00012.

    Depth is read as the programs do: integers and floats are millimetres, unless the file has integer_depth_scale or
    depth_unit_scale_factor (metres in a unit). Poses that the file says to be scaled (applied_scale) are divided by
    that. Frames go in the natural order of their images. Without w and h, the size of an image is its file's size.
    """

    Options: type[BaseModel] = TransformsOptions
    contents = "transforms.json"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the file of the cameras is there."""
        return self._file(folder).is_file()

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each entry of 'frames'. Raises what `read_transforms` raises."""
        path = self._file(folder)
        depth = self.options.depth or ("depth/{name}" if self.options.surface is not None else None)
        template = None if depth is None else Template("depth", depth, ("name",), ("name",))
        return read_transforms(path, self.options.root, folder, template)

    def _file(self, folder: Path) -> Path:
        """Return the file of the cameras, there or not."""
        if self.options.transforms is not None:
            return inside(self.options.root, folder, self.options.transforms, "option transforms")
        return next((path for name in FILES if (path := folder / name).is_file()), folder / FILES[0])


def read_transforms(path: Path, root: Path, folder: Path, depth: Template | None = None) -> list[FrameSource]:
    """Return the frames of a transforms.json, whose paths are relative to it and stay in root.

    `depth` is a template, relative to `folder`, of depth maps that the file does not name.

    Raises:
        DataError: For missing or damaged values, distortion, or no depth; the message names the file and the frame.
    """
    content, folders = read_object(path), Folders()
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{path}: 'frames' must be a list with an entry for each image")
    wheres = [f"{path}: frame {k}" for k in range(len(entries))]
    images = [_named(entry, ("file_path",), path, root, where) for entry, where in zip(entries, wheres, strict=True)]
    shared = Path(os.path.commonpath([image.parent for image in images if image is not None] or [path.parent]))
    scale, frames = MILLIMETRES, []  # units in a metre
    key = next((k for k in ("integer_depth_scale", "depth_unit_scale_factor") if content.get(k) is not None), None)
    if key is not None:
        metres = number(content, key, str(path))
        if metres <= 0 or math.isinf(1 / metres):
            raise DataError(f"{path}: '{key}' is {metres:g}; expected the metres in a unit of depth")
        scale = 1 / metres
    shrunk = number(content, "applied_scale", str(path)) if content.get("applied_scale") is not None else 1.0
    if not 0 < shrunk < math.inf or math.isinf(1 / shrunk):
        raise DataError(f"{path}: 'applied_scale' is {shrunk:g}; expected the factor by which poses were multiplied")
    for entry, image, where in zip(entries, images, wheres, strict=True):
        if image is None:
            raise DataError(f"{where}: 'file_path' is missing; add it")
        name = os.path.splitext(image.relative_to(shared).as_posix())[0]  # noqa: PTH122  dots in names are kept
        stated = _named(entry, ("depth_file_path", "depth_path"), path, root, where)
        if stated is None and depth is not None:
            stated = inside(root, folder, depth.filled(name=name), where)
        if stated is None:
            raise DataError(f"{where}: has no depth_file_path; add it, or set depth: 'depth/{{name}}.png'")
        color, pose = (
            folders.one_of(image, COLOR_SUFFIXES),
            matrix(entry.get("transform_matrix"), f"{where}: transform_matrix"),
        )
        pose[:3, 3] /= shrunk
        values = ChainMap(entry, content)
        if color is not None and "camera_angle_x" in values and not {"w", "h"} & values.keys():  # of Blender
            values = values.new_child(dict(zip("wh", color_size(color), strict=True)))
        frames.append(
            FrameSource(
                name=name, depth=folders.one_of(stated, DEPTH_SUFFIXES) or stated, pose=pose, pose_file=path,
                camera=_camera(values, where), color=color, depth_scale=scale,
            )
        )  # fmt: skip
    return sorted(frames, key=lambda frame: natural(frame.name))


def _named(entry: Mapping[str, Any], keys: tuple[str, ...], path: Path, root: Path, where: str) -> Path | None:
    """Return the path that the first present key holds, or None without the keys."""
    value = next((entry[key] for key in keys if entry.get(key) is not None), None)
    if value is None:
        return None
    if not isinstance(value, str) or not value:
        raise DataError(f"{where}: {keys[0]} is {repr(value)[:40]}; expected a path")
    return inside(root, path.parent, value.replace("\\", "/"), where)


def _camera(values: Mapping[str, Any], where: str) -> Camera:
    """Return the camera of a frame; its own values go before those of the file."""
    model = values.get("camera_model")
    coefficients = [number(values, key, where) for key in DISTORTION if values.get(key) is not None]
    if model not in PINHOLES or any(coefficients):
        what = repr(model)[:40] if model not in PINHOLES else "with k1, k2, ..."
        raise DataError(f"{where}: the camera ({what}) distorts; undistort the images and remove its coefficients")
    fx, fy = _focal(values, "x", where), _focal(values, "y", where)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise DataError(f"{where}: 'fl_x' is missing; add it, or camera_angle_x with w and h")
    size = (pixels(values, "w", where), pixels(values, "h", where)) if "w" in values and "h" in values else None
    cx = size[0] / 2 if size and "cx" not in values else number(values, "cx", where)
    cy = size[1] / 2 if size and "cy" not in values else number(values, "cy", where)
    return Camera.stated((fx, fy, cx, cy), size, where)


def _focal(values: Mapping[str, Any], axis: str, where: str) -> float | None:
    """Return focal length in pixels, from fl_x or the angle of the field of view, or None without both."""
    if values.get(f"fl_{axis}") is not None:
        return number(values, f"fl_{axis}", where)
    if values.get(f"camera_angle_{axis}") is None:
        return None
    side = pixels(values, "w" if axis == "x" else "h", where)
    angle = number(values, f"camera_angle_{axis}", where)
    if not 0 < angle < math.pi:
        raise DataError(f"{where}: 'camera_angle_{axis}' is {angle:g}; expected radians between 0 and pi")
    return side / (2 * math.tan(angle / 2))
