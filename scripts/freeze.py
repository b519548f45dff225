"""Keep the outputs of an earlier revision for fixed runs, and compare those of the working tree with them.

    python scripts/freeze.py keep /tmp/freeze --revision 07664a4      # once
    python scripts/freeze.py compare /tmp/freeze [--case city]    # after each step; 1 if anything differs

Everything goes through the command line, so that nothing inside needs to stay. Voxel tables and series are compared bit
by bit, summaries and tables to 1e-12. Names that changed are in `RENAMED`, commands that changed in `WORDS`.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("SEMSTAB_DATA", HERE.parent / "shared/data"))
TOP = ("backends", "backbones", "datasets", "configs", "conformance")
TOLERANCE = 1e-12
MOST_SHOWN = 10

RENAMED: dict[str, str | None] = {
    "judged": "headline",
    "reach": "ceiling_share",
    "reached": "share",
    "ceiling_share.classes.matters": "counts_for_verdict",
    "beyond_coin": "excess_over_chance",
    "settling": "drift_below_null",
    "each_place": "voxel_weighted",
    "ceiling_share.classes.places": "locations",
}
"""Keys of JSON, or ends of their paths, by their names at the kept revision; None: gone by design."""

OF_STATISTICS = ("sbd_null", "sbd_excess", "trend")
"""Columns of voxels that statistics compute: compared to 1e-12."""

RENAMED_COLUMNS: dict[str, str | None] = {}
"""Columns of Parquet and CSV, and files, likewise."""

BY_DESIGN = re.compile(
    r"paired\.(blocks|block_size)|rankings\[\d+\]\.ranks\[\d+\]\.(best|low|high)"  # resamples of the one engine
    r"|(disagreement|geometry|model|standardised)[._](low|high)|^range$|best_percent"
    r"|(geometry\.\w+|standardised\.values\.\w+\.\w+)\.(low|high|block_size|degrees)"  # intervals of the one engine
)
"""Numbers that changed with the redesign, as docs/validity.md tells."""

ROUNDED = ("influence", "looks")
"""Folders of sums that later commands read: compared to 1e-12, not bit by bit."""

WORDS: dict[str, str] = {}
"""Commands and options by their names at the kept revision."""

IGNORED = re.compile(
    r"^(key|unit|image)$|seconds|_ms|(^|_)ms$|time|memory|rss|bytes|version|date|path|folder|file|digest|identity|command|manifest|python"
    r"|machine|host|cpu|threads|platform|packages|schema|source|inputs?$|where$|columns$|text|sentence|advice|remarks?"
    r"|reason|line|title|caption|said|story|about|calibrated_on|created"
)
"""Keys whose values are times, places, versions, or sentences for people."""

QUIET = ("--rerun", "off", "--report", "off", "--quiet")
CITY = (
    "--set", "dataset.options.width=96", "--set", "dataset.options.height=64", "--set", "dataset.options.frames=12",
    "--scene", "scene0", "--voxel-size", "0.4",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """Commands in a folder of their own: words with {data}, {inputs}; whatever they write there is compared."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    exact: bool = True


def run(name: str, *words: str) -> Case:
    """A run without pictures."""
    return Case(name, (("run", *words, "--out", "run", *QUIET),))


