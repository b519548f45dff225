"""From where the viewer's eye looks at a map, so that it fills its view."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from semstab.core.types import Float64

FIELD_OF_VIEW = math.radians(55)
"""Of the viewer's eyes, from bottom to top."""

MARGIN = 0.96
"""Of a view's half height and half width, what is seen in it."""

OUTLIERS = 0.005
"""Share of a map's voxels that may lie beyond each edge of its view."""

BACKGROUND = (72, 72, 78)
"""Of the maps: neither end of the colour maps vanishes in it."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """What a scene's maps show, from which follows where they are seen from.

    points   (n, 3) metres, of the voxels or a sample of them
    cameras  (m, 4, 4) poses in the same world
    up       (3,), where it is known
    """

    points: Float64
    cameras: Float64
    up: Float64 | None


def eye(scenery: Scenery | None, aspect: float) -> rrb.EyeControls3D | None:
    """From where a view of that width by height shows it; None where the viewer chooses."""
    if scenery is None:
        return None
    target, distance = fit(scenery, aspect)
    toward, up = direction(scenery)
    return rrb.EyeControls3D(position=target + distance * toward, look_target=target, eye_up=up)


def direction(scenery: Scenery) -> tuple[Float64, Float64]:
    """Unit vectors from a scenery to the eye, and up.

    Where the world's up is known it looks down on the points, across their longest extent; else from the cameras' side.
    """
    points, cameras, up = scenery.points, scenery.cameras, scenery.up
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    side = (cameras[:, :3, 3] - middle).mean(axis=0) if len(cameras) else np.zeros(3)
    if up is None:
        up = -cameras[:, :3, 1].mean(axis=0) if len(cameras) else np.array([0.0, -1.0, 0.0])  # the images' top
        toward = side / max(float(np.linalg.norm(side)), 1e-9) + 0.3 * up
    else:
        flat = (points - middle) - np.outer((points - middle) @ up, up)
        across = np.cross(np.linalg.eigh(flat.T @ flat)[1][:, 2], up)
        toward = across * (1 if across @ side > 0 else -1) + up
    return toward / np.linalg.norm(toward), up / np.linalg.norm(up)


@functools.lru_cache(maxsize=256)
def fit(scenery: Scenery, aspect: float) -> tuple[Float64, float]:
    """Where an eye looks, and from how far, for a view of that width by height to be full of points and cameras.

    With the depth z of a point towards the eye, and its place (x, y) across, the view holds it where
    |x - x0| <= aspect * h * (d - z) and |y - y0| <= h * (d - z), h the tangent of half the field of view: so the edges
    of x - aspect * h * z and x + aspect * h * z say what d has to be, and likewise those of y.
    """
    toward, up = direction(scenery)
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    across = np.stack([right, np.cross(toward, right)])
    half = MARGIN * math.tan(FIELD_OF_VIEW / 2) * np.array([aspect, 1.0])

    def edges(places: Float64, trimmed: float) -> tuple[Any, Any]:
        at, near = places @ across.T, np.outer(places @ toward, half)
        return np.quantile(at - near, trimmed, axis=0), np.quantile(at + near, 1 - trimmed, axis=0)

    low, high = edges(scenery.points, OUTLIERS)
    if len(scenery.cameras):
        first, last = edges(scenery.cameras[:, :3, 3], 0.0)
        low, high = np.minimum(low, first), np.maximum(high, last)
    distance = float(((high - low) / (2 * half)).max())
    middle = float(np.median(scenery.points @ toward))
    return (low + high) / 2 @ across + middle * toward, distance - middle
