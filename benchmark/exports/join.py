"""Classify a given cloud: each point takes the class and columns of its voxel; the cloud is read in chunks."""

from __future__ import annotations

import copy
import io
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import atomic_path
from semstab.core.prefetch import SizedCache
from semstab.core.types import Float64, Int64
from semstab.data.tiles import AT_HAND, TileIndex
from semstab.data.voxel_keys import voxel_keys
from semstab.data.voxels import VoxelTable
from semstab.datasets.files.surfaces import open_las, points_at_once
from semstab.datasets.formats.ply import Header
from semstab.errors import ConfigError, DataError
from semstab.exports import clouds
from semstab.exports.voxels import ExportedUnit, ExportedVoxels

if TYPE_CHECKING:
    import laspy
    from scipy.spatial import cKDTree


# A point belongs to the voxel that it lies in, else to the nearest voxel within a radius.

NONE = -1
"""The row of a point that belongs to no voxel."""


class VoxelLookup:
    """A search for voxels of a table by coordinates of the scene; a radius of 0 takes no neighbours."""

    def __init__(self, table: VoxelTable, radius: float = 0.0) -> None:
        self.table, self._radius = table, radius
        index = self.table.index.astype(np.int64)
        self._low, self._high = index.min(axis=0), index.max(axis=0)
        (self._keys,) = voxel_keys(index)

    @property
    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lowest and the highest coordinates (3,) that may belong to a voxel, metres."""
        r = self.table.voxel_size
        return self._low * r - self._radius, (self._high + 1) * r + self._radius

    def rows(self, points: Float64) -> Int64:
        """Return (n,) the voxel of each point (n, 3), a row of the table, or NONE."""
        return self.nearest(points)[0]

    def nearest(self, points: Float64) -> tuple[Int64, Float64]:
        """Return the voxels, and the distance of their centres, 0 for the voxel that a point lies in."""
        index = np.floor(points / self.table.voxel_size).astype(np.int64)
        inside = np.flatnonzero(((index >= self._low) & (index <= self._high)).all(axis=1))
        rows, distances = np.full(len(points), NONE), np.full(len(points), np.inf)
        keys = np.ravel_multi_index(tuple((index[inside] - self._low).T), tuple(self._high - self._low + 1))
        positions = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        met = inside[self._keys[positions] == keys]
        rows[met], distances[met] = positions[self._keys[positions] == keys], 0.0
        if self._radius > 0:
            lost = np.flatnonzero(rows == NONE)
            rows[lost], distances[lost] = self._around(points[lost])
        return rows, distances

    def _around(self, points: Float64) -> tuple[Int64, Float64]:
        """Return (n,) the voxel whose centre is nearest to each point, within the radius, and its distance."""
        low, high = self.bounds
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        rows, distances = np.full(len(points), NONE), np.full(len(points), np.inf)
        distances[near], nearest = self._tree.query(points[near], distance_upper_bound=self._radius, workers=-1)
        rows[near] = np.where(nearest < len(self.table), nearest, NONE)
        return rows, distances

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.table.centers)


CHUNK = 1_000_000
"""The number of points that are read at a time."""

MEASURES = ("vss", "op", "category")
"""The columns of a point by default."""

BEFORE = "classification_before"
"""The extra dimension with the classification that a LAS cloud had."""

OLD_CODES = 31
"""The largest code that the point formats before LAS 1.4 have room for."""


@dataclass
class JoinTally:
    """The number of points, those with a voxel, those within the map's bounds from above, and the bounds of all."""

    points: int = 0
    classified: int = 0
    over: int = 0
    low: Float64 = field(default_factory=lambda: np.full(3, np.inf))
    high: Float64 = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, points: Float64, classified: int, over: int) -> None:
        """Count a chunk of points (n, 3), of which `classified` have a voxel, and `over` lie over the map."""
        self.points += len(points)
        self.classified += classified
        self.over += over
        self.low = np.minimum(self.low, points.min(axis=0, initial=np.inf))
        self.high = np.maximum(self.high, points.max(axis=0, initial=-np.inf))


@dataclass(frozen=True, eq=False)
class Taken:
    """The classes of points, from 1 on, and their columns, (n,) each; 0 without a voxel."""

    label: npt.NDArray[Any]
    columns: Mapping[str, npt.NDArray[Any]]


Finder = Callable[[Float64], Taken]
Writer = Callable[[ExportedVoxels, Path, Path, Finder], None]


