"""Differences between two folders of outputs: numbers, words, columns and files, whatever their format.

For `freeze.py`. Only what differs between two runs of one revision is left out, see `IGNORED`. `RENAMED` has the names
that changed.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

RENAMED: dict[str, str | None] = {
    "sizes": None,  # runs do not fuse frames again at half and twice the voxel size: `check` judges the size
}
"""Key, column, file, header or word of the kept revision -> its name now; None: gone by design (say why in a comment).

`parent.key` goes before `key`; the parent of a column is the stem of its file, or the folder if that is in FOLDERS. A
folder is `name/` on both sides. X_low, X_high and X_3 follow X.
"""

TOLERANCE = 1e-12

IGNORED = re.compile(
    r"seconds|milliseconds|.*_ms|.*_ms_per_frame|seconds_.*|.*_seconds|fps|.*memory.*|peak_.*|version|semstab|created"
    r"|command|root|path|source|.*_file|digest|identity|inputs|sha256|.*_hash"
)
"""Keys and columns of times, memory, versions and dates, and of paths and hashes, which hold the folder of a case."""

SKIPPED = re.compile(
    r"(.*/)?((units|figures)/.*|(manifest|digests)\.json|fusion\.(md|tex)|.*\.(html|svg|rrd|zip|xml|log))"
)
"""Files of pictures, which the tables beside them hold the numbers of, of hashes and times, and of units."""

EXACT = ("voxels", "truth", "observations", "frames")
"""Folders whose tables are compared bit by bit."""

HASH = re.compile(r"[0-9a-f]{24,64}")
"""Values that are digests, whatever their key."""

FOLDERS = (*EXACT, "sums", "columns")
"""Folders with a file for each unit, whose names are not of tables."""


@dataclass
class FolderComparison:
    """Differences between the two folders of a case, new outputs, and the verdicts."""

    differences: list[str] = field(default_factory=list)
    new: Counter[str] = field(default_factory=Counter)
    verdicts: dict[str, None] = field(default_factory=dict)
    files: int = 0

    def differ(self, where: str, old: Any, new: Any) -> None:
        """One value that is not what it was."""
        self.differences.append(f"{where}: {str(old)[:90]} is now {str(new)[:90]}")

    def names(self, a: Mapping[str, Any], b: Mapping[str, Any], parent: str, what: str) -> dict[str, str]:
        """Keys of `a` that are compared, with their names in `b`."""
        names = {key: name for key in a if (name := renamed(key, parent)) is not None}
        self.new[what] += len(b.keys() - set(names.values()))
        return {key: name for key, name in names.items() if not IGNORED.fullmatch(key)}

    def values(self, a: Any, b: Any, where: str, parent: str = "") -> None:
        """Values of JSON by their keys."""
        if isinstance(a, dict) and isinstance(b, dict):
            names = self.names(a, b, parent, "keys")
            if isinstance(verdict := a.get("verdict"), dict) and "level" in verdict:
                now = (b.get("verdict") or {}).get("level")
                change = "" if now == verdict["level"] else f" (now {now})"
                self.verdicts[f"{a.get('name', '')} {verdict['level']}{change}"] = None
            for key, name in names.items():
                if name not in b:
                    self.differ(f"{where}.{name}", a[key], "missing")
                else:
                    self.values(a[key], b[name], f"{where}.{name}", key)
        elif isinstance(a, list) and isinstance(b, list):
            if len(a) != len(b):
                self.differ(where, f"{len(a)} entries", f"{len(b)} entries")
            for i, (old, new) in enumerate(zip(a, b, strict=False)):
                self.values(old, new, f"{where}[{i}]", parent)
        elif not same(a, b, TOLERANCE, parent):
            self.differ(where, a, b)

    def columns(self, a: Mapping[str, Any], b: Mapping[str, Any], where: str, tolerance: float) -> None:
        """Columns by name, arrays or lists of text; tolerance 0: bit by bit."""
        folder, stem = Path(where).parent.name, Path(where).stem
        for key, name in self.names(a, b, folder if folder in FOLDERS else stem, "columns").items():
            x, y = (np.asarray(column) for column in (a[key], b.get(name, [])))
            if name not in b or x.shape != y.shape or (x.dtype != y.dtype and x.dtype.kind in "fiub"):
                self.differ(
                    f"{where}: {name}", f"{x.dtype} {x.shape}", f"{y.dtype} {y.shape}" if name in b else "missing"
                )
                continue
            x, y = x.ravel(), y.ravel()
            if x.dtype.kind not in "fiub":
                wrong = np.array([not same(p, q, tolerance) for p, q in zip(x.tolist(), y.tolist(), strict=True)], bool)
            elif tolerance and x.dtype.kind == "f":
                wrong = ~np.isclose(x, y, rtol=tolerance, atol=tolerance, equal_nan=True)
            elif x.dtype.kind == "f":
                wrong = ((x != y) | (np.signbit(x) != np.signbit(y))) & ~(np.isnan(x) & np.isnan(y))
            else:
                wrong = x != y
            if wrong.any():
                first = int(np.argmax(wrong))
                self.differ(f"{where}: {name}[{first}], one of {wrong.sum()} of {wrong.size}", x[first], y[first])

    def file(self, old: Path, new: Path, where: str) -> None:
        """One file, or the tiles of one table, by its kind."""
        self.files += 1
        path = Path(where)
        if path.suffix in (".json", ".yaml"):
            load: Callable[[str], Any] = json.loads if path.suffix == ".json" else yaml.safe_load
            self.values(load(old.read_text()), load(new.read_text()), where, path.stem)
        elif decode := DECODERS.get(path.suffix):
            tolerance = 0.0 if path.parent.name in EXACT else TOLERANCE
            self.columns(decode(old), decode(new), where, tolerance)
        elif old.read_bytes() != new.read_bytes():
            self.differ(where, f"{old.stat().st_size} bytes", f"{new.stat().st_size} other bytes")

    def folders(self, old: Path, new: Path) -> None:
        """All that the commands of a case left."""
        ours, theirs = listing(old), listing(new)
        codes = [(folder / "exit_codes").read_text() for folder in (old, new)]
        if codes[0] != codes[1]:
            self.differ("exit codes", *codes)
        names = {where: name for where in ours if (name := renamed_file(where)) is not None}
        self.new["files"] += len(theirs.keys() - set(names.values()))
        for where, name in names.items():
            if name not in theirs:
                self.differ(where, "a file", "missing")
            else:
                try:
                    self.file(ours[where], theirs[name], where)
                except Exception as error:  # noqa: BLE001  a file that cannot be read is a difference
                    self.differ(where, "readable", repr(error))


def listing(folder: Path) -> dict[str, Path]:
    """Files to be compared by their names; the tiles of a voxel table are one table, as one file is."""
    files: dict[str, Path] = {}
    for path in sorted(entry for entry in folder.rglob("*") if entry.is_file()):
        tiled = path.name.startswith("tile=")
        where = path.relative_to(folder).as_posix()
        name = f"{Path(where).parent.as_posix()}.parquet" if tiled else where
        if not SKIPPED.fullmatch(name):
            files[name] = path.parent if tiled else path
    return files


def renamed(name: str, parent: str = "") -> str | None:
    """Return the present name for a name of the kept revision; X_low, X_high and X_3 follow X."""
    for key in (f"{parent}.{name}", name):
        if key in RENAMED:
            return RENAMED[key]
    match = re.fullmatch(r"(.+)_(low|high|\d+)", name)
    if match is None or (stem := renamed(match[1], parent)) == match[1]:
        return name
    return stem and f"{stem}_{match[2]}"


def renamed_file(where: str) -> str | None:
    """The same of a file, folder by folder; its suffix stays."""
    *folders, file = where.split("/")
    stem, dot, suffix = file.partition(".")
    parts = [RENAMED.get(f"{folder}/", f"{folder}/") for folder in folders]
    parts.append(RENAMED[file] if file in RENAMED else (name := renamed(stem)) and f"{name}{dot}{suffix}")
    return None if None in parts else "".join(map(str, parts))


def same(a: Any, b: Any, tolerance: float, parent: str = "") -> bool:
    """Numbers to a tolerance, also where they are written as text; words through the names that changed."""
    if isinstance(a, bool | None) or isinstance(b, bool | None):
        return a is b
    if a == b or (isinstance(a, str) and renamed(a, parent) in (b, None)):
        return True
    if isinstance(a, str) and isinstance(b, str):
        if a.startswith("/") and b.startswith("/"):
            return Path(a).name == Path(b).name
        if HASH.fullmatch(a) and HASH.fullmatch(b):
            return True
    try:
        x, y = float(a), float(b)
    except ValueError:
        return False
    return (math.isnan(x) and math.isnan(y)) or x == y or abs(x - y) <= tolerance * max(1.0, abs(x), abs(y))


# --- Formats: each file as columns ------------------------------------------------------------------------------------


def of_parquet(path: Path) -> dict[str, Any]:
    """Columns; lists of numbers laid end to end. Rows are put in the order of voxels and frames."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    parts = sorted(path.iterdir()) if path.is_dir() else [path]
    table = pa.concat_tables([pq.read_table(part, partitioning=None) for part in parts])
    if order := [name for name in ("ix", "iy", "iz", "frame", "part") if name in table.column_names]:
        table = table.sort_by([(name, "ascending") for name in order])
    columns = {name: table[name].combine_chunks() for name in table.column_names}
    flat = {name: c.flatten() if hasattr(c, "flatten") else c for name, c in columns.items()}
    return {name: column.to_numpy(zero_copy_only=False) for name, column in flat.items()}


