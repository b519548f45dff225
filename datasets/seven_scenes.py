"""7-Scenes: frame-NNNNNN.color.png, .depth.png in millimetres, .pose.txt, in one folder a sequence.

Source: Shotton et al., Scene Coordinate Regression Forests, CVPR 2013, and the dataset's page.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from pydantic import BaseModel

from semstab.data.frames import Intrinsics
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import DepthScale, FileOptions, FourIntrinsics, FrameSource, InvalidDepth, Size
from semstab.datasets.files.reader import FileDataset, frames_of
from semstab.datasets.files.scene import FileScene
from semstab.datasets.files.surfaces import Surface
from semstab.datasets.formats.disk import files_named, read_intrinsics
from semstab.datasets.geometry.cameras import Camera, camera_of

IMAGE_SIZE = (640, 480)
INTRINSICS_FILE = "camera-intrinsics.txt"
USUAL = (585.0, 585.0, 320.0, 240.0)
KINECT_COLOR = (525, 525, 320, 240)
"""fx, fy, cx, cy of depth, and of colour, which is not registered to it."""


class SevenScenesOptions(FileOptions):
    """Options with the defaults of the format; the camera is 585 585 320 240 unless a file says."""

    depth_scale: DepthScale = 1000
    invalid_depth: InvalidDepth = (65535,)
    intrinsics: FourIntrinsics = None
    color_intrinsics: FourIntrinsics = None
    color_size: Size = IMAGE_SIZE


class SevenScenes(FileDataset[SevenScenesOptions]):
    """{name} is the file's name without .depth.png: frame-000000.

    Depth and colour are not registered to each other. Label maps that were predicted on colour are looked up with
    `color_intrinsics` where they are given, else taken as registered.
    """

    Options: type[BaseModel] = SevenScenesOptions
    contents = "files frame-NNNNNN.depth.png and frame-NNNNNN.pose.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether the first frame's pose or of any frame is there."""
        return (folder / "frame-000000.pose.txt").is_file() or any(folder.glob("frame-*.pose.txt"))

    def opened(
        self, entry: SceneEntry, frames: Sequence[FrameSource], options: FileOptions, surface: Surface | None
    ) -> FileScene:
        """Return the scene, which knows the camera of the Kinect's colour."""
        scene = super().opened(entry, frames, options, surface)
        if self.options.color_intrinsics is None:
            scene.usual = {"color_intrinsics": str(list(KINECT_COLOR))}
        return scene

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth image."""
        color = self.options.color_intrinsics
        camera = camera_of(self.options.intrinsics, USUAL, IMAGE_SIZE)
        files = (parent / INTRINSICS_FILE for parent in (folder, folder.parent))  # 3DMatch has it above the frames
        if self.options.intrinsics is None and (file := next((path for path in files if path.is_file()), None)):
            camera = Camera(read_intrinsics(file))
        label_camera = None if color is None else Camera(Intrinsics(*color), self.options.color_size)
        depth = self.depth_files(folder, "", ".depth.png", instead=files_named(folder, "", ".pose.txt"))
        return frames_of(folder, depth, camera, pose="{name}.pose.txt", color="{name}.color", label_camera=label_camera)
