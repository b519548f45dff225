"""Walks through scenes that Habitat renders: rgb/, depth/, semantic/ with ids of instances, and GT_Pose.txt.

Sources: Savva et al., Habitat, ICCV 2019; info_semantic.json of Straub et al., Replica, 2019, as habitat_renderer.py of
vMAP (Kong et al., CVPR 2023) reads it; exports differ by author, so that paths and the scale of depth are options.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import UInt16
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import NO_ID
from semstab.datasets.files.options import FileOptions, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, frames_of, images_named
from semstab.datasets.formats.disk import read_object, read_table
from semstab.datasets.formats.images import Read, depth_size, read_labels
from semstab.datasets.geometry.cameras import Camera, from_quaternions
from semstab.datasets.geometry.lenses import Labels
from semstab.errors import ConfigError, DataError

INFO = "info_semantic.json"
POSES = "GT_Pose.txt"


class HabitatOptions(FileOptions):
    """Options with the defaults of the format; the intrinsics are those of a view of 90 degrees."""

    depth_scale: opt.DepthScale = 1000
    camera_axes: opt.CameraAxes = "opengl"
    up_axis: opt.UpAxis = "y"
    intrinsics: opt.FourIntrinsics = None
    ground_truth: opt.GroundTruth = "semantic/{name}"
    quaternion: Literal["wxyz", "xyzw"] = Field("wxyz", description=f"order in {POSES}, after x y z")
    semantic_info: Path | None = Field(
        None, description=f"{INFO} of the scene, unless its folder, habitat/ in it, or a folder above has it"
    )


class Habitat(FileDataset[HabitatOptions]):
    """{name} is the image's name without suffix: 12. Frames go in its natural order, as the rows of GT_Pose.txt."""

    Options: type[BaseModel] = HabitatOptions
    contents = f"depth/ and {POSES} (x y z qw qx qy qz a row)"

    def is_scene(self, folder: Path) -> bool:
        """Return whether poses and depth are there; with a surface, the poses."""
        return (folder / POSES).is_file() and self.has_depth(folder / "depth")

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth image.

        Raises:
            DataError: If there are not as many poses, or the camera is not known.
        """
        path = folder / POSES
        numbers = read_table(path, 7, "x y z and a quaternion")
        xyzw = numbers[:, [4, 5, 6, 3]] if self.options.quaternion == "wxyz" else numbers[:, 3:]
        poses = from_quaternions(numbers[:, :3], xyzw, path)
        depth = self.depth_files(folder / "depth", "", ".png", instead=images_named(folder / "rgb"))
        camera = self._camera(folder, depth)
        return frames_of(folder, depth, camera, pose=POSES, color="rgb/{name}", poses=poses)

    def _camera(self, folder: Path, depth: dict[str, Path]) -> Camera:
        if self.options.intrinsics is not None:
            return Camera(Intrinsics(*self.options.intrinsics))
        size = next((size for file in depth.values() if (size := depth_size(file)) is not None), None)
        if size is None:
            raise DataError(f"{folder / 'depth'}: no PNG tells the size of images; set intrinsics: [fx, fy, cx, cy]")
        W, H = size
        return Camera.stated((W / 2, W / 2, (W - 1) / 2, (H - 1) / 2), size, str(folder / "depth"))

    def truth(self, folder: Path) -> TruthSource:
        """Return how instances become classes; raises DataError for a damaged table."""
        near = (folder / INFO, folder / "habitat" / INFO, folder.parent / INFO, folder.parent / "habitat" / INFO)
        path = self.options.semantic_info or next((path for path in near if path.is_file()), None)
        if path is None:
            return TruthSource(read=_without_table)
        ids, space = read_info(path)
        most = int(np.flatnonzero(ids[:IGNORE_16BIT] != NO_ID).max(initial=0))

        def instances(_: FrameSource, file: Path, read: Read) -> Labels:
            stored = read_labels(file, None, read)
            if stored.dtype == np.uint8 and most > IGNORE_8BIT:
                raise DataError(
                    f"{file}: has 8 bits, but {path.name} has instances up to {most}: ids above {IGNORE_8BIT} have"
                    " overflowed, and cannot be told apart; export semantic ids in 16 bits"
                )
            return stored

        return TruthSource(instances, ids, space)


def _without_table(_: FrameSource, file: Path, __: Read) -> Labels:
    raise DataError(f"{file}: holds ids of instances, and no {INFO} says their classes; set semantic_info: FILE")


def read_info(path: Path) -> tuple[UInt16, LabelSpace]:
    """Return the table (65536,) from instances to classes of an info_semantic.json, and its classes.

    An instance whose class is 0, or below, has none.

    Raises:
        DataError: If the file holds neither, or an id that cannot be one.
    """
    content = read_object(path)
    classes, labels = content.get("classes"), content.get("id_to_label")
    if not (isinstance(classes, list) and classes and isinstance(labels, list) and labels):
        raise DataError(f"{path}: has no lists 'classes' and 'id_to_label'; take that of Replica's habitat/ folder")
    names = {_id(row.get("id"), path): str(row.get("name")) for row in classes if isinstance(row, dict)}
    try:
        space = LabelSpace(f"classes of {path.parent.name}", tuple(names.values()), tuple(names))
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error
    if len(labels) >= NO_ID:
        raise DataError(f"{path}: 'id_to_label' has {len(labels)} instances; at most {NO_ID - 1} are read")
    ids = np.full(1 << 16, NO_ID, np.uint16)
    ids[IGNORE_16BIT] = IGNORE_16BIT
    for instance, label in enumerate(labels):
        class_id = label if isinstance(label, int) and label > 0 else None
        if class_id is not None and class_id not in names:
            raise DataError(f"{path}: instance {instance} of 'id_to_label' has class {class_id}, which 'classes' lacks")
        ids[instance] = IGNORE_16BIT if class_id is None else class_id
    return ids, space


def _id(value: Any, path: Path) -> int:
    if not (isinstance(value, int) and 0 <= value < NO_ID):
        raise DataError(f"{path}: {repr(value)[:40]} is no id of a class")
    return value
