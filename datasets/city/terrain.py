"""The ground: a gently rolling height field, its mesh, and rectangles (roads, yards, fields) draped over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.datasets.city.mesh import LOW_VEGETATION, Shape, Surface
from semstab.datasets.city.streets import Layout, Rectangle

SPACING = 4.0
"""Metres between vertices of the ground; the layers on it lie further apart than its triangles stray from `height`."""

HORIZON = 1500.0
GRASS = np.array([0.36, 0.44, 0.20])
DRY = np.array([0.52, 0.49, 0.27])


@dataclass(frozen=True)
class Terrain:
    """A sum of plane waves: wave vectors (w, 2) in rad/m, phases (w,), amplitudes (w,) metres, about a base height."""

    waves: Float64
    phases: Float64
    amplitudes: Float64
    base: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Terrain:
        """Six waves of 130 to 420 m, none steeper than 4 percent."""
        wavelength = rng.uniform(130, 420, size=6)
        direction = rng.uniform(0, 2 * np.pi, size=6)
        waves = 2 * np.pi / wavelength[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        amplitudes = rng.uniform(0.015, 0.04, size=6) * wavelength / (2 * np.pi)
        return cls(waves, rng.uniform(0, 2 * np.pi, size=6), amplitudes, float(rng.uniform(2, 9)))

    def height(self, x: Float64, y: Float64) -> Float64:
        """Height of the ground in metres at (x, y), arrays of one shape."""
        phase = np.multiply.outer(x, self.waves[:, 0]) + np.multiply.outer(y, self.waves[:, 1]) + self.phases
        height: Float64 = self.base + np.sin(phase) @ self.amplitudes
        return height

    def slope(self, x: Float64, y: Float64) -> Float64:
        """dz/dx and dz/dy at (x, y), stacked on the last axis."""
        phase = np.multiply.outer(x, self.waves[:, 0]) + np.multiply.outer(y, self.waves[:, 1]) + self.phases
        slope: Float64 = (np.cos(phase) * self.amplitudes) @ self.waves
        return slope

    def on(self, x: Float64, y: Float64, above: npt.ArrayLike = 0.0) -> Float64:
        """Points (n, 3) that stand `above` metres over the ground at (x, y)."""
        return np.stack([x, y, self.height(x, y) + np.asarray(above)], axis=-1)

    def mesh(self, low: Float64, high: Float64, rng: np.random.Generator) -> Surface:
        """Grass over the rectangle from `low` to `high` (x, y), with ever larger triangles up to the horizon."""
        x, y = (_graded(low[axis], high[axis]) for axis in (0, 1))
        gx, gy = np.meshgrid(x, y, indexing="ij")
        vertices = self.on(gx.ravel(), gy.ravel())
        faces = grid_faces(len(x), len(y))
        middle = vertices[faces].mean(axis=1)
        waves = Terrain.random(rng)
        patchy = 0.5 + 0.35 * np.sin(4 * waves.height(middle[:, 0], middle[:, 1]))[:, None]
        colors = GRASS + (DRY - GRASS) * patchy * rng.uniform(0.5, 1.0, size=(len(faces), 1))
        return Surface.of_class(vertices, faces, LOW_VEGETATION, colors)


@dataclass(frozen=True)
class Site:
    """Where a town stands: its street plan, and the ground under it."""

    layout: Layout
    terrain: Terrain

    def on(self, s: Float64, t: Float64, above: npt.ArrayLike = 0.0) -> Float64:
        """Points (n, 3) that stand `above` metres over the ground at plan points."""
        return self.terrain.on(*self.layout.to_world(s, t), above)

    def stand(
        self, template: Shape, class_id: int, places: tuple[Float64, ...], above: float, size: Float64, tint: Float64
    ) -> Surface:
        """Copies of a shape that follow the ground at `places`: plan coordinates s and t, and the angle in the plan."""
        s, t, angle = places
        lean = self.terrain.slope(*self.layout.to_world(s, t))
        return template.place(class_id, self.on(s, t, above), self.layout.heading(s, t, angle), size, tint, lean)

    def drape(self, area: Rectangle, above: float, class_id: int, color: npt.ArrayLike) -> Surface:
        """A rectangle of the plan laid over the ground, `above` metres over it, in cells of at most SPACING."""
        s = np.linspace(area.s0, area.s1, max(2, int(np.ceil((area.s1 - area.s0) / SPACING)) + 1))
        t = np.linspace(area.t0, area.t1, max(2, int(np.ceil((area.t1 - area.t0) / SPACING)) + 1))
        gs, gt = np.meshgrid(s, t, indexing="ij")
        return Surface.of_class(self.on(gs.ravel(), gt.ravel(), above), grid_faces(len(s), len(t)), class_id, color)


def grid_faces(rows: int, columns: int) -> Int64:
    """Triangles of a grid of rows x columns vertices in C order."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    first = np.stack([corner, corner + columns, corner + columns + 1], axis=1)
    second = np.stack([corner, corner + columns + 1, corner + 1], axis=1)
    return np.concatenate([first, second])


def _graded(low: float, high: float) -> Float64:
    """Coordinates SPACING apart from low to high, then ever further apart for another HORIZON metres each way."""
    fine = np.arange(low, high + SPACING, SPACING)
    steps = np.cumsum(SPACING * 1.25 ** np.arange(1, 21))
    coarse = steps[steps < HORIZON]
    return np.concatenate([fine[0] - coarse[::-1], fine, fine[-1] + coarse])
