"""A surface in a file, as the depth of any camera that looks at it."""

from __future__ import annotations

import hashlib
import logging
import math
import struct
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semstab.core.files import atomic_path, file_digest
from semstab.core.types import Float32, Float64, Int32
from semstab.data.frames import Intrinsics
from semstab.data.georeference import INSTALL, Georeference
from semstab.errors import ConfigError, DataError, MissingDependencyError, SemstabError, summarize_error

# Heights on a grid over x and y: of a raster file, and of the points of a cloud.

MOST_CELLS = 5_000_000
"""Largest grid: twice as many triangles take about a gigabyte."""

HEIGHT_QUANTILE = 0.8
"""Quantile of the heights in a cell: near its top, as a camera above sees it, but not a single point of noise."""

SPACINGS = 2.0
"""Mean distances between points that a cell is wide by default: nearly every cell then has a point."""


class Heights(NamedTuple):
    """Grid of heights z (rows, columns) float64 in metres, NaN if unknown; cell (j, i) is at x0 + dx i, y0 + dy j."""

    z: Float64
    x0: float
    y0: float
    dx: float
    dy: float


def read_heights(path: Path, cell: float | None, georeference: Georeference | None) -> Heights:
    """Return the first band of a GeoTIFF, averaged to cells of `cell` metres if given.

    Coordinates are less the offset of the georeference. A larger one than `MOST_CELLS` becomes coarser.

    Raises:
        DataError: For a rotated raster.
        ConfigError: If it lies in another projection than the scene.
    """
    import rasterio

    with rasterio.open(path) as file:
        transform = file.transform
        if transform.b or transform.d:
            raise DataError(f"{path}: the raster is rotated; bring it to north up (gdalwarp)")
        if georeference is not None and file.crs is not None:
            require_same_projection(path, file.crs.to_wkt(), georeference)
        factor = max(1.0, (cell or 0) / abs(transform.a), math.sqrt(file.width * file.height / MOST_CELLS))
        rows, columns = (max(1, math.floor(side / factor)) for side in (file.height, file.width))
        z = file.read(1, out_shape=(rows, columns), masked=True, resampling=rasterio.enums.Resampling.average)
        dx, dy = transform.a * file.width / columns, transform.e * file.height / rows
        x, y = transform.c + dx / 2, transform.f + dy / 2
    east, north, up = (0.0, 0.0, 0.0) if georeference is None else georeference.offset
    return Heights(z.astype(np.float64).filled(np.nan) - up, x - east, y - north, dx, dy)


def heights_of_points(path: Path, points: Float64, cell: float | None) -> Heights:
    """Return a grid of points (n, 3): in each cell their `HEIGHT_QUANTILE`.

    Raises:
        DataError: If it is too large.
    """
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

    file_crs, scene_crs = (CRS.from_user_input(text).to_2d() for text in (crs, georeference.crs))
    numbers = file_crs.to_epsg(), scene_crs.to_epsg()
    if None not in numbers and numbers[0] != numbers[1]:
        raise ConfigError(
            f"{path}: lies in EPSG:{numbers[0]}, the scene in EPSG:{numbers[1]}; reproject it (gdalwarp or pdal)"
        )


# A surface as triangles in the scene's coordinates, from whatever file holds it.


