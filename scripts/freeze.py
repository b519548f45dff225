"""Keep the outputs of a revision for fixed cases, and compare the outputs of a working tree with them.

    python scripts/freeze.py keep [--revision HEAD] --into DIR [--case NAME ...] [--quick]
    python scripts/freeze.py compare DIR [--source CHECKOUT] [--case NAME ...] [--quick]

Every case runs through the command line in processes of its own, so nothing of the product's inside is used. `compare`
prints a line for each case and exits with 1 if any number, interval, verdict, word, column or file differs. Only what
differs between two runs of one revision is left out: `differences.py` lists it, and the names that changed.
SEMSTAB_DATA is the folder of the real scenes.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from differences import FolderComparison, listing, of_parquet

HERE = Path(__file__).resolve().parents[1]
SHOWN = 10
SECONDS = 900  # after which a command is given up

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
"""Run next to the tests of the kept revision: scenes in the formats of several programs, and settings of studies."""


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


# --- The command ------------------------------------------------------------------------------------------------------


def compare_case(case: Case, reference: Path, out: Path) -> tuple[bool, str]:
    """Return whether the outputs are equal, and the line of the case with the differences."""
    comparison = FolderComparison()
    comparison.folders(reference, out)
    if case.same:
        first, second = (listing(out / run) for run in case.same)
        tables = [name for name in first if name.startswith(("voxels/", "truth/"))]
        for name in tables:
            comparison.columns(
                of_parquet(first[name]), of_parquet(second[name]), f"{' and '.join(case.same)}: {name}", 0.0
            )
        if not tables:
            comparison.differ(" and ".join(case.same), "voxel tables", "missing")
    text = f", {comparison.files} files"
    text += "".join(f", {count} new {what}" for what, count in comparison.new.items() if count)
    text += f"\n        verdicts: {', '.join(comparison.verdicts)}" if comparison.verdicts else ""
    differences = comparison.differences[:SHOWN]
    if more := len(comparison.differences) - len(differences):
        differences.append(f"and {more} more" if more > 0 else "")
    return not comparison.differences, text + "".join(f"\n    {line}" for line in differences)


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
    data = folder / "data"  # where the real scenes were when outputs were kept: worktrees have none next to them
    if keeps:
        folder.mkdir(parents=True, exist_ok=True)
        data.unlink(missing_ok=True)
        data.symlink_to(Path(os.environ.get("SEMSTAB_DATA", source.parent / "shared/data")).resolve())
    places = {"data": os.environ.get("SEMSTAB_DATA", str(data.resolve())), "inputs": str(folder / "inputs")}
    label = "kept" if keeps else f"now/{source.name}-{hashlib.sha256(str(source).encode()).hexdigest()[:8]}"

    def one(case: Case) -> tuple[bool, str]:
        began, out, reference = time.monotonic(), folder / label / case.name, folder / "kept" / case.name
        if not keeps and not (reference / "exit_codes").exists():
            return False, "was not kept"
        if error := run_case(case, tree, out, places):
            return False, error
        good, text = (True, "") if keeps else compare_case(case, reference, out)
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
