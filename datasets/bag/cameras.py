"""Cameras of a bag: pinhole and lens of CameraInfo messages, of raw images or of rectified ones.

Source: sensor_msgs/CameraInfo; REP 104 (distortion models).
"""

from __future__ import annotations

from typing import Any, Literal

from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Lens
from semstab.errors import DataError

Model = Literal["brown", "rational", "fisheye"]

MODELS: dict[str, tuple[Model, int]] = {
    "plumb_bob": ("brown", 5), "rational_polynomial": ("rational", 8), "equidistant": ("fisheye", 4),
    "fisheye": ("fisheye", 4),
}  # fmt: skip
"""Lens and number of coefficients, by distortion model."""


def is_rectified(topic: str) -> bool:
    """Return whether a topic holds rectified images, by its name as image_proc gives it: image_rect, image_rect_color.

    >>> is_rectified("/camera/depth/image_rect_raw"), is_rectified("/camera/direct/image_raw")
    (True, False)
    """
    return "rect" in topic.rpartition("/")[2].replace("direct", "")


def camera_of(info: Any, where: str, *, rectified: bool) -> tuple[Camera, Lens | None]:
    """Return the pinhole of a CameraInfo, in pixels of its image, and the lens of its raw images, or None without one.

    The pinhole of rectified images comes from P. The pinhole of raw images, and of undistorted images, comes from K.

    Raises:
        DataError: If it is not calibrated, or its distortion is of another model, with `where`.
    """
    K, D, P = (_numbers(info, name) for name in "KDP")
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified and P[0] else (K[0], K[4], K[2], K[5])
    if fx == 0 or fy == 0:
        raise DataError(f"{where}: the camera is not calibrated (its K is 0); set intrinsics: [fx, fy, cx, cy]")
    roi = info.roi
    width, height = (
        (int(roi.width), int(roi.height)) if roi.width and roi.height else (int(info.width), int(info.height))
    )
    size = (width, height) if width and height else None
    camera = Camera.stated((fx, fy, cx - int(roi.x_offset), cy - int(roi.y_offset)), size, where)
    if rectified or not any(D):
        return camera, None
    model, count = MODELS.get(info.distortion_model, ("brown", 0))
    if not count or any(D[count:]):
        raise DataError(
            f"{where}: distortion {info.distortion_model!r} with {len(D)} coefficients is not read; record rectified"
            " images, or set rectified: true to leave it out"
        )
    if size is None:
        raise DataError(f"{where}: says no width and height, which its distortion needs; record rectified images")
    return camera, Lens(camera, model, tuple((*D, *(0.0,) * count)[:count]))


def _numbers(info: Any, name: str) -> list[float]:
    """Return a field by its name in ROS 1, which ROS 2 has in small letters."""
    values = getattr(info, name) if hasattr(info, name) else getattr(info, name.lower())
    return [float(value) for value in values]
