"""Pictures of the camera: pose, colour and depth.

The camera has the frame's size. Pictures are smaller where that saves much; transforms lay them over each other.
"""

from __future__ import annotations

import functools
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.core.types import Float64
from semstab.model.frames import Frame, Intrinsics
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.recording.timeline import Background, path

IMAGE_SIDE, COARSE_SIDE = 640, 320
"""Pixels a side at most, of colour and labels; of depth and of what is looked up for each pixel."""

JPEG_QUALITY = 80


def stride_of(shape: tuple[int, int], side: int = IMAGE_SIDE) -> int:
    """Return every how many pixels a frame (H, W) is sampled for a picture: a power of 2, as JPEG decodes to."""
    return int(2 ** max(0, math.ceil(math.log2(max(shape) / side))))


def over_camera(stride: int) -> rr.Transform3D:
    """Lay a picture of every stride-th pixel over the camera's image: each pixel in the middle of its square."""
    shift = (1 - stride) / 2
    return rr.Transform3D(translation=[shift, shift, 0], scale=[stride, stride, 1])


def label_context(classes: LabelSpace) -> rr.AnnotationContext:
    """Return names and colours of the classes by their row; what is ignored stays clear."""
    infos = [rr.AnnotationInfo(k, name, classes.colors[k]) for k, name in enumerate(classes.classes)]
    ignored = [rr.AnnotationInfo(ignore, "ignored", (0, 0, 0, 0)) for ignore in (IGNORE_8BIT, IGNORE_16BIT)]
    return rr.AnnotationContext(infos + [info for info in ignored if info.id >= len(classes)])


class CameraLog:
    """The camera of a scene: its pictures are logged once a frame, whichever backbones and backends fuse it.

    translation  (3,) metres, the origin of the scene's maps
    unread       why a colour image is missing, where one is
    """

    def __init__(self, scene: str, translation: npt.NDArray[np.floating[Any]]) -> None:
        self._scene = scene
        self._translation = translation
        self._poses: dict[int, Float64] = {}
        self._intrinsics: tuple[Intrinsics, tuple[int, int]] | None = None
        self.unread: str | None = None

    @property
    def poses(self) -> Float64:
        """(n, 4, 4) so far, relative to the map's origin."""
        return np.array([*self._poses.values()]).reshape(-1, 4, 4)

    def log(self, stream: rr.RecordingStream, frame: Frame, background: Background) -> None:
        """Log the frame's pose, camera, colour and depth, where that has not happened yet, and the track up to it."""
        if frame.index in self._poses:
            return
        pose = self._poses[frame.index] = frame.T_wc.copy()
        pose[:3, 3] -= self._translation
        if self._intrinsics != (frame.intrinsics, frame.shape):
            self._intrinsics = frame.intrinsics, frame.shape
            stream.log(path(self._scene, "camera"), _pinhole(frame))
        stream.log(path(self._scene, "camera"), rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        n = len(self._poses)
        if n % (n // 100 + 1) == 0:  # long ones not with every frame: their size would grow with its square
            track = rr.LineStrips3D([self.poses[:, :3, 3]], colors=(255, 255, 255))
            stream.log(path(self._scene, "trajectory"), track)
        background.submit(frame.index, frame.timestamp, functools.partial(self._log_images, stream, frame))

    def _log_images(self, stream: rr.RecordingStream, frame: Frame) -> None:
        stride = stride_of(frame.shape, COARSE_SIDE)
        depth = frame.depth[::stride, ::stride]
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float16)  # to 0.05 %
        stream.log(path(self._scene, "depth"), rr.DepthImage(depth, meter=1.0, colormap="turbo"))
        if (jpeg := self.color(frame)) is not None:
            (H, W), stride = frame.shape, stride_of(frame.shape)
            image = rr.EncodedImage(contents=jpeg, media_type="image/jpeg", draw_order=-20)
            whole = rr.Transform3D(scale=[W / -(-W // stride), H / -(-H // stride), 1])
            stream.log(path(self._scene, "camera", "color"), image, whole)

    def color(self, frame: Frame) -> bytes | None:
        """Return colour as JPEG, in the size of the labels; None where the frame has none, or it cannot be read."""
        from PIL import Image

        stride, file = stride_of(frame.shape), Path(frame.files.get("color", ""))
        if frame.color is None and not file.is_file():
            return None
        H, W = (-(-side // stride) for side in frame.shape)
        buffer = io.BytesIO()
        try:
            with Image.open(file) if frame.color is None else Image.fromarray(frame.color) as image:
                image.draft("RGB", (W, H))  # JPEG decodes to 1/2, 1/4 and 1/8 of its size in less time
                small = image.convert("RGB").resize((W, H), Image.Resampling.BOX)
        except (OSError, Image.DecompressionBombError):
            self.unread = self.unread or f"{file}: the image cannot be decoded"
            return None
        small.save(buffer, "JPEG", quality=JPEG_QUALITY)
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
