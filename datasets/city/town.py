"""A town: streets in a grid, blocks of houses, of flats or with a park, and the traffic between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.flight import Flight
from semstab.datasets.city.ground import GRASS, Ground, Rectangle
from semstab.datasets.city.mesh import CLUTTER, LOW_VEGETATION, ROAD, STATIC_CAR, TriangleSurface, join, surface
from semstab.datasets.city.things import PAINT, car, choose, flats, houses, trees
from semstab.datasets.city.traffic import Movers, Street, traffic

REACH = 125.0
"""Metres from the flight's path up to which there are streets."""

STREET, SIDEWALK = 11.0, 2.0
MARKING_ABOVE, SIDEWALK_ABOVE, LAND_ABOVE, PATH_ABOVE = 0.05, 0.12, 0.17, 0.23
"""Metres above the asphalt, which lies under everything."""

KERB, MARKING, GRAVEL = (0.62, 0.61, 0.60), (0.82, 0.82, 0.80), (0.70, 0.63, 0.50)
PAVING = np.array([[0.60, 0.57, 0.53], [0.55, 0.50, 0.46], [0.63, 0.61, 0.58], [0.50, 0.42, 0.36]])

Rows = list[tuple[float, ...]]


@dataclass(frozen=True)
class Town:
    """The ground, everything that stands still as one surface (metres, relative to the origin), and what moves."""

    ground: Ground
    still: TriangleSurface
    movers: tuple[Movers, Movers]

    def moving(self, seconds: float, camera: Float64) -> TriangleSurface:
        """Return the moving cars and people near the camera (x, y, z) at a time."""
        return join([movers.surface_at(seconds, camera, self.ground) for movers in self.movers])


@lru_cache(maxsize=2)
def build_town(seed: int, flight: Flight) -> Town:
    """Return the town under a flight; the same for every camera, resolution and number of frames."""
    rng = np.random.default_rng([seed, flight.number])
    ground = Ground.random(rng)
    path = np.stack(ground.plan(*flight.path(np.linspace(0, 1, 60))), axis=1)
    s, t = (_streets(low - REACH, high + REACH, rng) for low, high in zip(path.min(0), path.max(0), strict=True))
    streets = [
        *(Street(False, position, t[0], t[-1]) for position in s),
        *(Street(True, position, s[0], s[-1]) for position in t),
    ]
    area = Rectangle(s[0], s[-1], t[0], t[-1]).within(-STREET / 2)
    site = _Site(ground, rng, [ground.land(area), *(_dashes(street, ground) for street in streets)])
    for (s0, s1), (t0, t1) in product(pairwise(s), pairwise(t)):
        block = Rectangle(s0, s1, t0, t1).within(STREET / 2)
        site.fill(block, near=bool(np.hypot(*(path - block.centre).T).min() < REACH + 50))
    return Town(ground, join(site.surfaces()), traffic(streets, STREET / 2, rng))


def _streets(low: float, high: float, rng: np.random.Generator) -> list[float]:
    """Return the middles of parallel streets, 65 to 105 m apart, the first at `low`, the last beyond `high`."""
    middles = [low]
    while middles[-1] < high:
        middles.append(middles[-1] + float(rng.uniform(65, 105)))
    return middles


def _dashes(street: Street, ground: Ground) -> TriangleSurface:
    """Return the marking in the middle of a street: every second cell of a narrow strip."""
    ends, sides = (street.low, street.high), (street.at - 0.08, street.at + 0.08)
    strip = Rectangle(*ends, *sides) if street.along_s else Rectangle(*sides, *ends)
    full_strip = ground.drape(strip, MARKING_ABOVE, ROAD, MARKING)
    return surface(full_strip.vertices, full_strip.faces.reshape(-1, 2, 3)[::2].reshape(-1, 3), ROAD, MARKING)


class _Lot(NamedTuple):
    """A lot of a block: its corner (s, front) at the street, its width and depth, and on which side it lies (1, -1)."""

    s: float
    front: float
    wide: float
    deep: float
    side: int

    def t(self, into: float) -> float:
        """Return the plan coordinate at `into` metres behind the front."""
        return self.front + self.side * into

    def part(self, left: float, right: float, near: float, far: float) -> Rectangle:
        """Return the part between two distances from the corner, and two from the front."""
        return Rectangle(self.s + left, self.s + right, *sorted((self.t(near), self.t(far))))


def _lots(land: Rectangle, wide: float) -> list[_Lot]:
    """Return two rows of lots back to back, about `wide` metres wide."""
    borders = np.linspace(land.s0, land.s1, round((land.s1 - land.s0) / wide) + 1)
    deep = (land.t1 - land.t0) / 2
    rows = ((land.t0, 1), (land.t1, -1))
    return [_Lot(s, front, borders[1] - borders[0], deep, side) for front, side in rows for s in borders[:-1]]


