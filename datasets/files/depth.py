"""Where a frame's depth comes from: a file of its own, or a surface that its camera looks at."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

import numpy as np

from semstab.core.types import Float32, Float64
from semstab.datasets.files.frame_source import FrameSource
from semstab.datasets.files.options import FileOptions
from semstab.datasets.files.surfaces import Surface, View
from semstab.datasets.formats.dense_depth import read_depth_map, read_dmap, read_mvei
from semstab.datasets.formats.images import MILLIMETRES, Read, color_size, read_depth
from semstab.datasets.geometry.cameras import planar
from semstab.errors import DataError
from semstab.model.frames import Intrinsics

Depth = Float32
Shape = tuple[int, int]
Camera = Callable[[Shape], Intrinsics]
"""The intrinsics of a frame's depth image, of shape (H, W)."""

FORMATS = {".bin": read_depth_map, ".mvei": read_mvei, ".dmap": read_dmap}
"""What reads depth by the file's suffix; `read_depth` reads the rest."""


class DepthSource(Protocol):
    """The depth of a scene's frames."""

    def path(self, frame: FrameSource) -> Path:
        """The file that a frame's depth comes from."""
        ...

    def scale(self, frame: FrameSource) -> float | None:
        """Units of stored depth in a metre, None where depth is not stored."""
        ...

    def depth(self, frame: FrameSource, read: Read, camera: Camera, T_wc: Callable[[], Float64]) -> Depth:
        """Depth (H, W) along the optical axis in metres, of a file whose bytes `read` gives. Raises DataError."""
        ...

    def digest(self, frame: FrameSource) -> bytes | None:
        """A hash of the content behind the frame's depth, None where the file has to be read for it."""
        ...


class StoredDepth:
    """A file a frame."""

    def __init__(self, options: FileOptions) -> None:
        self._options = options

    def path(self, frame: FrameSource) -> Path:
        """The frame's own file."""
        return frame.depth

    def scale(self, frame: FrameSource) -> float:
        """What is said, else what its kind of file means."""
        usual = MILLIMETRES if frame.depth.suffix.lower() == ".png" else 1.0
        return self._options.depth_scale or frame.depth_scale or usual

    def depth(self, frame: FrameSource, read: Read, camera: Camera, T_wc: Callable[[], Float64]) -> Depth:
        """What the file holds, without what marks pixels that have none."""
        scale = self._options.depth_scale or frame.depth_scale
        depth = FORMATS.get(frame.depth.suffix.lower(), read_depth)(frame.depth, scale, read)
        if np.isnan(depth[0, 0]) and np.isnan(depth).all():  # one frame that saw nothing ends no run; it is counted
            depth = np.zeros_like(depth)
        for value in self._options.invalid_depth:
            with np.errstate(over="ignore"):
                depth[depth == np.float32(value) / np.float32(self.scale(frame))] = 0
        if self._options.max_depth is not None:
            depth[depth >= self._options.max_depth] = 0
        shape = (depth.shape[0], depth.shape[1])
        return planar(depth, camera(shape)) if self._options.depth_kind == "ray" else depth

    def digest(self, frame: FrameSource) -> None:
        """That of its file, which the scene knows where it has read it."""
        return


class CastDepth:
    """Rays cast at one surface. `views` are those of all frames, which say what is wrong where one sees nothing."""

    def __init__(self, surface: Surface, options: FileOptions, views: Callable[[], Iterable[View]]) -> None:
        self._surface = surface
        self._options = options
        self._views = views
        self._seen = False

    def path(self, frame: FrameSource) -> Path:
        """The file of the surface."""
        return self._surface.path

    def scale(self, frame: FrameSource) -> None:
        """Depth is not stored."""
        return

    def depth(self, frame: FrameSource, read: Read, camera: Camera, T_wc: Callable[[], Float64]) -> Depth:
        """What the camera sees of it."""
        shape = shape_of(frame, self._options)
        depth = self._surface.depth(View(camera(shape), T_wc(), shape))
        if not self._seen and not depth.any():
            self._surface.require_seen(self._views())
        self._seen = True
        if self._options.max_depth is not None:
            depth[depth >= self._options.max_depth] = 0
        return depth

    def digest(self, frame: FrameSource) -> bytes:
        """That of the surface."""
        return self._surface.digest


def shape_of(frame: FrameSource, options: FileOptions) -> Shape:
    """(H, W) of what is cast for a frame: the size that its camera is for, else that of its depth file or colour image.

    Raises DataError where none is known.
    """
    size = options.intrinsics_size or frame.camera.size
    if size is not None:
        return size[1], size[0]
    if frame.depth.is_file():
        H, W = read_depth(frame.depth, 1.0).shape
        return H, W
    if frame.label_camera is not None or frame.color is None or not frame.color.is_file():
        raise DataError(f"{frame.color or frame.name}: no colour image says the size of depth; set intrinsics_size")
    width, height = color_size(frame.color)
    return height, width
