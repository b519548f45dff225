"""Scenes of convex solids, of which rays, classes and areas are known exactly: for `exact.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Texture = Callable[[Array], Ints]
"""Classes (n,) of points (n, 3) of a face."""


@dataclass(frozen=True)
class Solid:
    """An upright prism whose top may be tilted; its faces are the sides, the top and the bottom, in this order.

    Attributes:
        normals, offsets: (m, 3) and (m,): points inside have normals @ point <= offsets.
        polygons: The corners (k, 3) of each face.
        classes: (m,) class of each face.
        textures: Textures of faces with several classes.
    """

    normals: Array
    offsets: Array
    polygons: tuple[Array, ...]
    classes: Ints
    textures: Mapping[int, Texture] = field(default_factory=dict)

    @classmethod
    def prism(
        cls,
        outline: Array,
        height: float,
        side: int,
        top: int,
        *,
        gradient: Sequence[float] = (0.0, 0.0),
        bottom: float = 0.0,
        textures: Mapping[int, Texture] | None = None,
    ) -> Solid:
        """Return a prism over an outline (k, 2), counter-clockwise.

        Args:
            outline: Its corners.
            height: Height of the top in the middle of the outline.
            side: Class of the sides.
            top: Class of the top.
            gradient: Rise of the top along x and y.
            bottom: Height of the bottom.
            textures: By face; the top is face k.
        """
        middle, slope = outline.mean(axis=0), np.asarray(gradient, float)
        edges = np.roll(outline, -1, axis=0) - outline
        sides = np.stack([edges[:, 1], -edges[:, 0], np.zeros(len(edges))], axis=1)
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        above = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
        normals = np.concatenate([sides, above[None], [[0.0, 0.0, -1.0]]])
        upper = np.column_stack([outline, height + (outline - middle) @ slope])
        lower = np.column_stack([outline, np.full(len(outline), bottom)])
        offsets = np.append((sides * lower).sum(axis=1), [above @ upper[0], -bottom])
        k = len(outline)
        walls = [np.stack([lower[i], lower[(i + 1) % k], upper[(i + 1) % k], upper[i]]) for i in range(k)]
        classes = np.array([side] * k + [top, side])
        return cls(normals, offsets, (*walls, upper, lower), classes, textures or {})

    @cached_property
    def sphere(self) -> tuple[Array, float]:
        """A centre and a radius that hold it."""
        corners = np.concatenate(self.polygons)
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
        return centre, float(np.linalg.norm(corners - centre, axis=1).max())


def rectangle(low: Sequence[float] | Array, high: Sequence[float] | Array, turn: float = 0.0) -> Array:
    """Return the corners (4, 2) of a rectangle, turned about its middle; its edges face -y, +x, +y and -x."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]], float)
    c, s = np.cos(turn), np.sin(turn)
    return corners.mean(axis=0) + (corners - corners.mean(axis=0)) @ np.array([[c, s], [-s, c]])


