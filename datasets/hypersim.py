"""Hypersim: rendered rooms, a folder ai_VVV_NNN a scene, with images/scene_cam_XX_*/ and _detail/ of cameras.

Source: Roberts et al., Hypersim, ICCV 2021; github.com/apple/ml-hypersim: README (layout, coordinates), and
contrib/mikeroberts3000 (metadata_camera_parameters.csv: M_cam_from_uv gives the ray of a pixel, also of tilted lenses).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_16BIT, LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, frames_of
from semstab.datasets.formats.disk import files_named, read_text, subfolders
from semstab.datasets.formats.hdf5 import numbers, opened
from semstab.datasets.formats.image_sizes import MAX_PIXELS
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.cameras import CAMERA_AXES, Camera
from semstab.datasets.geometry.lenses import Labels
from semstab.errors import DataError

DATA = "dataset"
"""The name of the array in each HDF5 file."""

CAMERAS = "metadata_camera_parameters.csv"
MOST_ROWS = 1 << 20
MOST_BYTES = 1 << 26
STRAIGHT = 0.5
"""Pixels of skew up to which a camera is a pinhole."""


class HypersimOptions(FileOptions):
    """Options with the defaults of the format; metres_per_unit is that of the scene's metadata_scene.csv."""

    depth_scale: opt.DepthScale = 1
    depth_kind: opt.DepthKind = "ray"
    camera_axes: opt.CameraAxes = "opengl"
    up_axis: opt.UpAxis = "z"
    metres_per_unit: opt.MetresPerUnit = None
    intrinsics: opt.FourIntrinsics = None
    camera: str = Field("", pattern=r"^(cam_\d\d|)$", description="cam_00, ...; the first one of the scene by default")
    camera_parameters: Path | None = Field(None, description=f"{CAMERAS}, unless the scene or a folder above has it")


