"""Triangles with a class and a colour a face, and the templates from which the town is put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, UInt8
from semstab.data.labels import LabelSpace

Color = tuple[float, float, float]
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
class Surface:
    """Triangles: vertices (n, 3) metres, faces (m, 3), classes (m,) uavid8 ids, colors (m, 3) RGB in [0, 1]."""

    vertices: Float64
    faces: Int64
    classes: UInt8
    colors: Float64

    @classmethod
    def of_class(cls, vertices: Float64, faces: Int64, class_id: int, color: npt.ArrayLike) -> Surface:
        """Return a surface of one class; `color` is one RGB or one a face."""
        colors = np.broadcast_to(np.asarray(color, dtype=np.float64), (len(faces), 3))
        return cls(vertices, faces, np.full(len(faces), class_id, dtype=np.uint8), colors)


def join(surfaces: Sequence[Surface]) -> Surface:
    """Return all surfaces as one, in the given order."""
    return Surface(*_joined(surfaces), np.concatenate([s.classes for s in surfaces]), _colors(surfaces))


class Shape(NamedTuple):
    """A template placed many times: vertices (v, 3), faces (f, 3), colors (f, 3); NaN where a face takes the tint."""

    vertices: Float64
    faces: Int64
    colors: Float64

    def place(self, class_id: int, position: Float64, yaw: Float64, size: Float64, tint: Float64) -> Surface:
        """Place n copies: scaled by `size` (n, 3), turned by `yaw` (n,) about z, moved to `position` (n, 3).

        tint (n, 3) colours the faces without a colour.
        """
        n, v = len(position), len(self.vertices)
        x, y, z = np.moveaxis(self.vertices[None] * size[:, None], 2, 0)
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        vertices = np.stack([c * x - s * y, s * x + c * y, z], axis=2) + position[:, None]
        faces = self.faces[None] + (np.arange(n) * v)[:, None, None]
        colors = np.where(np.isnan(self.colors)[None], tint[:, None], self.colors[None])
        return Surface.of_class(vertices.reshape(-1, 3), faces.reshape(-1, 3), class_id, colors.reshape(-1, 3))


def combine(*shapes: Shape) -> Shape:
    """Return several shapes as one template."""
    return Shape(*_joined(shapes), _colors(shapes))


def shape(vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color | None = None) -> Shape:
    """Return a shape of triangles or quads of one colour; without a colour, its faces take the tint."""
    corners = np.asarray(faces, dtype=np.int64)
    if corners.shape[1] == 4:
        corners = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    colors = np.full((len(corners), 3), np.nan if color is None else color)
    return Shape(np.asarray(vertices, dtype=np.float64), corners, colors)


def box(
    x: Range = (-0.5, 0.5), y: Range = (-0.5, 0.5), z: Range = (0, 1), color: Color | None = None, taper: float = 1.0
) -> Shape:
    """Return a box without its bottom; `taper` scales the top about its centre."""
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    centre = corners.mean(axis=0)
    vertices = np.concatenate(
        [np.c_[corners, np.full(4, z[0])], np.c_[centre + taper * (corners - centre), [z[1]] * 4]]
    )
    return shape(vertices, [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]], color)


def blob(centre: npt.ArrayLike, radii: npt.ArrayLike, subdivisions: int, rng: np.random.Generator) -> Shape:
    """Return a dented ball without a colour; from trimesh's icosphere."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    dents = rng.uniform(0.85, 1.15, size=(len(ball.vertices), 1))
    return shape(ball.vertices * dents * np.asarray(radii) + np.asarray(centre), ball.faces)


def _joined(parts: Sequence[Surface | Shape]) -> tuple[Float64, Int64]:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def _colors(parts: Sequence[Surface | Shape]) -> Float64:
    return np.concatenate([part.colors for part in parts])
