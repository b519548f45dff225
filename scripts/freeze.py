"""Keep the outputs of a revision for fixed cases, and compare the outputs of a working tree with them.

    python scripts/freeze.py keep [--revision HEAD] --into DIR [--case NAME ...] [--quick]
    python scripts/freeze.py compare DIR [--source CHECKOUT] [--case NAME ...] [--quick]

Every case runs through the command line in processes of its own, so nothing of the product's inside is used. `compare`
prints a line for each case and exits with 1 if anything differs: numbers, intervals, verdicts, words, columns and files
alike. Only what differs between two runs of one revision is left out: see `IGNORED`. SEMSTAB_DATA is the folder of the
real scenes.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

RENAMED: dict[str, str | None] = {}
"""Key, column, file, header or word of the kept revision -> its name now; None: gone by design (say why in a comment).

`parent.key` goes before `key`; the parent of a column is the stem of its file, or the folder if that is in FOLDERS. A
folder is `name/` on both sides. X_low, X_high and X_3 follow X.
"""

HERE = Path(__file__).resolve().parents[1]
TOLERANCE = 1e-12
SHOWN = 10
SECONDS = 900  # after which a command is given up

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


# --- Cases ------------------------------------------------------------------------------------------------------------

MACROS = {
    "quiet": "--rerun off --report off --quiet",
    "drawn": "--rerun off --report on --quiet",
    "small": "--scene scene0 --option width=96 --option height=64 --option frames=60 --frames 0:20 --voxel-size 0.4",
    "clusters": "--predict colour-clusters --model colour-clusters",
    "shelf": "--data {data}/apc_shelf",
}


@dataclass(frozen=True)
class Case:
    """Commands in a folder of their own; what they leave there is compared."""

    name: str
    commands: Sequence[str]
    quick: bool = False
    same: tuple[str, str] | None = None  # two runs of the case whose voxel tables are equal


def cases() -> list[Case]:
    """All cases, long ones first."""
    two = [
        f"run {{shelf}} -m {name} --voxel-size 0.02 --statistics --out of_{name} {{quiet}}" for name in ("gt", "fcn")
    ]
    city = "run {small} -m sim-flicker --statistics --check none"
    return [
        Case("shelf_statistics", ["run {shelf} -m fcn -m gt --statistics --events --out r {drawn}"], quick=True),
        Case("study", ["study {inputs}/study.yaml --option root={inputs}/walls --out r --rerun off --quiet"]),
        Case("brighton", ["run --data {data}/brighton {clusters} --voxel-size 0.5 --statistics --out r {drawn}"]),
        Case("compare", [*two, "compare of_gt of_fcn --out c --quiet", "compare of_fcn of_gt --out d --quiet",
                         "export of_fcn --to more.parquet --join d/columns/apc_shelf__fcn__gt.parquet --quiet"]),
        Case("city_statistics", ["run {small} -m sim-flicker -m sim-soft -m gt --statistics --events --out r {drawn}"]),
        Case("city_large", ["run -s scene0 -m sim-flicker --voxel-size 0.12 --check none --statistics "
                            "--out r {quiet}"]),
        Case("city_sparse", ["run -s scene3 -m sim-flicker --check none --statistics --out r {quiet}"]),
        Case("tiles", [f"{city} --out whole {{quiet}}", f"{city} --tile-size 64 --out tiled {{quiet}}"], quick=True,
             same=("whole", "tiled")),
        *(Case(f"city_{name}", [f"run {{small}} -m sim-flicker -m gt -b {name} --statistics --events --check none "
                                "--out r {quiet}"], quick=True)
          for name in ("numpy", "numba", "open3d", "open3d-projective")),
        Case("city_checked", ["run {small} -m sim-flicker -b open3d -b numba --check numpy --out r {drawn}"]),
        Case("hololens", ["run --data {data}/hololens {clusters} --frames ::3 --statistics --out r {quiet}"]),
        Case("shelf", ["run {shelf} --out r {quiet}"], quick=True),
        *(Case(f"shelf_gt_{size}", [f"run {{shelf}} -m gt --voxel-size {size} --out r {{quiet}}"])
          for size in ("0.01", "0.02", "0.04", "0.08")),
        *(Case(f"scores_{K}", [f"run --data {{inputs}}/scores{K} --voxel-size 0.1 --statistics --out r {{quiet}}",
                               f"run --data {{inputs}}/scores{K} --voxel-size 0.1 --top-k 3 --out top {{quiet}}"])
          for K in (7, 150)),
        Case("gate", [*two, *(f"gate of_fcn --against of_gt --rule 'alpha drop < 0.02' --rule 'vss > 0.5' --rule "
                              f"'class *: recall > 0.6' --scope={scope} --out {scope}.json --quiet"
                              for scope in ("this-scene", "these-frames")),
                      "gate of_gt --against of_gt --rule 'vss > 0.1' --save-baseline base.zip --quiet",
                      "gate of_fcn --against base.zip --rule 'vss drop < 0.02' --out kept.json --quiet"]),
        Case("calibrate", [*two[1:], "calibrate of_fcn --out acted.yaml --precision 0.5 --confidence 0.8 --quiet",
                           "export of_fcn --to acted.csv --thresholds acted.yaml --quiet",
                           "relabel of_fcn --out acted --thresholds acted.yaml --quiet"]),
        Case("relabel", [*two[1:], "relabel of_fcn --out fused --min-op 2 --min-psa 0.5 --quiet",
                         "relabel of_fcn --out others --leave-one-out --quiet"]),
        Case("export", ["run --data {data}/brighton {clusters} --voxel-size 1 --statistics --out r {quiet}",
                        "export r --to m.ply --to m.las --to m.laz --to m.tif --to m.glb --to m.parquet --to m.csv -q",
                        "export r --to few.csv --min-op 3 --measure vss --measure psa --quiet",
                        "export r --to coarse.tif --cell 4 --measure entropy --quiet",
                        "export r --classify m.las --to onto.las --radius 2 --quiet"]),
        Case("filters", ["filters {shelf} -m fcn --filter ema-warped:0.6 --filter vote:3 --voxel-size 0.02 "
                         "--frames ::2 --out r --report off --quiet"]),
        Case("predict", ["predict --model colour-clusters {shelf} --frames ::5 --scores --out p --quiet"]),
        Case("convert", ["convert {shelf} --frames ::5 --out c --quiet",
                         "convert --dataset tum --config {inputs}/tum.yaml --data {inputs}/tum --out t --quiet"]),
        Case("check", ["check {shelf} --json c.json --quiet"]),
        Case("regions", ["study {inputs}/regions.yaml --option root={inputs}/wall --out r --rerun off --quiet"]),
        *(Case(name, [f"run --dataset {name} --config {{inputs}}/{name}.yaml --data {{inputs}}/{name} --voxel-size 0.1 "
                      "--statistics --out r {quiet}"]) for name in ("odm", "colmap", "tum")),
    ]  # fmt: skip


WRITER = """
import pathlib, sys
import cv2, numpy as np, yaml
import dataset_writers, tiny_study, wall_study