@dataclass(frozen=True, eq=False)
class Triangles:
    """vertices (n, 3) float64 in the scene's coordinates, metres; faces (m, 3) int32; `what` describes them."""

    vertices: Float64
    faces: Int32
    what: str

    @property
    def bounds(self) -> Float64:
        """Return (2, 3) the least and the largest coordinates."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def read_triangles(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    """Return the surface in a file: GeoTIFF is a height raster, LAS, LAZ, PLY without faces a cloud, else a mesh.

    Rasters and clouds become a grid over x and y, with cells of `cell` metres where that is given. GeoTIFF, LAS and LAZ
    lie in the projection of the georeference, and the rest in the scene's coordinates.

    Raises:
        DataError: For a file that holds no surface.
        MissingDependencyError: If its library is not installed.
    """
    try:
        triangles = READERS.get(path.suffix.lower(), _mesh)(path, cell, georeference)
    except (DataError, ConfigError):
        raise
    except ImportError as error:
        raise MissingDependencyError(f"{path}: cannot be read ({summarize_error(error)}); {INSTALL}") from error
    except Exception as error:
        raise DataError(f"{path}: cannot be read as a surface ({summarize_error(error)})") from error
    if not len(triangles.faces):
        raise DataError(f"{path}: holds no triangle that can be seen ({triangles.what})")
    return triangles


def _raster(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    heights = read_heights(path, cell, georeference)
    triangles = _of_heights(heights, f"height raster, cells of {abs(heights.dx):.3g} m")
    return _in_scene(triangles, georeference)


def _las(path: Path, cell: float | None, georeference: Georeference | None) -> Triangles:
    offset = np.zeros(3) if georeference is None else np.array(georeference.offset)

    def chunks() -> Iterator[Float64]:
        with open_las(path) as file:
            if georeference is not None and (crs := file.header.parse_crs()) is not None:
                require_same_projection(path, crs.to_wkt(), georeference)
            for points in file.chunk_iterator(points_at_once(file.header)):
                yield np.stack([points.x, points.y, points.z], axis=1) - offset

    return _in_scene(_of_points(path, np.concatenate([*chunks(), np.zeros((0, 3))]), cell), georeference)


def _in_scene(triangles: Triangles, georeference: Georeference | None) -> Triangles:
    """Bring triangles along the axes of the projection, less the offset, into the scene's coordinates."""
    if georeference is None or not georeference.turned:
        return triangles
    return replace(triangles, vertices=georeference.back_along(triangles.vertices))


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
    return _of_heights(heights, f"cloud of {len(points):,} points on a grid of {heights.dx:.3g} m")


def _of_heights(heights: Heights, what: str) -> Triangles:
    """Return two triangles between four neighbouring cells that all have a height."""
    z = heights.z
    rows, columns = z.shape
    corner = np.arange(z.size, dtype=np.int32).reshape(z.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    has_height = np.isfinite(z)
    complete = has_height[:-1, :-1] & has_height[:-1, 1:] & has_height[1:, 1:] & has_height[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], axis=-1)[complete], np.stack([a, c, d], axis=-1)[complete]])
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
"""Suffixes of files that hold heights over x and y, whatever their content."""


# LAS and LAZ clouds: laspy and lazrs take the memory that a header asks for, so sizes are checked first.

LAS_HEADER, LAS_1_4_HEADER = 227, 375
"""Bytes of a header, and of one that has the fields of LAS 1.4."""

LAS_RECORD, LAS_EXTENDED_RECORD = 54, 60
"""Least bytes of a variable length record, and of an extended one."""

POINT_BYTES_AT_ONCE = 2**26
"""Bytes of points that are read at a time, and of one chunk of LAZ, which is decoded at once."""


@contextmanager
def open_las(path: Path) -> Iterator[Any]:
    """Yield a laspy.LasReader. Any error in the file is a DataError of one line, also while it is read."""
    import laspy

    try:
        _require_whole_las(path)
        with laspy.open(path) as reader:
            if reader.header.are_points_compressed:
                _require_whole_chunks(path, reader.header)
            yield reader
    except (SemstabError, ImportError):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__module__ != "pyo3_runtime":  # lazrs panics with its own
            raise
        raise DataError(f"{path}: cannot be read ({summarize_error(error)})") from error


