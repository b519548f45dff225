"""Cameras that distort, and their images as a pinhole at the same position sees them.

Models: OpenCV's, which are those of OpenSfM and ODM too (opencv.org, calib3d; opensfm.org, Geometric Models).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64, Mask, UInt8, UInt16
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import ignore_id
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

# Label maps and scores brought to the pixels of the depth image: nearest for ids, linear for scores.

Labels = UInt8 | UInt16
Scores = npt.NDArray[np.floating[Any]]
Pixels = TypeVar("Pixels", bound=npt.NDArray[Any])
"""Labels (H, W) or scores (H, W, K): the same comes back."""

TIE = 1e-6
"""Pixels by which a position between two pixels is moved on, so that ties do not depend on rounding."""

FAR = 2.0**40
"""Pixels from which a position is anyway outside of any image, and still a whole number when it is rounded."""


def fit(values: Pixels, K: Intrinsics, K_fit: Intrinsics, shape: tuple[int, int]) -> Pixels:
    """Return a label map (H', W') or scores (H', W', K) as a camera with K_fit and an image (H, W) sees them.

    K belongs to `values`. Both images share centre and axes. Each pixel gets the nearest label; scores are linear
    between pixel centres, and beyond the outer centres the outer pixels hold. Pixels that K does not see are ignored:
    labels of 255 (65535), scores of 0.
    """
    if values.ndim == 2:
        return _nearest(values, K, K_fit, shape, int(ignore_id(values)))
    v, u = _positions(K, K_fit, shape)
    wide = values.astype(np.result_type(values.dtype, np.float32), copy=False)
    mixed = _linear(_linear(wide, v, axis=0), u, axis=1)
    inside = _within(v, values.shape[0])[:, None] & _within(u, values.shape[1])
    return cast(Pixels, np.where(inside[..., None], mixed, wide.dtype.type(0)))


def _nearest(values: Pixels, K: Intrinsics, K_fit: Intrinsics, shape: tuple[int, int], fill: int) -> Pixels:
    v, u = _positions(K, K_fit, shape)
    rows, columns = (np.floor(x + 0.5 + TIE).astype(np.intp) for x in (v, u))
    H, W = values.shape
    nearest: Any = values[rows.clip(0, H - 1)[:, None], columns.clip(0, W - 1)]
    nearest[~(_within(rows, H)[:, None] & _within(columns, W))] = fill
    return cast(Pixels, nearest)


def _positions(K: Intrinsics, K_depth: Intrinsics, shape: tuple[int, int]) -> tuple[Float64, Float64]:
    """Return the row of each row, column of each column of the depth image in the other one, in pixels."""
    v = K.fy * (np.arange(shape[0], dtype=np.float64) - K_depth.cy) / K_depth.fy + K.cy
    u = K.fx * (np.arange(shape[1], dtype=np.float64) - K_depth.cx) / K_depth.fx + K.cx
    return v.clip(-FAR, FAR), u.clip(-FAR, FAR)


def _within(positions: npt.NDArray[Any], length: int) -> Mask:
    """Return whether positions lie on the area of the pixels 0 to length - 1."""
    return (positions >= -0.5 - TIE) & (positions < length - 0.5 + TIE)


def _linear(values: npt.NDArray[Any], positions: Float64, axis: int) -> npt.NDArray[Any]:
    """Return values between the pixel centres of one axis."""
    last = values.shape[axis] - 1
    x = positions.clip(0, last)
    low = np.floor(x).astype(np.intp)
    share = (x - low).astype(values.dtype).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    below, above = values.take(low, axis), values.take(np.minimum(low + 1, last), axis)
    mixed: npt.NDArray[Any] = np.where(share == 0, below, below * (1 - share) + above * share)
    return mixed


# Label maps and scores brought from the pixels of their image to those of the depth, where both show the same view.

SHAPE_TOLERANCE = 0.02
"""Images whose ratios of width and height differ by more do not show the same view."""


def fitted(values: Pixels, shape: tuple[int, ...], where: str, what: str = "the image is") -> Pixels:
    """Return labels (H', W') or scores (H', W', K) at the pixels of an image (H, W) of the same view.

    Ids are the nearest ones, scores are linear.

    Raises:
        DataError: For another shape of image, with `where`, its file.
    """
    if values.shape[:2] == shape:
        return values
    require_same_view(values.shape, shape, where, f"{what} {{}} but depth is {{}}")
    h, w = shape[:2]
    target = Intrinsics(1, 1, (w - 1) / 2, (h - 1) / 2)
    return fit(values, Camera(target, (w, h)).intrinsics_at(values.shape), target, (h, w))


def at_image(frame: Frame, shape: tuple[int, int], where: str, K: Intrinsics | None = None) -> Frame:
    """Return a frame's depth and pose at the pixels of its colour image (H, W); no labels, depth 0 if unknown.

    K has the intrinsics of the image, if its view differs from the view of the depth.

    Raises:
        DataError: For another shape, with `where`.
    """
    depth = frame.depth
    if K is None:
        require_same_view(shape, frame.shape, where, "the image is {} but depth is {}")
        K = frame.intrinsics.resized((frame.shape[1], frame.shape[0]), (shape[1], shape[0]))
    if (K, shape) != (frame.intrinsics, frame.shape):
        depth = _nearest(depth, frame.intrinsics, K, shape, 0)
    return Frame(frame.index, depth, K, frame.T_wc, labels=np.zeros(shape, np.uint8), timestamp=frame.timestamp)


def require_same_view(shape: tuple[int, ...], other: tuple[int, ...], where: str, what: str) -> None:
    """Raise DataError with `where` and `what`, which has two holes for sizes, unless the shapes are of one view."""
    (H, W), (h, w) = shape[:2], other[:2]
    if abs(W * h / (H * w) - 1) > SHAPE_TOLERANCE:
        raise DataError(f"{where}: {what.format(f'{W}x{H}', f'{w}x{h}')}, another view; register one to the other")


OUTSIDE = -(2.0**20)
"""Pixels at which no image is."""

CHANNELS = 4
"""The channels that are interpolated at a time: OpenCV 5 ends the process with a hundred."""

SAMPLES = 2000
"""Samples of the radius that show whether the distortion folds the image over."""


@dataclass(frozen=True)
class Lens:
    """A camera that distorts: `camera` with its size, and the distortion before its intrinsics.

    Attributes:
        brown: k1 k2 p1 p2 k3: radial and tangential.
        rational: k1 k2 p1 p2 k3 k4 k5 k6: the same with a radial denominator.
        fisheye: k1 k2 k3 k4: of the angle to the optical axis.
    """

    camera: Camera
    model: Literal["brown", "rational", "fisheye"]
    coefficients: tuple[float, ...]


def undistorted(
    values: Pixels, lens: Lens, K: Intrinsics, shape: tuple[int, int], where: str, what: str = "the image is"
) -> Pixels:
    """Return an image of the lens, of ids or depth (H', W') or channels (H', W', C), as a pinhole with K sees it.

    The pinhole's image is (H, W). Ids and depth are the nearest ones, channels are linear between pixel centres; where
    the lens does not see a pixel ids are ignored, all else is 0.

    Raises:
        DataError: If the image is not of the lens's shape, with `where`, its file.
    """
    import cv2

    size = lens.camera.size
    assert size is not None
    require_same_view(values.shape, (size[1], size[0]), where, f"{what} {{}} but its camera {{}}")
    x, y = _source_pixels(lens, (values.shape[0], values.shape[1]), K, shape)
    remap: Any = cv2.remap
    if values.ndim == 2:
        nothing = 0 if values.dtype.kind == "f" else int(ignore_id(values))
        image = remap(values, x, y, cv2.INTER_NEAREST, borderValue=nothing)
    else:
        wide = values if values.dtype == np.uint8 else values.astype(np.float32, copy=False)
        parts = [wide[..., k : k + CHANNELS] for k in range(0, values.shape[2], CHANNELS)]
        mixed = [remap(np.ascontiguousarray(part), x, y, cv2.INTER_LINEAR, borderValue=0) for part in parts]
        image = np.concatenate([part.reshape(*shape, -1) for part in mixed], axis=2).astype(values.dtype, copy=False)
    return image  # type: ignore[no-any-return]


@functools.lru_cache(maxsize=2)
def _source_pixels(
    lens: Lens, source: tuple[int, int], K: Intrinsics, shape: tuple[int, int]
) -> tuple[Float32, Float32]:
    """Return the column and row (H, W), in an image of the lens of shape `source`, of each pixel of the pinhole."""
    import cv2

    inner = lens.camera.intrinsics_at(source)
    size = (shape[1], shape[0])
    maps: Any = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    x, y = maps(inner.matrix, np.array(lens.coefficients), np.eye(3), K.matrix, size, cv2.CV_32FC1)
    u = (np.arange(shape[1]) - K.cx) / K.fx
    v = (np.arange(shape[0])[:, None] - K.cy) / K.fy
    folded = np.hypot(u, v) > _reach(lens, float(np.hypot(np.abs(u).max(), np.abs(v).max())))
    x[folded] = OUTSIDE
    return x, y


def _reach(lens: Lens, farthest: float) -> float:
    """Return the distance from the axis, a metre ahead, up to which the lens preserves the order of distances."""
    radius = np.linspace(0, farthest, SAMPLES)
    if lens.model != "fisheye":
        k1, k2, _, _, k3, k4, k5, k6 = (*lens.coefficients, 0.0, 0.0, 0.0)[:8]
        radial = 1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6
        distorted = radius * radial / (1 + k4 * radius**2 + k5 * radius**4 + k6 * radius**6)
    else:
        angle = np.arctan(radius)
        distorted = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(lens.coefficients, start=1)))
    back = np.flatnonzero(np.diff(distorted) <= 0)
    return float(radius[back[0]]) if len(back) else np.inf
