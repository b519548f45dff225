"""Predictions brought from the pixels of the image to those of the depth, where both show the same view."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.cameras import Camera
from semstab.datasets.resampling import fit_labels, fit_scores
from semstab.errors import DataError
from semstab.frames import Intrinsics

SHAPE_TOLERANCE = 0.02
"""Images whose ratios of width and height differ by more do not show the same view."""

Labels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Scores = npt.NDArray[np.floating[Any]]


def fitted(
    labels: Labels | None, scores: Scores | None, shape: tuple[int, ...], where: str
) -> tuple[Labels | None, Scores | None]:
    """Labels (H', W') and scores (H', W', K), each where given, at the pixels of an image (H, W) of the same view.

    Nearest for ids, linear for scores. Raises DataError with `where` (the colour image) for another shape of image.
    """
    return (
        None if labels is None else _fit(fit_labels, labels, shape, where),
        None if scores is None else _fit(fit_scores, scores, shape, where),
    )


def _fit(fit: Any, values: Any, shape: tuple[int, ...], where: str) -> Any:
    if values.shape[:2] == shape:
        return values
    (H, W), (h, w) = values.shape[:2], shape
    if abs(W * h / (H * w) - 1) > SHAPE_TOLERANCE:
        raise DataError(f"{where}: the image is {W}x{H} but depth is {w}x{h}, another view; register one to the other")
    target = Intrinsics(1, 1, (w - 1) / 2, (h - 1) / 2)
    return fit(values, Camera(target, (w, h)).at(values.shape), target, (h, w))
