"""AirSim's recordings: airsim_rec.txt with the vehicle's poses, and the images that each row names.

Sources: github.com/microsoft/AirSim: docs/modify_recording_data.md and docs/image_apis.md, RecordingFile.cpp (names of
images), PawnSimApi.cpp (columns), common_utils/Utils.hpp (its .pfm, whose rows go from the top to the bottom).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float32, Float64
from semstab.data.frames import Intrinsics
from semstab.datasets import GROUND_TRUTH
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Finite, FrameSource, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.disk import records, to_number
from semstab.datasets.formats.images import Read, depth_size, read_depth
from semstab.datasets.geometry.cameras import Camera, from_quaternions, seen_across
from semstab.errors import DataError

RECORDING = "airsim_rec.txt"
POSE = ("POS_X", "POS_Y", "POS_Z", "Q_X", "Q_Y", "Q_Z", "Q_W")

NAME = re.compile(r"img_(?P<camera>.+)_(?P<kind>\d{1,2})_\d+\.(?:png|pfm|ppm)")
SCENE, SEGMENTATION = "0", "5"
DEPTH = {"1": "planar", "2": "ray"}
"""Types of images, of which two are depth."""


class AirSimOptions(FileOptions):
    """Options with the defaults of the format; depth_kind is that of the type of its images."""

    depth_scale: opt.DepthScale = 1
    depth_kind: opt.DepthKind = None
    max_depth: opt.MaxDepth = 1000
    camera_axes: opt.CameraAxes = "ned"
    up_axis: opt.UpAxis = "-z"
    intrinsics: opt.FourIntrinsics = None
    fov: float = Field(90, gt=0, lt=180, description="degrees across the image, FOV_Degrees of settings.json")
    camera: str = Field("", description="as in names of images: 0, front_center; the first one with depth by default")
    vehicle: str = Field("", description="whose rows count, where several are recorded")
    mount: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = Field(
        (0, 0, 0, 0, 0, 0),
        description="[x, y, z, roll, pitch, yaw] of the camera on the vehicle in settings.json: metres, degrees, NED",
    )


@dataclass(frozen=True)
class RecordingRow:
    """A row of the recording: the vehicle, seconds, seven numbers of its pose, and its camera's files by type."""

    line: int
    vehicle: str
    time: float
    pose: tuple[float, ...]
    files: dict[tuple[str, str], str]