def points_at_once(header: Any) -> int:
    """Return how many points of a LAS file to read at a time."""
    return int(max(1, POINT_BYTES_AT_ONCE // header.point_format.size))


def _require_whole_las(path: Path) -> None:
    """Raise ValueError where the file is too small for the records, points or chunks that its header claims."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LAS_1_4_HEADER)
        if len(head) < LAS_HEADER or head[:4] != b"LASF":
            raise ValueError("it is no LAS file")
        length, start, records, kind, record, points = struct.unpack_from("<HIIBHI", head, 94)
        if not LAS_HEADER <= length <= start <= size:
            raise ValueError(f"its points would begin at byte {start}, of {size}; it is cut short")
        first, extended = 0, 0
        if head[25] >= 4 and len(head) == LAS_1_4_HEADER:
            first, extended, points = struct.unpack_from("<QIQ", head, 235)
        if length + LAS_RECORD * records > start or (extended and first + LAS_EXTENDED_RECORD * extended > size):
            raise ValueError(f"it has no room for the {records + extended} records that its header names")
        compressed = bool(kind & 0x80)
        if not compressed and points * record > size - start:
            raise ValueError(f"ends after {(size - start) // record:,} of {points:,} points; it is cut short")
        if compressed:
            file.seek(start)
            table = int.from_bytes(file.read(8), "little", signed=True)
            if table == -1:  # its writer could not seek: the position of the table stands at the end
                file.seek(max(start, size - 8))
                table = int.from_bytes(file.read(8), "little", signed=True)
            if not start + 8 <= table <= size - 8:
                raise ValueError("its table of chunks is not in the file; it is cut short")
            file.seek(table + 4)
            chunks = int.from_bytes(file.read(4), "little")
            if chunks > table - start:
                raise ValueError(f"it names {chunks} chunks in {table - start} bytes")


def _require_whole_chunks(path: Path, header: Any) -> None:
    """Raise ValueError where the table of chunks of a LAZ file does not fit its header and size."""
    import lazrs

    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    laz = lazrs.LazVlr(record)
    with path.open("rb") as file:
        file.seek(header.offset_to_point_data)
        points, lengths = np.array(lazrs.read_chunk_table(file, laz), dtype=np.int64).reshape(-1, 2).T
        first = file.tell()
    size = header.point_format.size
    if laz.item_size() != size or points.sum() < header.point_count or first + lengths.sum() > path.stat().st_size:
        raise ValueError(f"its {len(points)} chunks do not hold the {header.point_count:,} points of its header")
    if points.max(initial=0) * size > POINT_BYTES_AT_ONCE:
        raise ValueError(f"it has chunks of {points.max():,} points; compress it again (laszip writes 50,000)")
    if layers := _layers_of(record):  # lazrs aborts the process without the memory that a layer claims
        with path.open("rb") as file:
            for length in lengths.tolist():
                file.seek(first + size + 4)
                if size + 4 + 4 * layers + sum(struct.unpack(f"<{layers}I", file.read(4 * layers))) != length:
                    raise ValueError(f"a chunk at byte {first} has layers that do not fit into it")
                first += length


LAZ_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of LAZ's items that are compressed in layers (LAS 1.4); item 14, extra bytes, has one a byte."""


def _layers_of(record: bytes) -> int:
    """Return how many layers a chunk has, by the items of the LASzip record; 0 if it is compressed point by point."""
    (items,) = struct.unpack_from("<H", record, 32)
    kinds = [struct.unpack_from("<HH", record, 34 + 6 * item) for item in range(items)]
    return sum(length if kind == 14 else LAZ_LAYERS.get(kind, 0) for kind, length in kinds)


# Rays cast at triangles with embree, which lets other threads work meanwhile, as Open3D's binding does not.

RAYS_AT_ONCE = 2**18
"""Bounds the memory of a large image."""

FAR = 1e30
"""Metres beyond which a ray hit nothing."""


@dataclass(frozen=True, eq=False)
class CameraView:
    """A camera: T_wc (4, 4) camera-to-world, and its image of shape (H, W)."""

    intrinsics: Intrinsics
    T_wc: Float64
    shape: tuple[int, int]


class Caster:
    """Triangles to cast rays at, from several threads at once."""

    def __init__(self, triangles: Triangles) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._centre = triangles.bounds.mean(axis=0)  # embree counts in float32
        self._scene: Any = EmbreeScene(robust=True)
        TriangleMesh(self._scene, (triangles.vertices - self._centre).astype(np.float32), triangles.faces)
        nothing = np.zeros((1, 3), dtype=np.float32)
        self._scene.run(nothing, nothing + 1, query="DISTANCE")  # builds the tree, which one thread must do

    def depth(self, view: CameraView) -> Float32:
        """Return depth (H, W) along the optical axis in metres, 0 where a ray hits nothing."""
        (H, W), K, R = view.shape, view.intrinsics, view.T_wc[:3, :3]
        x = (np.arange(W) - K.cx) / K.fx
        y = (np.arange(H) - K.cy) / K.fy
        along_row = [(R[axis, 0] * x).astype(np.float32) for axis in range(3)]
        along_column = [(R[axis, 1] * y + R[axis, 2]).astype(np.float32) for axis in range(3)]
        rows = max(1, RAYS_AT_ONCE // W)
        origins = np.broadcast_to((view.T_wc[:3, 3] - self._centre).astype(np.float32), (rows * W, 3))
        depth = np.empty((H, W), dtype=np.float32)
        directions = np.empty((rows, W, 3), dtype=np.float32)
        for top in range(0, H, rows):
            count = min(rows, H - top)
            for axis in range(3):
                np.add(along_row[axis], along_column[axis][top : top + count, None], out=directions[:count, :, axis])
            rays = directions[:count].reshape(-1, 3)  # of length 1 along the optical axis: distances are depth
            depth[top : top + count] = self._scene.run(origins[: len(rays)], rays, query="DISTANCE").reshape(-1, W)
        depth[depth > FAR] = 0
        return depth


# Cast depth is stored in files, so that a second run reads it.

logger = logging.getLogger("semstab")


class Casts:
    """The casts at one surface in a folder; None stores nothing. A failure to write is one warning.

    A file holds a checksum, then the exact depth in a fifth of its bytes: differences along rows, their bytes by
    significance, zstd.

    Attributes:
        surface: Bytes that are equal where the surface is the same.
    """

    def __init__(self, folder: Path | None, surface: bytes) -> None:
        self._folder = None if folder is None else folder / hashlib.blake2b(surface, digest_size=8).hexdigest()
        self._surface = surface

    def get(self, view: CameraView) -> Float32 | None:
        """Return the depth (H, W) of a view, or None if it is missing or damaged."""
        import pyarrow as pa

        file, (H, W) = self._file(view), view.shape
        if file is None or not file.is_file():
            return None
        try:
            data = file.read_bytes()
            if zlib.crc32(data[4:]) != int.from_bytes(data[:4], "little"):
                return None
            planes = np.frombuffer(pa.Codec("zstd").decompress(data[4:], 4 * H * W), np.uint8).reshape(4, -1)
        except OSError:
            return None
        change = np.ascontiguousarray(planes.T).view(np.uint32).reshape(H, W)
        return np.cumsum(change, axis=1, dtype=np.uint32).view(np.float32)

    def put(self, view: CameraView, depth: Float32) -> None:
        """Store the depth of a view."""
        import pyarrow as pa

        if (file := self._file(view)) is None:
            return
        change = np.diff(depth.view(np.uint32), axis=1, prepend=np.uint32(0))
        planes = np.ascontiguousarray(change.view(np.uint8).reshape(-1, 4).T)
        content = bytes(pa.Codec("zstd", 1).compress(planes, asbytes=True))
        try:
            with atomic_path(file) as temporary:
                temporary.write_bytes(zlib.crc32(content).to_bytes(4, "little") + content)
        except OSError as error:
            logger.warning("%s: cast depth cannot be stored (%s); set casts to a folder", self._folder, error.strerror)
            self._folder = None

    def _file(self, view: CameraView) -> Path | None:
        if self._folder is None:
            return None
        digest = hashlib.blake2b(self._surface, digest_size=16)
        digest.update(b"2" + repr((view.intrinsics, view.shape)).encode() + view.T_wc.tobytes())
        return self._folder / f"{digest.hexdigest()}.cast"


PROBE = (9, 16)
"""Rays of a view that tell whether it sees the surface at all: rows and columns."""


class Surface:
    """Opened by its file's digest; its triangles are read when a cast is asked for that is not stored.

    A mesh whose coordinates count from `mesh_origin`, (3,) in the projection, is brought into the scene; without one
    its coordinates are the scene's.

    Threads may ask at once.

    Raises:
        DataError: If the file cannot be read.
    """

    def __init__(
        self,
        path: Path,
        cell: float | None = None,
        georeference: Georeference | None = None,
        casts: Path | None = None,
        mesh_origin: tuple[float, float, float] | None = None,
    ) -> None:
        self.path = path
        self._mesh_origin = None if path.suffix.lower() in SEEN_FROM_ABOVE else mesh_origin
        self._cell = cell
        self._georeference = georeference
        self._casts = Casts(casts, self.digest)
        self._lock = threading.Lock()
        self._caster: Caster | None = None

    @cached_property
    def digest(self) -> bytes:
        """Return the bytes that are equal where the surface is."""
        offset = None if self._georeference is None else self._georeference.offset
        content: tuple[object, ...] = (self._cell, offset)
        if self._georeference is not None and self._georeference.turned:
            content = (*content, self._georeference.linear)
        return (
            file_digest(self.path)
            + repr(content if self._mesh_origin is None else (*content, self._mesh_origin)).encode()
        )

    @cached_property
    def triangles(self) -> Triangles:
        """Return the surface in the scene's coordinates. Raises what `read_triangles` raises."""
        triangles = read_triangles(self.path, self._cell, self._georeference)
        if self._mesh_origin is None or self._georeference is None:
            return triangles
        return replace(
            triangles, vertices=self._georeference.in_scene(triangles.vertices + np.array(self._mesh_origin))
        )

    def depth(self, view: CameraView) -> Float32:
        """Return depth (H, W) of a view along the optical axis in metres, 0 for pixels that see no surface."""
        depth = self._casts.get(view)
        if depth is None:
            depth = self._cast(view)
            self._casts.put(view, depth)
        return depth

    def require_seen(self, views: Iterable[CameraView]) -> None:
        """Raise DataError with the distance of the cameras if no view sees the surface."""
        centres = []
        for view in views:
            (H, W), (rows, columns), K = view.shape, PROBE, view.intrinsics
            small = min(H, W) <= max(PROBE)
            if self._cast(view if small else CameraView(K.resized((W, H), (columns, rows)), view.T_wc, PROBE)).any():
                return
            centres.append(view.T_wc[:3, 3])
        raise DataError(f"{self.path}: no frame sees it: {_apart(self.triangles, np.array(centres))}")

    def _cast(self, view: CameraView) -> Float32:
        with self._lock:
            if self._caster is None:
                self._caster = Caster(self.triangles)
        return self._caster.depth(view)


def _apart(triangles: Triangles, centres: Float64) -> str:
    """Return the position of the cameras relative to a surface that they do not see, and the remedy."""
    low, high = triangles.bounds
    nearest = np.clip(centres, low, high)
    closest = np.linalg.norm(centres - nearest, axis=1).argmin()
    x, y, z = centres[closest] - nearest[closest]
    if np.hypot(x, y) == 0 and z >= 0:
        return (
            f"the nearest camera is {z:.4g} m above it and looks elsewhere; are pose_convention and camera_axes right?"
        )
    return (
        f"the nearest camera is {np.linalg.norm((x, y, z)):,.0f} m away (east {x:,.0f}, north {y:,.0f}, up {z:,.0f}"
        " m); surface and poses have different coordinates; bring them to the same (an offset?)"
    )
