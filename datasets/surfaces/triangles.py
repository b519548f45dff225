"""A surface as triangles in the scene's coordinates, from whatever file holds it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.las_files import opened, points_at_once
from semstab.datasets.surfaces.grids import Heights, heights_of_points, read_heights, require_same_projection
from semstab.errors import ConfigError, DataError, MissingDependencyError, one_line
from semstab.model.georeference import INSTALL, Georeference

Float64 = npt.NDArray[np.float64]

DAMAGE = (
    ValueError, TypeError, LookupError, AttributeError, OSError, EOFError, AssertionError, NotImplementedError,
    struct.error, RuntimeError, OverflowError, NameError,
)  # fmt: skip
"""What reading a damaged file may raise in libraries."""


@dataclass(frozen=True, eq=False)
class Triangles:
    """vertices (n, 3) float64 in the scene's coordinates, metres; faces (m, 3) int32; `what` they are, in words."""

    vertices: Float64
    faces: npt.NDArray[np.int32]
    what: str

    @property
    def bounds(self) -> Float64:
        """(2, 3) the least and the largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def read_triangles(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    """The surface in a file: GeoTIFF is a height raster, LAS, LAZ and PLY without faces a cloud, all else a mesh.

    Rasters and clouds become a grid over x and y, with cells of `cell` metres where that is said. GeoTIFF, LAS and LAZ
    lie in the projection of the georeference, and the rest in the scene's coordinates.
    Raises DataError for a file that holds no surface, MissingDependencyError where its library is not installed.
    """
    try:
        found = READERS.get(path.suffix.lower(), _mesh)(path, cell, georeference)
    except (DataError, ConfigError):
        raise
    except ImportError as error:
        raise MissingDependencyError(f"{path}: cannot be read ({one_line(error)}); {INSTALL}") from error
    except DAMAGE as error:
        raise DataError(f"{path}: cannot be read as a surface ({one_line(error)})") from error
    if not len(found.faces):
        raise DataError(f"{path}: holds no triangle that can be seen ({found.what})")
    return found


def _raster(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    heights = read_heights(path, cell, georeference)
    return _of_heights(heights, f"height raster, cells of {heights.cell:.3g} m")


def _las(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    offset = np.zeros(3) if georeference is None else np.array(georeference.offset)

    def chunks() -> Iterator[Float64]:
        with opened(path) as file:
            if georeference is not None and (crs := file.header.parse_crs()) is not None:
                require_same_projection(path, crs.to_wkt(), georeference)
            for points in file.chunk_iterator(points_at_once(file.header)):
                yield np.stack([points.x, points.y, points.z], axis=1) - offset

    return _of_points(path, np.concatenate([*chunks(), np.zeros((0, 3))]), cell)


def _mesh(path: Path, cell: float | None, _: Georeference | None) -> Triangles:
    import trimesh

    scene = trimesh.load_scene(path, process=False, skip_materials=True)
    parts: list[Any] = scene.dump()
    meshes = [part for part in parts if hasattr(part, "faces")]
    if not meshes:
        points = [np.asarray(part.vertices) for part in parts if hasattr(part, "vertices")]
        return _of_points(path, np.concatenate([*points, np.zeros((0, 3))]), cell)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([np.asarray(mesh.vertices, dtype=np.float64) for mesh in meshes])
    faces = np.concatenate([np.asarray(mesh.faces) + start for mesh, start in zip(meshes, starts, strict=False)])
    if (vertices.shape[1], faces.shape[1]) != (3, 3):
        raise DataError(f"{path}: has vertices of {vertices.shape[1]} coordinates, and no triangles; export it again")
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise DataError(f"{path}: a triangle has corner {faces.max()}, but there are {len(vertices)}; export it again")
    faces = faces[np.isfinite(vertices).all(axis=1)[faces].all(axis=1)]
    return Triangles(vertices, faces.astype(np.int32), f"mesh of {len(faces):,} triangles")


def _of_points(path: Path, points: Float64, cell: float | None) -> Triangles:
    heights = heights_of_points(path, points, cell)
    return _of_heights(heights, f"cloud of {len(points):,} points on a grid of {heights.cell:.3g} m")


def _of_heights(heights: Heights, what: str) -> Triangles:
    """Two triangles between four neighbouring cells that all have a height."""
    z = heights.z
    rows, columns = z.shape
    corner = np.arange(z.size, dtype=np.int32).reshape(z.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    known = np.isfinite(z)
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, 1:] & known[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], axis=-1)[whole], np.stack([a, c, d], axis=-1)[whole]])
    x = heights.x0 + heights.dx * np.arange(columns)
    y = heights.y0 + heights.dy * np.arange(rows)
    X, Y = np.meshgrid(x, y)
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.stack([X.ravel()[used], Y.ravel()[used], z.ravel()[used]], axis=1)
    return Triangles(vertices, faces.reshape(-1, 3).astype(np.int32), what)


READERS: Mapping[str, Callable[[Path, float | None, Georeference | None], Triangles]] = {
    ".tif": _raster, ".tiff": _raster, ".las": _las, ".laz": _las,
}  # fmt: skip

SEEN_FROM_ABOVE = tuple(READERS)
"""Suffixes of files that hold heights over x and y, whatever is in them."""
