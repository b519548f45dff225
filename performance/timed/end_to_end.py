"""The command line on a folder of PNGs, against the bare OpenCV decode of the same files on the same cores.

A folder is made for each kind of depth and noise level. It has views of the built-in city, rendered at half the size
and scaled up (depth linearly, labels to the nearest). Depth has Gaussian noise of the given mm, as sensors have it, and
is stored as 16-bit PNGs or as .npy in metres; labels have 8 bits. `jpeg` is 16-bit PNGs and colour as JPEG; the loop
and the bare decode read the colour only if the run is `--recorded`. A bare read of .npy looks at each value once.
Noise 0 compresses best, so its bare decode is the fastest: the harder case. Both sides read files that are in the page
cache, and are bound to the same cores. Command and bare decode take turns; the figures are medians. One unmeasured
start compiles what is compiled on first use. Nothing is subtracted: the whole process has a column of its own, and
`loop` is what manifest.json says of reading, flicker, fusion and observers. `CPU ratio` is that of the user and system
time of all threads meanwhile (staged.py) to that of the bare decode: the one to look at on a machine that is not quiet.
"""

from __future__ import annotations

import itertools
import json
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import cv2
import measuring
import numpy as np

from semstab.datasets import open_dataset

DEPTH_SCALE = 500  # units a metre: 16 bits reach 131 m, beyond the city's farthest corner
LOOP = ("read", "flicker", "observe", "fuse")


def rendered(size: tuple[int, int], frames: int) -> list[Any]:
    """Views of the city at half the size."""
    options = {"width": size[0] // 2, "height": size[1] // 2, "frames": frames, "cache_megabytes": 0}
    scene = open_dataset("city", options).scene("scene0")
    return [scene.frame(index, "sim-flicker") for index in range(frames)]


def write_scene(root: Path, views: list[Any], size: tuple[int, int], noise: float, kind: str = "png") -> None:
    """Write the views as a posed folder, with noise in mm."""
    for part in ("depth", "pose", "labels/net"):
        (root / part).mkdir(parents=True)
    scale = 1 if kind == "npy" else DEPTH_SCALE
    (root / "scene.yaml").write_text(f"taxonomy: uavid8\ndepth_scale: {scale}\n", encoding="utf-8")
    camera = views[0].intrinsics.resized(views[0].shape[::-1], size).matrix
    np.savetxt(root / "intrinsics.txt", camera)
    rng = np.random.default_rng(0)
    for view in views:
        depth = cv2.resize(view.depth, size, interpolation=cv2.INTER_LINEAR).astype(np.float64)
        depth += (depth > 0) * rng.normal(0, noise / 1000, depth.shape)
        name = f"{view.index:04d}"
        if kind == "npy":
            np.save(root / "depth" / f"{name}.npy", depth.astype(np.float32))
        else:
            units = np.clip(np.round(depth * DEPTH_SCALE), 0, 65535).astype(np.uint16)
            cv2.imwrite(str(root / "depth" / f"{name}.png"), units)
        labels = cv2.resize(view.labels, size, interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(root / "labels/net" / f"{name}.png"), labels)
        np.savetxt(root / "pose" / f"{name}.txt", view.T_wc)
        if kind == "jpeg":
            (root / "color").mkdir(exist_ok=True)
            color = cv2.resize(view.color[..., ::-1], size, interpolation=cv2.INTER_LINEAR)
            cv2.imwrite(str(root / "color" / f"{name}.jpg"), color)


def decode_all(files: list[Path], threads: int) -> None:
    """Decode the files, and nothing else."""

    def decode(path: Path) -> None:
        if path.suffix == ".npy":
            assert np.load(path).max() > 0  # to have read it
        else:
            assert cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) is not None

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(decode, files))