def cases() -> tuple[Case, ...]:
    """All of them."""
    shelf, wall = ("--data", "{data}/apc_shelf"), ("--data", "{inputs}/wall")
    clusters = ("--predict", "colour-clusters", "--backbone", "colour-clusters")
    fine = ("--voxel-size", "0.02", "--statistics")
    two = tuple(("run", *shelf, "-m", name, *fine, "--out", name, *QUIET) for name in ("gt", "fcn"))
    backends = ("numpy", "numba", "open3d", "open3d-projective", "torch")
    suffixes = ("ply", "las", "tif", "glb", "parquet", "csv")
    return (
        *(run(f"city_{name}", *CITY, "-b", name, "--check", "none") for name in backends),
        run("city_checked", *CITY, "-b", "open3d", "-b", "numba"),
        run("city_statistics", *CITY, "-m", "sim-flicker", "-m", "gt", "--statistics", "--events"),
        run("scores_7", "--data", "{inputs}/scores7", "--voxel-size", "0.1", "--statistics"),
        run("scores_150", "--data", "{inputs}/scores150", "--voxel-size", "0.1"),
        Case("study", (("study", "{inputs}/study.yaml", "--out", "run", *QUIET[:4]),)),
        Case("regions", (("study", "{inputs}/regions.yaml", "--out", "run", *QUIET[:4]),)),
        *(run(form, "--config", f"{{inputs}}/{form}.yaml") for form in ("odm", "colmap", "tum")),
        run("shelf", *shelf, "--statistics"),
        *(run(f"shelf_gt_{r}", *shelf, "-m", "gt", "--voxel-size", r) for r in ("0.01", "0.02", "0.04", "0.08")),
        Case("tables", (("run", *shelf, "--statistics", "--out", "run", "--rerun", "off", "--quiet"),)),
        run("hololens", "--data", "{data}/hololens", *clusters, "--frames", "::3"),
        run("brighton", "--data", "{data}/brighton", *clusters, "--voxel-size", "0.5", "--statistics"),
        Case("compare", (*two, ("compare", "gt", "fcn", "--out", "compared", "--quiet"))),
        Case("gate", (*two, (
            "gate", "fcn", "--against", "gt", "--rule", "alpha drop < 0.02", "--rule", "vss > 0.5", "--rule",
            "class *: recall > 0.6", "--out", "gate.json", "--quiet",
        ))),
        Case("calibrate", (*two[1:], ("commit", "fcn", "--out", "commit.yaml", "--quiet"))),
        Case("exports", (
            ("run", "--data", "{data}/brighton", *clusters, "--voxel-size", "1", "--out", "run", *QUIET),
            ("export", "run", *(word for s in suffixes for word in ("--to", f"map.{s}")), "--quiet"),
            ("export", "run", "--to", "some.csv", "--min-op", "3", "--measure", "vss", "--quiet"),
        )),
        Case("relabel", (*two[1:], ("relabel", "fcn", "--out", "labels", "--min-op", "2", "--quiet"))),
        Case("convert", (("convert", *shelf, "--frames", "::5", "--out", "converted", "--quiet"),)),
        run("tiles", *CITY, "-m", "sim-flicker", "--tile-size", "32", "--statistics"),
        run("wall", *wall, "-m", "a", "-m", "b", "--statistics", "--events", "--voxel-size", "0.2"),
    )  # fmt: skip


# --- Running ----------------------------------------------------------------------------------------------------------


def import_tree(root: Path, folder: Path) -> Path:
    """A folder from which `import semstab` takes the code of a checkout."""
    package = folder / "semstab"
    package.mkdir(parents=True)
    for child in [*(root / "benchmark").iterdir(), *(root / name for name in TOP)]:
        if child.name != "__pycache__":
            (package / child.name).symlink_to(child)
    return folder


