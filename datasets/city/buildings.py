"""Buildings: walls with windows under gable, hip and flat roofs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.datasets.city.mesh import (
    BUILDING,
    CLUTTER,
    LOW_VEGETATION,
    TREE,
    Shape,
    Surface,
    blob,
    box,
    choose,
    combine,
    cone,
    moved,
    pane,
    shape,
)
from semstab.datasets.city.plots import Barrier, Building, Spot, columns
from semstab.datasets.city.terrain import Site

FOUNDATION = 2.0
"""Metres of wall below the ground in the building's middle, so that no gap opens on a slope."""

OVERHANG = 0.42
STOREY = 2.9
WALLS = np.array([[0.86, 0.83, 0.76], [0.80, 0.74, 0.62], [0.72, 0.68, 0.66], [0.63, 0.42, 0.34], [0.90, 0.89, 0.87]])
TILES = np.array([[0.58, 0.28, 0.20], [0.50, 0.25, 0.20], [0.38, 0.27, 0.24], [0.33, 0.33, 0.36], [0.64, 0.36, 0.24]])
FLAT = np.array([[0.56, 0.55, 0.54], [0.44, 0.44, 0.46], [0.66, 0.64, 0.60], [0.36, 0.37, 0.36]])
GLASS = np.array([[0.20, 0.24, 0.29]])
METAL = np.array([0.74, 0.75, 0.76])
GABLE = [[0, 1, 5, 4], [2, 3, 4, 5]]
HIP = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]]


