"""The things of a town: buildings, trees, cars and people, each placed many times on the ground."""

from __future__ import annotations

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.city.ground import Ground
from semstab.datasets.city.mesh import BUILDING, TREE, TriangleSurface, blob, box, join, surface

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


def choose(colors: Float64, count: int, rng: np.random.Generator) -> Float64:
    """Return (count, 3) colours, drawn at random from a few, some lighter and some darker."""
    return np.asarray(colors[rng.integers(len(colors), size=count)] * rng.uniform(0.88, 1.12, size=(count, 1)))


def houses(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[TriangleSurface]:
    """Return buildings under hip roofs; rows (n, 5) are s, t, and the extent along s, along t, and up to the eaves."""
    eaves = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0], [-0.2, 0, 1], [0.2, 0, 1]])
    roof = surface(eaves, [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]], BUILDING)
    size = np.stack([rows[:, 2] + 0.8, rows[:, 3] + 0.8, 0.4 * rows[:, 3]], axis=1)
    return _buildings(rows, roof, size, TILES, ground, rng)


def flats(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[TriangleSurface]:
    """Return buildings under flat roofs; rows (n, 5) are as for houses."""
    size = np.stack([rows[:, 2] - 1, rows[:, 3] - 1, np.full(len(rows), 0.5)], axis=1)
    return _buildings(rows, box(BUILDING), size, FELT, ground, rng)


def _buildings(
    rows: Float64, roof: TriangleSurface, size: Float64, roofing: Float64, ground: Ground, rng: np.random.Generator
) -> list[TriangleSurface]:
    """Return walls, roofs of a size, and a band of windows 3 cm in front of the walls on each storey."""
    foundation, spots = np.array([0, 0, FOUNDATION]), np.concatenate([rows[:, :2], np.zeros((len(rows), 1))], axis=1)
    walls, tiles = choose(WALLS, len(rows), rng), choose(roofing, len(rows), rng)
    top = ground.points(*rows[:, :2].T) + np.array([0, 0, 1]) * rows[:, 4:]
    surfaces = [
        ground.stand(box(BUILDING), spots, rows[:, 2:] + foundation, walls, -FOUNDATION),
        roof.place(top, np.full(len(rows), ground.yaw), size, tiles),
    ]
    for floor in range(int(rows[:, 4].max(initial=0) / STOREY)):
        k = rows[:, 4] >= (floor + 1) * STOREY
        band = rows[k, 2:] * [1, 1, 0] + [0.06, 0.06, 1.3]
        surfaces.append(ground.stand(box(BUILDING, color=GLASS), spots[k], band, walls[k], floor * STOREY + 1))
    return surfaces


def trees(rows: Float64, ground: Ground, rng: np.random.Generator) -> list[TriangleSurface]:
    """Return trees of four forms; rows (n, 3) are s, t and a size, 1 for 9 m."""
    surfaces = []
    for form_rows in np.array_split(rows, 4):
        parts = [box(TREE, (-0.25, 0.25), (-0.25, 0.25), (-0.5, 4), color=BARK)]
        parts += [blob(TREE, (0, 0, 5.6), (2.9, 2.9, 3.1), 1, rng)]
        for _ in range(3):
            centre = (*rng.uniform(-1.7, 1.7, 2), rng.uniform(4.6, 6.8))
            parts.append(blob(TREE, centre, rng.uniform(1.5, 2), 0, rng))
        size = form_rows[:, 2:] * rng.uniform(0.8, 1.15, size=(len(form_rows), 3))
        spots = np.c_[form_rows[:, :2], rng.uniform(0, 2 * np.pi, len(form_rows))]
        surfaces.append(ground.stand(join(parts), spots, size, choose(LEAVES, len(form_rows), rng), 0.1))
    return surfaces


def car(class_id: int) -> TriangleSurface:
    """Return a car 4.4 m long, 1.8 m wide, 1.45 m high; it drives along x and takes its paint as tint."""
    return join([
        box(class_id, (-2.2, 2.2), (-0.9, 0.9), (0, 0.82), taper=0.96),
        box(class_id, (-1.75, 1.0), (-0.82, 0.82), (0.8, 1.4), color=GLASS, taper=0.76),
        box(class_id, (-1.3, 0.52), (-0.62, 0.62), (1.38, 1.45)),
    ])  # fmt: skip


def person(class_id: int) -> TriangleSurface:
    """Return a person 1.75 m high who takes the colour of their clothes as tint."""
    body = box(class_id, (-0.15, 0.15), (-0.25, 0.25), (0, 1.47), taper=0.9)
    return join([body, box(class_id, (-0.11, 0.11), (-0.1, 0.1), (1.47, 1.75), color=SKIN)])