def classify(chosen: ExportedUnit, cloud: Path, out: Path, radius: float, asprs: Path | None = None) -> JoinTally:
    """Write the cloud with all its fields, and class, classification (LAS) and the voxels' columns.

    A point belongs to the voxel that it lies in, else to the nearest whose centre is within `radius` metres; else it
    has class 0 'unclassified' and zeros. Classes count from 1.

    Raises:
        ConfigError: For files of different or unknown kinds.
        DataError: For a damaged cloud, or one outside the map.
    """
    of_las = partial(_classify_las, asprs=asprs)
    kinds: dict[str, Writer] = {".las": of_las, ".laz": of_las, ".ply": _classify_ply}
    write = kinds.get(cloud.suffix.lower())
    if write is None:
        raise ConfigError(f"{cloud}: a cloud is a .las, .laz or .ply file")
    if kinds.get(out.suffix.lower()) is not write:
        raise ConfigError(f"{out}: the output has the format of {cloud.name}; write {out.with_suffix(cloud.suffix)}")
    if out.exists() and out.samefile(cloud):
        raise ConfigError(f"{out}: this is the cloud itself; choose another file")
    finder = _Finder(chosen, radius)
    with atomic_path(out) as temporary:
        write(chosen.first, cloud, temporary, finder)
        if not finder.tally.classified:
            raise _outside(cloud, finder)
    return finder.tally


class _Finder:
    """A search for the voxels of points, tile by tile; the latest tiles stay in memory."""

    def __init__(self, chosen: ExportedUnit, radius: float) -> None:
        self.chosen, self.tally, self._radius = chosen, JoinTally(), radius
        self._lookups = SizedCache(self.lookup, lambda lookup: len(lookup.table), AT_HAND)

    def lookup(self, tile: TileIndex) -> VoxelLookup:
        """Return the lookup of a tile with voxels."""
        return VoxelLookup(self.chosen[tile].table, self._radius)

    @cached_property
    def bounds(self) -> tuple[Float64, Float64]:
        """Return the lowest and the highest coordinates (3,) of the file that may belong to a voxel, metres."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for tile in self.chosen.tiles():
            voxels, r = self.chosen[tile], self.chosen.first.table.voxel_size
            index = voxels.table.index
            box = np.stack([index.min(axis=0) * r - self._radius, (index.max(axis=0) + 1) * r + self._radius])
            corners = voxels.in_file(np.array([*itertools.product(*box.T)]))
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
        return low, high

    def __call__(self, points: Float64) -> Taken:
        part, best_distance = self.chosen.first, np.full(len(points), np.inf)
        label = np.zeros(len(points), part.classified.dtype)
        columns = {
            name: np.zeros(len(points), clouds.as_stored(column.values).dtype) for name, column in part.columns.items()
        }
        placed = part.in_scene(points)
        for tile, rows in self._near(placed):
            voxels = self.chosen[tile]
            if not len(voxels.table):
                continue
            nearest, distance = self._lookups[tile].nearest(placed[rows])
            nearer = distance < best_distance[rows]
            point_rows, voxel_rows = rows[nearer], nearest[nearer]
            best_distance[point_rows], label[point_rows] = distance[nearer], voxels.classified[voxel_rows]
            for name, values in columns.items():
                values[point_rows] = clouds.as_stored(voxels.columns[name].values)[voxel_rows]
        low, high = (edge[:2] for edge in self.bounds)
        over = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
        self.tally.add(points, int(np.isfinite(best_distance).sum()), int(over.sum()))
        return Taken(label, columns)

    def _near(self, points: Float64) -> Iterator[tuple[TileIndex, Int64]]:
        """Yield the tiles that may hold the nearest voxels of points (n, 3), with the points' rows (m,)."""
        size, r = self.chosen.size, self.chosen.first.table.voxel_size
        if size is None:
            yield (0, 0), np.arange(len(points))
            return
        steps = np.linspace(-self._radius, self._radius, 2 + int(2 * self._radius / (size * r)))
        pairs = [
            np.column_stack([np.floor((points[:, :2] + shift) / (size * r)).astype(np.int64), np.arange(len(points))])
            for shift in itertools.product(steps, steps)
        ]
        tiles = np.unique(np.concatenate(pairs), axis=0)
        keys, first = np.unique(tiles[:, :2], axis=0, return_index=True)
        for (x, y), rows in zip(keys.tolist(), np.split(tiles[:, 2], first[1:]), strict=True):
            if (x, y) in self.chosen:
                yield (x, y), rows


def _outside(cloud: Path, finder: _Finder) -> DataError:
    """Return the error of a cloud without a point in the map."""
    map_box = finder.bounds
    cloud_span, map_span = (
        " to ".join("(" + ", ".join(f"{value:.1f}" for value in corner) + ")" for corner in box)
        for box in ((finder.tally.low, finder.tally.high), map_box)
    )
    georeferenced = finder.chosen.first.georeference is not None
    mend = "correct the cloud's coordinates" if georeferenced else "give the run's dataset a georeference (crs, offset)"
    return DataError(f"{cloud}: no point lies in the map: the cloud spans {cloud_span} m, the map {map_span}; {mend}")


# --- LAS --------------------------------------------------------------------------------------------------------------