@dataclass(frozen=True)
class _Placed:
    """Buildings as columns: middle and floor height in the world, yaw, extent; and colours."""

    position: Float64
    yaw: Float64
    size: Float64
    walls: Float64
    roofs: Float64

    def local(self, x: Float64, y: Float64, z: Float64) -> Float64:
        """Return the world points of points in the buildings' own axes; z is above the floor."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return self.position + np.stack([c * x - s * y, s * x + c * y, z], axis=-1)

    def pick(self, rows: Int64) -> _Placed:
        return _Placed(self.position[rows], self.yaw[rows], self.size[rows], self.walls[rows], self.roofs[rows])


def build(buildings: Sequence[Building], site: Site, rng: np.random.Generator) -> list[Surface]:
    """Return walls, roofs and windows of all buildings."""
    columns = np.array([b[:6] for b in buildings], dtype=np.float64)
    kind = np.array([b.roof for b in buildings])
    yaw = site.layout.heading(columns[:, 0], columns[:, 1], columns[:, 2])
    tone = rng.uniform(0.88, 1.08, size=(len(buildings), 1))
    tiles = np.where((kind == "flat")[:, None], choose(FLAT, len(kind), rng), choose(TILES, len(kind), rng))
    position = site.on(columns[:, 0], columns[:, 1])
    placed = _Placed(position, yaw, columns[:, 3:6], choose(WALLS, len(kind), rng) * tone, tiles * tone)
    foundation = np.array([0, 0, FOUNDATION])
    return [
        box().place(BUILDING, position - foundation, yaw, placed.size + foundation, placed.walls),
        *_pitched(placed.pick(np.flatnonzero(kind == "gable")), _roof(1, GABLE), rng),
        _gable_ends(placed.pick(np.flatnonzero(kind == "gable"))),
        *_pitched(placed.pick(np.flatnonzero(kind == "hip")), _roof(0.4, HIP), rng),
        *_flat_roofs(placed.pick(np.flatnonzero(kind == "flat")), rng),
        _windows(placed),
    ]


def _pitched(b: _Placed, roof: Shape, rng: np.random.Generator) -> list[Surface]:
    """Return roofs that rise with 0.75 across the ridge and stand over the walls by OVERHANG; a chimney on each."""
    zero = np.zeros(len(b.yaw))
    size = b.size + np.array([2 * OVERHANG, 2 * OVERHANG, 0])
    size[:, 2] = _rise(size[:, 1])
    eaves = b.size[:, 2] - _rise(np.full(len(zero), 2 * OVERHANG)) + 0.03
    chimney = b.local(b.size[:, 0] * rng.uniform(-0.2, 0.2, len(zero)), b.size[:, 1] * 0.13, b.size[:, 2])
    stack = np.stack([zero + 0.6, zero + 0.6, _rise(b.size[:, 1]) + 0.7], axis=1)
    return [
        roof.place(BUILDING, b.local(zero, zero, eaves), b.yaw, size, b.roofs),
        box().place(BUILDING, chimney, b.yaw, stack, b.walls * 0.7),
    ]


def _gable_ends(b: _Placed) -> Surface:
    zero = np.zeros(len(b.yaw))
    size = np.stack([b.size[:, 0], b.size[:, 1], _rise(b.size[:, 1])], axis=1)
    ends = shape([[x, y, z] for x in (-0.5, 0.5) for y, z in ((-0.5, 0), (0.5, 0), (0, 1))], [[0, 1, 2], [3, 4, 5]])
    return ends.place(BUILDING, b.local(zero, zero, b.size[:, 2]), b.yaw, size, b.walls)


def _flat_roofs(b: _Placed, rng: np.random.Generator) -> list[Surface]:
    """Return a roof surface within a parapet, and ventilators on it."""
    zero, height = np.zeros(len(b.yaw)), b.size[:, 2]
    surface = shape([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], [[0, 1, 2, 3]])
    parts = [surface.place(BUILDING, b.local(zero, zero, height + 0.04), b.yaw, b.size, b.roofs)]
    rim = 0.3
    for side in (-1, 1):
        along = np.stack([b.size[:, 0], zero + rim, zero + 0.55], axis=1)
        across = np.stack([zero + rim, b.size[:, 1], zero + 0.55], axis=1)
        x, y = (side * (b.size[:, axis] - rim) / 2 for axis in (0, 1))
        parts.append(box().place(BUILDING, b.local(zero, y, height), b.yaw, along, b.walls))
        parts.append(box().place(BUILDING, b.local(x, zero, height), b.yaw, across, b.walls))
    for _ in range(4):
        x, y = (rng.uniform(-0.38, 0.38, len(zero)) * b.size[:, axis] for axis in (0, 1))
        extent = rng.uniform([0.9, 0.9, 0.6], [2.6, 2.0, 1.7], size=(len(zero), 3))
        parts.append(box().place(BUILDING, b.local(x, y, height), b.yaw, extent, np.tile(METAL, (len(zero), 1))))
    return parts


def _windows(b: _Placed) -> Surface:
    """Return panes every 2.6 m or so along each wall and on each storey, 3 cm in front of it."""
    rows, x, y, z, turn = [], [], [], [], []
    for row, (length, width, height) in enumerate(b.size):
        floors = np.arange(max(1, int(height / STOREY))) * STOREY + 0.95
        for side, (extent, distance) in enumerate(((length, width), (width, length), (length, width), (width, length))):
            count = max(1, int(extent / 2.6))
            along = (np.arange(count) + 0.5) * extent / count - extent / 2
            u, v = (grid.ravel() for grid in np.meshgrid(along, floors))
            angle = side * np.pi / 2
            front = distance / 2 + 0.03
            rows.append(np.full(len(u), row))
            x.append(np.cos(angle) * u + np.sin(angle) * front)
            y.append(np.sin(angle) * u - np.cos(angle) * front)
            z.append(v)
            turn.append(np.full(len(u), angle))
    owner = b.pick(np.concatenate(rows))
    position = owner.local(np.concatenate(x), np.concatenate(y), np.concatenate(z))
    size = np.tile([1.25, 1.0, 1.35], (len(position), 1))
    return pane().place(BUILDING, position, owner.yaw + np.concatenate(turn), size, np.tile(GLASS, (len(position), 1)))


def _roof(ridge: float, faces: list[list[int]]) -> Shape:
    """Return the slopes of unit extent under a ridge of a length along x; their undersides are open."""
    eaves = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
    return shape([*eaves, [-ridge / 2, 0, 1], [ridge / 2, 0, 1]], faces)


def _rise(width: Float64) -> Float64:
    return 0.375 * width


# Trees, bushes, hedges and fences.

BARK = (0.33, 0.26, 0.20)
LEAVES = np.array([[0.20, 0.34, 0.12], [0.26, 0.40, 0.14], [0.17, 0.29, 0.13], [0.33, 0.41, 0.16], [0.24, 0.33, 0.20]])
NEEDLES = np.array([[0.12, 0.25, 0.15], [0.15, 0.28, 0.14]])
HEDGE = np.array([[0.22, 0.36, 0.13], [0.29, 0.40, 0.17]])
WOOD = np.array([[0.46, 0.37, 0.28], [0.60, 0.58, 0.55], [0.36, 0.29, 0.24]])
PIECE = 3.0
"""Metres of a hedge's or fence's pieces; each follows the slope under it."""


def trees(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> list[Surface]:
    """Return broad-leaved trees of six forms and, one in six, conifers; a spot's size 1 is about 9 m."""
    s, t, _, size = columns(spots)
    position = site.on(s, t)
    forms = [_broadleaf(rng) for _ in range(6)] + [_conifer()]
    form = rng.integers(len(forms), size=len(spots))
    yaw = rng.uniform(0, 2 * np.pi, len(spots))
    slim = rng.uniform(0.8, 1.15, size=(len(spots), 3)) * size[:, None]
    needles = (form == len(forms) - 1)[:, None]
    tint = np.where(needles, choose(NEEDLES, len(spots), rng), choose(LEAVES, len(spots), rng))
    tint = tint * rng.uniform(0.85, 1.15, size=(len(spots), 1))
    rows = [np.flatnonzero(form == k) for k in range(len(forms))]
    return [forms[k].place(TREE, position[r], yaw[r], slim[r], tint[r]) for k, r in enumerate(rows) if len(r)]


