"""Who fuses which tiles: rectangles of them, so that few frames are decoded for two, each small enough for a task."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.engine.tiling.sights import Sights
from semstab.model.voxels import Extent

ROOM = 4
"""A tile takes at most that part of what a task may take, where its size is not given."""

UNEVEN = 0.2
"""A rectangle is cut no further from where both sides weigh the same, as a share of it: strips have long edges."""

Cost = Callable[[float, float], float]
"""Bytes of a map of so many voxels and observations."""


@dataclass(frozen=True)
class Part:
    """Tiles that one task fuses: its voxels are in no other part.

    extent  of its tiles together
    size    edge of a tile, voxels
    frames  indices of those that see it, in order
    voxels  how many it will have, as estimated
    """

    extent: Extent
    size: int
    frames: tuple[int, ...]
    voxels: int

    @property
    def name(self) -> str:
        """The size of its tiles, and its corners in them: X_Y, or X_Y-X_Y of the first and the last one."""
        (x0, y0), (x1, y1) = ((x // self.size, y // self.size) for x, y in (self.extent.low, self.extent.high))
        first, last = f"{x0}_{y0}", f"{x1 - 1}_{y1 - 1}"
        return f"tiles{self.size}_" + (first if first == last else f"{first}-{last}")


@dataclass(frozen=True, eq=False)
class Tiling:
    """All parts of a unit's map.

    tiles   what frames see of each tile, weight (c,) bytes that each is expected to take
    budget  bytes that a part may take
    parts   of tiles
    """

    tiles: Sights
    weight: Float64
    budget: float
    parts: tuple[Part, ...]

    @property
    def size(self) -> int:
        """Edge of a tile, voxels."""
        return self.tiles.size

    @property
    def origin(self) -> tuple[int, int, int]:
        """Voxel of the first camera."""
        x, y, z = self.tiles.origin.tolist()
        return x, y, z

    @property
    def decodes(self) -> int:
        """How many frames the parts will read together."""
        return sum(len(part.frames) for part in self.parts)

    def bytes(self, part: Part) -> float:
        """That a part is expected to take."""
        return float(self.weight[self._rows(part)].sum())

    def halves(self, part: Part) -> tuple[Part, ...]:
        """A part in two, always the same ones; none where it is a single tile."""
        rows = self._rows(part)
        weight = self.weight[rows] + 1  # more may have come of a tile for which nothing was expected
        cut = _best_cut(self.tiles, rows, 2 * weight / weight.sum())
        return () if cut is None else tuple(_part(self.tiles, some) for some in cut.sides(self.tiles, rows))

    def _rows(self, part: Part) -> Int64:
        return np.flatnonzero(part.extent.holds(self.tiles.place.T * self.size))


def tiled(sights: Sights, cost: Cost, budget: float, size: int | None = None, least: int = 1) -> Tiling:
    """The parts of what frames see, each within the budget as far as tiles of that size allow it.

    size   edge of a tile, voxels, a power of 2; where none is given, the largest that leaves room
    least  so many parts at least, if there are as many tiles
    """
    if size is None:
        size = tile_size(sights, cost, budget / ROOM)
    tiles = sights.in_tiles(max(size, sights.size))
    total = cost(float(tiles.voxels.sum()), float(tiles.observations.sum()))
    budget = min(budget, 1.1 * total / least)
    weight = np.array([cost(*own) for own in zip(tiles.voxels, tiles.observations, strict=True)], dtype=np.float64)
    parts = (_part(tiles, rows) for rows in _split(tiles, weight, budget))
    return Tiling(tiles, weight, budget, tuple(part for part in parts if part.frames))


def tile_size(sights: Sights, cost: Cost, budget: float) -> int:
    """The largest power of 2 whose most crowded tile is within the budget, but no more than one tile for all."""
    size, tiles = sights.size, sights
    while len(tiles.place) > 1:
        tiles = tiles.in_tiles(2 * tiles.size)
        most = int(np.argmax(tiles.voxels)) if len(tiles.place) else 0
        if cost(tiles.voxels[most], tiles.observations[most]) > budget:
            break
        size = tiles.size
    return size


def _split(tiles: Sights, weight: Float64, budget: float) -> Iterator[Int64]:
    """Rows of tiles by rectangle, each within the budget as far as there is something to cut."""
    waiting = [np.arange(len(tiles.place))]
    while waiting:
        rows = waiting.pop()
        if weight[rows].sum() <= budget or (cut := _best_cut(tiles, rows, weight[rows] / budget)) is None:
            yield rows
        else:
            waiting += reversed(cut.sides(tiles, rows))


@dataclass(frozen=True, order=True)
class _Cut:
    """Of a rectangle of tiles across an axis, before the tiles at that coordinate; the least is the best.

    parts  that the two sides will come to
    twice  frames that see both sides, and will be decoded for either
    """

    parts: int
    uneven: bool
    twice: int
    imbalance: float
    axis: int
    at: int

    def sides(self, tiles: Sights, rows: Int64) -> tuple[Int64, ...]:
        """Rows of the tiles below, and of those above."""
        below = tiles.place[rows, self.axis] < self.at
        return rows[below], rows[~below]


def _best_cut(tiles: Sights, rows: Int64, weight: Float64) -> _Cut | None:
    """Where the rectangle of these tiles, whose weight is in parts, is cut; None where it is one tile."""
    place = tiles.place[rows]
    inside = ((tiles.cell >= place.min(axis=0)) & (tiles.cell <= place.max(axis=0))).all(axis=1)
    frame, cell = tiles.frame[inside], tiles.cell[inside]  # sorted by frame
    first = np.flatnonzero(np.diff(frame, prepend=-1))
    total, found = weight.sum(), []
    for axis in (0, 1):
        low = np.minimum.reduceat(cell[:, axis], first) if len(first) else first
        high = np.maximum.reduceat(cell[:, axis], first) if len(first) else first
        values, of = np.unique(place[:, axis], return_inverse=True)
        below = np.cumsum(np.bincount(of, weights=weight))[:-1]
        for at, part in zip(values[1:].tolist(), below.tolist(), strict=True):
            twice = int(np.count_nonzero((low < at) & (high >= at)))
            parts = math.ceil(part) + math.ceil(total - part)
            imbalance = abs(part / total - 0.5)
            found.append(_Cut(parts, imbalance > UNEVEN, twice, imbalance, axis, at))
    return min(found, default=None)


def _part(tiles: Sights, rows: Int64) -> Part:
    place, (x, y, z) = tiles.place[rows], tiles.origin.tolist()
    low, high = place.min(axis=0), place.max(axis=0) + 1
    inside = ((tiles.cell >= low) & (tiles.cell < high)).all(axis=1)
    frames = np.unique(tiles.frame[inside])
    corner, end = (tuple(int(edge) * tiles.size for edge in edges) for edges in (low, high))
    return Part(
        Extent((corner[0], corner[1]), (end[0], end[1]), (x, y, z)),
        tiles.size,
        tuple(frames.tolist()),
        round(float(tiles.voxels[rows].sum())),
    )