class AirSim(FileDataset[AirSimOptions]):
    """{name} is the image's name without suffix, img_0_0_1530000000000000000; any image of the frame's row will do."""

    Options: type[BaseModel] = AirSimOptions
    contents = f"{RECORDING}, and the images that it names, with depth"

    def is_scene(self, folder: Path) -> bool:
        """Return whether a recording is there, and its images."""
        return (folder / RECORDING).is_file() and (folder / "images").is_dir()

    def settled(self, folder: Path) -> AirSimOptions:
        """Return the options with the kind of the depth images, and the segmentation as truth if its classes are known.

        The colours are those of object ids, which mean what the taxonomy of `gt` says.
        """
        rows = self._rows(folder)
        camera, kind = self._camera(folder, rows)
        truth = self.options.ground_truth
        if truth is None and GROUND_TRUTH in self.options.taxonomies and (camera, SEGMENTATION) in rows[0].files:
            truth = "images/{name}.png"  # a frame is called after it, see `frames`
        kind = self.options.depth_kind or DEPTH[kind]
        return self.options.model_copy(update={"depth_kind": kind, "ground_truth": truth})

    def frames(self, folder: Path) -> Iterator[FrameSource]:
        """Yield a frame for each row.

        Raises:
            DataError: For a damaged row, or one that names no depth image.
        """
        rows, path = self._rows(folder), folder / RECORDING
        camera, kind = self._camera(folder, rows)
        kinds = [image_type for key_camera, image_type in rows[0].files if key_camera == camera]
        for row in rows:
            if lost := [image_type for image_type in kinds if (camera, image_type) not in row.files]:
                raise DataError(
                    f"{path}: line {row.line} names no image of type {lost[0]} of camera {camera}, as the first does;"
                    " remove the row"
                )
        numbers = np.array([row.pose for row in rows])
        T_wv = from_quaternions(numbers[:, :3], numbers[:, 3:], path)
        first = [image_type for image_type in (SEGMENTATION, SCENE, kind) if image_type in kinds]
        lens = self._lens(folder, [row.files[camera, kind] for row in rows])
        for row, pose in zip(rows, T_wv @ _mounted(self.options.mount), strict=True):
            files = {
                image_type: inside(folder, folder / "images", row.files[camera, image_type], str(path))
                for image_type in kinds
            }
            name, *aliases = [files[image_type].stem for image_type in first]
            yield FrameSource(
                name=name,
                depth=files[kind],
                pose_file=path,
                camera=lens,
                pose=pose,
                color=files.get(SCENE),
                depth_reader=read_recorded_depth,
                timestamp=row.time,
                aliases=tuple(aliases),
            )

    def _rows(self, folder: Path) -> list[RecordingRow]:
        """Return the rows of the vehicle."""
        path = folder / RECORDING
        rows = read_recording(path)
        vehicles = list(dict.fromkeys(row.vehicle for row in rows))
        vehicle = self.options.vehicle or vehicles[0]
        if vehicle not in vehicles or (len(vehicles) > 1 and not self.options.vehicle):
            raise DataError(f"{path}: holds rows of {', '.join(vehicles[:9])}; set vehicle to one of them")
        return [row for row in rows if row.vehicle == vehicle]

    def _camera(self, folder: Path, rows: list[RecordingRow]) -> tuple[str, str]:
        """Return the camera that is asked for, or the first with depth, and the type of its depth images."""
        with_depth = [key for key in rows[0].files if key[1] in DEPTH]
        camera_name = self.options.camera
        matches = [
            key for key in with_depth if not camera_name or key[0] == camera_name or key[0].endswith(f"_{camera_name}")
        ]
        if not matches:
            cameras = ", ".join(dict.fromkeys(camera for camera, _ in with_depth)) or "none"
            raise DataError(
                f"{folder / RECORDING}: the first row names no depth image (type 1 or 2) of camera"
                f" {camera_name or 'any'}; with depth: {cameras}; record ImageType 1 with PixelsAsFloat, or set camera"
            )
        return min(key for key in matches if key[0] == matches[0][0])

    def _lens(self, folder: Path, depth: list[str]) -> Camera:
        if self.options.intrinsics is not None:
            return Camera(Intrinsics(*self.options.intrinsics))
        size = next((size for name in depth if (size := depth_size(folder / "images" / name)) is not None), None)
        if size is None:
            raise DataError(f"{folder / 'images'}: no depth image tells its size; set intrinsics: [fx, fy, cx, cy]")
        return seen_across(self.options.fov, size, str(folder / "images"))


def read_recording(path: Path) -> list[RecordingRow]:
    """Return the rows of an airsim_rec.txt, by the names of its columns, which differ by vehicle.

    Raises:
        DataError: For a column that is missing, or a row that does not fit them; the message names the line.
    """
    rows: list[RecordingRow] = []
    columns: dict[str, int] = {}
    for line, text in records(path):
        words = [word.strip() for word in text.split("\t")]
        if not columns:
            columns = {name: k for k, name in enumerate(words)}
            if lost := [name for name in (*POSE, "TimeStamp", "ImageFile") if name not in columns]:
                raise DataError(
                    f"{path}: line {line} has no column {lost[0]}, apart by tabs; is it AirSim's recording?"
                )
            continue
        if len(words) != len(columns):
            raise DataError(f"{path}: line {line} has {len(words)} values; expected {len(columns)}, apart by tabs")
        by_name = dict(zip(columns, words, strict=True))
        pose = tuple(to_number(by_name[name], path, line) for name in POSE)
        files = {}
        for name in filter(None, by_name["ImageFile"].split(";")):
            if (match := NAME.fullmatch(name)) is None:
                raise DataError(f"{path}: line {line}: {name[:60]!r} is no image as img_CAMERA_TYPE_TIME.png or .pfm")
            files[match["camera"], match["kind"]] = name
        time = to_number(by_name["TimeStamp"], path, line) / 1000
        rows.append(RecordingRow(line, by_name.get("VehicleName", ""), time, pose, files))
    if not rows:
        raise DataError(f"{path}: holds no row; record a flight first")
    return rows


def _mounted(mount: tuple[float, ...]) -> Float64:
    """Return the pose (4, 4) of a camera on its vehicle: x forward, y right, z down of both."""
    from scipy.spatial.transform import Rotation

    x, y, z, roll, pitch, yaw = mount
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    T[:3, 3] = x, y, z
    return T


def read_recorded_depth(path: Path, scale: float | None, read: Read) -> Float32:
    """Return depth (H, W), float32: AirSim's .pfm, unlike others, begins with the top row. Raises as `read_depth`."""
    depth = read_depth(path, scale, read)
    return np.ascontiguousarray(depth[::-1]) if path.suffix.lower() == ".pfm" else depth
