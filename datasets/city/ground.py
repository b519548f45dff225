"""The ground: rolling land, and rectangles of the street plan that are laid over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.datasets.city.mesh import LOW_VEGETATION, ROAD, TriangleSurface, surface

SPACING = 4.0
"""Metres between vertices of the ground; layers on it lie further apart than its triangles stray from `height`."""

HORIZON = 1500.0
ASPHALT, GRASS = (0.30, 0.30, 0.31), (0.36, 0.44, 0.20)


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the street plan, metres."""

    s0: float
    s1: float
    t0: float
    t1: float

    @property
    def centre(self) -> tuple[float, float]:
        """The point (s, t) in its middle."""
        return (self.s0 + self.s1) / 2, (self.t0 + self.t1) / 2

    def within(self, margin: float) -> Rectangle:
        """Return the rectangle with all sides moved inwards."""
        return Rectangle(self.s0 + margin, self.s1 - margin, self.t0 + margin, self.t1 - margin)


@dataclass(frozen=True)
class Ground:
    """A sum of plane waves, and a street plan whose axes s and t are x and y turned by `yaw`.

    Attributes:
        waves: (w, 2) wave vectors in rad/m; phases (w,), amplitudes (w,) in metres.
    """

    yaw: float
    waves: Float64
    phases: Float64
    amplitudes: Float64

    @classmethod
    def random(cls, rng: np.random.Generator) -> Ground:
        """Return six waves of 130 to 420 m, none steeper than 2.5 percent."""
        wavelength, direction, phases = rng.uniform(size=(3, 6)) * [[290], [2 * np.pi], [2 * np.pi]]
        wavelength += 130
        waves = 2 * np.pi / wavelength[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        amplitudes = rng.uniform(0.01, 0.025, size=6) * wavelength / (2 * np.pi)
        return cls(float(rng.uniform(0.2, 1.3)), waves, phases, amplitudes)

    def height(self, x: Float64, y: Float64) -> Float64:
        """Return the height of the ground in metres at (x, y), arrays of one shape."""
        phase = np.multiply.outer(x, self.waves[:, 0]) + np.multiply.outer(y, self.waves[:, 1]) + self.phases
        height: Float64 = np.sin(phase) @ self.amplitudes
        return height

    def plan(self, x: Float64, y: Float64) -> tuple[Float64, Float64]:
        """Return the plan coordinates (s, t) of world points."""
        c, d = np.cos(self.yaw), np.sin(self.yaw)
        return c * x + d * y, c * y - d * x

    def points(self, s: Float64, t: Float64, above: float = 0.0) -> Float64:
        """Return world points (n, 3) that lie `above` metres over the ground at plan points."""
        c, d = np.cos(self.yaw), np.sin(self.yaw)
        x, y = c * s - d * t, d * s + c * t
        return np.stack([x, y, self.height(x, y) + above], axis=-1)

    def stand(
        self, template: TriangleSurface, spots: Float64, size: Float64, tint: Float64, above: float
    ) -> TriangleSurface:
        """Return upright copies of a template at `spots` (n, 3): plan coordinates s, t, and an angle in the plan."""
        s, t, angle = spots.T
        return template.place(self.points(s, t, above), self.yaw + angle, size, tint)

    def drape(self, area: Rectangle, above: float, class_id: int, color: npt.ArrayLike) -> TriangleSurface:
        """Return a rectangle of the plan laid over the ground, in cells of at most SPACING."""
        s, t = (
            np.linspace(low, high, int(np.ceil((high - low) / SPACING)) + 1)
            for low, high in ((area.s0, area.s1), (area.t0, area.t1))
        )
        return surface(self._grid(s, t, above), _grid_faces(len(s), len(t)), class_id, color)

    def land(self, town: Rectangle) -> TriangleSurface:
        """Return asphalt under the whole town, and grass around it in ever larger triangles up to the horizon."""
        far = np.cumsum(SPACING * 1.25 ** np.arange(1, 21))
        far = far[far < HORIZON]
        fine = [np.arange(low, high + SPACING, SPACING) for low, high in ((town.s0, town.s1), (town.t0, town.t1))]
        s, t = (np.concatenate([near[0] - far[::-1], near, near[-1] + far]) for near in fine)
        faces = _grid_faces(len(s), len(t))
        middle = np.stack(np.meshgrid(s, t, indexing="ij"), axis=-1).reshape(-1, 2)[faces].mean(axis=1)
        paved = ((middle > (town.s0, town.t0)) & (middle < (town.s1, town.t1))).all(axis=1)
        classes = np.where(paved, ROAD, LOW_VEGETATION).astype(np.uint8)
        return TriangleSurface(self._grid(s, t, 0.0), faces, classes, np.where(paved[:, None], ASPHALT, GRASS))

    def _grid(self, s: Float64, t: Float64, above: float) -> Float64:
        gs, gt = np.meshgrid(s, t, indexing="ij")
        return self.points(gs.ravel(), gt.ravel(), above)


def _grid_faces(rows: int, columns: int) -> Int64:
    """Return triangles of a grid of rows x columns vertices in C order, two for each cell."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    cell = np.array([[0, columns, columns + 1], [0, columns + 1, 1]])
    faces: Int64 = (corner[:, None, None] + cell).reshape(-1, 3)
    return faces
