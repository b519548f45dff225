"""What the camera sees: pose, colour, depth, labels, and the drift that the frame caused behind each pixel.

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

from semstab.core.types import Float64, UInt8
from semstab.datasets import Scene
from semstab.model.frames import Frame, Intrinsics
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.recording.timeline import Background, path

IMAGE_SIDE = 640
"""Pixels a side, of pictures that are made here."""

SAMPLING = 2
"""In large pictures drift and motion-compensated flicker are looked up for every second pixel of each axis."""

JPEG_QUALITY = 80
COLOR_BYTES = 400_000_000
"""Of a scene's colour, where its frames' files are JPEG: those within their share go into the recording as they are."""


def stride_of(shape: tuple[int, int]) -> int:
    """Every how many pixels a picture of a frame of that shape (H, W) is sampled: a power of 2, as JPEG decodes to."""
    return int(2 ** max(0, math.ceil(math.log2(max(shape) / IMAGE_SIDE))))


def coarse_stride(shape: tuple[int, int]) -> int:
    """The same of pictures whose pixels are looked up: of large ones every second one on each axis."""
    stride = stride_of(shape)
    return stride * sampling(tuple(-(-side // stride) for side in shape))


def sampling(shape: tuple[int, ...]) -> int:
    """Every how many pixels of each axis a picture of that shape is looked up."""
    return SAMPLING if max(shape) > IMAGE_SIDE // SAMPLING else 1


class Overlay:
    """Lays pictures of a camera over each other: says what part of the camera's image a picture covers."""

    def __init__(self) -> None:
        self._logged: dict[str, tuple[float, ...]] = {}

    def log(
        self, stream: rr.RecordingStream, entity: str, shape: tuple[int, ...], picture: tuple[int, ...], stride: int = 0
    ) -> None:
        """Lay the entity's picture over a camera image, both (H, W), where that differs from what was logged last.

        stride  of the sampling, where the picture is every stride-th pixel: these are then in the middle of the squares
                that they are drawn as
        """
        scale = (stride, stride) if stride else (shape[1] / picture[1], shape[0] / picture[0])
        shift = (1 - stride) / 2 if stride else 0.0
        if self._logged.get(entity, (1, 1, 0)) != (*scale, shift):
            self._logged[entity] = (*scale, shift)
            stream.log(entity, rr.Transform3D(translation=[shift, shift, 0], scale=[*scale, 1]))


def label_context(classes: LabelSpace) -> rr.AnnotationContext:
    """Names and colours of the classes by their row; what is ignored stays clear."""
    infos = [rr.AnnotationInfo(k, name, classes.colors[k]) for k, name in enumerate(classes.classes)]
    ignored = [rr.AnnotationInfo(ignore, "ignored", (0, 0, 0, 0)) for ignore in (IGNORE_8BIT, IGNORE_16BIT)]
    return rr.AnnotationContext(infos + [info for info in ignored if info.id >= len(classes)])


