"""Label maps and scores brought to the pixels of the depth image: nearest for ids, linear for scores."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Intrinsics
from semstab.model.labels import ignore_id

Labels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Scores = npt.NDArray[np.floating[Any]]
Pixels = TypeVar("Pixels", bound=npt.NDArray[Any])
"""Labels (H, W) or scores (H, W, K): the same comes back."""

TIE = 1e-6
"""Pixels by which a position between two pixels is moved on, so that ties do not depend on rounding."""

FAR = 2.0**40
"""Pixels from which a position is anyway outside of any image, and still a whole number when it is rounded."""


def fit(values: Pixels, K: Intrinsics, K_depth: Intrinsics, shape: tuple[int, int]) -> Pixels:
    """`fit_labels` of a label map, `fit_scores` of scores."""
    fitting: Any = fit_labels if values.ndim == 2 else fit_scores
    fitted: Pixels = fitting(values, K, K_depth, shape)
    return fitted


def fit_labels(labels: Labels, K: Intrinsics, K_depth: Intrinsics, shape: tuple[int, int]) -> Labels:
    """The label map as a camera with K_depth and an image (H, W) sees it: of each pixel the nearest label.

    K is that of the label map. Both images share centre and axes. What K does not see is ignored.
    """
    return _nearest(labels, K, K_depth, shape, ignore_id(labels))


def fit_depth(
    depth: npt.NDArray[np.float32], K_depth: Intrinsics, K: Intrinsics, shape: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """Depth as a camera with K and an image (H, W) sees it: of each pixel the nearest depth, 0 where there is none."""
    return _nearest(depth, K_depth, K, shape, 0)


def fit_scores(scores: Scores, K: Intrinsics, K_depth: Intrinsics, shape: tuple[int, int]) -> Scores:
    """Scores (H', W', K) as a camera with K_depth and an image (H, W) sees them: linear between pixel centres.

    Beyond the outer centres the outer pixels hold. Pixels that K does not see get scores of 0, which no one uses.
    """
    v, u = _positions(K, K_depth, shape)
    wide = scores.astype(np.result_type(scores.dtype, np.float32), copy=False)
    fitted = _linear(_linear(wide, v, axis=0), u, axis=1)
    inside = (_within(v, scores.shape[0])[:, None]) & _within(u, scores.shape[1])
    return np.where(inside[..., None], fitted, wide.dtype.type(0))


def _nearest(values: Pixels, K: Intrinsics, K_fit: Intrinsics, shape: tuple[int, int], fill: int) -> Pixels:
    v, u = _positions(K, K_fit, shape)
    rows, columns = (np.floor(x + 0.5 + TIE).astype(np.intp) for x in (v, u))
    H, W = values.shape
    fitted: Any = values[rows.clip(0, H - 1)[:, None], columns.clip(0, W - 1)]
    outside = ~(_within(rows, H)[:, None] & _within(columns, W))
    fitted[outside] = fill
    return cast(Pixels, fitted)


def _positions(
    K: Intrinsics, K_depth: Intrinsics, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Row of each row, column of each column of the depth image in the other one, in pixels."""
    v = K.fy * (np.arange(shape[0], dtype=np.float64) - K_depth.cy) / K_depth.fy + K.cy
    u = K.fx * (np.arange(shape[1], dtype=np.float64) - K_depth.cx) / K_depth.fx + K.cx
    return v.clip(-FAR, FAR), u.clip(-FAR, FAR)


def _within(positions: npt.NDArray[Any], length: int) -> npt.NDArray[np.bool_]:
    """Whether positions lie on the area of the pixels 0 to length - 1."""
    return (positions >= -0.5 - TIE) & (positions < length - 0.5 + TIE)


def _linear(values: npt.NDArray[Any], at: npt.NDArray[np.float64], axis: int) -> npt.NDArray[Any]:
    """Values between the pixel centres of one axis."""
    last = values.shape[axis] - 1
    x = at.clip(0, last)
    low = np.floor(x).astype(np.intp)
    share = (x - low).astype(values.dtype).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    below, above = values.take(low, axis), values.take(np.minimum(low + 1, last), axis)
    mixed: npt.NDArray[Any] = np.where(share == 0, below, below * (1 - share) + above * share)
    return mixed
