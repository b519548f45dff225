"""Label maps and scores brought from the pixels of their image to those of the depth, where both show the same view."""

from __future__ import annotations

import numpy as np

from semstab.datasets.views.cameras import Camera
from semstab.datasets.views.resampling import Pixels, fit, fit_depth
from semstab.errors import DataError
from semstab.model.frames import Frame, Intrinsics

SHAPE_TOLERANCE = 0.02
"""Images whose ratios of width and height differ by more do not show the same view."""


def fitted(values: Pixels, shape: tuple[int, ...], where: str, what: str = "the image is") -> Pixels:
    """Labels (H', W') or scores (H', W', K) at the pixels of an image (H, W) of the same view.

    Nearest for ids, linear for scores. Raises DataError with `where`, its file, for another shape of image.
    """
    if values.shape[:2] == shape:
        return values
    _require_one_view(values.shape, shape, where, what)
    h, w = shape[:2]
    target = Intrinsics(1, 1, (w - 1) / 2, (h - 1) / 2)
    return fit(values, Camera(target, (w, h)).at(values.shape), target, (h, w))


def at_image(frame: Frame, shape: tuple[int, int], where: str, K: Intrinsics | None = None) -> Frame:
    """A frame's depth and pose at the pixels of its colour image (H, W); no labels, depth 0 where it is not known.

    K is the image's, where it shows another view than the depth. Raises DataError with `where` for another shape.
    """
    depth = frame.depth
    if K is None:
        _require_one_view(shape, frame.shape, where, "the image is")
        K = frame.intrinsics.resized((frame.shape[1], frame.shape[0]), (shape[1], shape[0]))
    if (K, shape) != (frame.intrinsics, frame.shape):
        depth = fit_depth(depth, frame.intrinsics, K, shape)
    return Frame(frame.index, depth, K, frame.T_wc, labels=np.zeros(shape, np.uint8), timestamp=frame.timestamp)


def _require_one_view(image: tuple[int, ...], depth: tuple[int, ...], where: str, what: str) -> None:
    require_same_view(image, depth, where, f"{what} {{}} but depth is {{}}")


def require_same_view(shape: tuple[int, ...], other: tuple[int, ...], where: str, what: str) -> None:
    """Raise DataError with `where` and `what`, which has two places for sizes, unless the shapes are of one view."""
    (H, W), (h, w) = shape[:2], other[:2]
    if abs(W * h / (H * w) - 1) > SHAPE_TOLERANCE:
        raise DataError(f"{where}: {what.format(f'{W}x{H}', f'{w}x{h}')}, another view; register one to the other")
