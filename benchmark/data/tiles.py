"""A map by its tiles: the tiles that hold some voxels, and the voxels of a region, a few tiles in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from semstab.core.prefetch import SizedCache
from semstab.core.types import Float64, Int64
from semstab.data import parquet
from semstab.data.events import Events
from semstab.data.voxels import VoxelTable

AT_HAND = 1 << 22
"""Voxels of tiles that stay in memory."""

TileIndex = tuple[int, int]


T = TypeVar("T", VoxelTable, Events)


class Tiles(Generic[T]):
    """The tiles of a map, or of its log, by index; a map in a single file has one, which holds all.

    Attributes:
        size: Edge of a tile in voxels, None for that one.
        voxel_size: Metres.
    """

    def __init__(self, load: Mapping[TileIndex, Callable[[], T]], size: int | None, voxel_size: float) -> None:
        self.size, self.voxel_size = size, voxel_size
        self._load: Mapping[TileIndex, Callable[[], T]] = load
        self._tables: SizedCache[TileIndex, T] = SizedCache(lambda tile: self._load[tile](), len, AT_HAND)

    @classmethod
    def open(cls, path: str | Path, kind: type[T]) -> Tiles[T]:
        """Open a file, or a folder of tiles.

        Raises:
            DataError: If it is damaged.
        """
        files = parquet.files_of(path)
        voxel_size = parquet.voxel_size_of(files[0])
        if not Path(path).is_dir():
            return cls({(0, 0): partial(kind.load, files[0])}, None, voxel_size)
        tiles = {file: parquet.tile_of(file) for file in files}
        load = {(tile.x, tile.y): partial(kind.load, file) for file, tile in tiles.items()}
        return cls(load, tiles[files[0]].size, voxel_size)

    @classmethod
    def from_table(cls, table: T) -> Tiles[T]:
        """Return a table as the one tile of its map."""
        return cls({(0, 0): lambda: table}, None, table.voxel_size)

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._load)

    def __getitem__(self, tile: TileIndex) -> T:
        return self._tables[tile]

    def holding(self, points: Float64) -> Iterator[tuple[TileIndex, Int64]]:
        """Yield the tiles in which some of these points (n, 3) lie, metres, with the rows (m,) of these."""
        if self.size is None:
            yield (0, 0), np.arange(len(points))
            return
        index = np.floor(points[:, :2] / self.voxel_size).astype(np.int64)
        tiles, of = np.unique(index // self.size, axis=0, return_inverse=True)
        order = np.argsort(of.ravel(), kind="stable")
        rows = np.split(order, np.cumsum(np.bincount(of.ravel(), minlength=len(tiles)))[:-1])
        for (x, y), tile_rows in zip(tiles.tolist(), rows, strict=True):
            if (x, y) in self._load:
                yield (x, y), tile_rows

    def region(self, tile: TileIndex, size: int) -> T:
        """Return the voxels of a wider tile of that size, a multiple of the own one."""
        if self.size is None:
            table = self[0, 0]
            return table.rows(np.flatnonzero((table.ix // size == tile[0]) & (table.iy // size == tile[1])))
        inside = [index for index in self if self._in_wider(index, size) == tile]
        first = self[next(iter(self))] if not inside else self[inside[0]]
        return type(first).joined([self[index] for index in inside]) if inside else first.rows(np.zeros(0, np.int64))

    def wider(self, size: int) -> set[TileIndex]:
        """Return the wider tiles of that size that hold a voxel."""
        if self.size is not None:
            return {self._in_wider(tile, size) for tile in self}
        table = self[0, 0]
        pairs = np.unique(np.stack([table.ix // size, table.iy // size], axis=1), axis=0)
        return {(x, y) for x, y in pairs.tolist()}

    def _in_wider(self, tile: TileIndex, size: int) -> TileIndex:
        assert self.size is not None
        return tile[0] * self.size // size, tile[1] * self.size // size


def side_by_side(maps: Sequence[Tiles[Any]]) -> Iterator[tuple[Any, ...]]:
    """Yield the voxels of several maps region by region, by the widest of their tiles.

    Maps in single files are yielded at once.
    """
    sizes = [tiled_map.size for tiled_map in maps if tiled_map.size is not None]
    if not sizes:
        yield tuple(tiled_map[0, 0] for tiled_map in maps)
        return
    size = max(sizes)
    for tile in sorted({tile for tiled_map in maps for tile in tiled_map.wider(size)}):
        yield tuple(tiled_map.region(tile, size) for tiled_map in maps)
