"""Record the parts that all models of a scene share: axes, legend, and the camera with pose, colour and depth.

The camera has the frame's size. Pictures are smaller where that saves much; transforms lay them over each other.
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from semstab.core.types import Float64, Int64
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError
from semstab.metrics import dominant
from semstab.recording import drift
from semstab.recording.layout import Legend, SceneBounds, log_categories
from semstab.recording.timeline import FrameJobs, path
from semstab.task import Task

IMAGE_SIDE, COARSE_SIDE = 640, 320
"""The most pixels a side: of colour and labels; of depth and of pictures that need a lookup for each pixel."""

JPEG_QUALITY, MOST_BYTES = 80, 0.25
"""Quality of a colour image, and the most bytes a pixel of a JPEG file that is recorded as it is, in a picture's size.
"""


def stride_of(shape: tuple[int, int], side: int = IMAGE_SIDE) -> int:
    """Return the stride at which a frame (H, W) is sampled for a picture: a power of 2, as JPEG decoders support."""
    return int(2 ** max(0, math.ceil(math.log2(max(shape) / side))))


def over_camera(stride: int) -> rr.Transform3D:
    """Return the transform that lays a picture of every stride-th pixel over the camera's image."""
    shift = (1 - stride) / 2
    return rr.Transform3D(translation=[shift, shift, 0], scale=[stride, stride, 1])


def label_context(classes: LabelSpace) -> rr.AnnotationContext:
    """Return names and colours of the classes by their row; ignored pixels are transparent."""
    infos = [rr.AnnotationInfo(k, name, classes.colors[k]) for k, name in enumerate(classes.classes)]
    ignored = [rr.AnnotationInfo(ignore, "ignored", (0, 0, 0, 0)) for ignore in (IGNORE_8BIT, IGNORE_16BIT)]
    return rr.AnnotationContext(infos + [info for info in ignored if info.id >= len(classes)])


SAMPLE = 20_000
"""The most voxels of a scene from which the camera pose of its views is computed."""

ORIGIN_STEP = 1000.0
"""The step of map origins, metres: a scene near its world's origin keeps its coordinates."""