class Hypersim(FileDataset[HypersimOptions]):
    """{name} is the frame's number: 0012. Ground truth are the ids of NYU40 in frame.NNNN.semantic.hdf5."""

    Options: type[BaseModel] = HypersimOptions
    contents = "_detail/ and images/scene_cam_00_geometry_hdf5/"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the camera's poses and depth are there; with a surface, the poses."""
        return self._camera(folder) is not None

    def settled(self, folder: Path) -> HypersimOptions:
        """Return the options with the scene's unit, and the ground truth of the camera."""
        truth = f"images/scene_{self._camera(folder)}_geometry_hdf5/frame.{{name}}.semantic.hdf5"
        unit = self.options.metres_per_unit or _unit(folder / "_detail/metadata_scene.csv")
        truth = self.options.ground_truth or truth
        return self.options.model_copy(update={"ground_truth": truth, "metres_per_unit": unit})

    def truth(self, folder: Path) -> TruthSource:
        """Return how classes are read."""
        return TruthSource(read=_classes, space=LabelSpace.load("nyu40"))

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each depth map, whose number is that of its pose.

        Raises:
            DataError: For poses or a camera that are not there, or damaged.
            MissingDependencyError: If h5py is not installed.
        """
        name = self._camera(folder)
        where, images = folder / f"_detail/{name}", folder / f"images/scene_{name}_final_preview"
        previews = files_named(images, "frame.", ".color.jpg")
        depth = self.depth_files(
            folder / f"images/scene_{name}_geometry_hdf5", "frame.", ".depth_meters.hdf5", instead=previews
        )
        rows = [_number(stem, folder) for stem in depth]
        camera, turn = self._pinhole(folder)
        poses = _poses(where, rows) @ turn
        color = f"{images.relative_to(folder)}/frame.{{name}}.color"
        for frame in frames_of(folder, depth, camera, pose=f"_detail/{name}", color=color, poses=poses):
            yield replace(frame, depth_reader=_depth)

    def _camera(self, folder: Path) -> str | None:
        """Return the camera of the options, else the first camera with poses and depth, else None."""
        candidates = (
            [self.options.camera] if self.options.camera else subfolders(folder / "_detail") if folder.is_dir() else []
        )
        for name in candidates:
            poses = (folder / f"_detail/{name}/camera_keyframe_positions.hdf5").is_file()
            if poses and self.has_depth(folder / f"images/scene_{name}_geometry_hdf5"):
                return name
        return None

    def _pinhole(self, folder: Path) -> tuple[Camera, Float64]:
        """Return the camera, and the pose (4, 4) of its axes in those of the poses, both OpenGL."""
        if self.options.intrinsics is not None:
            return Camera(Intrinsics(*self.options.intrinsics)), np.eye(4)
        stated, above = self.options.camera_parameters, (folder, *folder.absolute().parents[:3])
        path = stated or next((parent / CAMERAS for parent in above if (parent / CAMERAS).is_file()), None)
        if path is None:
            raise DataError(
                f"{folder}: {CAMERAS} is not there or above; get it from ml-hypersim, contrib/mikeroberts3000, or set"
                " intrinsics: [886.81, 886.81, 511.5, 383.5], those of scenes with a usual lens"
            )
        return read_lens(path, folder.name)


def read_lens(path: Path, scene: str) -> tuple[Camera, Float64]:
    """Return the camera of a scene in metadata_camera_parameters.csv, and the pose (4, 4) of its axes, OpenGL.

    A pixel's ray is M_cam_from_uv (u v 1), with u, v from -1 to 1, v up: K R is the inverse for pixels, up to scale,
    so that a tilted lens is a pinhole that looks elsewhere.

    Raises:
        DataError: If the scene has no row, or its lens is no pinhole.
    """
    from scipy.linalg import rq

    rows = csv.DictReader(read_text(path, MOST_BYTES).splitlines())
    row = next((row for row in rows if row.get("scene_name") == scene), None)
    if row is None:
        raise DataError(f"{path}: has no row of {scene}; is that the scene's own name? else set intrinsics")
    try:
        W, H = (int(float(row[f"settings_output_img_{side}"])) for side in ("width", "height"))
        M = np.array([[float(row[f"M_cam_from_uv_{i}{j}"]) for j in range(3)] for i in range(3)])
        uv = np.array([[2 / W, 0, 1 / W - 1], [0, -2 / H, 1 - 1 / H], [0, 0, 1]])
        K, R = rq(np.linalg.inv(CAMERA_AXES["opengl"] @ M @ uv))
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError, np.linalg.LinAlgError) as error:
        raise DataError(f"{path}: the row of {scene} holds no size and M_cam_from_uv; download it again") from error
    signs = np.sign(np.diag(K))
    K, R = K * signs, (R.T * signs).T
    K = K / K[2, 2]
    if not abs(K[0, 1]) <= STRAIGHT or np.linalg.det(R) < 0:
        raise DataError(
            f"{path}: the lens of {scene} has a skew of {K[0, 1]:.1f} pixels, which no pinhole has; leave it out"
        )
    turn = np.eye(4)
    turn[:3, :3] = CAMERA_AXES["opengl"] @ R.T @ CAMERA_AXES["opengl"]
    return Camera.stated((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (W, H), str(path)), turn


def _poses(folder: Path, rows: list[int]) -> Float64:
    """Return (n, 4, 4) camera to world of these rows, OpenGL axes, in the scene's unit."""
    where, how = folder / "camera_keyframe_positions.hdf5", folder / "camera_keyframe_orientations.hdf5"
    with opened(where) as file:
        t = numbers(file, DATA, (None, 3), MOST_ROWS, where)
    with opened(how) as file:
        R = numbers(file, DATA, (None, 3, 3), MOST_ROWS, how)
    if lost := [row for row in rows if row >= min(len(t), len(R))]:
        raise DataError(
            f"{where}: has {len(t)} rows, and {len(R)} rotations, but frame {lost[0]} is there; download it again"
        )
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R[rows], t[rows]
    return T


def _unit(path: Path) -> float:
    """Return metres in a unit of the poses."""
    if not path.is_file():
        raise DataError(f"{path}: is missing; it holds meters_per_asset_unit; download it, or set metres_per_unit")
    rows = [line.split(",") for line in read_text(path, MOST_BYTES).splitlines()]
    value = next((row[1] for row in rows if len(row) > 1 and row[0].strip() == "meters_per_asset_unit"), "")
    try:
        unit = float(value)
    except ValueError:
        unit = 0.0
    if not 0 < unit < 1e6:
        raise DataError(f"{path}: meters_per_asset_unit is {value[:20]!r}; download it again, or set metres_per_unit")
    return unit


def _number(name: str, folder: Path) -> int:
    if not (name.isascii() and name.isdigit() and len(name) < 10):
        raise DataError(f"{folder}: {name[:40]!r} is no number of a frame, which ties it to its pose; rename it")
    return int(name)


def _depth(path: Path, scale: float | None, read: Read) -> Float32:
    with opened(path, read(path)) as file:
        depth = numbers(file, DATA, (None, None), MAX_PIXELS, path)
    return depth.astype(np.float32) / np.float32(scale or 1)


def _classes(_: FrameSource, path: Path, read: Read) -> Labels:
    """Return ids of NYU40; -1 and 0 are no class."""
    with opened(path, read(path)) as file:
        ids = numbers(file, DATA, (None, None), MAX_PIXELS, path)
    return np.where((ids > 0) & (ids < IGNORE_16BIT), ids, IGNORE_16BIT).astype(np.uint16)
