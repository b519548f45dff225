"""Images that CARLA's cameras save as they are: depth in 24 bits, semantic tags in the red channel or as colours.

Sources: carla.readthedocs.io, ref_sensors (coding of depth, tags); poses as in the files of Syndrone's generator
(LTTM/Syndrone, CarlaClient.py), or as in KITTI-CARLA (Deschaud, 2021; jedeschaud/kitti_carla_simulator: its generator
and KITTI_colorization.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.files.scans import rigid_inverse
from semstab.datasets.formats.disk import files_named, matrix_of, read_table
from semstab.datasets.formats.images import Read, depth_size, read_color, read_labels
from semstab.datasets.geometry.cameras import Camera, seen_across
from semstab.datasets.geometry.lenses import Labels
from semstab.datasets.syndrone import pose_of
from semstab.errors import DataError

FULL_SCALE = (2**24 - 1) / 1000
"""Stored units of depth in a metre; 1000 m is the sky."""

TO_OPENCV = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From axes x forward, y left, z up to those of OpenCV."""

USUAL_VIEW, KITTI_CARLA_VIEW = 90.0, 72.0
"""Degrees across an image: CARLA's default, and KITTI-CARLA's."""

LIDAR_POSES = "full_poses_lidar.txt"

SAME_TIME = 1e-3
"""Seconds that the pose of an image may be off it: there is one each millisecond."""


class CarlaOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = FULL_SCALE
    max_depth: opt.MaxDepth = 999
    up_axis: opt.UpAxis = "z"
    void_ids: opt.VoidIds = opt.ZERO_IS_VOID
    intrinsics: opt.FourIntrinsics = None
    fov: float | None = Field(None, gt=0, lt=180, description="degrees across the image; 90, of KITTI-CARLA 72")
    camera: Literal[0, 1] = Field(0, description="of KITTI-CARLA: the left or the right camera")
    tags: Literal["carla", "carla23"] | None = Field(
        None, description="what tags mean: carla from 0.9.14 on; carla23 from 0.9.10 to 0.9.13, as in KITTI-CARLA"
    )


