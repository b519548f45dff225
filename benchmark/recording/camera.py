"""What the camera sees: pose, colour, depth, labels, and the drift that the frame caused behind each pixel.

All pictures of a frame have one size, at most IMAGE_SIDE pixels a side, so that they can be laid over each other.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.datasets import Scene
from semstab.frames import Frame
from semstab.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.recording.entities import Clock, path
from semstab.recording.voxel_maps import SBD_MAX

IMAGE_SIDE = 640
JPEG_QUALITY = 80
LOOK_BEHIND = 2
"""Frames whose images may be waiting for the worker."""

NO_VOXEL, FIRST_SEEN, NO_DRIFT = 0, 1, 2
LEVELS = 24
LEVEL_EDGES = SBD_MAX * (np.arange(LEVELS + 1) / LEVELS) ** 2
"""Bits at which one level of drift ends and the next begins: finer where drift is small; the last one is open."""

# Red, orange, yellow, white: what drifts lights up like a glowing body.
GLOW = np.array([(150, 0, 40), (230, 30, 0), (255, 140, 0), (255, 230, 60), (255, 255, 230)], dtype=np.float64)


def stride_of(shape: tuple[int, int]) -> int:
    """Every how many pixels a picture of a frame of that shape (H, W) is sampled: a power of 2, as JPEG decodes to."""
    return int(2 ** max(0, math.ceil(math.log2(max(shape) / IMAGE_SIDE))))


def drift_levels(drift: npt.NDArray[np.float32], seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Picture of drift in bits (H, W), NaN where a voxel is seen for the first time; `seen` where there is a voxel."""
    level = np.searchsorted(LEVEL_EDGES[1:-1], drift, side="right") + NO_DRIFT + 1
    level[drift == 0] = NO_DRIFT
    level[np.isnan(drift)] = FIRST_SEEN
    level[~seen] = NO_VOXEL
    return level.astype(np.uint8)


def drift_context() -> rr.AnnotationContext:
    """Names and colours of the levels; over the colour image only what drifts is seen, and dimly what is new."""
    names = [f"{low:.4f} to {high:.4f} bits" for low, high in itertools.pairwise(LEVEL_EDGES)]
    names[-1] = f"{LEVEL_EDGES[-2]:.4f} bits and more"
    at = np.linspace(0, len(GLOW) - 1, LEVELS)
    glow = np.stack([np.interp(at, np.arange(len(GLOW)), channel) for channel in GLOW.T], axis=1).astype(int)
    infos: list[tuple[int, str, tuple[int, ...]]] = [
        (NO_VOXEL, "no voxel", (0, 0, 0, 200)),
        (FIRST_SEEN, "first seen", (40, 60, 110, 170)),
        (NO_DRIFT, "no drift", (0, 0, 0, 150)),
    ]
    infos += [(NO_DRIFT + 1 + k, name, (*glow[k].tolist(), 255)) for k, name in enumerate(names)]
    return rr.AnnotationContext([rr.AnnotationInfo(*info) for info in infos])


def label_context(classes: LabelSpace) -> rr.AnnotationContext:
    """Names and colours of the classes by their row; what is ignored stays clear."""
    infos = [rr.AnnotationInfo(k, name, classes.colors[k]) for k, name in enumerate(classes.classes)]
    ignored = [rr.AnnotationInfo(ignore, "ignored", (0, 0, 0, 0)) for ignore in (IGNORE_8BIT, IGNORE_16BIT)]
    return rr.AnnotationContext(infos + [info for info in ignored if info.id >= len(classes)])