def bushes(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> Surface:
    """Return low round bushes, up to about 1.5 m."""
    s, t, _, size = columns(spots)
    position = site.on(s, t, -0.1)
    bush = moved(blob(0, rng, 0.18), (0, 0, 0.45), (0.85, 0.85, 0.8))
    extent = rng.uniform(0.75, 1.3, size=(len(spots), 3)) * size[:, None]
    tint = choose(HEDGE, len(spots), rng) * rng.uniform(0.8, 1.25, size=(len(spots), 1))
    return bush.place(LOW_VEGETATION, position, rng.uniform(0, 6.28, len(spots)), extent, tint)


def hedges(barriers: Sequence[Barrier], site: Site, rng: np.random.Generator) -> Surface:
    """Return hedges 0.9 m thick and about 1.4 m high."""
    return _barriers(barriers, (0.9, 1.4), LOW_VEGETATION, HEDGE, site, rng)


def fences(barriers: Sequence[Barrier], site: Site, rng: np.random.Generator) -> Surface:
    """Return fences 8 cm thick and about 1.2 m high."""
    return _barriers(barriers, (0.08, 1.2), CLUTTER, WOOD, site, rng)


def _barriers(
    barriers: Sequence[Barrier],
    profile: tuple[float, float],
    class_id: int,
    colors: Float64,
    site: Site,
    rng: np.random.Generator,
) -> Surface:
    ends = columns(barriers).T
    counts = np.maximum(1, np.ceil(np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) / PIECE)).astype(int)
    owner = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    low, span = ends[owner, :2], ends[owner, 2:] - ends[owner, :2]
    points = [low + ((number + k) / counts[owner])[:, None] * span for k in (0, 1)]
    start, stop = (np.stack(site.layout.to_world(*point.T), axis=1) for point in points)
    middle, along = (start + stop) / 2, stop - start
    size = np.concatenate([np.hypot(*along.T)[:, None] + 0.05, np.tile(profile, (len(owner), 1))], axis=1)
    size[:, 2] *= rng.uniform(0.9, 1.1, len(owner)) * rng.uniform(0.8, 1.2, len(ends))[owner]
    tint = choose(colors, len(ends), rng)[owner] * rng.uniform(0.92, 1.08, size=(len(owner), 1))
    position = site.terrain.on(middle[:, 0], middle[:, 1], -0.15)
    lean = site.terrain.slope(middle[:, 0], middle[:, 1])
    return box().place(class_id, position, np.arctan2(along[:, 1], along[:, 0]), size, tint, lean)


def _broadleaf(rng: np.random.Generator) -> Shape:
    """Return a trunk and a crown of one large and three smaller dented balls; 9 m high, 6 to 7 m wide."""
    crown = [moved(blob(1, rng, 0.16), (0, 0, 5.6), (2.9, 2.9, 3.1))]
    for angle in rng.uniform(0, 0.8) + np.arange(3) * 2.1:
        reach, z, radius = rng.uniform(1.3, 2.0), rng.uniform(4.6, 6.8), rng.uniform(1.5, 2.0)
        centre = (reach * np.cos(angle), reach * np.sin(angle), z)
        crown.append(moved(blob(0, rng, 0.14), centre, (radius, radius, radius * 0.9)))
    return combine(cone(6, (-0.3, 4.0), (0.28, 0.2), color=BARK), *crown)


def _conifer() -> Shape:
    """Return a trunk under three stacked cones; 11 m high."""
    tiers = [cone(9, (z, z + h), (r, 0.02)) for z, h, r in ((1.4, 4.6, 2.3), (4.2, 4.2, 1.75), (7.0, 4.0, 1.15))]
    return combine(cone(6, (-0.3, 2.0), (0.25, 0.22), color=BARK), *tiers)
