"""A town as triangles: everything that stands still as one surface, and the traffic that moves over it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from semstab.core.types import Float64, Mask
from semstab.datasets.city.buildings import build, bushes, fences, hedges, trees
from semstab.datasets.city.mesh import (
    CLUTTER,
    HUMAN,
    MOVING_CAR,
    ROAD,
    STATIC_CAR,
    Shape,
    Surface,
    box,
    choose,
    combine,
    join,
)
from semstab.datasets.city.options import Flight
from semstab.datasets.city.plots import SIDEWALK, SIDEWALK_ABOVE, Inventory, Spot, columns, furnish
from semstab.datasets.city.terrain import MAIN_WIDTH, Layout, Rectangle, Site, Street, Terrain, plan_streets

# Cars and people: those that stay where they are, and those that move with time.

Bool = Mask

ROAD_ABOVE = 0.094
SIGHT = 140.0
"""Metres from the camera up to which moving things are put into a frame."""

PAINT = np.array(
    [[0.88, 0.88, 0.88], [0.12, 0.12, 0.13], [0.55, 0.57, 0.60], [0.70, 0.10, 0.10], [0.13, 0.25, 0.55],
     [0.32, 0.34, 0.36], [0.16, 0.38, 0.28], [0.82, 0.76, 0.60], [0.85, 0.55, 0.12]]
)  # fmt: skip
CLOTHES = np.array([[0.75, 0.20, 0.18], [0.18, 0.25, 0.60], [0.85, 0.82, 0.78], [0.18, 0.18, 0.20], [0.80, 0.65, 0.20]])
GLASS, TYRE = (0.13, 0.15, 0.18), (0.07, 0.07, 0.07)
TROUSERS, SKIN = (0.20, 0.22, 0.30), (0.72, 0.55, 0.44)


def car() -> Shape:
    """Return a car 4.4 m long, 1.8 m wide, 1.45 m high; it drives along x and takes its paint as tint."""
    wheels = [
        box((x - 0.32, x + 0.32), (y - 0.1, y + 0.1), (0, 0.62), color=TYRE) for x in (-1.4, 1.4) for y in (-0.8, 0.8)
    ]
    return combine(
        box((-2.2, 2.2), (-0.9, 0.9), (0.22, 0.82), taper=(0.97, 0.94)),
        box((-1.75, 1.0), (-0.82, 0.82), (0.8, 1.38), color=GLASS, taper=(0.68, 0.84)),
        box((-1.3, 0.52), (-0.68, 0.68), (1.37, 1.45), taper=(0.97, 0.95)),
        *wheels,
    )


def person() -> Shape:
    """Return a person 1.75 m high who faces x and takes the colour of their clothes as tint."""
    return combine(
        box((-0.14, 0.14), (-0.19, 0.19), (0, 0.84), color=TROUSERS),
        box((-0.16, 0.16), (-0.26, 0.26), (0.82, 1.47), taper=(0.8, 0.85)),
        box((-0.11, 0.11), (-0.1, 0.1), (1.47, 1.75), color=SKIN),
    )


def _painted_cars(count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return scales of length, width and height, and paint; one in seven is a van."""
    paint = choose(PAINT, count, rng)
    sizes = rng.uniform([0.86, 0.95, 0.97], [1.08, 1.04, 1.12], size=(count, 3))
    sizes[rng.random(count) < 1 / 7] *= [1.2, 1.1, 1.4]
    return sizes, paint


