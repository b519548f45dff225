"""Formulas of predicted against true classes, from sums over pixels or voxels: IoU and calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64

BINS = 15
"""Bins of the reliability diagram; bin b has the largest beliefs in (b / BINS, (b + 1) / BINS]."""


def iou(right: npt.NDArray[Any], true: npt.NDArray[Any], predicted: npt.NDArray[Any]) -> Float64:
    """Return intersection over union (...,) from the right, the true and the predicted; NaN for a union of 0."""
    union = true + predicted - right
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = np.where(union.real > 0, right / union, np.nan)
    return ratio


def mean_iou(right: npt.NDArray[Any], true: npt.NDArray[Any], predicted: npt.NDArray[Any]) -> Float64:
    """Return mean IoU (...,) over the classes, the last axis, that are true or predicted anywhere; NaN without any."""
    class_iou = iou(right, true, predicted)
    defined = ~np.isnan(class_iou)
    with np.errstate(invalid="ignore"):
        mean: Float64 = np.where(defined, class_iou, 0).sum(axis=-1) / defined.sum(axis=-1)
    return mean


def confidence_bin(confidence: Float64) -> Int64:
    """Return the bin (n,) of the reliability diagram that each largest belief (n,) lies in."""
    return np.clip(np.ceil(confidence * BINS - 1e-9).astype(np.int64) - 1, 0, BINS - 1)


def calibration_error(gap: Float64, count: Float64) -> Float64:
    """Return the expected calibration error (...,) (Guo et al. 2017, ICML); NaN for counts of 0.

    sum_b |right_b - confidence_b| / n.

    Args:
        gap: (..., B) number of the right ones less their confidence, summed in each bin of confidence.
        count: (...,) n.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        error: Float64 = (np.sign(gap.real) * gap).sum(axis=-1) / count
    return error