out = pathlib.Path(sys.argv[1])
def settings(name, content):
    (out / f"{name}.yaml").write_text(yaml.safe_dump(content))

for name, kind in (("odm", "odm"), ("colmap", "colmap, text"), ("tum", "tum")):
    form = dataset_writers.FORMATS[kind]
    frames = dataset_writers.source(form.scale)
    folder = out / name / "room"
    folder.mkdir(parents=True)
    dataset_writers.write_labels(folder, form.write(folder, frames), frames)
    options = {key: value() if callable(value) else value for key, value in form.options.items()}
    settings(name, {"dataset": {"name": name, "options": {"classes": dataset_writers.CLASSES, **options}}})

for name, step in wall_study.STEPS.items():
    wall_study.write_wall(out / "walls" / name, step)
posed = {"dataset": {"name": "posed_folder"}}
sweeps = {"voxel_size": [0.0625, 0.125], "depth_noise": {"values": [0, 0.01], "repeats": 2}}
settings("study", {**posed, "name": "walls", "models": ["nervous"], "voxel_size": 0.0625, "sweeps": sweeps,
                   "statistics": True, "backends": ["numpy", {"name": "numba", "scenes": ["often"]}]})

tiny_study.write(out / "wall", models=("a",), frames=4)
(out / "wall/labels/regions").mkdir()
for i in range(4):
    ids = np.where(np.arange(8) + i < 5, 200 + 2 * i, 300 - i).astype(np.uint16)
    cv2.imwrite(str(out / f"wall/labels/regions/{i:04d}.png"), np.tile(ids, (6, 1)))
