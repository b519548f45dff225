"""Triangle surfaces with a class and a colour a face, and the unit shapes from which the town is put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt8
from semstab.data.labels import LabelSpace

Color = tuple[float, float, float]

_BOX_FACES = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7]])


@dataclass(frozen=True)
class Surface:
    """Triangles: vertices (n, 3) metres, faces (m, 3), classes (m,) uint8 uavid8 ids, colors (m, 3) RGB in [0, 1]."""

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
    vertices, faces, colors = _joined(surfaces)
    return Surface(vertices, faces, np.concatenate([s.classes for s in surfaces]), colors)


def _joined(parts: Sequence[Surface | Shape]) -> tuple[Float64, Int64, Float64]:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    colors = np.concatenate([part.colors for part in parts])
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces), colors


def choose(colors: Float64, count: int, rng: np.random.Generator) -> Float64:
    """Return (count, 3) colours, drawn at random from a few."""
    return colors[rng.integers(len(colors), size=count)]


@dataclass(frozen=True)
class Shape:
    """A template placed many times: vertices (v, 3), faces (f, 3), colors (f, 3), and which faces take a tint."""

    vertices: Float64
    faces: Int64
    colors: Float64
    tinted: Mask

    def place(
        self, class_id: int, position: Float64, yaw: Float64, size: Float64, tint: Float64, lean: Float64 | None = None
    ) -> Surface:
        """Place n copies: scaled by `size` (n, 3), turned by `yaw` (n,) about z, moved to `position` (n, 3).

        tint (n, 3) colours the tinted faces; lean (n, 2) is the slope dz/dx, dz/dy of the ground that a copy follows.
        """
        n, v = len(position), len(self.vertices)
        scaled = self.vertices[None] * size[:, None]
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        turned = np.empty((n, v, 3))
        turned[..., 0] = c * scaled[..., 0] - s * scaled[..., 1]
        turned[..., 1] = s * scaled[..., 0] + c * scaled[..., 1]
        turned[..., 2] = scaled[..., 2]
        if lean is not None:
            turned[..., 2] += (turned[..., :2] * lean[:, None]).sum(axis=2)
        faces = self.faces[None] + (np.arange(n) * v)[:, None, None]
        colors = np.where(self.tinted[None, :, None], tint[:, None], self.colors[None])
        vertices = (turned + position[:, None]).reshape(-1, 3)
        return Surface.of_class(vertices, faces.reshape(-1, 3), class_id, colors.reshape(-1, 3))


def shape(vertices: npt.ArrayLike, faces: npt.ArrayLike, color: Color | None = None) -> Shape:
    """Return a shape of triangles or quads of one colour; without a colour, its faces take the tint."""
    corners = np.asarray(faces, dtype=np.int64)
    if corners.shape[1] == 4:
        corners = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    colors = np.tile(np.asarray(color or (0.0, 0.0, 0.0)), (len(corners), 1))
    return Shape(np.asarray(vertices, dtype=np.float64), corners, colors, np.full(len(corners), color is None))


def combine(*shapes: Shape) -> Shape:
    """Return several shapes as one template."""
    return Shape(*_joined(shapes), np.concatenate([s.tinted for s in shapes]))


def box(
    x: tuple[float, float] = (-0.5, 0.5),
    y: tuple[float, float] = (-0.5, 0.5),
    z: tuple[float, float] = (0.0, 1.0),
    *,
    color: Color | None = None,
    taper: tuple[float, float] = (1.0, 1.0),
) -> Shape:
    """Return a box without its bottom; `taper` scales the top's (x, y) about its centre."""
    corners = np.array([[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]])
    centre = corners.mean(axis=0)
    top = centre + (corners - centre) * taper
    vertices = np.concatenate([np.c_[corners, np.full(4, z[0])], np.c_[top, np.full(4, z[1])]])
    return shape(vertices, _BOX_FACES, color)


def pane() -> Shape:
    """Return an upright unit rectangle in the x-z plane, tinted: a window or a door."""
    return shape([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 0, 1], [-0.5, 0, 1]], [[0, 1, 2, 3]])


def cone(sides: int, z: tuple[float, float], radius: tuple[float, float], *, color: Color | None = None) -> Shape:
    """Return the mantle of a frustum with `sides` sides, from radius[0] at z[0] to radius[1] at z[1]."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.c_[ring * radius[k], np.full(sides, z[k])] for k in (0, 1)])
    a = np.arange(sides)
    b = (a + 1) % sides
    return shape(vertices, np.stack([a, b, b + sides, a + sides], axis=1), color)


def blob(subdivisions: int, rng: np.random.Generator, roughness: float) -> Shape:
    """Return a ball of radius 1 about the origin with a dented surface, tinted; from trimesh's icosphere."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    dents = 1.0 + roughness * rng.uniform(-1, 1, size=(len(ball.vertices), 1))
    return shape(np.asarray(ball.vertices) * dents, np.asarray(ball.faces))


def moved(template: Shape, offset: npt.ArrayLike, scale: npt.ArrayLike) -> Shape:
    """Return the template scaled about its origin, then moved."""
    vertices = template.vertices * np.asarray(scale) + np.asarray(offset)
    return Shape(vertices, template.faces, template.colors, template.tinted)


# Ids of the uavid8 classes, by which every face of the town is labelled.

CLUTTER, BUILDING, ROAD, STATIC_CAR, TREE, LOW_VEGETATION, HUMAN, MOVING_CAR = range(8)


@cache
def uavid8() -> LabelSpace:
    """Return the label space of the town's ground truth and of every simulated model."""
    return LabelSpace.load("uavid8")
