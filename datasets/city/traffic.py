"""Cars and people: those that stay where they are, and those that move with time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semstab.core.types import Float64, Mask
from semstab.datasets.city.mesh import HUMAN, MOVING_CAR, STATIC_CAR, Shape, Surface, box, choose, combine, join
from semstab.datasets.city.plots import SIDEWALK, SIDEWALK_ABOVE, Spot, columns
from semstab.datasets.city.streets import MAIN_WIDTH, Street
from semstab.datasets.city.terrain import Site

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
    """A car 4.4 m long, 1.8 m wide, 1.45 m high; it drives along x and takes its paint as tint."""
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
    """A person 1.75 m high who faces x and takes the colour of their clothes as tint."""
    return combine(
        box((-0.14, 0.14), (-0.19, 0.19), (0, 0.84), color=TROUSERS),
        box((-0.16, 0.16), (-0.26, 0.26), (0.82, 1.47), taper=(0.8, 0.85)),
        box((-0.11, 0.11), (-0.1, 0.1), (1.47, 1.75), color=SKIN),
    )


def parked_cars(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> Surface:
    """Cars that stand still."""
    paint = choose(PAINT, len(spots), rng)
    return site.stand(car(), STATIC_CAR, tuple(columns(spots)[:3]), ROAD_ABOVE, _car_sizes(len(spots), rng), paint)


def standing_people(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> Surface:
    """People who stand still."""
    clothes = choose(CLOTHES, len(spots), rng)
    heights = np.tile(rng.uniform(0.9, 1.08, size=(len(spots), 1)), (1, 3))
    return site.stand(person(), HUMAN, tuple(columns(spots)[:3]), ROAD_ABOVE, heights, clothes)


def roadside_cars(streets: list[Street], rng: np.random.Generator) -> list[Spot]:
    """Cars parked along the streets, clear of the crossings; on side streets on one side only."""
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
    """Things of one kind that go along streets at a constant speed, and start again at the other end.

    low, length, at  of their streets; along_s whether it runs along the plan's s axis
    offset           from the street's middle; start and speed along it, towards its high end where positive
    tint, size       (n, 3) and (n,) or (n, 3): what they look like
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

    def plan_places(self, seconds: float) -> tuple[Float64, Float64, Float64]:
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
        """A car every 38 m of lane or so at 6 to 13 m/s, a walker every 70 m of sidewalk or so at 0.9 to 1.7 m/s."""
        cars = _movers(streets, 38.0, lambda width: min(1.75, 0.135 * width), (6.0, 13.0), rng)
        walkers = _movers(streets, 70.0, lambda width: width / 2 + SIDEWALK / 2, (0.9, 1.7), rng)
        n, m = len(cars.at), len(walkers.at)
        cars = replace(cars, tint=choose(PAINT, n, rng), size=_car_sizes(n, rng))
        clothes, heights = choose(CLOTHES, m, rng), rng.uniform(0.9, 1.08, size=(m, 1))
        return cls(site, cars, replace(walkers, tint=clothes, size=np.tile(heights, (1, 3))))

    def at(self, seconds: float, camera: Float64) -> Surface:
        """What moves as it stands at a time, as far as it is within SIGHT of the camera at (x, y, z)."""
        return join(
            [
                self._place(self.cars, car(), MOVING_CAR, ROAD_ABOVE, seconds, camera),
                self._place(self.walkers, person(), HUMAN, SIDEWALK_ABOVE, seconds, camera),
            ]
        )

    def _place(
        self, movers: Movers, template: Shape, class_id: int, above: float, seconds: float, camera: Float64
    ) -> Surface:
        places = movers.plan_places(seconds)
        x, y = self.site.layout.to_world(*places[:2])
        near = np.hypot(x - camera[0], y - camera[1]) < SIGHT
        seen = tuple(place[near] for place in places)
        return self.site.stand(template, class_id, seen, above, movers.size[near], movers.tint[near])


def _movers(
    streets: list[Street],
    spacing: float,
    offset: Callable[[float], float],
    speeds: tuple[float, float],
    rng: np.random.Generator,
) -> Movers:
    """On both sides of each street, keeping right; what shares a lane shares a speed and never collides."""
    rows = []
    for street in streets:
        for side in (-1.0, 1.0):
            count = max(1, round(street.length / spacing))
            starts = (np.arange(count) + rng.uniform(0.15, 0.85, count)) * street.length / count
            speed = -side * rng.uniform(*speeds)
            lane = (
                street.low,
                street.length,
                street.at,
                street.axis == "s",
                _keep_right(street, side) * offset(street.width),
            )
            rows += [(*lane, start, speed) for start in starts]
    low, length, at, along_s, across, start, speed = np.array(rows, dtype=np.float64).T
    none = np.empty((len(rows), 0))
    return Movers(low, length, at, along_s.astype(bool), across, start, speed, tint=none, size=none)


def _keep_right(street: Street, side: float) -> float:
    """The sign of the offset on which traffic with the direction -side drives on the right."""
    return side if street.axis == "s" else -side


def _car_sizes(count: int, rng: np.random.Generator) -> Float64:
    """Scales of length, width and height; one in seven is a van."""
    sizes = rng.uniform([0.86, 0.95, 0.97], [1.08, 1.04, 1.12], size=(count, 3))
    sizes[rng.random(count) < 1 / 7] *= [1.2, 1.1, 1.4]
    return sizes
