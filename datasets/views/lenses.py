"""Cameras that distort, and their images as a pinhole at the same place sees them.

Models: OpenCV's, which are those of OpenSfM and ODM too (opencv.org, calib3d; opensfm.org, Geometric Models).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.datasets.views.cameras import Camera
from semstab.datasets.views.resampling import Pixels
from semstab.datasets.views.same_view import require_same_view
from semstab.model.frames import Intrinsics
from semstab.model.labels import ignore_id

OUTSIDE = -(2.0**20)
"""Pixels at which no image is."""

CHANNELS = 4
"""That are interpolated at a time: OpenCV 5 ends the process with a hundred."""

SAMPLES = 2000
"""Of the radius, at which it is seen whether the distortion folds the image over."""


@dataclass(frozen=True)
class Lens:
    """A camera that distorts: `camera` with its size, and what happens before its intrinsics.

    brown    k1 k2 p1 p2 k3: radial and tangential
    fisheye  k1 k2 k3 k4: of the angle to the optical axis
    """

    camera: Camera
    model: Literal["brown", "fisheye"]
    coefficients: tuple[float, ...]


def undistorted(
    values: Pixels, lens: Lens, K: Intrinsics, shape: tuple[int, int], where: str, what: str = "the image is"
) -> Pixels:
    """An image of the lens, ids (H', W') or channels (H', W', C), as a pinhole with K and an image (H, W) sees it.

    Of ids the nearest, of channels linear between pixel centres; what the lens does not see is ignored, or 0.
    Raises DataError with `where`, its file, where the image is not of the lens's shape.
    """
    import cv2

    size = lens.camera.size
    assert size is not None
    require_same_view(values.shape, (size[1], size[0]), where, f"{what} {{}} but its camera {{}}")
    x, y = _source_pixels(lens, (values.shape[0], values.shape[1]), K, shape)
    remap: Any = cv2.remap
    found: Any
    if values.ndim == 2:
        found = remap(values, x, y, cv2.INTER_NEAREST, borderValue=int(ignore_id(values)))
    else:
        wide = values if values.dtype == np.uint8 else values.astype(np.float32, copy=False)
        parts = [wide[..., k : k + CHANNELS] for k in range(0, values.shape[2], CHANNELS)]
        mixed = [remap(np.ascontiguousarray(part), x, y, cv2.INTER_LINEAR, borderValue=0) for part in parts]
        found = np.concatenate([part.reshape(*shape, -1) for part in mixed], axis=2).astype(values.dtype, copy=False)
    return found  # type: ignore[no-any-return]


@functools.lru_cache(maxsize=2)
def _source_pixels(
    lens: Lens, source: tuple[int, int], K: Intrinsics, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Column and row (H, W), in an image of the lens of shape `source`, of each pixel of the pinhole."""
    import cv2

    inner = lens.camera.at(source)
    size = (shape[1], shape[0])
    maps: Any = cv2.initUndistortRectifyMap if lens.model == "brown" else cv2.fisheye.initUndistortRectifyMap
    x, y = maps(inner.matrix, np.array(lens.coefficients), np.eye(3), K.matrix, size, cv2.CV_32FC1)
    u = (np.arange(shape[1]) - K.cx) / K.fx
    v = (np.arange(shape[0])[:, None] - K.cy) / K.fy
    folded = np.hypot(u, v) > _reach(lens, float(np.hypot(np.abs(u).max(), np.abs(v).max())))
    x[folded] = OUTSIDE
    return x, y


def _reach(lens: Lens, farthest: float) -> float:
    """Distance from the axis, a metre ahead, up to which the lens maps further out what lies further out."""
    radius = np.linspace(0, farthest, SAMPLES)
    if lens.model == "brown":
        k1, k2, _, _, k3 = lens.coefficients
        distorted = radius * (1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
    else:
        angle = np.arctan(radius)
        distorted = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(lens.coefficients, start=1)))
    back = np.flatnonzero(np.diff(distorted) <= 0)
    return float(radius[back[0]]) if len(back) else np.inf