class CameraLog:
    """The camera of a scene: its pictures are logged once a frame, whichever backbones and backends fuse it."""

    def __init__(self, scene: Scene, translation: npt.NDArray[np.floating[Any]], frames: int) -> None:
        self.scene = scene
        self._poses: list[Float64] = []
        self.unread: str | None = None
        """Why a colour image is missing, where one is."""
        self._translation = translation
        self._share = COLOR_BYTES // max(frames, 1)
        self._logged: set[int] = set()
        self._overlay = Overlay()
        self._intrinsics: tuple[Intrinsics, tuple[int, int]] | None = None
        self._depth_unit: float | None = None

    @property
    def poses(self) -> Float64:
        """(n, 4, 4) so far, relative to the map's origin."""
        return np.array(self._poses).reshape(-1, 4, 4)

    def log(self, stream: rr.RecordingStream, frame: Frame, background: Background) -> None:
        """Log the frame's pose, camera, colour and depth, where that has not happened yet, and the track up to it."""
        if frame.index in self._logged:
            return
        self._logged.add(frame.index)
        pose = frame.T_wc.copy()
        pose[:3, 3] -= self._translation
        self._poses.append(pose)
        self._log_camera(stream, frame, pose)
        n = len(self._poses)
        if n % (n // 100 + 1) == 0:  # long ones not with every frame: their size would grow with its square
            track = rr.LineStrips3D([self.poses[:, :3, 3]], colors=(255, 255, 255))
            stream.log(path(self.scene.name, "trajectory"), track)
        background.submit(frame.index, frame.timestamp, functools.partial(self._log_images, stream, frame))

    def _log_images(self, stream: rr.RecordingStream, frame: Frame) -> None:
        stream.log(path(self.scene.name, "depth"), self._depth(frame, 2 * stride_of(frame.shape)))
        if (color := self.color(frame)) is not None:
            jpeg, size = color
            self._overlay.log(stream, self._path("color"), frame.shape, size)
            stream.log(self._path("color"), rr.EncodedImage(contents=jpeg, media_type="image/jpeg", draw_order=-20))

    def _log_camera(self, stream: rr.RecordingStream, frame: Frame, pose: npt.NDArray[Any]) -> None:
        if self._intrinsics != (frame.intrinsics, frame.shape):
            self._intrinsics = frame.intrinsics, frame.shape
            K = frame.intrinsics.matrix
            K[:2, 2] += 0.5  # the viewer's pixel centres are at halves
            H, W = frame.shape
            depth = frame.depth[::16, ::16]
            valid = depth[np.isfinite(depth) & (depth > 0)]
            far = np.median(valid) if len(valid) else 1.0
            pinhole = rr.Pinhole(
                image_from_camera=K, width=W, height=H, camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.2 * float(far),
            )  # fmt: skip
            stream.log(self._path(), pinhole)
        stream.log(self._path(), rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

    def _depth(self, frame: Frame, stride: int) -> rr.DepthImage:
        """16-bit depth in a unit that the scene's first frame decides: a decimal part of a metre."""
        depth = np.where(np.isfinite(frame.depth[::stride, ::stride]), frame.depth[::stride, ::stride], 0)
        if self._depth_unit is None:
            self._depth_unit = 10.0 ** math.floor(math.log10(65535 / (4 * max(float(depth.max()), 1e-3))))
        units = np.clip(np.round(depth * self._depth_unit), 0, 65535).astype(np.uint16)
        return rr.DepthImage(units, meter=self._depth_unit, colormap="turbo")

    def color(self, frame: Frame) -> tuple[bytes, tuple[int, int]] | None:
        """Colour as JPEG, and its size (H, W); None where the frame has none, or it cannot be read."""
        import cv2

        stride = stride_of(frame.shape)
        H, W = (-(-side // stride) for side in frame.shape)
        if frame.color is not None:
            image = np.ascontiguousarray(frame.color[..., ::-1])
        else:
            file = Path(frame.files.get("color", ""))
            if not file.is_file():
                return None
            data = file.read_bytes()
            if len(data) <= self._share and (size := _jpeg_size(data)) is not None:
                return data, size
            decoded = _decoded(data, stride)
            if decoded is None:
                self.unread = self.unread or f"{file}: the image cannot be decoded"
                return None
            image = decoded
        small = cv2.resize(image, (W, H), interpolation=cv2.INTER_AREA) if image.shape[:2] != (H, W) else image
        _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return bytes(jpeg), (H, W)

    def _path(self, *parts: str) -> str:
        return path(self.scene.name, "camera", *parts)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(H, W) of a JPEG file that is whole, and of a kind that the viewer shows; else None."""
    from PIL import Image, UnidentifiedImageError

    if not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        return None
    try:
        with Image.open(io.BytesIO(data)) as image:  # reads no more than the header
            known = image.format == "JPEG" and image.mode in ("RGB", "L")
            return (image.height, image.width) if known else None
    except (UnidentifiedImageError, OSError):
        return None


def _decoded(data: bytes, reduction: int) -> UInt8 | None:
    """An image file's pixels, BGR, up to `reduction` times smaller: JPEG decodes to 1/2, 1/4 and 1/8 in less time."""
    import cv2

    flags = cv2.IMREAD_IGNORE_ORIENTATION | {
        1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4,
        8: cv2.IMREAD_REDUCED_COLOR_8,
    }[max(step for step in (1, 2, 4, 8) if step <= max(reduction, 1))]  # fmt: skip
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)
