"""Write the map from above as GeoTIFF, with bands of classes and measures, and the voxels as a mesh (GLB)."""

from __future__ import annotations

import functools
import logging
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import atomic_path, not_written
from semstab.core.types import Float64, Int64
from semstab.data.georeference import INSTALL
from semstab.data.information import normalise
from semstab.data.tiles import TileIndex
from semstab.data.topdown import covered, level_axes
from semstab.errors import ConfigError, MissingDependencyError
from semstab.exports.voxels import ExportedUnit, ExportedVoxels, VoxelColumn, together
from semstab.metrics import CATEGORIES, categories

RASTER_MEASURES = ("vss", "entropy", "op")
"""The bands of measures by default."""

MOST_CELLS = 10**10
"""The most cells of a raster."""

WINDOW = 1024
"""The cells along a side of a window that is written at a time: whole blocks of the file."""

STABLE = len(CATEGORIES) - 1


def write_raster(chosen: ExportedUnit, path: Path, cell: int = 1) -> int:
    """Write FILE.tif with bands in single precision (NaN: no voxel), and FILE.class.tif with classes and their colours.

    A cell is `cell` voxels wide. Its class is that of the summed belief of the topmost voxels of its columns, each
    measure their mean, height the highest one's centre; the share of stable voxels is that of all voxels below as well.
    It is written window by window; only the tiles that a window shows are in memory. Returns the number of voxels.

    Raises:
        ConfigError: If the up axis is not known or the raster would be too large.
        MissingDependencyError: If rasterio is not installed.
    """
    try:
        import rasterio  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(f"{path}: .tif needs rasterio; {INSTALL}") from error
    part, windows, voxels = chosen.first, {}, 0
    for tile in chosen.tiles():
        windows[tile] = _window(chosen[tile], cell)
        voxels += len(chosen[tile].table)
    extent = _fitting(functools.reduce(Window.around, windows.values()))
    grid, names = _grid(part, extent, cell), _names(part)
    few = len(part.classes) < 2**8
    with (
        atomic_path(path) as temporary,
        atomic_path(path.with_suffix(f".class{path.suffix}")) as temporary_classes,
        _raster(temporary, count=len(names), dtype="float32", nodata=np.nan, predictor=3, **grid) as measures,
        _raster(temporary_classes, count=1, dtype="uint8" if few else "uint16", nodata=0, **grid) as classes,
    ):
        for window in extent.parts():
            parts = [chosen[tile] for tile, tile_window in windows.items() if tile_window.meets(window)]
            bands = _bands(together(parts), cell, window) if parts else {}
            nothing = np.full(window.shape, np.nan, np.float32)
            values = {name: bands[name].values if bands else nothing for name in names}
            _write_window(measures, classes, values, window.within(extent))
        _describe_measures(measures.raster, part)
        _describe_classes(classes.raster, part)
    return voxels


def _names(part: ExportedVoxels) -> tuple[str, ...]:
    """Return the names of the bands of measures."""
    return ("class", *part.columns, "stable", "height")


def _grid(part: ExportedVoxels, extent: Window, cell: int) -> dict[str, Any]:
    """Return where the cells of a raster lie, and how they are stored."""
    import rasterio

    edge, (west, north) = cell * part.table.voxel_size, _corner(part, extent, cell)
    height, width = extent.shape
    return {
        "driver": "GTiff", "width": width, "height": height,
        "transform": rasterio.Affine(edge, 0, west, 0, -edge, north),
        "crs": None if part.georeference is None else rasterio.crs.CRS.from_wkt(part.georeference.crs),
        "compress": "deflate", "tiled": True, "blockxsize": 256, "blockysize": 256, "bigtiff": "if_safer",
    }  # fmt: skip