def run_case(case: Case, tree: Path, out: Path, inputs: Path, words: dict[str, str]) -> str:
    """Run its commands in a new folder; an error's last lines, empty where all went well."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    environment = os.environ | {"PYTHONPATH": str(tree), "SEMSTAB_DATA": str(DATA), "COLUMNS": "100"}
    for command in case.commands:
        made = [words.get(word, word).format(data=DATA, inputs=inputs) for word in command]
        done = subprocess.run(
            [sys.executable, "-m", "semstab", *made],
            cwd=out,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode not in (0, 3, 4):
            return f"{' '.join(made)}: exit code {done.returncode}\n{(done.stdout + done.stderr)[-1500:]}"
        with (out / "exit_codes.json").open("a") as codes:
            codes.write(f"{done.returncode}\n")
    return ""


def write_inputs(root: Path, tree: Path, inputs: Path) -> None:
    """Scenes that the tests' writers make, by the code of the kept revision."""
    shutil.rmtree(inputs, ignore_errors=True)
    inputs.mkdir(parents=True)
    code = f"""
import json, sys; sys.path.insert(0, {str(root / "tests")!r})
from pathlib import Path
import cv2, numpy as np
import tiny_study
from dataset_writers import CLASSES, FORMATS, camera_option, source, write_labels
out = Path({str(inputs)!r})
for name, form in (("odm", "odm"), ("colmap", "colmap, text"), ("tum", "tum")):
    frames = source(FORMATS[form].scale)
    folder = out / name / "room"; folder.mkdir(parents=True)
    names = FORMATS[form].write(folder, frames)
    write_labels(folder, names, frames)
    options = {{"root": str(out / name), "classes": CLASSES}}
    options |= {{"intrinsics": camera_option()}} if name == "tum" else {{}}
    config = {{"dataset": {{"name": name, "options": options}}, "voxel_size": 0.1}}
    (out / f"{{name}}.yaml").write_text(json.dumps(config, default=list))
tiny_study.write(out / "wall", backbones=("a", "b"), frames=4)
(out / "wall/labels/regions").mkdir()
columns = np.arange(8)
for i in range(4):
    ids = np.where(columns + i < 5, 200 + 2 * i, 300 - i).astype(np.uint16)
    cv2.imwrite(str(out / f"wall/labels/regions/{{i:04d}}.png"), np.tile(ids, (6, 1)))
for K in (7, 150):
    rng, folder = np.random.default_rng(K), out / f"scores{{K}}"
    for part in ("depth", "pose", "scores/net"): (folder / part).mkdir(parents=True)
    np.savetxt(folder / "intrinsics.txt", [[40, 0, 24], [0, 40, 16], [0, 0, 1]])
    base = rng.dirichlet(np.full(K, 0.1), (4, 6)).repeat(8, 0).repeat(8, 1)
    for i in range(8):
        T = np.eye(4); T[:3, 3] = 0.05 * i + 0.003, 0.02 * i + 0.004, 0.005
        np.savetxt(folder / f"pose/{{i:03d}}.txt", T)
        depth = 1500 + 300 * np.sin(np.arange(48) / 9 + i / 8)[None, :] + np.zeros((32, 1))
        cv2.imwrite(str(folder / f"depth/{{i:03d}}.png"), depth.astype(np.uint16))
        scores = base + 0.5 * rng.dirichlet(np.full(K, 0.1), (32, 48))
        np.savez_compressed(folder / f"scores/net/{{i:03d}}.npz", scores=scores.transpose(2, 0, 1).astype(np.float32))
    (folder / "scene.yaml").write_text("up_axis: -y\\nclasses: [" + ", ".join(f"c{{k}}" for k in range(K)) + "]\\n")
"""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    wall = f"dataset: {{name: posed_folder, options: {{root: {inputs / 'wall'}}}}}\nvoxel_size: 0.2\n"
    (inputs / "study.yaml").write_text(
        wall + "backbones: [a, b]\nstatistics: true\nsweeps: {voxel_size: [0.1, 0.4], pixel_stride: [1, 2]}\n"
    )
    (inputs / "regions.yaml").write_text(wall + "backbones: [a]\nregion_maps: [regions]\nbackends: [{name: numpy}]\n")


# --- Comparing --------------------------------------------------------------------------------------------------------


def differences(old: Path, new: Path) -> Iterator[str]:
    """What the new folder of a case does not have as the old one has it."""
    for file in sorted(path for path in old.rglob("*") if path.is_file()):
        where = file.relative_to(old)
        if any(part in ("units", ".semstab", "recording.rrd") for part in where.parts):
            continue
        compare = READERS.get(file.suffix)
        if compare is None or file.name in ("manifest.json", "config.yaml"):
            continue
        name = RENAMED_COLUMNS.get(file.name, file.name)
        if name is None:
            continue
        other = new / where.with_name(name)
        if not other.is_file():
            yield f"{where}: missing"
        else:
            yield from (f"{where}: {line}" for line in compare(file, other))


def _close(a: Any, b: Any) -> bool:
    if isinstance(a, bool) or isinstance(b, bool) or not isinstance(a, int | float) or not isinstance(b, int | float):
        return bool(a == b)
    return (math.isnan(a) and math.isnan(b)) or abs(a - b) <= TOLERANCE * max(1.0, abs(a), abs(b))


def of_json(old: Path, new: Path) -> Iterator[str]:
    """Values by their keys."""
    if old.name == "exit_codes.json":
        yield from [] if old.read_text() == new.read_text() else ["exit codes differ"]
        return
    yield from _nodes(json.loads(old.read_text()), json.loads(new.read_text()), "")


