"""Heights on a grid over x and y: of a raster file, and of the points of a cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, DataError
from semstab.model.georeference import Georeference

Float64 = npt.NDArray[np.float64]

MOST_CELLS = 5_000_000
"""Of a grid: twice as many triangles take about a gigabyte."""

HEIGHT_QUANTILE = 0.8
"""Of a cell's points: near its top, as a camera above sees it, but not the single point that is noise."""

SPACINGS = 2.0
"""Mean distances between points that a cell is wide where nothing is said: nearly every cell then has a point."""


@dataclass(frozen=True, eq=False)
class Heights:
    """z (rows, columns) float64 in metres, NaN where there is none; cell (j, i) is at x0 + dx i, y0 + dy j."""

    z: Float64
    x0: float
    y0: float
    dx: float
    dy: float

    @property
    def cell(self) -> float:
        """Metres of a cell's side."""
        return abs(self.dx)


def read_heights(path: Path, cell: float | None, georeference: Georeference | None) -> Heights:
    """The first band of a GeoTIFF, in the scene's coordinates, averaged to cells of `cell` metres where that is said.

    A larger one than `MOST_CELLS` becomes coarser. Raises DataError for a rotated raster, ConfigError where it lies in
    another projection than the scene.
    """
    import rasterio

    with rasterio.open(path) as file:
        place = file.transform
        if place.b or place.d:
            raise DataError(f"{path}: the raster is rotated; bring it to north up (gdalwarp)")
        if georeference is not None and file.crs is not None:
            require_same_projection(path, file.crs.to_wkt(), georeference)
        factor = max(1.0, (cell or 0) / abs(place.a), math.sqrt(file.width * file.height / MOST_CELLS))
        rows, columns = (max(1, math.floor(side / factor)) for side in (file.height, file.width))
        z = file.read(1, out_shape=(rows, columns), masked=True, resampling=rasterio.enums.Resampling.average)
        dx, dy = place.a * file.width / columns, place.e * file.height / rows
        x, y = place.c + dx / 2, place.f + dy / 2
    east, north, up = (0.0, 0.0, 0.0) if georeference is None else georeference.offset
    return Heights(z.astype(np.float64).filled(np.nan) - up, x - east, y - north, dx, dy)


def heights_of_points(path: Path, points: Float64, cell: float | None) -> Heights:
    """A grid of points (n, 3): in each cell their `HEIGHT_QUANTILE`. Raises DataError where it would be too large."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 4:
        raise DataError(f"{path}: a cloud of {len(points)} points is no surface")
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    side = cell or SPACINGS * math.sqrt(max(np.prod(high - low), 1e-12) / len(points))
    columns, rows = (int(n) for n in np.floor((high - low) / side) + 1)
    if columns * rows > MOST_CELLS:
        raise DataError(
            f"{path}: {columns}x{rows} cells of {side:.3g} m are too many (at most {MOST_CELLS:,}); set a larger"
            " surface_cell"
        )
    i, j = (np.minimum(((points[:, k] - low[k]) / side).astype(np.int64), n - 1) for k, n in ((0, columns), (1, rows)))
    flat = j * columns + i
    order = np.lexsort((points[:, 2], flat))
    cells, first, counts = np.unique(flat[order], return_index=True, return_counts=True)
    z = np.full(columns * rows, np.nan)
    z[cells] = points[order[first + np.floor(HEIGHT_QUANTILE * (counts - 1)).astype(np.int64)], 2]
    return Heights(z.reshape(rows, columns), low[0] + side / 2, low[1] + side / 2, side, side)


def require_same_projection(path: Path, crs: str, georeference: Georeference) -> None:
    """Raise ConfigError where a file's reference system is known to be another one than the scene's."""
    from pyproj import CRS

    theirs, ours = (CRS.from_user_input(text).to_2d() for text in (crs, georeference.crs))
    numbers = theirs.to_epsg(), ours.to_epsg()
    if None not in numbers and numbers[0] != numbers[1]:
        raise ConfigError(
            f"{path}: lies in EPSG:{numbers[0]}, the scene in EPSG:{numbers[1]}; reproject it (gdalwarp or pdal)"
        )