def _write_window(measures: _Raster, classes: _Raster, values: Mapping[str, npt.NDArray[Any]], window: Any) -> None:
    """Write the bands of a window, the classes into the file of their colours, too."""
    for number, band in enumerate(values.values(), start=1):
        measures.write(band, number, window)
    kind = classes.raster.dtypes[0]
    classes.write(np.nan_to_num(values["class"], nan=0).astype(kind), 1, window)


def _describe_measures(raster: Any, part: ExportedVoxels) -> None:
    """Say what the bands are, and the classes by number."""
    for number, (name, unit, about) in enumerate(_abouts(part), start=1):
        raster.set_band_description(number, name)
        raster.set_band_unit(number, unit)
        raster.update_tags(number, about=about)
    raster.update_tags(1, **_legend(part))
    if part.benchmark:
        raster.update_tags(benchmark=part.benchmark)


def _describe_classes(raster: Any, part: ExportedVoxels) -> None:
    """Say which classes the numbers mean, and their colours."""
    if part.benchmark:
        raster.update_tags(benchmark=part.benchmark)
    raster.write_colormap(1, {0: (0, 0, 0, 0)} | {k: (*map(int, c), 255) for k, c in enumerate(part.colors, start=1)})
    raster.set_band_description(1, "class")
    raster.update_tags(1, **_legend(part))


def _legend(part: ExportedVoxels) -> dict[str, str]:
    return {str(k): name for k, name in enumerate(("unclassified", *part.classes))}


@dataclass
class _Raster:
    """A raster that is written, and the checksum of each window of each band."""

    raster: Any
    sums: list[tuple[int, Any, int]] = field(default_factory=list)

    def write(self, values: npt.NDArray[Any], band: int, window: Any) -> None:
        """Write a window of a band."""
        self.raster.write(values, band, window=window)
        self.sums.append((band, window, zlib.crc32(np.ascontiguousarray(values).data)))


@contextmanager
def _raster(path: Path, **profile: Any) -> Iterator[_Raster]:
    """Create a raster, which is read again at the end: GDAL reports no full disk.

    Raises:
        OSError: If it does not hold what was written.
    """
    import rasterio

    logging.getLogger("rasterio").addHandler(logging.NullHandler())  # its lines about the disk; the error says it
    try:
        with rasterio.open(path, "w", **profile) as file:
            written = _Raster(file)
            yield written
            names = file.descriptions
        with rasterio.open(path) as file:
            complete = file.descriptions == names and all(
                zlib.crc32(np.ascontiguousarray(file.read(band, window=window)).data) == checksum
                for band, window, checksum in written.sums
            )
    except rasterio.errors.RasterioError as error:
        raise not_written() from error
    if not complete:
        raise not_written()


@dataclass(frozen=True)
class Window:
    """The cells of the plane with low <= (ahead, right) <= high."""

    low: tuple[int, int]
    high: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns."""
        return self.high[0] - self.low[0] + 1, self.high[1] - self.low[1] + 1

    def around(self, other: Window) -> Window:
        """Return the smallest that holds both."""
        low, high = (
            tuple(map(extreme, *ends))
            for extreme, ends in ((min, (self.low, other.low)), (max, (self.high, other.high)))
        )
        return Window((low[0], low[1]), (high[0], high[1]))

    def meets(self, other: Window) -> bool:
        """Return whether they share a cell."""
        return all(self.low[k] <= other.high[k] and other.low[k] <= self.high[k] for k in (0, 1))

    def within(self, whole: Window) -> Any:
        """Return it as rasterio's window of the pixels of a raster."""
        from rasterio.windows import Window as Pixels

        return Pixels(self.low[1] - whole.low[1], whole.high[0] - self.high[0], *reversed(self.shape))

    def parts(self) -> Iterator[Window]:
        """Yield windows that make it up, WINDOW cells a side, from the farthest row on, as files have their blocks."""
        for last in range(self.high[0], self.low[0] - 1, -WINDOW):
            for first in range(self.low[1], self.high[1] + 1, WINDOW):
                low = max(self.low[0], last - WINDOW + 1), first
                yield Window(low, (last, min(self.high[1], first + WINDOW - 1)))