@dataclass
class _Site:
    """A town that is being built: ground that is laid out, and the rows of what will stand on it (see `things`)."""

    ground: Ground
    rng: np.random.Generator
    laid: list[TriangleSurface]
    houses: Rows = field(default_factory=list)
    flats: Rows = field(default_factory=list)
    trees: Rows = field(default_factory=list)
    cars: Rows = field(default_factory=list)

    def surfaces(self) -> list[TriangleSurface]:
        """Return all that was laid out and put up."""
        g, rng = self.ground, self.rng
        cars, size = np.array(self.cars), rng.uniform([0.86, 0.95, 0.97], [1.08, 1.04, 1.2], size=(len(self.cars), 3))
        return [
            *self.laid,
            *houses(np.array(self.houses).reshape(-1, 5), g, rng),
            *flats(np.array(self.flats).reshape(-1, 5), g, rng),
            *trees(rng.permutation(self.trees), g, rng),
            g.stand(car(STATIC_CAR), cars, size, choose(PAINT, len(cars), rng), 0.08),
        ]

    def fill(self, block: Rectangle, near: bool) -> None:
        """Lay out a block between streets; one that is `near` the flight has a use, and its streets are furnished."""
        land = block.within(SIDEWALK)
        self._lay(block, SIDEWALK_ABOVE, CLUTTER, KERB)
        use = self.rng.choice(3, p=[0.7, 0.15, 0.15]) if near else 0
        class_id, color = (CLUTTER, PAVING[1]) if use == 1 else (LOW_VEGETATION, np.array(GRASS))
        self._lay(land, LAND_ABOVE, class_id, color * self.rng.uniform(0.85, 1.2))
        if not near:
            return
        (self._put_houses, self._put_flats, self._put_park)[use](land)
        kerbside = self._some(_around(block, 1.1, 6.0), 0.4)
        self.cars += [(s, t, angle + self.rng.normal(0, 0.02)) for s, t, angle in kerbside]
        self.trees += [(s, t, self.rng.uniform(0.45, 0.75)) for s, t, _ in self._some(_around(block, -1.0, 11.0), 0.3)]

    def _put_houses(self, land: Rectangle) -> None:
        """Put two rows of houses back to back, each with a driveway, perhaps a car on it, and a garden."""
        rng = self.rng
        for lot in _lots(land, 18):
            wide, deep, setback = rng.uniform(9, lot.wide - 5), rng.uniform(7.5, 10), rng.uniform(3.5, 6)
            self.houses.append((lot.s + 1.2 + wide / 2, lot.t(setback + deep / 2), wide, deep, rng.uniform(3.1, 6.4)))
            self._lay(lot.part(lot.wide - 3.6, lot.wide - 0.4, 0, setback + 6), PATH_ABOVE, CLUTTER, rng.choice(PAVING))
            if rng.random() < 0.55:
                self.cars.append((lot.s + lot.wide - 2, lot.t(rng.uniform(3, setback + 2)), np.pi / 2))
            garden = lot.part(1, lot.wide - 1, setback + deep + 2.5, lot.deep)
            self._plant(garden, int(rng.integers(1, 5)))

    def _put_flats(self, land: Rectangle) -> None:
        """Put two rows of long buildings on a paved court, with a lawn behind each and cars in the middle."""
        rng = self.rng
        for lot in _lots(land, 38):
            wide, deep, height = lot.wide - rng.uniform(4, 9), rng.uniform(11, 13), 2.9 * rng.integers(3, 6) + 0.6
            self.flats.append((lot.s + lot.wide / 2, lot.t(3 + deep / 2), wide, deep, height))
            lawn = lot.part(2, lot.wide - 2, deep + 4, deep + 8)
            self._lay(lawn, PATH_ABOVE, LOW_VEGETATION, GRASS)
            self._plant(lawn, 4)
            parked = np.arange(lot.s + 2, lot.s + lot.wide - 2, 2.7)
            self.cars += [(s, lot.t(lot.deep - 2.6), np.pi / 2) for s in parked if rng.random() < 0.6]

    def _put_park(self, land: Rectangle) -> None:
        """Put two paths that cross, and trees on the lawns between them."""
        s, t = land.centre + self.rng.uniform(-8, 8, 2)
        self._lay(Rectangle(s - 1.3, s + 1.3, land.t0, land.t1), PATH_ABOVE, CLUTTER, GRAVEL)
        self._lay(Rectangle(land.s0, land.s1, t - 1.3, t + 1.3), PATH_ABOVE, CLUTTER, GRAVEL)
        for s0, s1 in ((land.s0, s), (s, land.s1)):
            for t0, t1 in ((land.t0, t), (t, land.t1)):
                self._plant(Rectangle(s0, s1, t0, t1).within(2.5), int((s1 - s0) * (t1 - t0) / 120))

    def _lay(self, area: Rectangle, above: float, class_id: int, color: Sequence[float] | Float64) -> None:
        self.laid.append(self.ground.drape(area, above, class_id, color))

    def _plant(self, area: Rectangle, count: int) -> None:
        """Put trees anywhere in a rectangle."""
        self.trees += self.rng.uniform([area.s0, area.t0, 0.5], [area.s1, area.t1, 1.1], size=(count, 3)).tolist()

    def _some(self, rows: Float64, share: float) -> Float64:
        return rows[self.rng.random(len(rows)) < share]


def _around(block: Rectangle, outside: float, step: float) -> Float64:
    """Return (n, 3) plan coordinates and headings every `step` metres along a block's sides, `outside` metres off."""
    s, t = np.arange(block.s0 + 5, block.s1 - 5, step), np.arange(block.t0 + 5, block.t1 - 5, step)
    rows = [(x, edge, 0.0) for edge in (block.t0 - outside, block.t1 + outside) for x in s]
    rows += [(edge, x, np.pi / 2) for edge in (block.s0 - outside, block.s1 + outside) for x in t]
    return np.array(rows)