def disc(middle: Sequence[float] | Array, radius: float, sides: int = 8) -> Array:
    """Return the corners of a regular polygon."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.asarray(middle) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


class ExactScene:
    """Solids, the first of which is the ground; the faces of all are counted through.

    Args:
        solids: They may overlap: of their union there are the points that a camera outside can see.
    """

    def __init__(self, solids: Sequence[Solid]) -> None:
        self.solids = tuple(solids)
        self.first = np.cumsum([0, *(len(one.classes) for one in solids)])
        self.normals = np.concatenate([one.normals for one in solids])
        self.classes = np.concatenate([one.classes for one in solids])
        self.textures = {
            int(first) + face: texture
            for first, one in zip(self.first, solids, strict=False)
            for face, texture in one.textures.items()
        }
        fans = [
            (first + face, corners[[0, i, i + 1]])
            for first, one in zip(self.first, solids, strict=False)
            for face, corners in enumerate(one.polygons[:-1])  # no camera is below a solid
            for i in range(1, len(corners) - 1)
        ]
        self._faces, self._triangles = (
            np.array([face for face, _ in fans]),
            np.stack([triangles for _, triangles in fans]),
        )
        a, b, c = self._triangles.transpose(1, 0, 2)
        self._areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def cast(self, origin: Array, directions: Array) -> tuple[Array, Ints]:
        """Return where rays first meet a surface.

        Args:
            origin: (3,) of all rays.
            directions: (n, 3) of any length.

        Returns:
            (n,) t, where they meet it at origin + t direction, inf where they do not; and the face (n,), or -1.
        """
        t, face = np.full(len(directions), np.inf), np.full(len(directions), -1)
        length = np.linalg.norm(directions, axis=1)
        for first, one in zip(self.first, self.solids, strict=False):
            centre, radius = one.sphere
            along = directions @ (centre - origin) / length
            aside = ((centre - origin) ** 2).sum() - along**2
            some = np.flatnonzero((aside <= radius**2) & (along > -radius))
            slope, gap = directions[some] @ one.normals.T, one.offsets - one.normals @ origin
            with np.errstate(divide="ignore", invalid="ignore"):
                at = gap / slope
            enters = np.where(slope < 0, at, np.where((slope == 0) & (gap < 0), np.inf, -np.inf))
            leaves = np.where(slope > 0, at, np.inf).min(axis=1)
            through = enters.argmax(axis=1)
            near = enters[np.arange(len(some)), through]
            hit = (near <= leaves) & (near > 0) & (near < t[some])
            t[some[hit]], face[some[hit]] = near[hit], first + through[hit]
        return t, face

    def true_class(self, points: Array, face: Ints) -> Ints:
        """Return the classes (n,) of points (n, 3) of faces (n,); -1 without a face."""
        classes = np.where(face >= 0, self.classes[face], -1)
        for number, texture in self.textures.items():
            at = np.flatnonzero(face == number)
            if len(at):
                classes[at] = texture(points[at])
        return classes

    def draw(self, n: int, rng: np.random.Generator) -> tuple[Array, Ints]:
        """Return points (n, 3), equally likely on each square metre of the surfaces, and their faces (n,)."""
        which = rng.choice(len(self._areas), n, p=self._areas / self._areas.sum())
        s, r = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
        a, b, c = self._triangles[which].transpose(1, 0, 2)
        return (1 - s) * a + s * (1 - r) * b + s * r * c, self._faces[which]


def patches(half: float, K: int, rng: np.random.Generator) -> Texture:
    """Return patches about 5 m wide of random classes, with 3 stripes 0.4 m wide across them."""
    n = max(64, K)
    sites, of = rng.uniform(-half, half, (n, 2)), rng.permutation(np.arange(n) % K)
    nearest = cKDTree(sites)
    angles, at, striped = rng.uniform(0, np.pi, 3), rng.uniform(-half / 2, half / 2, 3), rng.integers(0, K, 3)

    def texture(points: Array) -> Ints:
        classes: Ints = of[nearest.query(points[:, :2])[1]]
        for angle, offset, stripe in zip(angles, at, striped, strict=True):
            across = points[:, 0] * np.cos(angle) + points[:, 1] * np.sin(angle) - offset
            classes = np.where(np.abs(across) < 0.2, stripe, classes)
        return classes

    return texture


YARD = 25.0
"""Half the edge of the ground, metres."""


def yard(K: int, rng: np.random.Generator) -> ExactScene:
    """Return ground with patches and stripes, 9 boxes, 3 slopes and 6 poles, all within 12 m of its middle."""
    ground = rectangle((-YARD, -YARD), (YARD, YARD))
    solids = [Solid.prism(ground, 0.0, 0, 0, bottom=-1.0, textures={4: patches(YARD, K, rng)})]
    for _ in range(9):
        size, middle = rng.uniform(1.5, 5, 2), _within(9, rng)
        outline = rectangle(middle - size / 2, middle + size / 2, rng.uniform(0, np.pi))
        solids.append(Solid.prism(outline, rng.uniform(1, 5), *rng.integers(0, K, 2).tolist()))
    for _ in range(3):
        size, middle, turn, tall = rng.uniform(3, 6, 2), _within(9, rng), rng.uniform(0, np.pi), rng.uniform(0.8, 3)
        rise = tall / size[0] * np.array([np.cos(turn), np.sin(turn)])
        outline = rectangle(middle - size / 2, middle + size / 2, turn)
        solids.append(Solid.prism(outline, tall / 2, *rng.integers(0, K, 2).tolist(), gradient=rise.tolist()))
    for _ in range(6):
        outline, of = disc(_within(11, rng), rng.uniform(0.08, 0.2)), int(rng.integers(0, K))
        solids.append(Solid.prism(outline, rng.uniform(3, 6), of, of))
    return ExactScene(solids)


def _within(radius: float, rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, 2 * np.pi)
    return radius * np.sqrt(rng.random()) * np.array([np.cos(angle), np.sin(angle)])


ROAD, LENGTH = 4.0, (-15.0, 85.0)
"""Half the width of a road, and where a street begins and ends along x, metres."""


def street(K: int, rng: np.random.Generator) -> ExactScene:
    """Return a street along x: road with marks, pavements, facades with windows, poles and parked cars.

    Its classes are of 8 things, modulo K with fewer classes.
    """
    road, mark, pavement, wall, window, pole, car, roof = (kind % K for kind in range(8))

    def floor(points: Array) -> Ints:
        x, y = points[:, 0], points[:, 1]
        marked = ((np.abs(y) < 0.1) & (x % 6 < 3)) | (np.abs(np.abs(y) - ROAD + 0.3) < 0.08)
        return np.where(np.abs(y) > ROAD, pavement, np.where(marked, mark, road))

    def facade(points: Array) -> Ints:
        x, z = points[:, 0] % 3, points[:, 2] % 3
        return np.where((x < 1.2) & (z > 1) & (z < 2.4), window, wall)

    ground = rectangle((LENGTH[0], -20), (LENGTH[1], 20))
    solids = [Solid.prism(ground, 0.0, road, road, bottom=-1.0, textures={4: floor})]
    for side in (-1, 1):
        x = LENGTH[0]
        while x < LENGTH[1] - 6:
            end = min(x + rng.uniform(8, 16), LENGTH[1])
            y = sorted((side * rng.uniform(7.5, 9), side * 18.0))
            facing = {0: facade, 2: facade}
            solids.append(
                Solid.prism(rectangle((x, y[0]), (end, y[1])), rng.uniform(6, 14), wall, roof, textures=facing)
            )
            x = end + rng.choice([0.0, 3.0])
        for x in np.arange(LENGTH[0] + 5, LENGTH[1], 12):
            outline = disc((x + rng.uniform(-2, 2), side * 5.0), rng.uniform(0.06, 0.15))
            solids.append(Solid.prism(outline, rng.uniform(4, 7), pole, pole))
        for x in np.arange(LENGTH[0] + 8, LENGTH[1] - 8, 9):
            if rng.random() < 0.6:
                start = x + rng.uniform(0, 3)
                y = sorted((side * 2.6, side * (ROAD - 0.2)))
                solids.append(Solid.prism(rectangle((start, y[0]), (start + 4.2, y[1])), 1.5, car, car))
    return ExactScene(solids)
