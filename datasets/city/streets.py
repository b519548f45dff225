"""The street plan: a rectangle that is split again and again by streets, bent and turned into the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from semstab.core.types import Float64

MAIN_WIDTH = 11.0
SIDE_WIDTH = 8.0
LARGEST_BLOCK = 105.0
SMALLEST_BLOCK = 44.0


@dataclass(frozen=True)
class Layout:
    """From plan coordinates (s, t) to the world's (x, y), both in metres: sine bends of some 10 m, then a turn."""

    yaw: float
    bend: Float64
    wavenumber: Float64
    phase: Float64

    @classmethod
    def random(cls, rng: np.random.Generator) -> Layout:
        """A turn by any angle; bends of 6 to 12 m over 240 to 380 m."""
        bend, length, phase = rng.uniform(6, 12, 2), rng.uniform(240, 380, 2), rng.uniform(0, 2 * np.pi, 2)
        return cls(float(rng.uniform(0.1, np.pi / 2 - 0.1)), bend, 2 * np.pi / length, phase)

    def to_world(self, s: Float64, t: Float64) -> tuple[Float64, Float64]:
        """World x and y of plan points."""
        a = s + self.bend[0] * np.sin(self.wavenumber[0] * t + self.phase[0])
        b = t + self.bend[1] * np.sin(self.wavenumber[1] * s + self.phase[1])
        c, d = np.cos(self.yaw), np.sin(self.yaw)
        return c * a - d * b, d * a + c * b

    def heading(self, s: Float64, t: Float64, angle: Float64) -> Float64:
        """Heading in the world of what points along `angle` (radians from the s axis) at plan points."""
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
        """With each side moved inwards by its own distance."""
        return Rectangle(self.s0 + s0, self.s1 - s1, self.t0 + t0, self.t1 - t1)

    def within(self, margin: float) -> Rectangle:
        """With all sides moved inwards."""
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
        """The part between two offsets from the middle, over the whole length unless said."""
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
        """Those places along this street that keep a distance from every street that meets it."""
        for other in streets:
            if other.axis != self.axis and other.low - 1 <= self.at <= other.high + 1:
                along = along[np.abs(along - other.at) > distance + other.width / 2]
        return along


@dataclass(frozen=True)
class Plot:
    """What is left between streets: its rectangle and the widths of the streets at s0, s1, t0, t1."""

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
        street = _split(plot, depth, rng)
        if street is None:
            plots.append(plot)
            continue
        streets.append(street)
        open_plots += [(half, depth + 1) for half in _halves(plot, street)]
    return streets, plots


def _split(plot: Plot, depth: int, rng: np.random.Generator) -> Street | None:
    s, t = plot.area.size
    if max(s, t) < LARGEST_BLOCK or max(s, t) < 2 * SMALLEST_BLOCK:
        return None
    fraction, width = rng.uniform(0.38, 0.62), MAIN_WIDTH if depth < 3 else SIDE_WIDTH
    area = plot.area
    if s > t:
        return Street("t", area.s0 + fraction * s, area.t0, area.t1, width)
    return Street("s", area.t0 + fraction * t, area.s0, area.s1, width)


def _halves(plot: Plot, street: Street) -> tuple[Plot, Plot]:
    s0, s1, t0, t1 = plot.widths
    if street.axis == "t":
        first = Plot(replace(plot.area, s1=street.at), (s0, street.width, t0, t1))
        return first, Plot(replace(plot.area, s0=street.at), (street.width, s1, t0, t1))
    first = Plot(replace(plot.area, t1=street.at), (s0, s1, t0, street.width))
    return first, Plot(replace(plot.area, t0=street.at), (s0, s1, street.width, t1))
