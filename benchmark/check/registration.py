"""Do label maps and depth show the same thing at the same pixel: the edges of one on the edges of the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

JUMP = 0.05
"""An edge of depth is where it changes by this share from pixel to pixel."""

WIDTH = 192
"""Edges are compared on a grid of about so many columns."""

SCALES = np.arange(0.84, 1.17, 0.02)
REACH = 0.08
"""Other registrations that are tried: enlarged about the image's centre, and moved by this share of the width."""

CLEARLY = 1.1
"""Another registration has to fit so many times as well, in each half of the frames and in most of them."""

LEAST_FIT = 0.1
"""Correlation of edges from which a fit is one."""

LEAST_OFFSET = 0.03
"""Share of the image's width: what is off by less in the middle of its sides is no matter of registration."""

MOST = 0.75
"""Share of the frames that another registration has to fit better."""

LEAST_FRAMES = 4

Map = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Edges = tuple[npt.NDArray[np.float32], Mask]
"""Depth (H, W), and edges (H, W) of labels or of the image."""


@dataclass(frozen=True)
class Offset:
    """What would bring the label maps onto the depth: enlarge them about the centre, then move them, pixels."""

    scale: float
    shift: tuple[float, float]
    fit: float
    present: float

    def __str__(self) -> str:
        x, y = self.shift
        return (
            f"their edges lie on those of depth best when they are enlarged {self.scale:.2f} times and moved by"
            f" ({x:.0f}, {y:.0f}) pixels (correlation {self.fit:.2f}, as they are {self.present:.2f})"
        )


def find_offset(pairs: Sequence[Edges]) -> Offset | None:
    """How far edges (H, W) of labels or images are off those of depth (H, W), frame by frame; None where they fit.

    Both halves of the frames have to say the same, so that edges that have nothing to do with each other do not count.
    """
    maps = [(_thinned(depth_edges(depth)), _thinned(edges)) for depth, edges in pairs]
    maps = [(a, b) for a, b in maps if a.any() and b.any() and a.shape == b.shape == maps[0][0].shape]
    if len(maps) < LEAST_FRAMES:
        return None
    fits = [_fits(a, b) for a, b in maps]
    halves = [np.mean(fits[k::2], axis=0) for k in (0, 1)]
    whole = np.mean(fits, axis=0)
    best, here = _peak(whole), _identity(whole)
    agree = all(_distance(_peak(half), best, maps[0][0].shape) < LEAST_OFFSET for half in halves)
    clear = all(half[best] > CLEARLY * half[here] for half in halves) and whole[best] >= LEAST_FIT
    clear = clear and np.mean([fit[best] > fit[here] for fit in fits]) >= MOST
    if not (agree and clear) or _distance(best, here, maps[0][0].shape) < LEAST_OFFSET:
        return None
    cell, reach = pairs[0][0].shape[1] / maps[0][0].shape[1], whole.shape[1] // 2
    shift = ((best[2] - whole.shape[2] // 2) * cell, (best[1] - reach) * cell)
    return Offset(float(SCALES[best[0]]), shift, float(whole[best]), float(whole[here]))


def depth_edges(depth: npt.NDArray[np.float32]) -> Mask:
    """(H, W) where neighbouring pixels lie on different surfaces.

    Small gaps are closed with the farthest depth around them: beside an edge sensors miss what lies behind it.
    """
    import cv2

    found = np.where((depth > 0) & (depth < np.inf), depth, np.float32(0)).astype(np.float32)
    size = 2 * max(3, depth.shape[1] // 100) + 1
    closed = np.where(found > 0, found, cv2.dilate(found, np.ones((size, size))))
    with np.errstate(all="ignore"):
        log = np.where(closed > 0, np.log(closed), np.nan)
        return _changes(log, lambda a, b: np.abs(a - b) > JUMP)


def label_edges(labels: npt.NDArray[Any], ignore: int) -> Mask:
    """(H, W) where neighbouring pixels have different labels."""
    return _changes(labels, lambda a, b: (a != b) & (a != ignore) & (b != ignore))


def grey_levels(color: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(H, W) brightness of colour (H, W, 3) from 0 to 254, so that it can be brought to the depth like labels."""
    grey: npt.NDArray[np.uint8] = (color.mean(axis=2) * (254 / 255)).astype(np.uint8)
    return grey


def image_edges(grey: npt.NDArray[Any]) -> Mask:
    """(H, W) where a grey image changes most: a tenth of its pixels."""
    dy, dx = np.gradient(grey.astype(np.float32))
    strength = np.hypot(dx, dy)
    edges: Mask = strength > max(float(np.quantile(strength, 0.9)), 1.0)
    return edges


def _changes(values: npt.NDArray[Any], changed: Callable[[Any, Any], Any]) -> Mask:
    edges = np.zeros(values.shape, dtype=np.bool_)
    edges[:, 1:] |= changed(values[:, 1:], values[:, :-1])
    edges[1:] |= changed(values[1:], values[:-1])
    return edges


def _thinned(edges: Mask) -> Map:
    """Share of edges in each cell of a coarse grid, smoothed a little, without its mean."""
    import cv2

    cell = max(1, math.ceil(edges.shape[1] / WIDTH))
    H, W = (side // cell for side in edges.shape)
    grid = edges[: H * cell, : W * cell].reshape(H, cell, W, cell).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), 1.0), dtype=np.float64)


def _fits(a: Map, b: Map) -> Map:
    """(scales, shifts in y, shifts in x): correlation of map a with map b, enlarged about the centre and moved."""
    import cv2

    H, W = a.shape
    reach = max(1, round(REACH * W))
    spectrum = np.fft.rfft2(a - a.mean(), (2 * H, 2 * W))
    fits = []
    for scale in SCALES:
        about = np.array([[scale, 0, (1 - scale) * (W - 1) / 2], [0, scale, (1 - scale) * (H - 1) / 2]])
        warped = cv2.warpAffine(b, about, (W, H), flags=cv2.INTER_LINEAR)
        warped = warped - warped.mean()
        product = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(warped, (2 * H, 2 * W))), (2 * H, 2 * W))
        norm = float(np.linalg.norm(a - a.mean()) * np.linalg.norm(warped))
        near = np.roll(product, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]
        fits.append(near / max(norm, 1e-12))
    return np.array(fits)


def _peak(fits: Map) -> tuple[int, ...]:
    return tuple(int(k) for k in np.unravel_index(fits.argmax(), fits.shape))


def _identity(fits: Map) -> tuple[int, ...]:
    return (int(np.abs(SCALES - 1).argmin()), fits.shape[1] // 2, fits.shape[2] // 2)


def _distance(one: tuple[int, ...], other: tuple[int, ...], shape: tuple[int, ...]) -> float:
    """How far two registrations lie apart in the middle of the image's sides, as a share of its width."""
    H, W = shape
    scale = abs(SCALES[one[0]] - SCALES[other[0]])
    x, y = (abs(one[k] - other[k]) / W for k in (2, 1))
    return float(max(x + scale / 2, y + scale / 2 * H / W))