def _nodes(a: Any, b: Any, where: str) -> Iterator[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        for key, value in a.items():
            ends = re.sub(r"\[\d+\]", "", f"{where}.{key}").split(".")
            name = RENAMED.get(".".join(ends[-3:]), RENAMED.get(key, key))
            if name is None or IGNORED.search(key):
                continue
            if name not in b:
                yield f"{where}.{name}: missing (was {str(value)[:60]})"
            else:
                yield from _nodes(value, b[name], f"{where}.{name}")
    elif isinstance(a, list) and isinstance(b, list):
        if len(a) != len(b):
            yield f"{where}: {len(a)} entries, now {len(b)}"
        for i, (x, y) in enumerate(zip(a, b, strict=False)):
            yield from _nodes(x, y, f"{where}[{i}]")
    elif not _close(a, b) and not (isinstance(a, str) and " " in a) and not BY_DESIGN.search(where):
        yield f"{where}: {str(a)[:80]} is now {str(b)[:80]}"


def of_yaml(old: Path, new: Path) -> Iterator[str]:
    """The same of YAML."""
    import yaml

    yield from _nodes(yaml.safe_load(old.read_text()), yaml.safe_load(new.read_text()), "")


def of_parquet(old: Path, new: Path) -> Iterator[str]:
    """Columns bit by bit."""
    import pyarrow.parquet as pq

    a, b = pq.read_table(old), pq.read_table(new)
    if old.parent.name in ROUNDED:
        axes = [(name, "ascending") for name in ("ix", "iy", "iz", "frame") if name in a.column_names]
        a, b = (table.sort_by(axes) if axes else table for table in (a, b))
    if a.num_rows != b.num_rows:
        yield f"{a.num_rows} rows, now {b.num_rows}"
        return
    for key in a.column_names:
        name = RENAMED_COLUMNS.get(key, key)
        if name is None:
            continue
        if name not in b.column_names:
            yield f"column {name}: missing"
        elif not _same(
            a[key].combine_chunks(),
            b[name].combine_chunks(),
            rounded=old.parent.name in ROUNDED or key in OF_STATISTICS,
        ):
            yield f"column {name}: differs"


def _same(a: Any, b: Any, *, rounded: bool) -> bool:
    if a.equals(b):
        return True
    try:
        x, y = (np.asarray(column.to_numpy(zero_copy_only=False)) for column in (a, b))
        if rounded and x.dtype.kind == "f":
            scale = TOLERANCE * (1 + np.nan_to_num(np.abs(x)).max(initial=0))
            return bool(np.allclose(x, y, rtol=TOLERANCE, atol=scale, equal_nan=True))
        return bool(np.array_equal(x, y, equal_nan=x.dtype.kind == "f"))
    except (TypeError, ValueError):
        return bool(a.to_pylist() == b.to_pylist())


def of_csv(old: Path, new: Path) -> Iterator[str]:
    """Cells; those of series to the last bit, as text."""
    rows = [list(csv.DictReader(path.open(newline=""))) for path in (old, new)]
    if len(rows[0]) != len(rows[1]):
        yield f"{len(rows[0])} rows, now {len(rows[1])}"
        return
    for n, (a, b) in enumerate(zip(*rows, strict=True)):
        for key, value in a.items():
            name = RENAMED_COLUMNS.get(key, key)
            if name is None or IGNORED.search(key):
                continue
            if name not in b:
                yield f"column {name}: missing"
                return
            if (
                value != b[name]
                and not BY_DESIGN.search(key)
                and not ("tiles" in old.parts and _close_text(value, b[name]))
            ):
                yield f"row {n}, {name}: {value} is now {b[name]}"
                return


def _close_text(a: str, b: str) -> bool:
    """Of tiles, whose sums are added in another order."""
    try:
        return _close(float(a), float(b))
    except ValueError:
        return False


def of_image(old: Path, new: Path) -> Iterator[str]:
    """Pixels."""
    import cv2

    a, b = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (old, new))
    if a is None or b is None or not np.array_equal(a, b):
        yield "pixels differ"


def of_raster(old: Path, new: Path) -> Iterator[str]:
    """Bands and where they lie."""
    import rasterio

    with rasterio.open(old) as a, rasterio.open(new) as b:
        if a.transform != b.transform or a.crs != b.crs or not np.array_equal(a.read(), b.read(), equal_nan=True):
            yield "raster differs"