def _classify_las(voxels: ExportedVoxels, cloud: Path, out: Path, find: Finder, asprs: Path | None) -> None:
    clouds.with_lazrs(cloud)
    with open_las(cloud) as reader:
        _require_same_crs(voxels, reader.header, cloud)
        header, records = _extended(reader.header, voxels), type(reader.header.vlrs)(_without_copc(reader.evlrs or ()))
        _require_header(header)
    with clouds.las_writer(out, header) as writer:
        for points in _las_chunks(cloud):
            writer.write_points(_classified_points(points, writer.header, voxels, find, asprs))
        if records:
            writer.write_evlrs(records)


def _require_header(header: laspy.LasHeader) -> None:
    """Write and read an empty file: if its fields cannot be kept, the error is the cloud's, not the disk's."""
    import laspy

    empty = io.BytesIO()
    laspy.open(empty, "w", header=copy.deepcopy(header), closefd=False).close()
    laspy.open(io.BytesIO(empty.getvalue())).close()


def _las_chunks(cloud: Path) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Yield the points of a cloud; errors of writing them are not errors of the cloud."""
    with open_las(cloud) as reader:
        yield from reader.chunk_iterator(min(CHUNK, points_at_once(reader.header)))


def _extended(header: laspy.LasHeader, voxels: ExportedVoxels) -> laspy.LasHeader:
    """Return the cloud's header with the dimensions of the voxels."""
    extended = copy.deepcopy(header)
    extended.vlrs = type(header.vlrs)(_without_copc(header.vlrs))
    clouds.declare(extended, voxels, **{BEFORE: (np.uint8, "what was there before")})
    return extended


def _without_copc(records: Iterable[laspy.VLR]) -> list[laspy.VLR]:
    """Drop the records of the order of points in a COPC file: it is written as plain LAZ."""
    return [record for record in records if record.user_id != "copc"]


def _classified_points(
    points: laspy.ScaleAwarePointRecord,
    header: laspy.LasHeader,
    voxels: ExportedVoxels,
    find: Finder,
    asprs: Path | None,
) -> laspy.ScaleAwarePointRecord:
    """Return a chunk with the classes and columns of its points."""
    assigned = find(np.stack([points.x, points.y, points.z], axis=1))
    taken = type(points).zeros(len(points), header=header)
    taken.copy_fields_from(points)
    if BEFORE not in points.point_format.dimension_names:
        taken[BEFORE] = points.classification
    codes = clouds.codes(voxels, asprs)
    if header.point_format.id < clouds.FIRST_OF_1_4:
        codes[codes > OLD_CODES] = clouds.UNCLASSIFIED
    taken.classification = codes[assigned.label]
    taken["class"] = assigned.label
    for name, values in assigned.columns.items():
        taken[name] = values
    return taken


def _require_same_crs(voxels: ExportedVoxels, header: laspy.LasHeader, cloud: Path) -> None:
    """Raise DataError where cloud and run have different projections."""
    stated = header.parse_crs()
    if stated is None or voxels.georeference is None:
        return
    from pyproj import CRS

    flat = stated.sub_crs_list[0] if stated.is_compound else stated
    cloud_epsg, run_epsg = (crs.to_epsg() for crs in (flat, CRS.from_wkt(voxels.georeference.crs)))
    if cloud_epsg is not None and run_epsg is not None and cloud_epsg != run_epsg:
        raise DataError(f"{cloud}: the cloud is in EPSG:{cloud_epsg}, the run in EPSG:{run_epsg}; reproject the cloud")


# --- PLY --------------------------------------------------------------------------------------------------------------


def _classify_ply(voxels: ExportedVoxels, cloud: Path, out: Path, find: Finder) -> None:
    with cloud.open("rb") as source, out.open("wb") as target:
        header = Header.read(source, cloud)
        fields = {name: header.dtype[name].newbyteorder("<") for name in header.dtype.names or ()}
        kinds = {
            "class": voxels.classified.dtype,
            **{k: clouds.as_stored(column.values).dtype for k, column in voxels.columns.items()},
        }
        dtype = np.dtype([*(fields | kinds).items()])
        comments = dict.fromkeys((*header.comments, *clouds.legend(voxels)))
        target.write(Header(dtype, header.count, 0, tuple(comments)).text())
        for points in _ply_chunks(source, header, cloud):
            assigned = find(np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1))
            chunk = np.empty(len(points), dtype)
            for name in fields:
                chunk[name] = points[name]
            chunk["class"] = assigned.label
            for name, values in assigned.columns.items():
                chunk[name] = values
            target.write(chunk.tobytes())


def _ply_chunks(source: Any, header: Header, cloud: Path) -> Iterator[npt.NDArray[np.void]]:
    for first in range(0, header.count, CHUNK):
        count = min(CHUNK, header.count - first)
        points = np.fromfile(source, header.dtype, count)
        if len(points) < count:
            raise DataError(
                f"{cloud}: the file ends after {first + len(points):,} of {header.count:,} points; it is cut short"
            )
        yield points
