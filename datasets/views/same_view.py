"""Label maps and scores brought from the pixels of their image to those of the depth, where both show the same view."""

from __future__ import annotations

from semstab.datasets.views.cameras import Camera
from semstab.datasets.views.resampling import Pixels, fit
from semstab.errors import DataError
from semstab.model.frames import Intrinsics

SHAPE_TOLERANCE = 0.02
"""Images whose ratios of width and height differ by more do not show the same view."""


def fitted(values: Pixels, shape: tuple[int, ...], where: str, what: str = "the image is") -> Pixels:
    """Labels (H', W') or scores (H', W', K) at the pixels of an image (H, W) of the same view.

    Nearest for ids, linear for scores. Raises DataError with `where`, its file, for another shape of image.
    """
    if values.shape[:2] == shape:
        return values
    h, w = shape[:2]
    require_same_view(values.shape, shape, where, f"{what} {{}} but depth is {{}}")
    target = Intrinsics(1, 1, (w - 1) / 2, (h - 1) / 2)
    return fit(values, Camera(target, (w, h)).at(values.shape), target, (h, w))


def require_same_view(shape: tuple[int, ...], other: tuple[int, ...], where: str, what: str) -> None:
    """Raise DataError with `where` and `what`, which has two places for sizes, unless the shapes are of one view."""
    (H, W), (h, w) = shape[:2], other[:2]
    if abs(W * h / (H * w) - 1) > SHAPE_TOLERANCE:
        raise DataError(f"{where}: {what.format(f'{W}x{H}', f'{w}x{h}')}, another view; register one to the other")