settings("regions", {**posed, "voxel_size": 0.25, "region_maps": ["regions"], "backends": ["numpy"]})
"""
"""Run beside the tests of the kept revision: scenes in the formats of several programs, and settings of studies."""


def write_scores(folder: Path, K: int) -> None:
    """A posed folder with soft scores of K classes, drawn by a seed."""
    import cv2

    rng, height, width = np.random.default_rng(K), 32, 48
    for part in ("depth", "pose", "scores/net"):
        (folder / part).mkdir(parents=True)
    np.savetxt(folder / "intrinsics.txt", [[40, 0, 24], [0, 40, 16], [0, 0, 1]])
    classes = ", ".join(f"class {k}" for k in range(K))
    (folder / "scene.yaml").write_text(f"up_axis: -y\nclasses: [{classes}]\n")
    blocks = rng.dirichlet(np.full(K, 0.05), (height // 8, width // 8)).repeat(8, 0).repeat(8, 1)
    for i in range(8):
        pose = np.eye(4)
        pose[:3, 3] = 0.05 * i + 0.003, 0.02 * i + 0.004, 0.005
        np.savetxt(folder / f"pose/{i:03d}.txt", pose)
        depth = 1500 + 300 * np.sin(np.arange(width) / 9 + i / 8) + np.zeros((height, 1))
        cv2.imwrite(str(folder / f"depth/{i:03d}.png"), depth.astype(np.uint16))
        scores = (0.6 * blocks + 0.4 * rng.dirichlet(np.full(K, 0.05), (height, width))).astype(np.float32)
        np.savez_compressed(folder / f"scores/net/{i:03d}.npz", scores=scores.transpose(2, 0, 1))


# --- Running ----------------------------------------------------------------------------------------------------------


def link_tree(root: Path, tree: Path) -> Path:
    """A folder from which `import semstab` takes the code of a checkout."""
    tree.mkdir(parents=True)
    (tree / "semstab").symlink_to(root / "src" / "semstab")
    return tree


def run_case(case: Case, tree: Path, out: Path, places: Mapping[str, str]) -> str:
    """Run its commands in a new folder; what went wrong, else nothing."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": str(tree), "SEMSTAB_CACHE": str(tree / "cache")}
    codes = []
    for command in case.commands:
        parts = shlex.split(_filled(command, MACROS))
        line = ["-m", "semstab", *(_filled(part, places) for part in parts)]
        try:
            done = subprocess.run(
                [sys.executable, *line],
                cwd=out,
                env=environment,
                capture_output=True,
                text=True,
                timeout=SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"{shlex.join(line)}: not done after {SECONDS} s"
        codes.append(str(done.returncode))
        if done.returncode not in (0, 3, 4, 5):
            return f"{shlex.join(line)}: exit code {done.returncode}\n{(done.stdout + done.stderr).strip()[-1200:]}"
    (out / "exit_codes").write_text(" ".join(codes))
    return ""


def _filled(text: str, values: Mapping[str, str]) -> str:
    for name, value in values.items():
        text = text.replace("{" + name + "}", value)
    return text


def write_inputs(root: Path, tree: Path, inputs: Path) -> None:
    """Scenes that both sides read, by the code and the tests of the kept revision."""
    shutil.rmtree(inputs, ignore_errors=True)
    inputs.mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), str(root / "tests")])}
    subprocess.run([sys.executable, "-c", WRITER, inputs], env=environment, check=True)
    for K in (7, 150):
        write_scores(inputs / f"scores{K}", K)
    (inputs / "done").touch()


# --- Comparing --------------------------------------------------------------------------------------------------------


@dataclass
class Comparison:
    """What differs between the two folders of a case, what is new, and the verdicts."""

    differences: list[str] = field(default_factory=list)
    new: Counter[str] = field(default_factory=Counter)
    verdicts: dict[str, None] = field(default_factory=dict)
    files: int = 0

    def differ(self, where: str, old: Any, new: Any) -> None:
        """One value that is not what it was."""
        self.differences.append(f"{where}: {str(old)[:90]} is now {str(new)[:90]}")

    def names(self, a: Mapping[str, Any], b: Mapping[str, Any], parent: str, what: str) -> dict[str, str]:
        """Keys of `a` that are compared, with their names in `b`."""
        found = {key: name for key in a if (name := renamed(key, parent)) is not None}
        self.new[what] += len(b.keys() - set(found.values()))
        return {key: name for key, name in found.items() if not IGNORED.fullmatch(key)}

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
            x, y = (np.asarray(each) for each in (a[key], b.get(name, [])))
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
    found: dict[str, Path] = {}
    for path in sorted(each for each in folder.rglob("*") if each.is_file()):
        tiled = path.name.startswith("tile=")
        where = path.relative_to(folder).as_posix()
        name = f"{Path(where).parent.as_posix()}.parquet" if tiled else where
        if not SKIPPED.fullmatch(name):
            found[name] = path.parent if tiled else path
    return found


