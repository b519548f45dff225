"""The ground: a gently rolling height field, its mesh, and rectangles (roads, yards, fields) draped over it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.datasets.city.mesh import LOW_VEGETATION, Shape, Surface

# The street plan: a rectangle that is split again and again by streets, bent and turned into the world.

MAIN_WIDTH = 11.0
SIDE_WIDTH = 8.0
LARGEST_BLOCK = 105.0


@dataclass(frozen=True)
class Layout:
    """A map from plan coordinates (s, t) to the world's (x, y), in metres: sine bends of some 10 m, then a turn."""

    yaw: float
    bend: Float64
    wavenumber: Float64
    phase: Float64

    @classmethod
    def random(cls, rng: np.random.Generator) -> Layout:
        """Return a turn by any angle; bends of 6 to 12 m over 240 to 380 m."""
        bend, length, phase = rng.uniform(6, 12, 2), rng.uniform(240, 380, 2), rng.uniform(0, 2 * np.pi, 2)
        return cls(float(rng.uniform(0.1, np.pi / 2 - 0.1)), bend, 2 * np.pi / length, phase)

    def to_world(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:
        """Return the world x and y of plan points."""
        a = s + self.bend[0] * np.sin(self.wavenumber[0] * t + self.phase[0])
        b = t + self.bend[1] * np.sin(self.wavenumber[1] * s + self.phase[1])
        c, d = np.cos(self.yaw), np.sin(self.yaw)
        return c * a - d * b, d * a + c * b

    def heading(self, s: Float64, t: Float64, angle: Float64) -> Float64:
        """Return the heading in the world of a direction `angle` (radians from the s axis) at plan points."""
        a = self.bend[0] * self.wavenumber[0] * np.cos(self.wavenumber[0] * t + self.phase[0])
        b = self.bend[1] * self.wavenumber[1] * np.cos(self.wavenumber[1] * s + self.phase[1])
        along_s, along_t = np.cos(angle), np.sin(angle)
        heading: Float64 = self.yaw + np.arctan2(along_t + b * along_s, along_s + a * along_t)
        return heading


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the plan, metres."""

    s0: float
    s1: float
    t0: float
    t1: float

    @property
    def size(self) -> tuple[float, float]:
        """Extent along s and along t."""
        return self.s1 - self.s0, self.t1 - self.t0

    @property
    def centre(self) -> tuple[float, float]:
        """The point (s, t) in its middle."""
        return (self.s0 + self.s1) / 2, (self.t0 + self.t1) / 2

    def shrunk(self, s0: float, s1: float, t0: float, t1: float) -> Rectangle:
        """Return the rectangle with each side moved inwards by its own distance."""
        return Rectangle(self.s0 + s0, self.s1 - s1, self.t0 + t0, self.t1 - t1)

    def within(self, margin: float) -> Rectangle:
        """Return the rectangle with all sides moved inwards."""
        return self.shrunk(margin, margin, margin, margin)


@dataclass(frozen=True)
class Street:
    """A street along one axis of the plan: its middle is at `at` on the other axis, from `low` to `high`."""

    axis: Literal["s", "t"]
    at: float
    low: float
    high: float
    width: float

    @property
    def length(self) -> float:
        """Metres."""
        return self.high - self.low

    def strip(self, left: float, right: float, low: float | None = None, high: float | None = None) -> Rectangle:
        """Return the part between two offsets from the middle, over the whole length by default."""
        low, high = self.low if low is None else low, self.high if high is None else high
        if self.axis == "s":
            return Rectangle(low, high, self.at + left, self.at + right)
        return Rectangle(self.at + left, self.at + right, low, high)

    def point(self, along: Float64, offset: Float64) -> tuple[Float64, Float64]:
        """Plan coordinates of points at `along` (from low to high) and an offset from the middle."""
        across = self.at + offset
        return (along, across) if self.axis == "s" else (across, along)

    @property
    def heading(self) -> float:
        """Direction of travel towards `high`, radians in the plan."""
        return 0.0 if self.axis == "s" else np.pi / 2

    def clear_of_crossings(self, along: Float64, streets: list[Street], distance: float) -> Float64:
        """Return the points along this street at a distance from every street that meets it."""
        for other in streets:
            if other.axis != self.axis and other.low - 1 <= self.at <= other.high + 1:
                along = along[np.abs(along - other.at) > distance + other.width / 2]
        return along


@dataclass(frozen=True)
class Plot:
    """The land between streets: its rectangle and the widths of the streets at s0, s1, t0, t1."""

    area: Rectangle
    widths: tuple[float, float, float, float]

    @property
    def inside(self) -> Rectangle:
        """The plot without its halves of the streets."""
        return self.area.shrunk(*(width / 2 for width in self.widths))


def plan_streets(area: Rectangle, rng: np.random.Generator) -> tuple[list[Street], list[Plot]]:
    """Split an area into plots by streets; the first splits are main roads.

    Streets end in the middle of the street they meet, so junctions have three or four arms and no dead ends.
    """
    streets: list[Street] = []
    plots: list[Plot] = []
    open_plots = [(Plot(area, (0.0, 0.0, 0.0, 0.0)), 0)]
    while open_plots:
        plot, depth = open_plots.pop()
        area, (s, t) = plot.area, plot.area.size
        if max(s, t) < LARGEST_BLOCK:
            plots.append(plot)
            continue
        fraction, width = rng.uniform(0.38, 0.62), MAIN_WIDTH if depth < 3 else SIDE_WIDTH
        s0, s1, t0, t1 = plot.widths
        if s > t:
            street = Street("t", area.s0 + fraction * s, area.t0, area.t1, width)
            halves = [Plot(replace(area, s1=street.at), (s0, width, t0, t1))]
            halves.append(Plot(replace(area, s0=street.at), (width, s1, t0, t1)))
        else:
            street = Street("s", area.t0 + fraction * t, area.s0, area.s1, width)
            halves = [Plot(replace(area, t1=street.at), (s0, s1, t0, width))]
            halves.append(Plot(replace(area, t0=street.at), (s0, s1, width, t1)))
        streets.append(street)
        open_plots += [(half, depth + 1) for half in halves]
    return streets, plots


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
        """Return six waves of 130 to 420 m, none steeper than 4 percent."""
        wavelength = rng.uniform(130, 420, size=6)
        direction = rng.uniform(0, 2 * np.pi, size=6)
        waves = 2 * np.pi / wavelength[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        amplitudes = rng.uniform(0.015, 0.04, size=6) * wavelength / (2 * np.pi)
        return cls(waves, rng.uniform(0, 2 * np.pi, size=6), amplitudes, float(rng.uniform(2, 9)))

    def height(self, x: Float64, y: Float64) -> Float64:
        """Return the height of the ground in metres at (x, y), arrays of one shape."""
        phase = np.multiply.outer(x, self.waves[:, 0]) + np.multiply.outer(y, self.waves[:, 1]) + self.phases
        height: Float64 = self.base + np.sin(phase) @ self.amplitudes
        return height

    def slope(self, x: Float64, y: Float64) -> Float64:
        """Return dz/dx and dz/dy at (x, y), stacked on the last axis."""
        phase = np.multiply.outer(x, self.waves[:, 0]) + np.multiply.outer(y, self.waves[:, 1]) + self.phases
        slope: Float64 = (np.cos(phase) * self.amplitudes) @ self.waves
        return slope

    def on(self, x: Float64, y: Float64, above: npt.ArrayLike = 0.0) -> Float64:
        """Return points (n, 3) that stand `above` metres over the ground at (x, y)."""
        return np.stack([x, y, self.height(x, y) + np.asarray(above)], axis=-1)

    def mesh(self, low: Float64, high: Float64, rng: np.random.Generator) -> Surface:
        """Return grass over the rectangle from `low` to `high` (x, y), with ever larger triangles up to the horizon."""
        steps = np.cumsum(SPACING * 1.25 ** np.arange(1, 21))
        far = steps[steps < HORIZON]
        fine = [np.arange(low[axis], high[axis] + SPACING, SPACING) for axis in (0, 1)]
        x, y = (np.concatenate([near[0] - far[::-1], near, near[-1] + far]) for near in fine)
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
    """The site of a town: its street plan, and the ground under it."""

    layout: Layout
    terrain: Terrain

    def on(self, s: Float64, t: Float64, above: npt.ArrayLike = 0.0) -> Float64:
        """Return points (n, 3) that stand `above` metres over the ground at plan points."""
        return self.terrain.on(*self.layout.to_world(s, t), above)

    def stand(
        self, template: Shape, class_id: int, spots: Iterable[Float64], above: float, size: Float64, tint: Float64
    ) -> Surface:
        """Return copies of a shape that follow the ground at `spots`: plan coordinates s and t, and an angle there."""
        s, t, angle = spots
        lean = self.terrain.slope(*self.layout.to_world(s, t))
        return template.place(class_id, self.on(s, t, above), self.layout.heading(s, t, angle), size, tint, lean)

    def drape(self, area: Rectangle, above: float, class_id: int, color: npt.ArrayLike) -> Surface:
        """Return a rectangle of the plan laid over the ground, `above` metres over it, in cells of at most SPACING."""
        sides = ((area.s0, area.s1), (area.t0, area.t1))
        s, t = (np.linspace(low, high, max(2, int(np.ceil((high - low) / SPACING)) + 1)) for low, high in sides)
        gs, gt = np.meshgrid(s, t, indexing="ij")
        return Surface.of_class(self.on(gs.ravel(), gt.ravel(), above), grid_faces(len(s), len(t)), class_id, color)


def grid_faces(rows: int, columns: int) -> Int64:
    """Return triangles of a grid of rows x columns vertices in C order."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    first = np.stack([corner, corner + columns, corner + columns + 1], axis=1)
    second = np.stack([corner, corner + columns + 1, corner + 1], axis=1)
    return np.concatenate([first, second])
