"""A town: streets in a grid, blocks of houses, of flats or with a park, and the traffic between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise, product

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.flight import Flight
from semstab.datasets.city.ground import GRASS, Ground, Rectangle
from semstab.datasets.city.mesh import CLUTTER, LOW_VEGETATION, ROAD, STATIC_CAR, Surface, join
from semstab.datasets.city.things import PAINT, bushes, car, choose, flats, houses, trees
from semstab.datasets.city.traffic import Street, Traffic

REACH = 125.0
"""Metres from the flight's path up to which there are streets."""

STREET, SIDEWALK = 11.0, 2.0
MARKING_ABOVE, SIDEWALK_ABOVE, LAND_ABOVE, PATH_ABOVE = 0.05, 0.12, 0.17, 0.23
"""Metres above the asphalt, which lies under everything."""

KERB, MARKING, GRAVEL = (0.62, 0.61, 0.60), (0.82, 0.82, 0.80), (0.70, 0.63, 0.50)
PAVING = ((0.60, 0.57, 0.53), (0.55, 0.50, 0.46), (0.63, 0.61, 0.58), (0.50, 0.42, 0.36))

Rows = list[tuple[float, ...]]


@dataclass(frozen=True)
class Town:
    """The ground, everything that stands still as one surface (metres, relative to the origin), and what moves."""

    ground: Ground
    still: Surface
    traffic: Traffic


@lru_cache(maxsize=2)
def build_town(seed: int, flight: Flight) -> Town:
    """Return the town under a flight; the same for every camera, resolution and number of frames."""
    rng = np.random.default_rng([seed, flight.number])
    ground = Ground.random(rng)
    path = np.stack(ground.plan(*flight.path(np.linspace(0, 1, 60))), axis=1)
    s, t = (_streets(low - REACH, high + REACH, rng) for low, high in zip(path.min(0), path.max(0), strict=True))
    streets = [*(Street(False, at, t[0], t[-1]) for at in s), *(Street(True, at, s[0], s[-1]) for at in t)]
    area = Rectangle(s[0], s[-1], t[0], t[-1]).within(-STREET / 2)
    site = _Site(ground, rng, [ground.land(area), *(_dashes(street, ground) for street in streets)])
    for (s0, s1), (t0, t1) in product(pairwise(s), pairwise(t)):
        block = Rectangle(s0, s1, t0, t1).within(STREET / 2)
        site.fill(block, near=bool(np.hypot(*(path - block.centre).T).min() < REACH + 50))
    return Town(ground, join(site.surfaces()), Traffic.random(streets, ground, STREET / 2, rng))


def _streets(low: float, high: float, rng: np.random.Generator) -> list[float]:
    """Return the middles of parallel streets, 65 to 105 m apart, the first at `low`, the last beyond `high`."""
    middles = [low]
    while middles[-1] < high:
        middles.append(middles[-1] + float(rng.uniform(65, 105)))
    return middles


def _dashes(street: Street, ground: Ground) -> Surface:
    """Return the marking in the middle of a street: every second cell of a narrow strip."""
    ends, sides = (street.low, street.high), (street.at - 0.08, street.at + 0.08)
    strip = Rectangle(*ends, *sides) if street.along_s else Rectangle(*sides, *ends)
    whole = ground.drape(strip, MARKING_ABOVE, ROAD, MARKING)
    return Surface.of_class(whole.vertices, whole.faces.reshape(-1, 2, 3)[::2].reshape(-1, 3), ROAD, MARKING)