def of_csv(path: Path) -> dict[str, Any]:
    """Columns of text."""
    rows = list(csv.reader(io.StringIO(path.read_text())))
    return {name: [row[i] for row in rows[1:]] for i, name in enumerate(rows[0])} if rows else {}


def of_ply(path: Path) -> dict[str, Any]:
    """Properties of the points of a binary file, and the bytes that follow them."""
    kinds = {"double": "f8", "float": "f4", "uchar": "u1", "ushort": "u2", "short": "i2", "int": "i4", "uint": "u4"}
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode().splitlines()]
    kind = np.dtype([(line[2], f"<{kinds[line[1]]}") for line in lines if line[0] == "property" and line[1] != "list"])
    points = np.frombuffer(body, kind, next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"]))
    return {name: points[name] for name in kind.names or ()} | {"faces": [body[points.nbytes :].hex()]}


def of_las(path: Path) -> dict[str, Any]:
    """Dimensions, and what coordinates are counted in."""
    import laspy

    cloud = laspy.read(path)
    header = cloud.header
    placed = {"scales": header.scales, "offsets": header.offsets, "crs": [str(header.parse_crs())]}
    return {name: np.asarray(cloud[name]) for name in cloud.point_format.dimension_names} | placed


def of_raster(path: Path) -> dict[str, Any]:
    """Bands by what they are called, and where they lie."""
    import rasterio

    with rasterio.open(path) as raster:
        bands = {name or f"band {i}": raster.read(i + 1) for i, name in enumerate(raster.descriptions)}
        return bands | {"transform": list(raster.transform), "crs": [str(raster.crs)]}


def of_mesh(path: Path) -> dict[str, Any]:
    """Corners with their colours, in an order of their own, and the number of triangles."""
    import trimesh

    mesh: Any = trimesh.load(path, force="mesh", process=False)
    colors = np.asarray(getattr(mesh.visual, "vertex_colors", np.zeros((len(mesh.vertices), 0))))
    corners = np.hstack([np.asarray(mesh.vertices, float), colors])
    return {"corners": corners[np.lexsort(corners.T)], "triangles": np.array([len(mesh.faces)])}


def of_image(path: Path) -> dict[str, Any]:
    """Pixels."""
    import cv2

    return {"pixels": cv2.imread(str(path), cv2.IMREAD_UNCHANGED)}


DECODERS: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    ".parquet": of_parquet, ".csv": of_csv, ".ply": of_ply, ".las": of_las, ".laz": of_las, ".tif": of_raster,
    ".glb": of_mesh, ".png": of_image, ".npz": lambda path: dict(np.load(path)),
}  # fmt: skip