def of_las(old: Path, new: Path) -> Iterator[str]:
    """Points by dimension."""
    import laspy

    a, b = laspy.read(old), laspy.read(new)
    for name in a.point_format.dimension_names:
        other = RENAMED_COLUMNS.get(name, name)
        x, y = np.asarray(a[name]), np.asarray(b[other or name])
        if other is not None and not np.array_equal(x, y, equal_nan=x.dtype.kind == "f"):
            yield f"dimension {name} differs"


def of_mesh(old: Path, new: Path) -> Iterator[str]:
    """Corners of triangles and their colours, in whatever order."""
    import trimesh

    found = []
    for path in (old, new):
        mesh = trimesh.load(path, force="mesh", process=False)
        corners = np.asarray(mesh.triangles).reshape(len(mesh.faces), -1).round(4)
        found.append(corners[np.lexsort(corners.T)])
    if found[0].shape != found[1].shape or not np.allclose(found[0], found[1], atol=2e-4):
        yield f"mesh differs: {found[0].shape} and {found[1].shape}"


def of_bytes(old: Path, new: Path) -> Iterator[str]:
    """Bytes."""
    if old.read_bytes() != new.read_bytes():
        yield "bytes differ"


READERS: dict[str, Callable[[Path, Path], Iterator[str]]] = {
    ".json": of_json, ".yaml": of_yaml, ".parquet": of_parquet, ".csv": of_csv, ".png": of_image, ".tif": of_raster,
    ".las": of_las, ".glb": of_mesh, ".ply": of_bytes, ".npy": of_bytes,
}  # fmt: skip


def verdicts(folder: Path) -> Iterator[str]:
    """What the statistics call each unit."""
    for file in sorted(folder.rglob("summary.json")):
        for row in json.loads(file.read_text()).get("runs", []):
            verdict = ((row.get("statistics") or {}).get("verdict") or {}).get("level")
            if verdict:
                yield f"{row.get('backbone')} {verdict}"


# --- The command ------------------------------------------------------------------------------------------------------


def main() -> int:
    """Keep or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("keep", "compare"))
    parser.add_argument("folder", type=Path, help="where the outputs of the earlier revision lie")
    parser.add_argument("--revision", default="07664a4")
    parser.add_argument("--source", type=Path, default=HERE, help="the checkout that is compared")
    parser.add_argument("--case", action="append", help="only cases whose names begin so")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    folder = given.folder.resolve()
    inputs = folder / "inputs"
    chosen = [case for case in cases() if not given.case or case.name.startswith(tuple(given.case))]
    with tempfile.TemporaryDirectory() as name:
        root, words = given.source.resolve(), WORDS
        if given.what == "keep":
            root, words = Path(name) / "earlier", {}
            subprocess.run(
                ["git", "-C", str(HERE), "worktree", "add", "--detach", str(root), given.revision], check=True
            )
        tree = import_tree(root, Path(name) / "tree")
        try:
            if given.what == "keep":
                write_inputs(root, tree, inputs)
            return _all(given.what, chosen, tree, folder, words, given.jobs)
        finally:
            if given.what == "keep":
                subprocess.run(["git", "-C", str(HERE), "worktree", "remove", "--force", str(root)], check=True)


def _all(what: str, chosen: list[Case], tree: Path, folder: Path, words: dict[str, str], jobs: int) -> int:
    def one(case: Case) -> tuple[Case, str, list[str], float]:
        began, out = time.monotonic(), folder / ("kept" if what == "keep" else "now") / case.name
        error = run_case(case, tree, out, folder / "inputs", words)
        found = [] if error or what == "keep" else list(differences(folder / "kept" / case.name, out))
        return case, error, found, time.monotonic() - began

    bad = 0
    with ThreadPoolExecutor(jobs) as pool:
        for case, error, found, seconds in pool.map(one, chosen):
            out = folder / ("kept" if what == "keep" else "now") / case.name
            said = "; ".join(dict.fromkeys(verdicts(out)))
            state = "FAILED" if error else ("DIFFERS" if found else "ok")
            print(f"{case.name:20} {state:8} {seconds:5.1f} s  {said}", flush=True)
            for line in error.splitlines()[-12:] if error else found[:MOST_SHOWN]:
                print(f"    {line}")
            if len(found) > MOST_SHOWN:
                print(f"    and {len(found) - MOST_SHOWN} more")
            bad += bool(error or found)
    print(f"{len(chosen)} cases, {bad} differ" if bad else f"{len(chosen)} cases: all as before")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