def run(root: Path, backend: str, threads: int, voxel_size: float | None, *, recorded: bool) -> dict[str, float]:
    """Seconds of the whole process and of its parts, from what the run itself wrote."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = ["--check", "none", "--backend", backend, "--data", str(root), "--set", f"threads={threads}"]
        words += [] if voxel_size is None else ["--voxel-size", str(voxel_size)]
        process, stages = measuring.staged(out, *words, recording=recorded)
        spent = measuring.seconds_of(out)
        (summary,) = json.loads((out / "summary.json").read_text())["runs"]
    names = [f"fuse {backend}" if stage == "fuse" else stage for stage in LOOP]
    loop, after = (
        sum(spent.get(name, 0.0) for name in names),
        sum(spent[name] for name in ("measure", "write", "digest")),
    )
    return {
        "loop": loop, "loop_cpu": sum(stages.get(name, {"all_s": 0.0})["all_s"] for name in names),
        "whole": process.wall_s, "start": process.wall_s - loop - after, "voxel_m": summary["voxel_size"],
        "read": spent["read"], "fuse": spent[f"fuse {backend}"], "observe": spent.get("observe", 0.0),
    }  # fmt: skip


def main(
    size: tuple[str, ...] = ("3840x2160",),
    depth: tuple[Literal["png", "jpeg", "npy"], ...] = ("png", "jpeg", "npy"),
    noise: tuple[float, ...] = (0.0, 10.0, 50.0),
    backend: tuple[str, ...] = ("numba",),
    frames: int = 24,
    voxel_size: float | None = None,
    recorded: bool = False,
    runs: int = 5,
    threads: int = 2,
) -> Any:
    measuring.use_cores(threads)
    table = measuring.MarkdownTable(
        size="", depth="", noise_mm="g", backend="", voxel_m=".2g", MB=".1f", decode_ms=".1f", loop_ms=".1f",
        ratio=".2f", CPU_ratio=".2f", whole_s=".2f", start_s=".2f", read_ms=".1f", fuse_ms=".1f", observe_ms=".1f",
    )  # fmt: skip
    for image_size in size:
        views = rendered(measuring.sides(image_size), frames)
        for kind, level in itertools.product(depth, noise):
            with tempfile.TemporaryDirectory() as folder:
                root = Path(folder) / "scene"
                write_scene(root, views, measuring.sides(image_size), level, kind)
                files = [*root.glob("depth/*"), *root.glob("labels/net/*"), *(root.glob("color/*") if recorded else ())]
                files.sort(key=lambda path: path.stem)
                for name in backend:
                    row = measured(root, files, name, runs, threads, voxel_size, recorded, frames)
                    table.add(size=image_size, depth=kind, noise_mm=level, backend=name, **row)
                shutil.rmtree(root)
    return table.rows


def measured(
    root: Path, files: list[Path], backend: str, runs: int, threads: int, voxel_size: float | None, recorded: bool,
    frames: int,
) -> dict[str, float]:  # fmt: skip
    """The numbers of a row; runs and bare decodes take turns."""

    def decode() -> dict[str, float]:
        cpu = time.process_time()
        wall = measuring.wall_ms(decode_all, files, threads) / 1e3
        return {"wall": wall, "cpu": time.process_time() - cpu}

    works = {"decode": decode, "run": lambda: run(root, backend, threads, voxel_size, recorded=recorded)}
    taken = {name: measuring.medians(rows) for name, rows in measuring.in_turns(works, runs).items()}
    bare, of_run, ms = taken["decode"], taken["run"], 1e3 / frames
    return {
        "voxel_m": of_run["voxel_m"], "MB": sum(path.stat().st_size for path in files) / frames / 1e6,
        "decode_ms": ms * bare["wall"], "loop_ms": ms * of_run["loop"], "ratio": of_run["loop"] / bare["wall"],
        "CPU_ratio": of_run["loop_cpu"] / bare["cpu"], "whole_s": of_run["whole"], "start_s": of_run["start"],
        **{f"{part}_ms": ms * of_run[part] for part in ("read", "fuse", "observe")},
    }  # fmt: skip
