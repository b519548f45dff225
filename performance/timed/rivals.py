"""CPU time, memory, voxels and labels of semstab's fusion, and of other programs that fuse the same points.

A camera walks round a noisy room; 12 % of the patches of its label maps err. Each implementation runs as a program of
its own on one core, and they take turns. The columns:

- CPU ms: a frame after the first, the median over frames and rounds; faster: the time of Open3D's own
  `VoxelBlockGrid.integrate`, which has no labels, over it
- bytes: what the process grew by from before the first frame to after the last one, a voxel; peak: to its highest
- missing, extra: voxels that only numba's map of the same points has, or only the program's
- label differs: share of their common voxels with another most likely class; without ties: of those where the largest
  evidence of numba's map is one class's

`--rival "NAME=PROGRAM WORDS" ...` names other programs, `--commit NAME=FOLDER ...` or `=HASH` the state of each.
`--pyslam` names your checkout of pySLAM (luigifreda/pyslam). Its semantic voxel blocks (cpp/volumetric) are compiled
with the driver rivals/pyslam.cpp and pySLAM's own flags; this needs g++ and headers, on Debian and Ubuntu

    apt install g++ libtbb-dev libeigen3-dev libopencv-dev pybind11-dev

`--keep FOLDER` keeps our runs of these frames, by the rules mean and votes, and the rivals' maps, for
`semstab-bench maps FOLDER/mean FOLDER/*.npz`.

Any other rival is a program that you have built. Nothing of another project is part of semstab. A rival is called as
PROGRAM WORDS IN OUT. All numbers are little-endian:

- IN: float64 voxel size, int64 K, int64 frames; then of each frame int64 n, three float64 of the camera's position,
  n x 3 float64 world points, n int32 labels 0..K-1. A coordinate is a float32 number.
- OUT: int64 n, n x 3 float64 points, each anywhere in its voxel, n int32 labels. The voxel of x is floor(x / size).
- Standard output: one line of JSON, {"ms": [CPU time of each frame], "bytes": resident memory after the last frame less
  that before the first, "peak_bytes": the highest (VmHWM) less that before the first}.

SLIM-VDB (umfieldrobotics/slim-vdb, 89e10e32) was not measured: `VDBVolume.h` names `VecXFGrid` and `VecXF32`, which
branch slim-vdb of its fork of OpenVDB (7e1f4fe2, the newest at hand) does not have, nor does OpenVDB itself; the fork
also asks for Boost 1.80, where Debian 12 has 1.74. It fuses along each ray within the truncation of a distance field:
its voxels would not be those of the points.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Literal

import measuring
import numpy as np
import room

import semstab
from semstab import backends
from semstab.core.process import resident_bytes, trim_malloc
from semstab.metrics import dominant

BASELINE, OURS, IMAGES = "Open3D integrate", "semstab numba", "semstab numba, depth images"
OWN = {BASELINE: "open3d", OURS: "points", IMAGES: "images"}
BENCH = Path(__file__).parents[1] / "bench.py"


def views(size: str, frames: int, K: int) -> list[semstab.Frame]:
    """The frames of the walk."""
    return [room.frame(index, *measuring.sides(size), K) for index in range(frames)]


def world(frame: semstab.Frame) -> tuple[Any, Any]:
    """World points of the valid pixels, float32 as a scan has them, and their labels."""
    assert frame.labels is not None
    x, y = np.meshgrid(*frame.rays)
    z = frame.depth.astype(np.float64)
    points = np.stack([x * z, y * z, z], axis=-1)[frame.valid] @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]
    return points.astype(np.float32), frame.labels[frame.valid]


def scan(frame: semstab.Frame) -> semstab.Frame:
    """The frame as a scan of world points."""
    points, labels = world(frame)
    return semstab.Frame(frame.index, points=points, labels=labels, T_wc=np.eye(4))


def write_frames(path: Path, frames: Sequence[semstab.Frame], voxel_size: float, K: int) -> None:
    """Write IN."""
    with path.open("wb") as file:
        file.write(np.array(voxel_size, "<f8").tobytes() + np.array([K, len(frames)], "<i8").tobytes())
        for frame in frames:
            points, labels = world(frame)
            file.write(np.array(len(points), "<i8").tobytes() + frame.T_wc[:3, 3].astype("<f8").tobytes())
            file.write(points.astype("<f8").tobytes() + labels.astype("<i4").tobytes())


def highest() -> int:
    """Bytes of the most memory that this process has had since it last forgot."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def fuse(kind: str, out: Path, images: str, count: int, K: int, size: float) -> None:
    """Be one of our own programs: 'open3d', 'points' or 'images'."""
    small, *frames = views("64x48", 1, K) + views(images, count, K)
    if kind == "points":
        small, *frames = (scan(frame) for frame in (small, *frames))
    grid: list[Any] = []

    def make() -> Callable[[semstab.Frame], object]:
        if kind == "open3d":
            return fusion.open3d_integrate(size)
        grid[:] = [backends.create("numba", voxel_size=size, num_classes=K)]
        integrate: Callable[[semstab.Frame], object] = grid[0].integrate
        return integrate

    if kind == "open3d":
        from timed import fusion

        for frame in frames:
            fusion.prepare(frame)
        small = frames[0]  # it is known by its index
    make()(small)  # loads and compiles
    integrate = make()
    trim_malloc()
    Path("/proc/self/clear_refs").write_text("5")
    before = resident_bytes()
    ms = [measuring.cpu_ms(integrate, frame) for frame in frames]
    report = {"ms": ms, "bytes": resident_bytes() - before, "peak_bytes": highest() - before}
    if grid:
        table = grid[0].table()
        evidence = np.asarray(table.evidence)
        ties = (evidence == evidence.max(axis=1, keepdims=True)).sum(axis=1) > 1
        index = np.stack([table.ix, table.iy, table.iz], axis=1)
        with out.open("wb") as file:
            file.write(np.array(len(table), "<i8").tobytes() + ((index + 0.5) * size).astype("<f8").tobytes())
            file.write(dominant(table).astype("<i4").tobytes() + ties.tobytes())
    print(json.dumps(report))


