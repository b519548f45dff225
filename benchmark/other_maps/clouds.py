"""Read labelled clouds and voxel maps of other programs, PLY, LAS, NPZ and Parquet: points with labels or colours."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.files import parse_json
from semstab.core.types import Float64, UInt8
from semstab.datasets.files.surfaces import open_las
from semstab.errors import ConfigError, DataError, SemstabError, summarize_error
from semstab.exports.clouds import with_lazrs

FIELDS = (
    "class", "label", "labels", "class_id", "label_id", "semantic", "semantic_label", "semantic_id", "semantics",
    "object_id", "classification",
)  # fmt: skip
"""The names of columns that hold the class of a point, the first one that is there counts."""

COLOUR = "colour"
"""The word for the colour of a point, where that tells its class."""

POSITIONS = ("points", "xyz", "positions", "centers", "centres", "vertices")
INDICES = ("index", "indices", "voxels", "coords")
"""The names of the arrays (n, 3) of an NPZ file: coordinates, or indices of voxels with `voxel_size`."""

LAS_CLOUD = (".las", ".laz")

System = Literal["scene", "projection"]
Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Stated:
    """Description of a file by its own header.

    Attributes:
        names: Name of each class by its id.
        crs: Reference system in words that pyproj reads, or its name; '' if not stated.
        system: The system of its coordinates; None if not stated.
        voxel_size: Edge of its voxels in metres, NaN if not stated.
        origin: (3,) coordinates of the corner of voxel (0, 0, 0).
    """

    names: Mapping[int, str] = field(default_factory=dict)
    crs: str = ""
    system: System | None = None
    voxel_size: float = float("nan")
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Cloud:
    """A labelled cloud.

    Attributes:
        points: (n, 3) coordinates of the file.
        label: (n,) ids or names of classes; None if colours alone tell the classes.
        colors: (n, 3) RGB, 0 to 255; None without colours.
        what: The field that holds the class, or COLOUR.
        faces: (m, 3) corners of the triangles of a mesh.
    """

    path: Path
    points: Float64
    label: npt.NDArray[Any] | None
    colors: UInt8 | None
    what: str
    stated: Stated
    faces: npt.NDArray[np.integer[Any]] | None = None


def read_cloud(path: Path, field_name: str | None = None) -> Cloud:
    """Read a cloud, whose class is in the named field, or else in the first of FIELDS, or else in its colour.

    Raises:
        ConfigError: For a suffix that is not known, or a field that is not there.
        DataError: For a damaged file, or one without points or classes.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: format '{path.suffix}' is not known; a map is one of {', '.join(READERS)}")
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    try:
        columns, stated, faces = reader(path)
        plain_columns = {_plain(name): values for name, values in columns.items()}
        return _cloud(path, plain_columns, stated, faces, field_name)
    except (SemstabError, ImportError):
        raise
    except Exception as error:  # readers of other libraries raise anything at a damaged file
        raise DataError(f"{path}: cannot be read ({summarize_error(error)}); export it again") from error


def _plain(name: str) -> str:
    """Return the name of a field in lower case, without the prefix that CloudCompare writes."""
    return name.lower().removeprefix("scalar_").removeprefix("sf_")


def _cloud(
    path: Path, columns: Columns, stated: Stated, faces: npt.NDArray[Any] | None, field_name: str | None
) -> Cloud:
    points, colors = _points(path, columns, stated), _colors(columns)
    plain_name = None if field_name is None else _plain(field_name)
    if plain_name in ("color", COLOUR):
        if colors is None:
            raise ConfigError(f"{path}: its points have no colour; leave out --field")
        return Cloud(path, points, None, colors, COLOUR, stated, faces)
    if plain_name is not None and plain_name not in columns:
        raise ConfigError(f"{path}: no field '{field_name}'; it has {', '.join(sorted(columns))}")
    what = plain_name or next((name for name in FIELDS if name in columns), None)
    if what is None and colors is None:
        raise DataError(
            f"{path}: no field holds a class ({', '.join(FIELDS[:4])} ...), and points have no colour;"
            f" it has {', '.join(sorted(columns))}: name one with --field"
        )
    label = None if what is None else _labels(path, what, columns[what])
    for name, values in (("label", label), ("colour", colors)):
        if values is not None and len(values) != len(points):
            raise DataError(f"{path}: {len(values):,} values of {name} for {len(points):,} points")
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise DataError(f"{path}: holds no point")
    if faces is not None and finite.all():
        return Cloud(path, points, label, colors, what or COLOUR, stated, faces)
    label, colors = (None if values is None else values[finite] for values in (label, colors))
    return Cloud(path, points[finite], label, colors, what or COLOUR, stated)