def seen_from_above(voxels: ExportedVoxels, cell: int = 1) -> tuple[Mapping[str, VoxelColumn], float, float]:
    """Return the bands (H, W) float32 by name, first row the farthest ahead, and the coordinates of their corner."""
    extent = _fitting(_window(voxels, cell))
    return _bands(voxels, cell, extent), *_corner(voxels, extent, cell)


def _axes(voxels: ExportedVoxels) -> tuple[Float64, Float64, Float64]:
    if voxels.up is None:
        raise ConfigError("the up direction is not known; set up_axis of the dataset, and run again")
    return level_axes(voxels.up)


def _covered(voxels: ExportedVoxels) -> tuple[Int64, Int64]:
    """Return the cells (m, 2) of one voxel's width, and the voxel (m,) that covers each."""
    right, ahead, above = _axes(voxels)
    table, laid = voxels.table, voxels.laid
    plane = np.stack([laid @ ahead, laid @ right], axis=1)
    if voxels.georeference is not None and voxels.georeference.turned:
        return _covered_by_turned(plane, voxels.linear[1::-1, 1::-1], table.voxel_size)
    return covered(plane, above, table.voxel_size, table.voxel_size)


def _covered_by_turned(plane: Float64, axes: Float64, edge: float) -> tuple[Int64, Int64]:
    """Return the cells (m, 2) under voxels whose sides are not along the raster's, and the voxel (m,) that covers each.

    A voxel covers the cell that its centre lies in, and those whose centres lie under it: by the first no voxel is
    lost, by the second there are no gaps between neighbours.

    Args:
        plane: (n, 2) centres.
        axes: (2, 2) from the scene's level axes to the raster's.
        edge: Edge of a cell and of a voxel, in the unit of `plane`.
    """
    base, to_scene, rows = np.floor(plane / edge).astype(np.int64), np.linalg.inv(axes).T, np.arange(len(plane))
    cells, covering = [base], [rows]
    for step in np.ndindex(3, 3):
        cell = base + (np.array(step) - 1)
        offset = ((cell + 0.5) * edge - plane) @ to_scene
        under = ((offset >= -edge / 2) & (offset < edge / 2)).all(axis=1) & (cell != base).any(axis=1)
        cells.append(cell[under])
        covering.append(rows[under])
    return np.concatenate(cells), np.concatenate(covering)


def _window(voxels: ExportedVoxels, cell: int) -> Window:
    """Return the cells that voxels cover."""
    cells = _covered(voxels)[0] // cell
    (low, first), (high, last) = cells.min(axis=0).tolist(), cells.max(axis=0).tolist()
    return Window((low, first), (high, last))


def _fitting(window: Window) -> Window:
    """Return the window.

    Raises:
        ConfigError: If it has too many cells for a raster.
    """
    H, W = window.shape
    if H * W > MOST_CELLS:
        raise ConfigError(f"the raster would have {W} x {H} cells; choose larger ones with --cell, or fewer voxels")
    return window


def _corner(voxels: ExportedVoxels, extent: Window, cell: int) -> tuple[float, float]:
    """Return the coordinates west and north of a raster of these cells."""
    (right, ahead, _), edge = _axes(voxels), cell * voxels.table.voxel_size
    west, north = extent.low[1] * edge + voxels.offset @ right, (extent.high[0] + 1) * edge + voxels.offset @ ahead
    return float(west), float(north)


def _abouts(voxels: ExportedVoxels) -> Iterator[tuple[str, str, str]]:
    """Yield name, unit and explanation of each band."""
    yield "class", "", "1 to K, of the topmost voxels"
    for name, column in voxels.columns.items():
        yield name, column.unit, f"{column.about}, mean of the topmost voxels"
    yield "stable", "", "share of stable voxels, of all of the column"
    yield "height", "m", "of the topmost voxel's centre"


