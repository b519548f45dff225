"""A town as triangles: everything that stands still as one surface, and the traffic that moves over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.buildings import build, bushes, fences, hedges, trees
from semstab.datasets.city.mesh import CLUTTER, ROAD, Surface, box, join
from semstab.datasets.city.options import Flight
from semstab.datasets.city.plots import Inventory, Spot, columns, furnish
from semstab.datasets.city.streets import MAIN_WIDTH, Layout, Plot, Rectangle, Street, plan_streets
from semstab.datasets.city.terrain import Site, Terrain
from semstab.datasets.city.traffic import ROAD_ABOVE, Traffic, parked_cars, roadside_cars, standing_people

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


def build_world(seed: int, flight: Flight) -> World:
    """The town under a flight; the same for every camera, resolution and number of frames."""
    layout = Layout.random(_rng(seed, flight, 0))
    terrain = Terrain.random(_rng(seed, flight, 1))
    site = Site(layout, terrain)
    path = np.stack(flight.path(np.linspace(0, 1, 60)), axis=1)
    streets, plots = plan_streets(_plan_area(layout, path), _rng(seed, flight, 2))
    town = _furnished(plots, layout, path, _rng(seed, flight, 3))
    town.cars += roadside_cars(streets, _rng(seed, flight, 4))
    town.trees += _street_trees(streets, _rng(seed, flight, 5))
    still = [
        terrain.mesh(path.min(axis=0) - REACH, path.max(axis=0) + REACH, _rng(seed, flight, 6)),
        *_ground(town, streets, site, path),
        *_standing(town, site, path, seed, flight),
    ]
    return World(terrain, join(still), Traffic.random(streets, site, _rng(seed, flight, 15)))


def _rng(seed: int, flight: Flight, purpose: int) -> np.random.Generator:
    """A generator for one purpose, so that a change in one part of the town leaves the others as they are."""
    return np.random.default_rng([seed, flight.number, purpose])


def _plan_area(layout: Layout, path: Float64) -> Rectangle:
    """A rectangle of the plan that holds everything within REACH of the path."""
    margin = REACH + 30
    c, s = np.cos(layout.yaw), np.sin(layout.yaw)
    plan = path @ np.array([[c, -s], [s, c]])
    low, high = plan.min(axis=0) - margin, plan.max(axis=0) + margin
    return Rectangle(float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def _furnished(plots: Sequence[Plot], layout: Layout, path: Float64, rng: np.random.Generator) -> Inventory:
    town = Inventory()
    for plot, near in zip(plots, _near([p.area.centre for p in plots], layout, path, REACH + 70), strict=True):
        if near:
            furnish(plot, town, rng)
    return town


def _street_trees(streets: Sequence[Street], rng: np.random.Generator) -> list[Spot]:
    """Rows of trees along the sidewalks of the main roads."""
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
    """Streets with their markings, sidewalks, yards and fields, laid over the terrain one above the other."""
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
    return [_within(surface, path) for surface in surfaces]


def _standing(town: Inventory, site: Site, path: Float64, seed: int, flight: Flight) -> list[Surface]:
    def close(rows: Sequence[Spot]) -> list[Spot]:
        near = _near([row[:2] for row in rows], site.layout, path, REACH)
        return [row for row, keep in zip(rows, near, strict=True) if keep]

    return [
        *build(town.buildings, site, _rng(seed, flight, 7)),
        *trees(close(town.trees), site, _rng(seed, flight, 8)),
        bushes(close(town.bushes), site, _rng(seed, flight, 9)),
        hedges(town.hedges, site, _rng(seed, flight, 10)),
        fences(town.fences, site, _rng(seed, flight, 11)),
        parked_cars(close(town.cars), site, _rng(seed, flight, 12)),
        standing_people(close(town.people), site, _rng(seed, flight, 13)),
        _bins(town, site, _rng(seed, flight, 14)),
    ]


def _bins(town: Inventory, site: Site, rng: np.random.Generator) -> Surface:
    """Containers and bins."""
    *places, size = columns(town.bins)
    extent = rng.uniform([0.7, 0.6, 0.9], [1.9, 1.1, 1.5], size=(len(size), 3)) * size[:, None]
    tint = rng.uniform([0.15, 0.22, 0.2], [0.5, 0.45, 0.5], size=(len(size), 3))
    return site.stand(box(), CLUTTER, tuple(places), 0.02, extent, tint)


def _near(places: Sequence[tuple[float, ...]], layout: Layout, path: Float64, distance: float) -> list[bool]:
    """Which plan points are within a distance of the path."""
    s, t = np.array(places, dtype=np.float64).T
    return [bool(near) for near in _distance(np.stack(layout.to_world(s, t), axis=1), path) < distance]


def _within(surface: Surface, path: Float64) -> Surface:
    """The faces within REACH of the path; vertices stay."""
    keep = _distance(surface.vertices[surface.faces[:, 0], :2], path) < REACH
    return Surface(surface.vertices, surface.faces[keep], surface.classes[keep], surface.colors[keep])


def _distance(points: Float64, path: Float64) -> Float64:
    """Distance of points (n, 2) from the nearest vertex of a path (m, 2)."""
    offsets = points[:, None] - path[None]
    distance: Float64 = np.sqrt((offsets**2).sum(axis=2).min(axis=1))
    return distance