def _labels(path: Path, what: str, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return classes (n,) as whole numbers or texts; a whole float counts, as CloudCompare stores them."""
    if values.ndim == 2 and values.shape[1] > 1:
        raise DataError(f"{path}: field '{what}' has {values.shape[1]} numbers a point; take the largest, and store it")
    values = values.reshape(-1)
    if values.dtype.kind in "OUS":
        return values.astype(str)
    if values.dtype.kind == "f":
        ids = np.where(np.isfinite(values), values, -1)
        if (ids != np.round(ids)).any():
            raise DataError(f"{path}: field '{what}' holds numbers that are not whole, so no classes; name another one")
        return ids.astype(np.int64)
    return values.astype(np.int64)


def _points(path: Path, columns: Columns, stated: Stated) -> Float64:
    """Return coordinates (n, 3), of centres where the file holds indices of voxels."""
    if all(axis in columns for axis in "xyz"):
        return np.stack([columns[axis].astype(np.float64).reshape(-1) for axis in "xyz"], axis=1)
    position = next((columns[name] for name in POSITIONS if name in columns), None)
    if position is not None:
        return _triples(path, position).astype(np.float64)
    if all(axis in columns for axis in ("ix", "iy", "iz")):
        index = np.stack([columns[axis].reshape(-1) for axis in ("ix", "iy", "iz")], axis=1)
    elif (indices := next((columns[name] for name in INDICES if name in columns), None)) is not None:
        index = _triples(path, indices)
    else:
        raise DataError(f"{path}: no coordinates: x, y, z, or points (n, 3); it has {', '.join(sorted(columns))}")
    if not stated.voxel_size > 0:
        raise DataError(f"{path}: holds indices of voxels without their size; add voxel_size, in metres")
    centres: Float64 = (index.astype(np.float64) + 0.5) * stated.voxel_size + np.array(stated.origin)
    return centres


def _triples(path: Path, triples: npt.NDArray[Any]) -> npt.NDArray[Any]:
    if triples.ndim != 2 or triples.shape[1] != 3 or triples.dtype.kind not in "iuf":
        raise DataError(
            f"{path}: coordinates of shape {triples.shape} and type {triples.dtype}, expected numbers (n, 3)"
        )
    return triples


def _colors(columns: Columns) -> UInt8 | None:
    """Return colours (n, 3) in 8 bits, of 16 bits and of shares as well."""
    for names in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")):
        if all(name in columns for name in names):
            rgb = np.stack([columns[name].reshape(-1) for name in names], axis=1)
            break
    else:
        colors = next((columns[name] for name in ("colors", "colours", "rgb") if name in columns), None)
        if colors is None or colors.ndim != 2 or colors.shape[1] < 3:
            return None
        rgb = colors[:, :3]
    largest = rgb.max(initial=0)
    if rgb.dtype.kind == "f" and largest <= 1:
        return np.round(255 * rgb).astype(np.uint8)
    if largest > 255:  # LAS has 16 bits
        return np.round(rgb / 257).astype(np.uint8)
    return rgb.astype(np.uint8)


# --- Formats ----------------------------------------------------------------------------------------------------------

Content = tuple[Columns, Stated, npt.NDArray[Any] | None]

NAMED = re.compile(r"class (\d+) (.+)")
OURS = re.compile(r"semstab: voxels of ([\d.e+-]+) m, (.+)")
SCENE = "coordinates of the scene"


def _read_ply(path: Path) -> Content:
    """Read a cloud or a mesh; comments `class NUMBER NAME` name its classes."""
    import trimesh

    comments = _comments(path)
    with path.open("rb") as file:
        kwargs: dict[str, Any] = trimesh.exchange.ply.load_ply(file, fix_texture=False, skip_materials=True)
    vertices = kwargs["metadata"]["_ply_raw"]["vertex"]["data"]
    names = vertices.dtype.names if isinstance(vertices, np.ndarray) else vertices.keys()
    columns = {name: np.asarray(vertices[name]) for name in names}
    faces = kwargs.get("faces")
    classes = {int(match[1]): match[2] for line in comments if (match := NAMED.fullmatch(line))}
    ours = next((match for line in comments if (match := OURS.fullmatch(line))), None)
    stated = Stated(classes) if ours is None else _of_ours(classes, float(ours[1]), ours[2])
    return columns, stated, faces if faces is not None and len(faces) else None


def _comments(path: Path) -> list[str]:
    lines: list[str] = []
    with path.open("rb") as file:
        while (line := file.readline(2**16)) and line.strip() != b"end_header" and file.tell() < 2**20:
            lines.append(line.decode("utf-8", "replace").strip())
    return [line.removeprefix("comment ").strip() for line in lines if line.startswith("comment ")]


def _of_ours(names: Mapping[int, str], voxel_size: float, where: str) -> Stated:
    """Return what an export of semstab says: the system of its coordinates by name."""
    if where.startswith(SCENE):
        return Stated(names, "", "scene", voxel_size)
    return Stated(names, where, "projection", voxel_size)


def _read_las(path: Path) -> Content:
    """Read a LAS or LAZ cloud: its dimensions, and the classes that an export of semstab names."""
    with_lazrs(path)
    with open_las(path) as reader:
        header, cloud = reader.header, reader.read()
        columns = {name: np.asarray(cloud[name]) for name in cloud.point_format.dimension_names if name not in "XYZ"}
        columns |= {axis: np.asarray(getattr(cloud, axis)) for axis in "xyz"}
        crs = header.parse_crs()
        legends = [vlr for vlr in header.vlrs if vlr.user_id == "semstab"]
        names = json.loads(legends[0].record_data_bytes())["classes"] if legends else []
    if crs is not None:
        flat = crs.sub_crs_list[0] if crs.is_compound else crs
        return columns, Stated(dict(enumerate(names)), flat.to_wkt(), "projection"), None
    return columns, Stated(dict(enumerate(names)), system="scene" if legends else None), None


def _read_npz(path: Path) -> Content:
    """Read arrays by name: points or index with voxel_size, a field of FIELDS, names in `classes`."""
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    size = float(arrays.pop("voxel_size", np.nan))
    origin = tuple(map(float, np.reshape(arrays.pop("origin", np.zeros(3)), 3)))
    names: Sequence[str] = [*map(str, arrays.pop("classes", ()))]
    return arrays, Stated(dict(enumerate(names)), voxel_size=size, origin=origin), None


def _read_parquet(path: Path) -> Content:
    """Read columns: x, y, z or ix, iy, iz, and a field of FIELDS; classes may be texts."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pq.read_schema(path)
    about = parse_json((schema.metadata or {}).get(b"semstab", b"{}"))
    column_names = {"x", "y", "z", "ix", "iy", "iz", "red", "green", "blue", "r", "g", "b", *FIELDS}
    table = pq.read_table(path, columns=[name for name in schema.names if _plain(name) in column_names])
    columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)  # noqa: PLW2901  of names
        if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
            columns[name] = np.array(column.fill_null("").to_pylist(), dtype=np.str_)
        else:
            columns[name] = column.to_numpy()
    if not about:
        return columns, Stated(), None
    names = dict(enumerate(about.get("classes", ())))
    crs, of_table = about.get("crs") or "", "ix" in columns and "x" not in columns
    system: System = "projection" if crs and not of_table else "scene"
    return columns, Stated(names, crs, system, float(about.get("voxel_size", np.nan))), None


READERS: Mapping[str, Callable[[Path], Content]] = {
    ".ply": _read_ply, **dict.fromkeys(LAS_CLOUD, _read_las), ".npz": _read_npz, ".parquet": _read_parquet,
}  # fmt: skip
"""The readers by suffix."""
