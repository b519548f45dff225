"""Colours of classes: as many as there are, each unlike the others, for any colour vision."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Color = tuple[int, int, int]
Float64 = npt.NDArray[np.float64]

# Paul Tol's 'bright' and 'muted' schemes: distinguishable with any colour vision.
PALETTE: tuple[Color, ...] = (
    (68, 119, 170), (238, 102, 119), (34, 136, 51), (204, 187, 68), (102, 204, 238), (170, 51, 119), (187, 187, 187),
    (51, 34, 136), (136, 204, 238), (68, 170, 153), (17, 119, 51), (153, 153, 51), (221, 204, 119), (204, 102, 119),
    (136, 34, 85), (170, 68, 153),
)  # fmt: skip

GLOW: tuple[Color, ...] = ((150, 0, 40), (230, 30, 0), (255, 140, 0), (255, 230, 60), (255, 255, 230))
"""What the recording shows drift in, from little to much: no class is given a colour of this fire."""

CLEAR = 45.0
"""Distance in RGB that classes keep from it; Tol's colours do."""

LEVELS = tuple(range(0, 256, 17))
"""Of each channel of the colours that are chosen from."""

LIGHTNESS = (0.3, 0.92)
"""Of these colours, in OKLab: neither ink nor paper."""

TO_LMS = np.array(
    [[0.41222147, 0.53633254, 0.05144599], [0.2119035, 0.6806995, 0.107397], [0.0883025, 0.2817188, 0.6299787]]
)
TO_LAB = np.array(
    [[0.21045426, 0.79361779, -0.00407205], [1.9779985, -2.4285922, 0.4505937], [0.0259040, 0.7827718, -0.8086758]]
)
"""From linear RGB to OKLab (Ottosson 2020, A perceptual color space for image processing)."""

DEUTAN = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
"""What linear RGB looks like without green cones (Vienot, Brettel, Mollon 1999, Color Research and Application)."""


@functools.cache
def palette(K: int) -> tuple[Color, ...]:
    """K colours: Tol's, and of those that are left the one farthest from all before, each by itself.

    >>> len(set(palette(150)))
    150
    """
    chosen = [*PALETTE[:K]]
    grid = np.stack(np.meshgrid(LEVELS, LEVELS, LEVELS, indexing="ij"), axis=-1).reshape(-1, 3)
    candidates, places = grid, _places(grid)
    fit = (places[:, 0] >= LIGHTNESS[0]) & (places[:, 0] <= LIGHTNESS[1])
    fit &= np.linalg.norm(grid[:, None] - between(GLOW, 4 * len(GLOW)), axis=2).min(axis=1) >= CLEAR
    candidates, places = candidates[fit], places[fit]
    if len(chosen) < K:
        own = _places(np.array(chosen))
        nearest = np.min([_distance(places, one) for one in own], axis=0)
    while len(chosen) < K:
        best = int(nearest.argmax())
        chosen.append((int(candidates[best, 0]), int(candidates[best, 1]), int(candidates[best, 2])))
        nearest = np.minimum(nearest, _distance(places, places[best]))
    return tuple(chosen)


def between(colors: Sequence[Color], n: int) -> Float64:
    """(n, 3) colours from the first to the last, evenly along the line through all of them."""
    at = np.linspace(0, len(colors) - 1, n)
    return np.stack([np.interp(at, np.arange(len(colors)), channel) for channel in np.transpose(colors)], axis=1)


def _places(colors: npt.NDArray[np.integer]) -> Float64:
    """(n, 6) OKLab of colours (n, 3), as they are and without green cones."""
    share = colors / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.concatenate([_oklab(linear), _oklab(np.clip(linear @ DEUTAN.T, 0, 1))], axis=1)


def _oklab(linear: Float64) -> Float64:
    found: Float64 = np.cbrt(linear @ TO_LMS.T) @ TO_LAB.T
    return found


def _distance(places: Float64, one: Float64) -> Float64:
    """(n,) how far colours look from one: to all eyes, and half as much to those without green cones."""
    difference = places - one
    seen = np.linalg.norm(difference[:, :3], axis=1) + 0.5 * np.linalg.norm(difference[:, 3:], axis=1)
    found: Float64 = seen
    return found