class Carla(FileDataset[CarlaOptions]):
    """{name} is the depth image's name without suffix: 00012; of KITTI-CARLA the number before its camera, 0012."""

    Options: type[BaseModel] = CarlaOptions
    contents = f"depth/ (24 bits), rgb/ and camera/NAME.json (or images_depth/ and {LIDAR_POSES} of KITTI-CARLA)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether depth in 24 bits is there, and poses; with a surface, the poses."""
        if (folder / LIDAR_POSES).is_file():
            return self.has_depth(folder / "images_depth")
        if not ((folder / "camera").is_dir() and (folder / "rgb").is_dir()):
            return False
        first = next(iter(files_named(folder / "depth", "", ".png").values()), None)
        return self.has_depth(folder / "depth") and (first is None or not _is_grey(first))

    def settled(self, folder: Path) -> CarlaOptions:
        """Return the options with the ground truth of the camera."""
        kitti = (folder / LIDAR_POSES).is_file()
        truth = f"images_ss/{{name}}_{10 + self.options.camera}.png" if kitti else "semantic/{name}.png"
        return self.options.model_copy(update={"ground_truth": self.options.ground_truth or truth})

    def truth(self, folder: Path) -> TruthSource:
        """Return how tags are read, and what they mean."""
        usual = "carla23" if (folder / LIDAR_POSES).is_file() else "carla"
        space = LabelSpace.load(self.options.tags or usual)
        return TruthSource(partial(read_tags, space=space), space=space)

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each depth image.

        Raises:
            DataError: For an image that has no pose, or a damaged file.
        """
        kitti, k = (folder / LIDAR_POSES).is_file(), self.options.camera
        images, after, color = (
            ("images_rgb", f"_{k}", f"images_rgb/{{name}}_{k}") if kitti else ("rgb", "", "rgb/{name}")
        )
        color_images = images_named(folder / images, "", after)
        where = ("images_depth", f"_{20 + k}.png") if kitti else ("depth", ".png")
        depth = self.depth_files(folder / where[0], "", where[1], instead=color_images)
        if kitti:
            pose, (poses, times) = LIDAR_POSES, _kitti_carla(folder, k, list(depth))
        else:
            pose, times = "camera/{name}.json", None
            poses = np.array([pose_of(folder / f"camera/{name}.json") for name in depth]).reshape(-1, 4, 4)
        camera = self._camera(depth, USUAL_VIEW if times is None else KITTI_CARLA_VIEW, folder / where[0])
        for index, frame in enumerate(frames_of(folder, depth, camera, pose=pose, color=color, poses=poses)):
            time = None if times is None else float(times[index])
            yield replace(frame, depth_reader=read_packed_depth, timestamp=time)

    def _camera(self, depth: dict[str, Path], view: float, where: Path) -> Camera:
        if self.options.intrinsics is not None:
            return Camera(Intrinsics(*self.options.intrinsics))
        size = next((size for file in depth.values() if (size := depth_size(file)) is not None), None)
        if size is None:
            raise DataError(f"{where}: no PNG tells the size of images; set intrinsics: [fx, fy, cx, cy]")
        return seen_across(self.options.fov or view, size, str(where))


def _is_grey(path: Path) -> bool:
    """Return whether a PNG is grey of 16 bits, which is another coding of depth."""
    try:
        with path.open("rb") as file:
            return file.read(26)[24:] == b"\x10\x00"
    except OSError:  # raised where the image is needed
        return False


def read_packed_depth(path: Path, scale: float | None, read: Read) -> Float32:
    """Return depth (H, W) in metres, float32, of R + 256 G + 65536 B; `scale` is units in a metre.

    Raises:
        DataError: For a damaged image, or a grey one, which is a picture of the depth.
    """
    image = read_color(path, read)
    if image.any() and (image == image[..., :1]).all():
        raise DataError(
            f"{path}: its three channels are equal: a picture of the depth, without its lower 16 bits; save it without"
            " a ColorConverter"
        )
    units = image.astype(np.float32) @ np.array([1, 256, 65536], np.float32)  # whole below 2^24: exact
    metres: Float32 = units / np.float32(scale or FULL_SCALE)
    return metres


def read_tags(_: FrameSource, path: Path, read: Read, *, space: LabelSpace) -> Labels:
    """Return tags (H, W): the red channel where the others are 0, or grey, else those of CARLA's colours."""
    image = read_color(path, read)
    if not image[..., 1:].any() or (image == image[..., :1]).all():
        return image[..., 0]
    return read_labels(path, space, read)


def _kitti_carla(folder: Path, camera: int, names: list[str]) -> tuple[Float64, Float64]:
    """Return poses (n, 4, 4) camera to world, right-handed, z up, and times (n,), seconds, of KITTI-CARLA's images."""
    stamps, path, mount = folder / "full_ts_camera.txt", folder / LIDAR_POSES, folder / f"lidar_to_cam{camera}.txt"
    by_number = {int(row[0]): row[1] for row in read_table(stamps, 2, "frame_id timestamp") if np.isfinite(row[0])}
    if lost := [name for name in names if not (name.isdecimal() and int(name) in by_number)]:
        raise DataError(f"{stamps}: has no row of image {lost[0][:40]}; get it again, or remove the image")
    times = np.array([by_number[int(name)] for name in names])
    rows = read_table(path, 13, "R(0,0) R(0,1) R(0,2) t(0) ... timestamp")
    near = np.abs(rows[:, 12] - times[:, None]).argmin(axis=1)
    gaps = np.abs(rows[near, 12] - times)
    if (far := ~(gaps <= SAME_TIME)).any():
        k = int(far.argmax())
        raise DataError(f"{path}: has no pose at {times[k]:g} s, of image {names[k]}; get it again")
    T_cl = TO_OPENCV @ matrix_of(read_table(mount, 12, "R(0,0) R(0,1) R(0,2) t(0) ...")[0])
    poses = np.array([matrix_of(row) for row in rows[near, :12]]).reshape(-1, 4, 4)
    return poses @ rigid_inverse(T_cl, str(mount)), times