@dataclass
class _Site:
    """A town that is being built: ground that is laid out, and the rows of what will stand on it (see `things`)."""

    ground: Ground
    rng: np.random.Generator
    laid: list[Surface]
    houses: Rows = field(default_factory=list)
    flats: Rows = field(default_factory=list)
    trees: Rows = field(default_factory=list)
    bushes: Rows = field(default_factory=list)
    cars: Rows = field(default_factory=list)

    def surfaces(self) -> list[Surface]:
        """Return all that was laid out and put up."""
        g, rng = self.ground, self.rng
        cars, size = np.array(self.cars), rng.uniform([0.86, 0.95, 0.97], [1.08, 1.04, 1.2], size=(len(self.cars), 3))
        return [
            *self.laid,
            *houses(np.array(self.houses), g, rng),
            *flats(np.array(self.flats), g, rng),
            *trees(rng.permutation(self.trees), g, rng),
            bushes(np.array(self.bushes), g, rng),
            g.stand(car(), STATIC_CAR, cars, size, choose(PAINT, len(cars), rng), 0.08),
        ]

    def fill(self, block: Rectangle, near: bool) -> None:
        """Lay out a block between streets; one that is `near` the flight has a use, and its streets are furnished."""
        land = block.within(SIDEWALK)
        self._lay(block, SIDEWALK_ABOVE, CLUTTER, KERB)
        use = self.rng.choice(3, p=[0.7, 0.15, 0.15]) if near else 2
        tone = self.rng.uniform(0.85, 1.2)
        lawn = use != 1
        self._lay(land, LAND_ABOVE, LOW_VEGETATION if lawn else CLUTTER, tone * np.array(GRASS if lawn else PAVING[1]))
        if not near:
            return
        uses: Sequence[Callable[[Rectangle], None]] = (self._put_houses, self._put_flats, self._put_park)
        uses[use](land)
        kerbside = self._some(_around(block, 1.1, 6.0), 0.4)
        self.cars += [(s, t, angle + self.rng.normal(0, 0.02)) for s, t, angle in kerbside]
        self.trees += [(s, t, self.rng.uniform(0.45, 0.75)) for s, t, _ in self._some(_around(block, -1.0, 11.0), 0.3)]

    def _put_houses(self, land: Rectangle) -> None:
        """Put two rows of houses back to back, each with a driveway, perhaps a car on it, and a garden."""
        rng, depth = self.rng, (land.t1 - land.t0) / 2
        count = round((land.s1 - land.s0) / 18)
        for front, back in ((land.t0, 1), (land.t1, -1)):
            for s0, s1 in pairwise(np.linspace(land.s0, land.s1, count + 1).tolist()):
                wide, deep = rng.uniform(9, s1 - s0 - 5), rng.uniform(7.5, 10)
                setback = rng.uniform(3.5, 6)
                house = (s0 + 1.2 + wide / 2, front + back * (setback + deep / 2))
                self.houses.append((*house, wide, deep, rng.uniform(3.1, 6.4)))
                drive = s1 - 2
                far = front + back * (setback + 6)
                paving = PAVING[rng.integers(len(PAVING))]
                self._lay(
                    Rectangle(drive - 1.6, drive + 1.6, min(front, far), max(front, far)), PATH_ABOVE, CLUTTER, paving
                )
                if rng.random() < 0.55:
                    self.cars.append((drive, front + back * rng.uniform(3, setback + 2), np.pi / 2))
                garden = (front + back * (setback + deep + 2.5), front + back * depth)
                plot = Rectangle(s0 + 1, s1 - 1, min(garden), max(garden))
                self._plant(plot, int(rng.integers(1, 5)), int(rng.integers(2, 6)))

    def _put_flats(self, land: Rectangle) -> None:
        """Put two rows of long buildings on a paved court, with a lawn behind each and cars in the middle."""
        rng = self.rng
        count = round((land.s1 - land.s0) / 38)
        for front, back in ((land.t0, 1), (land.t1, -1)):
            for s0, s1 in pairwise(np.linspace(land.s0, land.s1, count + 1).tolist()):
                deep, height = rng.uniform(11, 13), 2.9 * rng.integers(3, 6) + 0.6
                self.flats.append(
                    ((s0 + s1) / 2, front + back * (3 + deep / 2), s1 - s0 - rng.uniform(4, 9), deep, height)
                )
                sides = (front + back * (deep + 4), front + back * (deep + 8))
                lawn = Rectangle(s0 + 2, s1 - 2, min(sides), max(sides))
                self._lay(lawn, PATH_ABOVE, LOW_VEGETATION, GRASS)
                self._plant(lawn, 4, 4)
            along = np.arange(land.s0 + 4, land.s1 - 4, 2.7)
            self.cars += [(s, land.centre[1] - back * 2.6, np.pi / 2) for s in along[rng.random(len(along)) < 0.6]]

    def _put_park(self, land: Rectangle) -> None:
        """Put two paths that cross, and trees and bushes on the lawns between them."""
        s, t = land.centre + self.rng.uniform(-8, 8, 2)
        self._lay(Rectangle(s - 1.3, s + 1.3, land.t0, land.t1), PATH_ABOVE, CLUTTER, GRAVEL)
        self._lay(Rectangle(land.s0, land.s1, t - 1.3, t + 1.3), PATH_ABOVE, CLUTTER, GRAVEL)
        for s0, s1 in ((land.s0, s), (s, land.s1)):
            for t0, t1 in ((land.t0, t), (t, land.t1)):
                self._plant(Rectangle(s0, s1, t0, t1).within(2.5), int((s1 - s0) * (t1 - t0) / 120), 12)

    def _lay(self, area: Rectangle, above: float, class_id: int, color: Sequence[float] | Float64) -> None:
        self.laid.append(self.ground.drape(area, above, class_id, color))

    def _plant(self, area: Rectangle, tall: int, low: int) -> None:
        """Put so many trees and bushes anywhere in a rectangle."""
        rows = self.rng.uniform([area.s0, area.t0, 0.5], [area.s1, area.t1, 1.1], size=(tall + low, 3)).tolist()
        self.trees += rows[:tall]
        self.bushes += rows[tall:]

    def _some(self, rows: Float64, share: float) -> Float64:
        return rows[self.rng.random(len(rows)) < share]


def _around(block: Rectangle, outside: float, step: float) -> Float64:
    """Return (n, 3) plan coordinates and headings every `step` metres along a block's sides, `outside` metres off."""
    s, t = np.arange(block.s0 + 5, block.s1 - 5, step), np.arange(block.t0 + 5, block.t1 - 5, step)
    sides = [
        *(np.c_[s, np.full(len(s), at), np.zeros(len(s))] for at in (block.t0 - outside, block.t1 + outside)),
        *(np.c_[np.full(len(t), at), t, np.full(len(t), np.pi / 2)] for at in (block.s0 - outside, block.s1 + outside)),
    ]
    return np.concatenate(sides)
