"""GeoTIFF: the map from above, with a band of classes and one of each measure; and the classes in their colours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, MissingDependencyError
from semstab.metrics import CATEGORIES, categories
from semstab.model.georeference import INSTALL
from semstab.model.information import normalise
from semstab.outputs.export.voxels import Column, Voxels
from semstab.outputs.plots.topdown import covered, level_axes
from semstab.runtime.files import atomic_path

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

MEASURES = ("vss", "entropy", "op")
"""The bands of measures where none is chosen."""

LARGEST = 10**8
"""Cells of a raster."""

STABLE = len(CATEGORIES) - 1


def write(voxels: Voxels, path: Path, cell: int = 1) -> None:
    """FILE.tif with bands in single precision (NaN: no voxel), and FILE.class.tif with the classes and their colours.

    A cell is `cell` voxels wide. Its class is that of the summed belief of the topmost voxels of its columns, each
    measure their mean, height the highest one's centre; the share of stable voxels is that of all voxels below as well.
    Raises ConfigError where the up axis is not known or the raster would be too large, MissingDependencyError.
    """
    try:
        import rasterio
        from rasterio import Affine
    except ImportError as error:
        raise MissingDependencyError(f"{path}: .tif needs rasterio; {INSTALL}") from error
    bands, west, north = seen_from_above(voxels, cell)
    edge = cell * voxels.table.voxel_size
    height, width = bands["class"].values.shape
    shape: dict[str, Any] = {
        "driver": "GTiff", "width": width, "height": height, "transform": Affine(edge, 0, west, 0, -edge, north),
        "crs": None if voxels.georeference is None else rasterio.crs.CRS.from_wkt(voxels.georeference.crs),
        "compress": "deflate", "tiled": True, "blockxsize": 256, "blockysize": 256,
    }  # fmt: skip
    legend = {str(k): name for k, name in enumerate(("unclassified", *voxels.classes))}
    many: dict[str, Any] = {"count": len(bands), "dtype": "float32", "nodata": np.nan, "predictor": 3}
    with atomic_path(path) as temporary, rasterio.open(temporary, "w", **many, **shape) as file:
        for number, (name, band) in enumerate(bands.items(), start=1):
            file.write(band.values, number)
            file.set_band_description(number, name)
            file.set_band_unit(number, band.unit)
            file.update_tags(number, about=band.about)
        file.update_tags(1, **legend)
    classes = np.nan_to_num(bands["class"].values, nan=0).astype(np.uint8 if len(legend) <= 2**8 else np.uint16)
    palette = {0: (0, 0, 0, 0)} | {k: (*map(int, color), 255) for k, color in enumerate(voxels.colors, start=1)}
    one: dict[str, Any] = {"count": 1, "dtype": classes.dtype, "nodata": 0}
    beside = path.with_suffix(f".class{path.suffix}")
    with atomic_path(beside) as temporary, rasterio.open(temporary, "w", **one, **shape) as file:
        file.write(classes, 1)
        file.write_colormap(1, palette)
        file.set_band_description(1, "class")
        file.update_tags(1, **legend)


def seen_from_above(voxels: Voxels, cell: int = 1) -> tuple[Mapping[str, Column], float, float]:
    """The bands (H, W) float32 by name, the first row the farthest ahead, and the coordinates of their corner."""
    if voxels.up is None:
        raise ConfigError("which way is up is not known; set up_axis of the dataset, and run again")
    table, (right, ahead, above) = voxels.table, level_axes(voxels.up)
    plane = np.stack([table.centers @ ahead, table.centers @ right], axis=1)
    fine, rows = covered(plane, above, table.voxel_size, table.voxel_size)
    cells = fine // cell
    first, last = cells.min(axis=0), cells.max(axis=0)
    H, W = (int(n) for n in last - first + 1)
    if H * W > LARGEST:
        raise ConfigError(f"the raster would have {W} x {H} cells; choose larger ones with --cell, or fewer voxels")
    height = (table.centers + voxels.offset) @ above
    top = _topmost(fine, height[rows])
    at = (last[0] - cells[:, 0]) * W + cells[:, 1] - first[1]
    over = _Cells(at[top], rows[top], (H, W))
    belief = np.stack([over.mean(part) for part in normalise(table.evidence).T])
    label = np.where(over.empty, np.nan, np.nan_to_num(belief).argmax(axis=0) + 1.0)
    every = _Cells(at, rows, (H, W))
    bands = {"class": Column(label, "", "1 to K, of the topmost voxels")}
    for name, column in voxels.columns.items():
        bands[name] = Column(over.mean(column.values), column.unit, f"{column.about}, mean of the topmost voxels")
    stable = (categories(table) == STABLE).astype(np.float64)
    bands["stable"] = Column(every.mean(stable), "", "share of stable voxels, of all of the column")
    bands["height"] = Column(over.highest(height), "m", "of the topmost voxel's centre")
    edge = cell * table.voxel_size
    west, north = first[1] * edge + voxels.offset @ right, (last[0] + 1) * edge + voxels.offset @ ahead
    single = {name: Column(c.values.astype(np.float32), c.unit, c.about) for name, c in bands.items()}
    return single, float(west), float(north)


class _Cells:
    """Voxels (m,) in the cells (m,) of a raster, counted row by row."""

    def __init__(self, at: Int64, rows: Int64, shape: tuple[int, int]) -> None:
        self._at, self._rows, self._shape = at, rows, shape
        self.empty = np.bincount(at, minlength=shape[0] * shape[1]).reshape(shape) == 0

    def mean(self, values: npt.NDArray[Any]) -> Float64:
        """Of values (n,) of the voxels (H, W); NaN where none is defined."""
        taken = values[self._rows].astype(np.float64)
        defined, n = ~np.isnan(taken), self.empty.size
        total = np.bincount(self._at[defined], taken[defined], minlength=n)
        with np.errstate(invalid="ignore"):
            mean: Float64 = (total / np.bincount(self._at[defined], minlength=n)).reshape(self._shape)
        return mean

    def highest(self, values: Float64) -> Float64:
        """The largest of values (n,) of the voxels (H, W); NaN where there is none."""
        most = np.full(self.empty.size, -np.inf)
        np.maximum.at(most, self._at, values[self._rows])
        return np.where(np.isinf(most), np.nan, most).reshape(self._shape)


def _topmost(cells: Int64, height: Float64) -> Int64:
    """Which entry (m,) is the highest of each cell (m, 2)."""
    order = np.lexsort((height, cells[:, 1], cells[:, 0]))
    last = np.append((np.diff(cells[order], axis=0) != 0).any(axis=1), True)
    topmost: Int64 = order[last]
    return topmost
