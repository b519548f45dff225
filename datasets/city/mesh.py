"""Triangles with a class and a colour a face, and the templates from which the town is put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, UInt8
from semstab.data.labels import LabelSpace

Range = tuple[float, float]

CLUTTER, BUILDING, ROAD, STATIC_CAR, TREE, LOW_VEGETATION, HUMAN, MOVING_CAR = range(8)
"""Ids of the uavid8 classes, by which every face is labelled."""

MOVERS = (HUMAN, MOVING_CAR)
"""The classes of everything that moves; things of all other classes stand still."""


@cache
def uavid8() -> LabelSpace:
    """Return the label space of the town's ground truth and of every simulated model."""
    return LabelSpace.load("uavid8")


@dataclass(frozen=True)
class TriangleSurface:
    """Triangles, or a template of them that is placed many times.

    Attributes:
        vertices, faces: (n, 3) metres; (m, 3) vertices of each triangle.
        classes: (m,) uavid8 ids.
        colors: (m, 3) RGB in [0, 1]; NaN for the tint of a copy.
    """

    vertices: Float64
    faces: Int64
    classes: UInt8
    colors: Float64

    def place(self, position: Float64, yaw: Float64, size: Float64, tint: Float64) -> TriangleSurface:
        """Place n tinted copies, scaled (n, 3), turned by `yaw` (n,) about z, and moved to positions (n, 3)."""
        n, v = len(position), len(self.vertices)
        x, y, z = np.moveaxis(self.vertices[None] * size[:, None], 2, 0)
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        vertices = np.stack([c * x - s * y, s * x + c * y, z], axis=2) + position[:, None]
        faces = self.faces[None] + (np.arange(n) * v)[:, None, None]
        colors = np.where(np.isnan(self.colors)[None], tint[:, None], self.colors[None])
        return TriangleSurface(
            vertices.reshape(-1, 3), faces.reshape(-1, 3), np.tile(self.classes, n), colors.reshape(-1, 3)
        )


def surface(vertices: Float64, faces: npt.ArrayLike, class_id: int, color: npt.ArrayLike = np.nan) -> TriangleSurface:
    """Return a surface of one class and colour from triangles or quads; without a colour, copies are tinted."""
    corners = np.asarray(faces, dtype=np.int64)
    if corners.shape[1] == 4:
        corners = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    colors = np.broadcast_to(np.asarray(color, dtype=np.float64), (len(corners), 3))
    return TriangleSurface(vertices, corners, np.full(len(corners), class_id, dtype=np.uint8), colors)


def join(surfaces: Sequence[TriangleSurface]) -> TriangleSurface:
    """Return all surfaces as one, in the given order."""
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=False)])
    vertices, classes, colors = (
        np.concatenate([getattr(s, name) for s in surfaces]) for name in ("vertices", "classes", "colors")
    )
    return TriangleSurface(vertices, faces, classes, colors)


def box(
    class_id: int, x: Range = (-0.5, 0.5), y: Range = (-0.5, 0.5), z: Range = (0, 1), *, color: npt.ArrayLike = np.nan,
    taper: float = 1.0,
) -> TriangleSurface:  # fmt: skip
    """Return a box without its bottom; `taper` scales the top about its centre."""
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    centre = corners.mean(axis=0)
    vertices = np.concatenate([np.c_[corners, [z[0]] * 4], np.c_[centre + taper * (corners - centre), [z[1]] * 4]])
    return surface(vertices, [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]], class_id, color)


def blob(
    class_id: int, centre: npt.ArrayLike, radii: npt.ArrayLike, detail: int, rng: np.random.Generator
) -> TriangleSurface:
    """Return a dented ball that is tinted; from trimesh's icosphere, subdivided `detail` times."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=detail)
    dents = rng.uniform(0.85, 1.15, size=(len(ball.vertices), 1))
    return surface(ball.vertices * dents * np.asarray(radii) + np.asarray(centre), ball.faces, class_id)
