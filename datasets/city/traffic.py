"""Moving cars and people, who go along straight lanes at a constant speed and start again at the other end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.ground import Ground
from semstab.datasets.city.mesh import HUMAN, MOVING_CAR, TriangleSurface
from semstab.datasets.city.things import PAINT, car, choose, person

SIGHT = 140.0
"""Metres from the camera up to which moving things are put into a frame."""


class Street(NamedTuple):
    """A street along the plan's axis s or t: its middle is at `at` on the other axis, from `low` to `high`."""

    along_s: bool
    at: float
    low: float
    high: float


class MoverKind(NamedTuple):
    """A kind of movers: surface; height, mean spacing and offset from a street's middle in metres; possible speeds."""

    template: TriangleSurface
    above: float
    spacing: float
    offset: float
    speeds: tuple[float, float]


@dataclass(frozen=True)
class Movers:
    """Moving things of one kind.

    Attributes:
        lanes: (6, n) 1 if a thing's lane runs along the plan's axis s; its place on the other axis, its beginning and
            its length in metres; the start of the thing along it, and its speed, negative towards the beginning.
        size, tint: (n, 3) each.
    """

    kind: MoverKind
    lanes: Float64
    size: Float64
    tint: Float64

    @classmethod
    def random(cls, kind: MoverKind, streets: Sequence[Street], rng: np.random.Generator) -> Movers:
        """Return movers on both sides of each street, who keep right; movers on one lane share a speed."""
        rows: list[tuple[float, ...]] = []
        for street in streets:
            length = street.high - street.low
            count = max(1, round(length / kind.spacing))
            for direction in (-1.0, 1.0):
                across = street.at + kind.offset * (-direction if street.along_s else direction)  # on the right
                speed = direction * rng.uniform(*kind.speeds)
                starts = (np.arange(count) + rng.uniform(0.15, 0.85, count)) * length / count
                rows += [(street.along_s, across, street.low, length, start, speed) for start in starts]
        return cls(kind, np.array(rows).T, rng.uniform(0.9, 1.1, size=(len(rows), 3)), choose(PAINT, len(rows), rng))

    def spots(self, seconds: float) -> Float64:
        """Return (n, 3) the plan coordinates s, t and the heading in the plan, at a time."""
        along_s, across, low, length, start, speed = self.lanes
        along = low + np.mod(start + speed * seconds, length)
        heading = np.where(along_s, 0.0, np.pi / 2) + np.where(speed < 0, np.pi, 0.0)
        return np.stack([np.where(along_s, along, across), np.where(along_s, across, along), heading], axis=1)

    def surface_at(self, seconds: float, camera: Float64, ground: Ground) -> TriangleSurface:
        """Return the things at a time, those within SIGHT of the camera at (x, y, z)."""
        spots = self.spots(seconds)
        k = np.hypot(*(ground.points(*spots[:, :2].T)[:, :2] - camera[:2]).T) < SIGHT
        return ground.stand(self.kind.template, spots[k], self.size[k], self.tint[k], self.kind.above)


def traffic(streets: Sequence[Street], kerb: float, rng: np.random.Generator) -> tuple[Movers, Movers]:
    """Return cars on the lanes, and people on the sidewalks, which begin `kerb` metres from a street's middle."""
    cars = MoverKind(car(MOVING_CAR), 0.0, spacing=38.0, offset=2.0, speeds=(6.0, 13.0))
    people = MoverKind(person(HUMAN), 0.12, spacing=22.0, offset=kerb + 1.0, speeds=(0.9, 1.7))
    return Movers.random(cars, streets, rng), Movers.random(people, streets, rng)