def _bands(voxels: ExportedVoxels, cell: int, window: Window) -> Mapping[str, VoxelColumn]:
    """Return the bands of a window, by the voxels of the tiles that it shows."""
    fine, rows = _covered(voxels)
    inside = ((fine // cell >= window.low) & (fine // cell <= window.high)).all(axis=1)
    fine, rows = fine[inside], rows[inside]
    cells, (H, W), (_, _, above) = fine // cell, window.shape, _axes(voxels)
    height = voxels.points @ above
    top = _topmost(fine, height[rows])
    flat = (window.high[0] - cells[:, 0]) * W + cells[:, 1] - window.low[1]
    over, all_cells = _Cells(flat[top], rows[top], (H, W)), _Cells(flat, rows, (H, W))
    belief = np.stack([over.mean(part) for part in normalise(voxels.table.evidence).T])
    label = np.where(over.empty, np.nan, np.nan_to_num(belief).argmax(axis=0) + 1.0)
    stable = (categories(voxels.table) == STABLE).astype(np.float64)
    values = {"class": label, **{name: over.mean(column.values) for name, column in voxels.columns.items()}}
    values |= {"stable": all_cells.mean(stable), "height": over.highest(height)}
    return {name: VoxelColumn(values[name].astype(np.float32), unit, about) for name, unit, about in _abouts(voxels)}


class _Cells:
    """The voxels (m,) in the cells (m,) of a raster, counted row by row."""

    def __init__(self, flat: Int64, rows: Int64, shape: tuple[int, int]) -> None:
        self._at, self._rows, self._shape = flat, rows, shape
        self.empty = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape) == 0

    def mean(self, values: npt.NDArray[Any]) -> Float64:
        """Return the mean (H, W) of values (n,) of the voxels; NaN for a column without defined values."""
        taken = values[self._rows].astype(np.float64)
        defined, n = ~np.isnan(taken), self.empty.size
        total = np.bincount(self._at[defined], taken[defined], minlength=n)
        with np.errstate(invalid="ignore"):
            mean: Float64 = (total / np.bincount(self._at[defined], minlength=n)).reshape(self._shape)
        return mean

    def highest(self, values: Float64) -> Float64:
        """Return the largest of values (n,) of the voxels (H, W); NaN for a column without defined values."""
        most = np.full(self.empty.size, -np.inf)
        np.maximum.at(most, self._at, values[self._rows])
        return np.where(np.isinf(most), np.nan, most).reshape(self._shape)


def _topmost(cells: Int64, height: Float64) -> Int64:
    """Return the positions of the highest entry of each cell (m, 2)."""
    order = np.lexsort((height, cells[:, 1], cells[:, 0]))
    last = np.append((np.diff(cells[order], axis=0) != 0).any(axis=1), True)
    topmost: Int64 = order[last]
    return topmost


# GLB shows the voxels as cubes in the colours of their classes, in a browser.

SIDES = np.array([
    [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]], [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
    [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
    [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
])  # fmt: skip
"""The corners (6, 4, 3) of a cube's sides, anticlockwise from outside: +x, -x, +y, -y, +z, -z."""

NEIGHBOURS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
MOST_SPANNED = 2**40
"""The most cells that the voxels of a tile may span: corners are packed into one number."""

MOST_BYTES = 2**31
"""The most bytes of the meshes of a file: glTF counts in 32 bits, and trimesh makes a file in memory."""


def write_mesh(chosen: ExportedUnit, path: Path) -> int:
    """Write the sides of voxels that no other voxel hides, a mesh for each tile; return the number of voxels.

    glTF is in single precision: coordinates count from `origin`, and the scene's extras say where that is. glTF's y is
    up, where the scene's up axis is known.

    Raises:
        ConfigError: If the voxels span too much, or are too many for a file.
    """
    import trimesh

    corners = {tile: chosen[tile].table.index.min(axis=0).astype(np.int64) for tile in chosen.tiles()}
    first, low = chosen.first, np.min([*corners.values()], axis=0)
    extras = {
        "origin": (first.linear @ (low * first.table.voxel_size) + first.offset).tolist(),
        "coordinates": "the scene" if first.georeference is None else first.georeference.name,
        "voxel_size": first.table.voxel_size,
        "classes": list(first.classes),
        "benchmark": first.benchmark,
    }
    scene: Any = trimesh.Scene(metadata=extras)
    voxels, size, to_gltf = 0, 0, first.table.voxel_size * (_to_gltf(first.up) @ first.linear).T
    for tile in corners:
        part = chosen[tile]
        voxels += len(part.table)
        corner, label, quads = _sides(
            part.table.index - low, part.classified.astype(np.int64) - 1, _adjacent(chosen, tile) - low
        )
        if not len(quads):
            continue
        size += 16 * len(corner) + 24 * len(quads)
        if size > MOST_BYTES:
            raise ConfigError("the mesh would be larger than 2 GB; select fewer voxels with --class, --min-op")
        scene.add_geometry(
            trimesh.Trimesh(
                (corner @ to_gltf).astype(np.float32),
                np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint32),
                vertex_colors=first.colors[label],
                process=False,
            )
        )
    with atomic_path(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb"))
    return voxels


def _adjacent(chosen: ExportedUnit, tile: TileIndex) -> Int64:
    """Return the voxels (n, 3) of the tiles around one that may touch it."""
    adjacent, size = [np.zeros((0, 3), np.int64)], chosen.size
    for (dx, dy), axis, edge in (((1, 0), 0, 0), ((-1, 0), 0, -1), ((0, 1), 1, 0), ((0, -1), 1, -1)):
        other = tile[0] + dx, tile[1] + dy
        if size is not None and other in chosen:
            index = chosen[other].table.index.astype(np.int64)
            adjacent.append(index[index[:, axis] % size == edge % size])
    return np.concatenate(adjacent)


def _sides(index: Int64, label: Int64, adjacent: Int64) -> tuple[Int64, Int64, Int64]:
    """Return corners (v, 3) with their class (v,), and the sides (m, 4) between them, that are not between two voxels.

    Args:
        index: (n, 3) voxels.
        label: (n,) their classes.
        adjacent: (b, 3) voxels that hide sides, and have none here.
    """
    low = index.min(axis=0) - 1
    size = index.max(axis=0) - low + 3  # a margin of one cell gives every neighbour a key
    if int(np.prod(size.astype(object))) >= MOST_SPANNED:
        raise ConfigError(
            f"the voxels span {' x '.join(map(str, size))}: too much for a mesh; select fewer with --class, --min-op"
        )
    step = np.array([size[1] * size[2], size[2], 1])
    near = adjacent[((adjacent >= low) & (adjacent < low + size)).all(axis=1)]
    keys, hiding = (index - low) @ step, (np.concatenate([index, near]) - low) @ step
    K, parts = int(label.max()) + 1, []
    for side, neighbour in zip(SIDES, NEIGHBOURS, strict=True):
        open_ = ~np.isin(keys + neighbour @ step, hiding)
        corner = (index[open_][:, None] - low + side) @ step
        parts.append(corner * K + label[open_][:, None])
    packed, quads = np.unique(np.concatenate(parts), return_inverse=True)
    return np.stack(np.unravel_index(packed // K, tuple(size)), axis=1) + low, packed % K, quads.reshape(-1, 4)


def _to_gltf(up: tuple[float, float, float] | None) -> Float64:
    """Return (3, 3) from the scene's axes to glTF's: x right, y up, z towards the viewer."""
    if up is None:
        return np.eye(3)
    right, ahead, above = level_axes(up)
    return np.stack([right, above, -ahead])