def renamed(name: str, parent: str = "") -> str | None:
    """What a name of the kept revision is now; X_low, X_high and X_3 follow X."""
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
    flat = {name: c.flatten() if pa.types.is_fixed_size_list(c.type) else c for name, c in columns.items()}
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


# --- The command ------------------------------------------------------------------------------------------------------


def compare_case(case: Case, kept: Path, out: Path) -> tuple[bool, str]:
    """Whether nothing differs, and the line of the case with what does."""
    found = Comparison()
    found.folders(kept, out)
    if case.same:
        first, second = (listing(out / run) for run in case.same)
        tables = [name for name in first if name.startswith(("voxels/", "truth/"))]
        for name in tables:
            found.columns(of_parquet(first[name]), of_parquet(second[name]), f"{' and '.join(case.same)}: {name}", 0.0)
        if not tables:
            found.differ(" and ".join(case.same), "voxel tables", "missing")
    text = f", {found.files} files"
    text += "".join(f", {count} new {what}" for what, count in found.new.items() if count)
    text += f"\n        verdicts: {', '.join(found.verdicts)}" if found.verdicts else ""
    shown = found.differences[:SHOWN]
    if more := len(found.differences) - len(shown):
        shown.append(f"and {more} more" if more > 0 else "")
    return not found.differences, text + "".join(f"\n    {line}" for line in shown)


def main() -> int:
    """Keep or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    keeping, comparing = actions.add_parser("keep"), actions.add_parser("compare")
    keeping.add_argument("--revision", default="HEAD")
    keeping.add_argument("--into", dest="folder", type=Path, required=True)
    comparing.add_argument("folder", type=Path, help="where an earlier `keep` left its outputs")
    for action in (keeping, comparing):
        action.add_argument("--source", type=Path, default=HERE, help="the checkout; by default the script's own")
        action.add_argument("--case", action="append", help="cases whose names begin so; repeatable")
        action.add_argument("--quick", action="store_true", help="the city, the shelf, statistics and tiles alone")
        action.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    keeps, source, folder = given.action == "keep", given.source.resolve(), given.folder.resolve()
    wanted = tuple(given.case or [""])
    chosen = [case for case in cases() if case.name.startswith(wanted) and (case.quick or not given.quick)]
    data = folder / "data"  # where the real scenes were when outputs were kept: worktrees have none beside them
    if keeps:
        folder.mkdir(parents=True, exist_ok=True)
        data.unlink(missing_ok=True)
        data.symlink_to(Path(os.environ.get("SEMSTAB_DATA", source.parent / "shared/data")).resolve())
    places = {"data": os.environ.get("SEMSTAB_DATA", str(data.resolve())), "inputs": str(folder / "inputs")}
    label = "kept" if keeps else f"now/{source.name}-{hashlib.sha256(str(source).encode()).hexdigest()[:8]}"

    def one(case: Case) -> tuple[bool, str]:
        began, out, kept = time.monotonic(), folder / label / case.name, folder / "kept" / case.name
        if not keeps and not (kept / "exit_codes").exists():
            return False, "was not kept"
        if error := run_case(case, tree, out, places):
            return False, error
        good, text = (True, "") if keeps else compare_case(case, kept, out)
        if good and not keeps:
            shutil.rmtree(out)
        return good, f"{time.monotonic() - began:5.1f} s{text}"

    began, bad = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(given.jobs) as pool:
        root = Path(name) / "revision" if keeps else source
        if keeps:
            root.mkdir()
            archive = ["git", "-C", str(source), "archive", given.revision]
            content = subprocess.run(archive, capture_output=True, check=True).stdout
            subprocess.run(["tar", "-x", "-C", str(root)], input=content, check=True)
        tree = link_tree(root, Path(name) / "tree")
        if keeps and not (folder / "inputs/done").exists():
            write_inputs(root, tree, folder / "inputs")
        for case, (good, text) in zip(chosen, pool.map(one, chosen), strict=True):
            bad += not good
            print(f"{'ok     ' if good else 'DIFFERS'} {case.name:22} {text}", flush=True)
    print(f"{len(chosen)} cases, {bad} not as they were; {time.monotonic() - began:.0f} s")
    return int(bad > 0 or not chosen)


if __name__ == "__main__":
    sys.exit(main())