def read_map(path: Path, voxel_size: float) -> dict[str, Any]:
    """The distinct voxels of OUT as one sorted number each, their labels, and ties where they are told."""
    data = path.read_bytes()
    (n,) = np.frombuffer(data, "<i8", 1)
    points = np.frombuffer(data, "<f8", 3 * n, 8).reshape(n, 3)
    labels = np.frombuffer(data, "<i4", n, 8 + 24 * n)
    a, b, c = np.floor(points / voxel_size).astype(np.int64).T + (1 << 20)
    voxel, first = np.unique((a << 42) | (b << 21) | c, return_index=True)
    ties = np.frombuffer(data, np.bool_, -1, 8 + 28 * n)
    return {"voxel": voxel, "label": labels[first], "ties": ties[first] if len(ties) else None}


def keep_maps(folder: Path, maps: dict[str, Path], frames: Sequence[semstab.Frame], voxel_size: float, K: int) -> None:
    """Write FOLDER/mean and FOLDER/votes, our runs by these rules, and FOLDER/NAME.npz of each rival."""
    names = [f"class {k}" for k in range(K)]
    for rule in ("mean", "votes"):
        result = semstab.fuse(map(scan, frames), voxel_size=voxel_size, classes=names, check=None, rule=rule)
        result.save(folder / rule)
    for name, path in maps.items():
        data = path.read_bytes()
        (n,) = np.frombuffer(data, "<i8", 1)
        points = np.frombuffer(data, "<f8", 3 * n, 8).reshape(n, 3)
        label = np.frombuffer(data, "<i4", n, 8 + 24 * n)
        np.savez(folder / f"{name.replace(', ', '-')}.npz", points=points, label=label, classes=names)


def compared(ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, Any]:
    """Voxels that one of two maps has, and how many labels differ in those of both."""
    _, a, b = np.intersect1d(ours["voxel"], theirs["voxel"], assume_unique=True, return_indices=True)
    differs, unique = ours["label"][a] != theirs["label"][b], ~ours["ties"][a]
    return {
        "voxels": len(theirs["voxel"]),
        "missing": len(ours["voxel"]) - len(a),
        "extra": len(theirs["voxel"]) - len(b),
        "label_differs": float(differs.mean()) if len(a) else None,
        "without_ties": float(differs[unique].mean()) if unique.any() else None,
    }


