"""Edges in a frame: of depth, of labels, and of the brightness of an image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Mask

JUMP = 0.05
"""Relative change of depth from pixel to pixel that counts as an edge."""


def depth_edges(depth: Float32) -> Mask:
    """Return a mask (H, W) of the pixels whose neighbours lie on other surfaces.

    Small gaps are closed with the farthest depth around them: next to an edge sensors miss the surface behind it.
    """
    import cv2

    valid_depth = np.where((depth > 0) & (depth < np.inf), depth, np.float32(0)).astype(np.float32)
    size = 2 * max(3, depth.shape[1] // 100) + 1
    closed = np.where(valid_depth > 0, valid_depth, cv2.dilate(valid_depth, np.ones((size, size))))
    with np.errstate(all="ignore"):
        log = np.where(closed > 0, np.log(closed), np.nan)
        return _changes(log, lambda a, b: np.abs(a - b) > JUMP)


def label_edges(labels: npt.NDArray[Any], ignore: int) -> Mask:
    """Return a mask (H, W) of the pixels whose neighbours have other labels."""
    return _changes(labels, lambda a, b: (a != b) & (a != ignore) & (b != ignore))


def image_edges(grey: npt.NDArray[Any]) -> Mask:
    """Return a mask (H, W) of the tenth of its pixels where a grey image changes most."""
    dy, dx = np.gradient(grey.astype(np.float32))
    strength = np.hypot(dx, dy)
    edges: Mask = strength > max(float(np.quantile(strength, 0.9)), 1.0)
    return edges


def _changes(values: npt.NDArray[Any], changed: Callable[[Any, Any], Any]) -> Mask:
    edges = np.zeros(values.shape, dtype=np.bool_)
    edges[:, 1:] |= changed(values[:, 1:], values[:, :-1])
    edges[1:] |= changed(values[1:], values[:-1])
    return edges