class Camera:
    """The camera of a scene: its pictures are logged once a frame, whichever backbones and backends fuse it."""

    def __init__(self, scene: Scene, translation: npt.NDArray[np.floating[Any]]) -> None:
        self.scene = scene
        self.poses: list[npt.NDArray[np.float64]] = []
        """(4, 4) each, relative to the map's origin."""
        self.unread: str | None = None
        """Why a colour image is missing, where one is."""
        self._translation = translation
        self._logged: set[int] = set()
        self._depth_unit: float | None = None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="semstab-pictures")
        self._pending: deque[Future[None]] = deque()

    def log(self, stream: rr.RecordingStream, frame: Frame, clock: Clock) -> None:
        """Log the frame's pose, camera, colour and depth at the stream's time, where that has not happened yet."""
        if frame.index in self._logged:
            return
        self._logged.add(frame.index)
        pose = frame.T_wc.copy()
        pose[:3, 3] -= self._translation
        self.poses.append(pose)
        stride = stride_of(frame.shape)
        self._log_camera(stream, frame, pose, stride)
        while len(self._pending) >= LOOK_BEHIND:
            self._pending.popleft().result()
        self._pending.append(self._worker.submit(self._log_images, stream, frame, stride, clock))

    def close(self) -> None:
        """Wait for the images that are still being made."""
        self._worker.shutdown()
        for pending in self._pending:
            pending.result()

    def _log_images(self, stream: rr.RecordingStream, frame: Frame, stride: int, clock: Clock) -> None:
        """In the worker: what it decodes and encodes is nothing that the next frame has to wait for."""
        clock.set(stream, frame.index, frame.timestamp)  # a stream has a time for each thread
        stream.log(path(self.scene.name, "depth"), self._depth(frame, 2 * stride))
        H, W = (-(-side // stride) for side in frame.shape)
        if (color := self._color(frame, (W, H))) is not None:
            stream.log(self._path("color"), rr.EncodedImage(contents=color, media_type="image/jpeg", draw_order=-20))

    def _log_camera(self, stream: rr.RecordingStream, frame: Frame, pose: npt.NDArray[Any], stride: int) -> None:
        K = frame.intrinsics.every(stride).matrix
        K[:2, 2] += 0.5  # the viewer's pixel centres are at halves
        H, W = (-(-side // stride) for side in frame.shape)
        depth = frame.depth[::16, ::16]
        far = np.median(depth[np.isfinite(depth) & (depth > 0)]) if (depth > 0).any() else 1.0
        pinhole = rr.Pinhole(
            image_from_camera=K, width=W, height=H, camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.2 * float(far),
        )  # fmt: skip
        stream.log(self._path(), rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), pinhole)
        n = len(self.poses)
        if n % (n // 100 + 1) == 0:  # long ones not with every frame: their size would grow with its square
            track = np.array([p[:3, 3] for p in self.poses])
            stream.log(path(self.scene.name, "trajectory"), rr.LineStrips3D([track], colors=(255, 255, 255)))

    def _depth(self, frame: Frame, stride: int) -> rr.EncodedDepthImage:
        """16-bit depth in a unit that the scene's first frame decides: a decimal part of a metre."""
        import cv2

        depth = np.where(np.isfinite(frame.depth[::stride, ::stride]), frame.depth[::stride, ::stride], 0)
        if self._depth_unit is None:
            self._depth_unit = 10.0 ** math.floor(math.log10(65535 / (4 * max(float(depth.max()), 1e-3))))
        units = np.clip(np.round(depth * self._depth_unit), 0, 65535).astype(np.uint16)
        _, png = cv2.imencode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return rr.EncodedDepthImage(png.tobytes(), media_type="image/png", meter=self._depth_unit, colormap="turbo")

    def _color(self, frame: Frame, size: tuple[int, int]) -> bytes | None:
        """Colour as JPEG of that size (width, height); None where the frame has none, or it cannot be read."""
        import cv2

        image = self._small_color(frame, size[0])
        if image is None:
            return None
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if image.shape[1::-1] != size else image
        _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return bytes(jpeg)

    def _small_color(self, frame: Frame, width: int) -> npt.NDArray[np.uint8] | None:
        """Colour (h, w, 3), BGR, of `width` pixels or more; from a file decoded no larger than is needed."""
        if frame.color is not None:
            return np.ascontiguousarray(frame.color[..., ::-1])
        file = Path(frame.files.get("color", ""))
        if not file.is_file():
            return None
        image = _decoded(file.read_bytes(), frame.shape[1] // width)
        if image is None:
            self.unread = self.unread or f"{file}: the image cannot be decoded"
        return image

    def _path(self, *parts: str) -> str:
        return path(self.scene.name, "camera", *parts)


def _decoded(data: bytes, reduction: int) -> npt.NDArray[np.uint8] | None:
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
