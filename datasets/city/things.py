"""The things of a town: buildings, trees, bushes, cars and people, each placed many times on the ground."""

from __future__ import annotations

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.ground import Ground
from semstab.datasets.city.mesh import BUILDING, LOW_VEGETATION, TREE, Shape, Surface, blob, box, combine, shape

STOREY = 2.9
FOUNDATION = 2.0
"""Metres of wall below the ground in a building's middle, so that no gap opens on a slope."""

WALLS = np.array([[0.86, 0.83, 0.76], [0.80, 0.74, 0.62], [0.72, 0.68, 0.66], [0.63, 0.42, 0.34], [0.90, 0.89, 0.87]])
TILES = np.array([[0.58, 0.28, 0.20], [0.50, 0.25, 0.20], [0.38, 0.27, 0.24], [0.33, 0.33, 0.36], [0.64, 0.36, 0.24]])
FELT = np.array([[0.56, 0.55, 0.54], [0.44, 0.44, 0.46], [0.66, 0.64, 0.60], [0.36, 0.37, 0.36]])
LEAVES = np.array([[0.20, 0.34, 0.12], [0.26, 0.40, 0.14], [0.17, 0.29, 0.13], [0.33, 0.41, 0.16], [0.24, 0.33, 0.20]])
PAINT = np.array(
    [[0.88, 0.88, 0.88], [0.12, 0.12, 0.13], [0.55, 0.57, 0.60], [0.70, 0.10, 0.10], [0.13, 0.25, 0.55],
     [0.32, 0.34, 0.36], [0.16, 0.38, 0.28], [0.82, 0.76, 0.60], [0.85, 0.55, 0.12]]
)  # fmt: skip
GLASS, BARK, SKIN = (0.13, 0.15, 0.18), (0.33, 0.26, 0.20), (0.72, 0.55, 0.44)


GLAZED = box(color=GLASS)


def choose(colors: Float64, count: int, rng: np.random.Generator) -> Float64:
    """Return (count, 3) colours, drawn at random from a few, some lighter and some darker."""
    return colors[rng.integers(len(colors), size=count)] * rng.uniform(0.88, 1.12, size=(count, 1))


def houses(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[Surface]:
    """Return buildings under hip roofs; rows (n, 5) are s, t, and the extent along s, along t, and up to the eaves."""
    eaves = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0], [-0.2, 0, 1], [0.2, 0, 1]]
    roof = shape(eaves, [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]])
    size = rows[:, 2:] + np.array([0.8, 0.8, 0.0])
    size[:, 2] = 0.4 * rows[:, 3]
    return [*_walls(rows, ground, rng), _on_top(roof, rows, size, ground, choose(TILES, len(rows), rng))]


def flats(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[Surface]:
    """Return buildings under flat roofs; rows (n, 5) as those of houses."""
    size = rows[:, 2:] - np.array([1.0, 1.0, 0.0])
    size[:, 2] = 0.5
    return [*_walls(rows, ground, rng), _on_top(box(), rows, size, ground, choose(FELT, len(rows), rng))]


def _walls(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[Surface]:
    """Return walls, and a band of windows 3 cm in front of them on each storey."""
    foundation = np.array([0, 0, FOUNDATION])
    tint = choose(WALLS, len(rows), rng)
    surfaces = [ground.stand(box(), BUILDING, _spots(rows), rows[:, 2:] + foundation, tint, -FOUNDATION)]
    for floor in range(int(rows[:, 4].max() / STOREY)):
        tall = rows[rows[:, 4] >= (floor + 1) * STOREY]
        size = np.c_[tall[:, 2:4] + 0.06, np.full(len(tall), 1.3)]
        surfaces.append(ground.stand(GLAZED, BUILDING, _spots(tall), size, np.zeros_like(size), floor * STOREY + 1))
    return surfaces


def _on_top(roof: Shape, rows: Float64, size: Float64, ground: Ground, tint: Float64) -> Surface:
    s, t = rows[:, :2].T
    position = ground.points(s, t) + np.array([0, 0, 1]) * rows[:, 4:]
    return roof.place(BUILDING, position, np.full(len(rows), ground.yaw), size, tint)


def _spots(rows: Float64) -> Float64:
    return np.concatenate([rows[:, :2], np.zeros((len(rows), 1))], axis=1)


def trees(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[Surface]:
    """Return trees of four forms; rows (n, 3) are s, t and a size, 1 for 9 m."""
    surfaces = []
    for own in np.array_split(rows, 4):
        crown = [blob((0, 0, 5.6), (2.9, 2.9, 3.1), 1, rng)]
        crown += [blob((*rng.uniform(-1.7, 1.7, 2), rng.uniform(4.6, 6.8)), rng.uniform(1.5, 2), 0, rng) for _ in "123"]
        form = combine(box((-0.25, 0.25), (-0.25, 0.25), (-0.5, 4), BARK), *crown)
        surfaces.append(_grown(form, TREE, own, ground, rng))
    return surfaces


def bushes(rows: Float64, ground: Ground, rng: np.random.Generator) -> Surface:
    """Return low round bushes; rows (n, 3) are s, t and a size, 1 for 1.2 m."""
    return _grown(blob((0, 0, 0.4), (0.85, 0.85, 0.8), 0, rng), LOW_VEGETATION, rows, ground, rng)


def _grown(form: Shape, class_id: int, rows: Float64, ground: Ground, rng: np.random.Generator) -> Surface:
    size = rows[:, 2:] * rng.uniform(0.8, 1.15, size=(len(rows), 3))
    spots = np.c_[rows[:, :2], rng.uniform(0, 2 * np.pi, len(rows))]
    return ground.stand(form, class_id, spots, size, choose(LEAVES, len(rows), rng), 0.1)


def car() -> Shape:
    """Return a car 4.4 m long, 1.8 m wide, 1.45 m high; it drives along x and takes its paint as tint."""
    return combine(
        box((-2.2, 2.2), (-0.9, 0.9), (0, 0.82), taper=0.96),
        box((-1.75, 1.0), (-0.82, 0.82), (0.8, 1.4), GLASS, taper=0.76),
        box((-1.3, 0.52), (-0.62, 0.62), (1.38, 1.45)),
    )


def person() -> Shape:
    """Return a person 1.75 m high who takes the colour of their clothes as tint."""
    return combine(
        box((-0.15, 0.15), (-0.25, 0.25), (0, 1.47), taper=0.9), box((-0.11, 0.11), (-0.1, 0.1), (1.47, 1.75), SKIN)
    )
