"""Plots of land and the things on them: houses with gardens, apartment blocks, a market hall, a park or fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.mesh import CLUTTER, LOW_VEGETATION, Color
from semstab.datasets.city.terrain import Plot, Rectangle

SIDEWALK = 1.9
YARD_ABOVE, FIELD_ABOVE, SIDEWALK_ABOVE = 0.052, 0.047, 0.163
PAVING: tuple[Color, ...] = ((0.60, 0.57, 0.53), (0.55, 0.50, 0.46), (0.63, 0.61, 0.58), (0.50, 0.42, 0.36))
CROPS: tuple[Color, ...] = ((0.62, 0.57, 0.30), (0.33, 0.47, 0.17), (0.44, 0.50, 0.22), (0.55, 0.46, 0.27))
KERB: Color = (0.62, 0.61, 0.60)


class Patch(NamedTuple):
    """A rectangle of ground with a surface of its own."""

    area: Rectangle
    above: float
    class_id: int
    color: Color


class Building(NamedTuple):
    """A building: middle, angle in the plan, extent along and across its ridge, height of its walls, roof."""

    s: float
    t: float
    angle: float
    length: float
    width: float
    height: float
    roof: Literal["gable", "hip", "flat"]


class Spot(NamedTuple):
    """A small thing that stands at a point: a tree, a bush, a car, a person."""

    s: float
    t: float
    angle: float = 0.0
    size: float = 1.0


class Barrier(NamedTuple):
    """A hedge or a fence from one plan point to another."""

    s0: float
    t0: float
    s1: float
    t1: float


def columns(rows: Sequence[Spot | Barrier]) -> Float64:
    """Return four arrays, one for each field; empty ones where there are no rows."""
    return np.array(rows, dtype=np.float64).reshape(-1, 4).T


@dataclass
class Inventory:
    """Everything that stands in the town, in plan coordinates."""

    patches: list[Patch] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    trees: list[Spot] = field(default_factory=list)
    bushes: list[Spot] = field(default_factory=list)
    cars: list[Spot] = field(default_factory=list)
    people: list[Spot] = field(default_factory=list)
    bins: list[Spot] = field(default_factory=list)
    hedges: list[Barrier] = field(default_factory=list)
    fences: list[Barrier] = field(default_factory=list)


def furnish(plot: Plot, town: Inventory, rng: np.random.Generator) -> None:
    """Put sidewalks around a plot and one of the kinds of use on it."""
    inside, w = plot.inside, SIDEWALK
    s0, s1, t0, t1 = inside.s0, inside.s1, inside.t0, inside.t1
    strips = [(s0, s1, t0, t0 + w), (s0, s1, t1 - w, t1), (s0, s0 + w, t0 + w, t1 - w), (s1 - w, s1, t0 + w, t1 - w)]
    town.patches += [Patch(Rectangle(*strip), SIDEWALK_ABOVE, CLUTTER, KERB) for strip in strips]
    land = inside.within(SIDEWALK)
    uses: tuple[Callable[[Rectangle, Inventory, np.random.Generator], None], ...]
    uses = (_houses, _apartments, _hall, _park, _fields)
    use = uses[int(rng.choice(len(uses), p=[0.52, 0.20, 0.09, 0.11, 0.08]))]
    use(land, town, rng)


class _Row(NamedTuple):
    """A row of parcels along one long side of a plot: its start, the direction that its houses face, its depth."""

    land: Rectangle
    along_s: bool
    front: float
    inwards: int
    depth: float

    @property
    def span(self) -> tuple[float, float]:
        """Both ends of the row."""
        return (self.land.s0, self.land.s1) if self.along_s else (self.land.t0, self.land.t1)

    def point(self, along: float, into: float) -> tuple[float, float]:
        """Plan point at a position along the row and a distance behind its front."""
        across = self.front + self.inwards * into
        return (along, across) if self.along_s else (across, along)

    def area(self, a0: float, a1: float, into0: float, into1: float) -> Rectangle:
        (s0, t0), (s1, t1) = self.point(a0, into0), self.point(a1, into1)
        return Rectangle(min(s0, s1), max(s0, s1), min(t0, t1), max(t0, t1))


def _rows(land: Rectangle, two_from: float = np.inf) -> list[_Row]:
    """Return one or, where the land is deep enough, two rows back to back along its longer side."""
    s, t = land.size
    along_s = s >= t
    depth, low, high = (t, land.t0, land.t1) if along_s else (s, land.s0, land.s1)
    if depth < two_from:
        return [_Row(land, along_s, low, 1, depth)]
    return [_Row(land, along_s, low, 1, depth / 2), _Row(land, along_s, high, -1, depth / 2)]


def _houses(land: Rectangle, town: Inventory, rng: np.random.Generator) -> None:
    for row in _rows(land, two_from=34.0):
        low, high = row.span
        count = max(1, round((high - low) / rng.uniform(16, 21)))
        borders = np.linspace(low, high, count + 1).tolist()
        for a0, a1 in pairwise(borders):
            _parcel(row, a0, a1, town, rng)
        back = [row.point(low, row.depth - 0.1), row.point(high, row.depth - 0.1)]
        (town.hedges if rng.random() < 0.6 else town.fences).append(Barrier(*back[0], *back[1]))


def _parcel(row: _Row, a0: float, a1: float, town: Inventory, rng: np.random.Generator) -> None:
    """Build one house: driveway and car beside it, terrace and trees behind it, a hedge or fence along one border."""
    width = a1 - a0
    length, deep = min(rng.uniform(9, 12.5), width - 5.5), rng.uniform(7.5, 10)
    setback = rng.uniform(3.5, 6.0)
    middle = a0 + 1.2 + length / 2
    s, t = row.point(middle, setback + deep / 2)
    turn = float(rng.normal(0, 0.03)) + (0.0 if row.along_s else np.pi / 2)
    across = rng.random() < 0.25
    shape = (deep, length, turn + np.pi / 2) if across else (length, deep, turn)
    roof: Literal["gable", "hip", "flat"] = ("gable", "hip", "flat")[int(rng.choice(3, p=[0.62, 0.25, 0.13]))]
    height = float(rng.uniform(3.1, 6.4))
    town.buildings.append(Building(s, t, shape[2], shape[0], shape[1], height, roof))
    paving = PAVING[int(rng.integers(len(PAVING)))]
    drive = a1 - 1.9
    town.patches.append(Patch(row.area(drive - 1.6, drive + 1.6, 0, setback + 6), YARD_ABOVE, CLUTTER, paving))
    end = setback + deep
    town.patches.append(Patch(row.area(middle - 3, middle + 3, end, end + 3.4), YARD_ABOVE, CLUTTER, paving))
    heading = turn + np.pi / 2
    if rng.random() < 0.55:
        town.cars.append(Spot(*row.point(drive, rng.uniform(3.0, setback + 2)), heading))
    if rng.random() < 0.6:
        town.bins.append(Spot(*row.point(drive - 2.4, 1.0), heading, 0.6))
    if rng.random() < 0.3:
        town.people.append(Spot(*row.point(middle + rng.uniform(-4, 4), end + rng.uniform(0.8, 5)), heading))
    for _ in range(int(rng.integers(1, 5))):
        into = rng.uniform(end + 3.5, max(end + 4, row.depth - 1.5))
        town.trees.append(Spot(*row.point(rng.uniform(a0 + 1, a1 - 1), into), 0.0, rng.uniform(0.45, 0.85)))
    for _ in range(int(rng.integers(2, 7))):
        into = rng.uniform(0.6, 2.4) if rng.random() < 0.5 else rng.uniform(end + 0.7, max(end + 1, row.depth - 1))
        town.bushes.append(Spot(*row.point(rng.uniform(a0 + 0.6, drive - 2), into), 0.0, rng.uniform(0.4, 1.0)))
    border = Barrier(*row.point(a0, 0.3), *row.point(a0, row.depth))
    (town.hedges if rng.random() < 0.5 else town.fences).append(border)


def _apartments(land: Rectangle, town: Inventory, rng: np.random.Generator) -> None:
    """Build two rows of long buildings with a paved court between them, or one row with a car park behind it."""
    town.patches.append(Patch(land.within(-0.2), YARD_ABOVE - 0.02, CLUTTER, PAVING[int(rng.integers(len(PAVING)))]))
    floors = int(rng.integers(3, 5))
    for row in _rows(land, two_from=40.0):
        low, high = row.span
        count = max(1, round((high - low) / rng.uniform(30, 42)))
        deep = min(rng.uniform(11, 13.5), row.depth - 6)
        for a0, a1 in pairwise(np.linspace(low, high, count + 1).tolist()):
            length, height = a1 - a0 - rng.uniform(4, 9), 2.9 * (floors + int(rng.integers(-1, 2))) + 0.63
            s, t = row.point((a0 + a1) / 2, 3.0 + deep / 2)
            angle = 0.0 if row.along_s else np.pi / 2
            roof: Literal["flat", "hip", "gable"] = ("flat", "hip", "gable")[int(rng.choice(3, p=[0.6, 0.25, 0.15]))]
            town.buildings.append(Building(s, t, angle, float(length), float(deep), height, roof))
            grass = row.area(a0 + 2, a1 - 2, deep + 4.2, min(deep + 8.5, row.depth - 0.5))
            if min(grass.size) > 1.5:
                town.patches.append(Patch(grass, YARD_ABOVE + 0.03, LOW_VEGETATION, (0.34, 0.45, 0.19)))
                town.trees += [
                    Spot(rng.uniform(grass.s0, grass.s1), rng.uniform(grass.t0, grass.t1), 0.0, rng.uniform(0.5, 1.0))
                    for _ in range(4)
                ]
                town.bushes += [
                    Spot(rng.uniform(grass.s0, grass.s1), rng.uniform(grass.t0, grass.t1)) for _ in range(4)
                ]
        parking = row.point(0.0, row.depth - 2.6)
        for along in np.arange(low + 4, high - 4, 2.7):
            if rng.random() < 0.55:
                s, t = (along, parking[1]) if row.along_s else (parking[0], along)
                heading = (np.pi / 2 if row.along_s else 0.0) + rng.normal(0, 0.03)
                town.cars.append(Spot(float(s), float(t), heading))
    _crowd(land, 5, town, rng)


def _hall(land: Rectangle, town: Inventory, rng: np.random.Generator) -> None:
    """Build a wide flat hall and a car park beside it."""
    town.patches.append(Patch(land.within(-0.2), YARD_ABOVE - 0.02, CLUTTER, (0.42, 0.42, 0.43)))
    row = _rows(land)[0]
    low, high = row.span
    split = low + 0.5 * (high - low)
    s, t = row.point((low + split) / 2 + 1, row.depth / 2)
    angle = 0.0 if row.along_s else np.pi / 2
    town.buildings.append(Building(s, t, angle, split - low - 6, row.depth - 9, float(rng.uniform(6, 9)), "flat"))
    for lane in np.arange(6, row.depth - 5, 9.2):
        for along in np.arange(split + 6, high - 2, 2.75):
            if rng.random() < 0.62:
                heading = (np.pi / 2 if row.along_s else 0.0) + rng.normal(0, 0.02)
                town.cars.append(Spot(*row.point(float(along), float(lane)), heading))
    town.bins += [Spot(*row.point(rng.uniform(low + 2, split), rng.uniform(1, 3)), 0.3) for _ in range(6)]
    _crowd(land, 8, town, rng)


def _park(land: Rectangle, town: Inventory, rng: np.random.Generator) -> None:
    """Plant groups of trees on grass, two crossing paths with people on them."""
    (s, t), (cs, ct) = land.size, land.centre
    a, b = cs + rng.uniform(-0.2, 0.2) * s, ct + rng.uniform(-0.2, 0.2) * t
    for k, path in enumerate(
        (Rectangle(a - 1.3, a + 1.3, land.t0, land.t1), Rectangle(land.s0, land.s1, b - 1.3, b + 1.3))
    ):
        town.patches.append(Patch(path, YARD_ABOVE + 0.006 * k, CLUTTER, (0.70, 0.63, 0.50)))
        for _ in range(6):
            town.people.append(Spot(rng.uniform(path.s0, path.s1), rng.uniform(path.t0, path.t1), rng.uniform(0, 6.28)))
    for _ in range(int(s * t / 110)):
        tree = Spot(
            rng.uniform(land.s0 + 1, land.s1 - 1), rng.uniform(land.t0 + 1, land.t1 - 1), 0.0, rng.uniform(0.6, 1.25)
        )
        if min(abs(tree.s - a), abs(tree.t - b)) > 2.5:
            town.trees.append(tree)
    town.bushes += [Spot(rng.uniform(land.s0, land.s1), rng.uniform(land.t0, land.t1)) for _ in range(int(s * t / 90))]


def _fields(land: Rectangle, town: Inventory, rng: np.random.Generator) -> None:
    """Lay beds of crops in rows, a hedge around them and a shed."""
    row = _rows(land)[0]
    low, high = row.span
    count = max(2, round((high - low) / 11))
    for a0, a1 in pairwise(np.linspace(low + 3, high - 3, count + 1).tolist()):
        crop = CROPS[int(rng.integers(len(CROPS)))]
        bed = row.area(a0 + 0.6, a1 - 0.6, 3, row.depth - 3)
        town.patches.append(Patch(bed, FIELD_ABOVE + float(rng.uniform(0, 0.5)), LOW_VEGETATION, crop))
    s, t = row.point(low + 4.5, 5)
    town.buildings.append(Building(s, t, 0.1, 6.0, 4.4, 2.6, "gable"))
    edge = land.within(0.8)
    corners = [(edge.s0, edge.t0), (edge.s1, edge.t0), (edge.s1, edge.t1), (edge.s0, edge.t1)]
    town.hedges += [Barrier(*corners[k], *corners[(k + 1) % 4]) for k in range(3)]
    _crowd(land, 2, town, rng)


def _crowd(land: Rectangle, count: int, town: Inventory, rng: np.random.Generator) -> None:
    for _ in range(count):
        s, t = rng.uniform(land.s0, land.s1), land.t0 - rng.uniform(0.2, 1.6)
        town.people.append(Spot(s, t, rng.uniform(0, 6.28)))