def run(command: Sequence[str], files: Sequence[Path]) -> dict[str, Any]:
    """Run a program on one core; return what it prints."""
    one = ["taskset", "-c", str(max(os.sched_getaffinity(0)))] if shutil.which("taskset") else []
    threads = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"), "1")
    words = [*one, *command, *map(str, files)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env={**os.environ, **threads})
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {done.returncode}:\n{done.stderr}")
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def commit_of(given: str) -> str:
    """The commit of a checkout: of git, or of the file COMMIT in an archive; a hash is itself."""
    folder = Path(given)
    if not folder.is_dir():
        return given
    if (folder / "COMMIT").is_file():
        return (folder / "COMMIT").read_text().strip()
    words = ["git", "-C", str(folder), "rev-parse", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def build_pyslam(checkout: Path, folder: Path) -> dict[str, str]:
    """Compile the driver with the headers of a checkout of pySLAM; return the words that call it, by name."""
    program, libraries = folder / "pyslam", sysconfig.get_config_var("LIBDIR")
    words = [
        "g++", "-std=c++20", "-O3", "-march=native", "-DNDEBUG", "-DTBB_FOUND", "-w",
        *(f"-I{headers}" for headers in (
            checkout / "cpp/volumetric", "/usr/include/eigen3", "/usr/include/opencv4", sysconfig.get_path("include"),
        )),
        str(BENCH.with_name("rivals") / "pyslam.cpp"), "-o", str(program), "-ltbb",
        f"-L{libraries}", f"-Wl,-rpath,{libraries}", f"-lpython{sysconfig.get_config_var('LDVERSION')}",
    ]  # fmt: skip
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise SystemExit("--pyslam: there is no g++; --help says what it needs") from None
    if done.returncode:
        first = next((text for text in done.stderr.splitlines() if "error" in text), done.stderr)
        raise SystemExit(f"--pyslam {checkout} does not compile; --help says what it needs: {first}")
    return {f"pySLAM, {kind}": f"{shlex.quote(str(program))} {kind}" for kind in ("votes", "probabilities")}


def by_name(given: Sequence[str]) -> dict[str, str]:
    """NAME=VALUE as a dictionary."""
    return {name: value for name, _, value in (one.partition("=") for one in given)}


def main(
    pyslam: Path | None = None,
    rival: tuple[str, ...] = (),
    commit: tuple[str, ...] = (),
    size: str = "640x480",
    frames: int = 20,
    classes: int = 7,
    voxel_size: float = 0.02,
    rounds: int = 1,
    one: Literal["open3d", "points", "images"] | None = None,
    out: Path | None = None,
    keep: Path | None = None,
) -> Any:
    if one and out:  # in a process of its own
        fuse(one, out, size, frames, classes, voxel_size)
        return None
    commits = {name: commit_of(given) for name, given in by_name(commit).items()}
    options = ["--size", size, "--frames", str(frames), "--classes", str(classes), "--voxel-size", str(voxel_size)]
    with tempfile.TemporaryDirectory() as name:
        folder, rivals = Path(name), by_name(rival)
        if pyslam:
            rivals = build_pyslam(pyslam, folder) | rivals
            commits = {"pySLAM": commit_of(str(pyslam))} | commits
        given = folder / "frames.bin"
        write_frames(given, views(size, frames, classes), voxel_size, classes)
        maps = {name: folder / f"{k}.bin" for k, name in enumerate((*OWN, *rivals))}
        works: dict[str, Callable[[], Any]] = {
            name: partial(run, [sys.executable, str(BENCH), "rivals", *options, "--one", kind, "--out"], [maps[name]])
            for name, kind in OWN.items()
        }
        works |= {name: partial(run, shlex.split(words), [given, maps[name]]) for name, words in rivals.items()}
        reports = measuring.in_turns(works, rounds, warm=0)
        found = {name: read_map(path, voxel_size) for name, path in maps.items() if path.exists()}
        if keep:
            keep_maps(keep, {name: maps[name] for name in rivals}, views(size, frames, classes), voxel_size, classes)
    print(f"{frames} frames of {size}, K = {classes}, {voxel_size:g} m, one core")
    print(*(f"{name}: {which}" for name, which in commits.items()), sep="\n", end="\n\n")
    table = measuring.MarkdownTable(
        implementation="", CPU_ms=".1f", faster=".2f", voxels=",", bytes=",.0f", peak=",.0f", missing=",", extra=",",
        label_differs=".2%", without_ties=".2%",
    )  # fmt: skip
    ms = {
        name: median([t for r in reports_of_rival for t in r["ms"][1:]]) for name, reports_of_rival in reports.items()
    }
    for name, reports_of_rival in reports.items():
        row = compared(found[OURS], found[name]) if name in found else {}
        if row:
            row["bytes"], row["peak"] = (
                median(r[k] for r in reports_of_rival) / max(1, row["voxels"]) for k in ("bytes", "peak_bytes")
            )
        table.add(implementation=name, CPU_ms=ms[name], faster=ms[BASELINE] / ms[name], **row)
    return {"commits": commits, "rows": table.rows}