class SceneLog:
    """A scene of a plan: its axes, its legend, the origin of its maps, and its camera.

    The camera's pictures are logged once a frame, whichever models and backends fuse it.

    Attributes:
        origin: (3,) voxels, None before anything of the scene is logged.
        bounds: Bounds of its first finished map, None before that.
    """

    def __init__(self, tasks: list[Task]) -> None:
        self._tasks, self.name = tasks, tasks[0].scene.name
        self.legend = Legend([task.mapping.target for task in tasks])
        self.origin: Int64 | None = None
        self.bounds: SceneBounds | None = None
        self._translation: Float64 = np.zeros(3)
        self._poses: dict[int, Float64] = {}
        self._intrinsics: tuple[Intrinsics, tuple[int, int]] | None = None
        self._scale: tuple[float, float, float] | None = None  # of the last colour image
        self._unread, self._posed = False, tasks[0].scene.posed

    def log_static(self, stream: rr.RecordingStream) -> None:
        """Log the parts that hold in all frames: axes, legends, names and colours."""
        if (up := self._tasks[0].scene.up) is not None:  # the nearest axis of the world
            axis = int(np.abs(up).argmax())
            axes = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
            stream.log(path(self.name), getattr(rr.ViewCoordinates, axes), static=True)
        self.legend.log(stream, self.name)
        log_categories(stream, self.name)
        for task in self._tasks:
            nothing = drift.AMONG_POINTS if task.scene.of_scans else drift.OVER_COLOUR
            for name, context in {"labels": label_context(task.mapping.target), **drift.contexts(nothing)}.items():
                stream.log(path(self.name, "camera", task.model, name), context, static=True)

    def begin(self, stream: rr.RecordingStream, position: Float64, voxel_size: float) -> Int64:
        """Return the origin of the scene's maps, near the first camera position (3,), metres, that is known."""
        if self.origin is None:
            steps = np.round(position / ORIGIN_STEP).astype(np.int64)
            self.origin = steps * round(ORIGIN_STEP / voxel_size)
            translation = self._translation = (self.origin * voxel_size).astype(np.float64)
            if steps.any():
                where = ", ".join(f"{name} = {value:.3f} m" for name, value in zip("xyz", translation, strict=True))
                text = f"map coordinates are relative to {where} of the scene's world"
                stream.log(path(self.name, "log"), rr.TextLog(text))
        return self.origin

    def see(self, stream: rr.RecordingStream, task: Task, table: VoxelTable) -> None:
        """Update the order of the legend by a finished map; the first map also sets the bounds of the views."""
        self.legend.see(task.mapping.target, dominant(table))
        self.legend.log(stream, self.name)
        if self.bounds is None and len(table):
            sample = table.index[:: math.ceil(len(table) / SAMPLE)]
            points = ((sample + 0.5) * table.voxel_size - self._translation).astype(np.float64)
            self.bounds = SceneBounds(points, np.array([*self._poses.values()]).reshape(-1, 4, 4), task.scene.up)

    def log(self, stream: rr.RecordingStream, frame: Frame, background: FrameJobs) -> None:
        """Log the frame's pose, camera, colour and depth once, and the track up to it."""
        if frame.index in self._poses:
            return
        if not self._posed:
            self._poses[frame.index] = frame.T_wc
            background.submit(frame.index, frame.timestamp, functools.partial(self._log_color, stream, frame))
            return
        pose = self._poses[frame.index] = frame.T_wc.copy()
        pose[:3, 3] -= self._translation
        n = len(self._poses)  # a long track is not logged with every frame: the size would grow with its square
        track = [camera_pose[:3, 3] for camera_pose in self._poses.values()] if n % (n // 100 + 1) == 0 else []
        background.submit(frame.index, frame.timestamp, functools.partial(self._log_posed, stream, frame, pose, track))

    def _log_posed(self, stream: rr.RecordingStream, frame: Frame, pose: Float64, track: Sequence[Float64]) -> None:
        if self._intrinsics != (frame.intrinsics, frame.shape):
            self._intrinsics = frame.intrinsics, frame.shape
            if not frame.is_scan:
                stream.log(path(self.name, "camera"), _pinhole(frame))
        stream.log(path(self.name, "camera"), rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if track:
            stream.log(path(self.name, "trajectory"), rr.LineStrips3D([track], colors=(255, 255, 255)))
        self._log_images(stream, frame)

    def _log_images(self, stream: rr.RecordingStream, frame: Frame) -> None:
        if frame.is_scan:
            return
        stride = stride_of(frame.shape, COARSE_SIDE)
        depth = frame.depth[::stride, ::stride]
        depth = np.where(depth <= np.finfo(np.float16).max, depth, 0).astype(np.float16)  # to 0.05 %
        stream.log(path(self.name, "depth"), rr.DepthImage(depth, meter=1.0, colormap="turbo"))
        self._log_color(stream, frame)

    def _log_color(self, stream: rr.RecordingStream, frame: Frame) -> None:
        try:
            jpeg = color_of(frame)
        except DataError as error:
            if not self._unread:
                stream.log(path(self.name, "log"), rr.TextLog(f"without colour: {error}"))
            self._unread = True
            return
        if jpeg is not None:
            (H, W), stride = frame.shape, stride_of(frame.shape)
            image = rr.EncodedImage(contents=jpeg, media_type="image/jpeg", draw_order=-20)
            scale = W / -(-W // stride), H / -(-H // stride), 1.0
            placed = [] if scale == self._scale else [rr.Transform3D(scale=scale)]
            self._scale = scale
            stream.log(path(self.name, "camera", "color"), image, *placed)


def color_of(frame: Frame) -> bytes | None:
    """Return the colour as JPEG, in the size of the labels; None if the frame has no colour.

    A JPEG file of that size is taken as it is if it has at most MOST_BYTES a pixel.

    Raises:
        DataError: If its file cannot be read.
    """
    from PIL import ExifTags, Image

    stride, file = stride_of(frame.shape), Path(frame.files.get("color", ""))
    if frame.color is None and not file.is_file():
        return None
    H, W = (-(-side // stride) for side in frame.shape)
    buffer = io.BytesIO()
    try:
        with Image.open(file) if frame.color is None else Image.fromarray(frame.color) as image:
            upright = image.getexif().get(ExifTags.Base.Orientation, 1) == 1
            if (image.format, image.mode, image.size) == ("JPEG", "RGB", (W, H)) and upright:
                stored = file.read_bytes()
                if len(stored) <= MOST_BYTES * W * H and stored.endswith(b"\xff\xd9"):  # the end of a whole image
                    return stored
            image.draft("RGB", (W, H))  # JPEG decodes to 1/2, 1/4 and 1/8 of its size in less time
            image.load()
            colour = image if image.mode == "RGB" else image.convert("RGB")
            small = colour if colour.size == (W, H) else colour.resize((W, H), Image.Resampling.BOX)
            small.save(buffer, "JPEG", quality=JPEG_QUALITY)
    except (OSError, Image.DecompressionBombError) as error:
        raise DataError(f"{file}: the image cannot be decoded") from error
    return buffer.getvalue()


def _pinhole(frame: Frame) -> rr.Pinhole:
    """Return the camera, its image at a fifth of the median depth."""
    K = frame.intrinsics.matrix
    K[:2, 2] += 0.5  # the viewer's pixel centres are at halves
    depth = frame.depth[::16, ::16]
    valid = depth[np.isfinite(depth) & (depth > 0)]
    far = float(np.median(valid)) if len(valid) else 1.0
    H, W = frame.shape
    axes = rr.ViewCoordinates.RDF
    return rr.Pinhole(image_from_camera=K, width=W, height=H, camera_xyz=axes, image_plane_distance=0.2 * far)