def _dressed_people(count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return scales of the three axes, and clothes."""
    clothes = choose(CLOTHES, count, rng)
    return np.tile(rng.uniform(0.9, 1.08, size=(count, 1)), (1, 3)), clothes


def roadside_cars(streets: list[Street], rng: np.random.Generator) -> list[Spot]:
    """Return cars parked along the streets, clear of the crossings; on side streets on one side only."""
    spots = []
    for street in streets:
        sides = (-1, 1) if street.width >= MAIN_WIDTH else (1,)
        for side in sides:
            along = np.arange(street.low + 8, street.high - 8, 6.0)
            along = street.clear_of_crossings(along[rng.random(len(along)) < 0.42], streets, 7.0)
            s, t = street.point(along, np.full(len(along), side * (street.width / 2 - 0.97)))
            heading = street.heading + (0.0 if side < 0 else np.pi) + rng.normal(0, 0.02, len(along))
            spots += [Spot(*map(float, row)) for row in zip(s, t, heading, strict=True)]
    return spots


@dataclass(frozen=True)
class Movers:
    """Moving things of one kind that go along streets at a constant speed, and start again at the other end.

    Attributes:
        low, length, at: Bounds of their streets; along_s says whether one runs along the plan's s axis.
        offset: Distance from the street's middle; start and speed along it, towards its high end where positive.
        tint, size: (n, 3) and (n,) or (n, 3): their appearance.
    """

    low: Float64
    length: Float64
    at: Float64
    along_s: Bool
    offset: Float64
    start: Float64
    speed: Float64
    tint: Float64
    size: Float64

    def plan_points(self, seconds: float) -> tuple[Float64, Float64, Float64]:
        """Plan coordinates s and t, and heading in the plan, at a time."""
        along = self.low + np.mod(self.start + self.speed * seconds, self.length)
        across = self.at + self.offset
        s, t = np.where(self.along_s, along, across), np.where(self.along_s, across, along)
        return s, t, np.where(self.along_s, 0.0, np.pi / 2) + np.where(self.speed < 0, np.pi, 0.0)


@dataclass(frozen=True)
class Traffic:
    """The moving cars and walking people of a town."""

    site: Site
    cars: Movers
    walkers: Movers

    @classmethod
    def random(cls, streets: list[Street], site: Site, rng: np.random.Generator) -> Traffic:
        """Return a car every 38 m of lane or so, at 6 to 13 m/s, a walker every 70 m of sidewalk, at 0.9 to 1.7 m/s."""
        cars = _movers(streets, 38.0, lambda width: min(1.75, 0.135 * width), (6.0, 13.0), rng)
        walkers = _movers(streets, 70.0, lambda width: width / 2 + SIDEWALK / 2, (0.9, 1.7), rng)
        sizes, paint = _painted_cars(len(cars.at), rng)
        heights, clothes = _dressed_people(len(walkers.at), rng)
        return cls(site, replace(cars, size=sizes, tint=paint), replace(walkers, size=heights, tint=clothes))

    def at(self, seconds: float, camera: Float64) -> Surface:
        """Return the moving things at their positions at a time, those within SIGHT of the camera at (x, y, z)."""
        kinds = ((self.cars, car(), MOVING_CAR, ROAD_ABOVE), (self.walkers, person(), HUMAN, SIDEWALK_ABOVE))
        surfaces = []
        for movers, template, class_id, above in kinds:
            s, t, heading = movers.plan_points(seconds)
            x, y = self.site.layout.to_world(s, t)
            near = np.hypot(x - camera[0], y - camera[1]) < SIGHT
            spots = (s[near], t[near], heading[near])
            surfaces.append(self.site.stand(template, class_id, spots, above, movers.size[near], movers.tint[near]))
        return join(surfaces)


def _movers(
    streets: list[Street],
    spacing: float,
    offset: Callable[[float], float],
    speeds: tuple[float, float],
    rng: np.random.Generator,
) -> Movers:
    """Return movers on both sides of each street, keeping right; those that share a lane share a speed."""
    rows = []
    for street in streets:
        for side in (-1.0, 1.0):
            count = max(1, round(street.length / spacing))
            starts = (np.arange(count) + rng.uniform(0.15, 0.85, count)) * street.length / count
            speed = -side * rng.uniform(*speeds)
            along_s = street.axis == "s"
            across = (side if along_s else -side) * offset(street.width)  # on the right
            rows += [(street.low, street.length, street.at, along_s, across, start, speed) for start in starts]
    low, length, at, along_s, across, start, speed = np.array(rows, dtype=np.float64).T
    none = np.empty((len(rows), 0))
    return Movers(low, length, at, along_s.astype(bool), across, start, speed, tint=none, size=none)


REACH = 125.0
"""Metres from the flight's path up to which the town is built; beyond it there is grass."""

ASPHALT, MARKING = (0.30, 0.30, 0.31), (0.82, 0.82, 0.80)
MARKING_ABOVE = 0.121


@dataclass(frozen=True)
class World:
    """A town: its ground, its still surface (metres, relative to the origin) and its traffic."""

    terrain: Terrain
    still: Surface
    traffic: Traffic


@lru_cache(maxsize=2)
def build_world(seed: int, flight: Flight) -> World:
    """Return the town under a flight; the same for every camera, resolution and number of frames."""
    layout = Layout.random(_rng(seed, flight, 0))
    terrain = Terrain.random(_rng(seed, flight, 1))
    site = Site(layout, terrain)
    path = np.stack(flight.path(np.linspace(0, 1, 60)), axis=1)
    c, s = np.cos(layout.yaw), np.sin(layout.yaw)
    plan = path @ np.array([[c, -s], [s, c]])
    low, high = plan.min(axis=0) - REACH - 30, plan.max(axis=0) + REACH + 30
    area = Rectangle(float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    streets, plots = plan_streets(area, _rng(seed, flight, 2))
    town, rng = Inventory(), _rng(seed, flight, 3)
    for plot, near in zip(plots, _near([p.area.centre for p in plots], layout, path, REACH + 70), strict=True):
        if near:
            furnish(plot, town, rng)
    town.cars += roadside_cars(streets, _rng(seed, flight, 4))
    town.trees += _street_trees(streets, _rng(seed, flight, 5))
    still = [
        terrain.mesh(path.min(axis=0) - REACH, path.max(axis=0) + REACH, _rng(seed, flight, 6)),
        *_ground(town, streets, site, path),
        *_standing(town, site, path, seed, flight),
    ]
    return World(terrain, join(still), Traffic.random(streets, site, _rng(seed, flight, 15)))


def _rng(seed: int, flight: Flight, purpose: int) -> np.random.Generator:
    """Return a generator for one purpose, so that a change in one part of the town leaves the others as they are."""
    return np.random.default_rng([seed, flight.number, purpose])


def _street_trees(streets: Sequence[Street], rng: np.random.Generator) -> list[Spot]:
    """Return rows of trees along the sidewalks of the main roads."""
    spots = []
    for street in streets:
        if street.width < MAIN_WIDTH:
            continue
        for side in (-1, 1):
            along = np.arange(street.low + 6, street.high - 6, 11.5)
            along = street.clear_of_crossings(along[rng.random(len(along)) < 0.55], list(streets), 5.0)
            s, t = street.point(along, np.full(len(along), side * (street.width / 2 + 1.2)))
            spots += [Spot(float(a), float(b), 0.0, float(rng.uniform(0.5, 0.75))) for a, b in zip(s, t, strict=True)]
    return spots


def _ground(town: Inventory, streets: Sequence[Street], site: Site, path: Float64) -> list[Surface]:
    """Return streets with their markings, sidewalks, yards and fields, laid over the terrain one above the other."""
    surfaces = [site.drape(p.area, p.above, p.class_id, p.color) for p in town.patches]
    for number, street in enumerate(streets):
        half = street.width / 2
        shade = np.array(ASPHALT) * (0.92 + 0.04 * (number % 4))
        above = ROAD_ABOVE + 0.0007 * number  # crossing streets do not lie in one plane
        lane = street.strip(-half - 0.3, half + 0.3)  # its edges lie under the kerbs: no grass shows between
        surfaces.append(site.drape(lane, above, ROAD, shade))
        for low in street.clear_of_crossings(np.arange(street.low + 3, street.high - 6, 7.0), list(streets), 6.0):
            dash = street.strip(-0.08, 0.08, float(low), float(low) + 3.0)
            surfaces.append(site.drape(dash, MARKING_ABOVE + 0.0007 * number, ROAD, MARKING))
    near = [_distance(surface.vertices[surface.faces[:, 0], :2], path) < REACH for surface in surfaces]
    return [Surface(s.vertices, s.faces[k], s.classes[k], s.colors[k]) for s, k in zip(surfaces, near, strict=True)]


def _standing(town: Inventory, site: Site, path: Float64, seed: int, flight: Flight) -> list[Surface]:
    def close(rows: Sequence[Spot]) -> list[Spot]:
        near = _near([row[:2] for row in rows], site.layout, path, REACH)
        return [row for row, keep in zip(rows, near, strict=True) if keep]

    cars, people, bins = columns(close(town.cars)), columns(close(town.people)), columns(town.bins)
    rng = _rng(seed, flight, 14)
    extent = rng.uniform([0.7, 0.6, 0.9], [1.9, 1.1, 1.5], size=(bins.shape[1], 3))
    tint = rng.uniform([0.15, 0.22, 0.2], [0.5, 0.45, 0.5], size=(bins.shape[1], 3))
    return [
        *build(town.buildings, site, _rng(seed, flight, 7)),
        *trees(close(town.trees), site, _rng(seed, flight, 8)),
        bushes(close(town.bushes), site, _rng(seed, flight, 9)),
        hedges(town.hedges, site, _rng(seed, flight, 10)),
        fences(town.fences, site, _rng(seed, flight, 11)),
        site.stand(car(), STATIC_CAR, cars[:3], ROAD_ABOVE, *_painted_cars(cars.shape[1], _rng(seed, flight, 12))),
        site.stand(person(), HUMAN, people[:3], ROAD_ABOVE, *_dressed_people(people.shape[1], _rng(seed, flight, 13))),
        site.stand(box(), CLUTTER, bins[:3], 0.02, size=extent * bins[3][:, None], tint=tint),
    ]


def _near(points: Sequence[tuple[float, ...]], layout: Layout, path: Float64, distance: float) -> list[bool]:
    s, t = np.array(points, dtype=np.float64).T
    return [bool(near) for near in _distance(np.stack(layout.to_world(s, t), axis=1), path) < distance]


def _distance(points: Float64, path: Float64) -> Float64:
    """Return the distance of points (n, 2) from the nearest vertex of a path (m, 2)."""
    offsets = points[:, None] - path[None]
    distance: Float64 = np.sqrt((offsets**2).sum(axis=2).min(axis=1))
    return distance
