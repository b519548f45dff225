"""Time of one frame through each fusion backend, beside Open3D's own VoxelBlockGrid.integrate on the same frames.

    python tests/perf/bench_fusion.py [--json FILE] [--sizes 1280x720 3840x2160] [--classes 7 20 150] [--rounds 5]

'first' is the first frame of a new map, code already compiled; 'later' the median of all others, most of whose voxels
are known. The implementations take turns. The floor is depth and labels, read once at measured bandwidth.
"""

from __future__ import annotations

import argparse
import logging
from collections import defaultdict
from collections.abc import Callable
from statistics import median

import flight
import numpy as np
import open3d as o3d
import open3d.core as o3c

import semstab
from semstab import backends
from semstab.runtime.files import write_json

VOXEL_SIZE, FRAMES = 0.2, 4
BASELINE = "Open3D integrate"


def open3d_integrate() -> Callable[[semstab.Frame], None]:
    """A new TSDF map with colour, block resolution 16, by its documented calls; inputs are made outside the clock."""
    attributes = ("tsdf", "weight", "color"), (o3c.float32,) * 3, ((1), (1), (3))
    grid = o3d.t.geometry.VoxelBlockGrid(*attributes, VOXEL_SIZE, 16, 4096, o3c.Device("CPU:0"))

    def integrate(frame: semstab.Frame) -> None:
        depth, color, K, T_cw = o3d_inputs[frame.index, frame.shape]
        blocks = grid.compute_unique_block_coordinates(depth, K, T_cw, 1.0, 1000.0)
        grid.integrate(blocks, depth, color, K, T_cw, 1.0, 1000.0)

    return integrate


o3d_inputs: dict[tuple[int, tuple[int, int]], tuple[object, ...]] = {}


def prepare(frame: semstab.Frame) -> None:
    """The frame as Open3D wants it."""
    image = o3d.t.geometry.Image
    gray = np.repeat((frame.labels / 255).astype(np.float32)[..., None], 3, axis=2)
    o3d_inputs[frame.index, frame.shape] = (
        image(o3c.Tensor(np.array(frame.depth))),
        image(o3c.Tensor(gray)),
        o3c.Tensor(frame.intrinsics.matrix),
        o3c.Tensor(np.linalg.inv(frame.T_wc)),
    )


def measure(frames: list[semstab.Frame], K: int, rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds of the first frame and of later ones by implementation."""

    def backend(name: str) -> Callable[[semstab.Frame], object]:
        return backends.create(name, voxel_size=VOXEL_SIZE, num_classes=K).integrate

    makers = {
        BASELINE: open3d_integrate,
        "numba": lambda: backend("numba"),
        "open3d": lambda: backend("open3d"),
        "numpy": lambda: backend("numpy"),
    }
    first, later = defaultdict(list), defaultdict(list)
    for make in makers.values():  # compiles what is compiled on first use
        flight.milliseconds(make(), frames[0])
    for _ in range(rounds):
        for name, make in makers.items():
            integrate = make()
            times = [flight.milliseconds(integrate, frame) for frame in (*frames, *frames)]
            first[name].append(times[0])
            later[name].extend(times[1:])
    return {name: {"first_ms": median(first[name]), "later_ms": median(later[name])} for name in makers}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--sizes", nargs="+", default=["1280x720", "3840x2160"])
    parser.add_argument("--classes", nargs="+", type=int, default=[7, 20, 150])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    bandwidth = flight.read_bandwidth()
    rows = []
    print(f"memory is read at {bandwidth / 1e9:.1f} GB/s by two threads")
    print(f"{'size':>10} {'K':>4}  {'implementation':<17} {'first ms':>9} {'later ms':>9} {'ratio':>7} {'floor ms':>9}")
    for size in arguments.sizes:
        width, height = map(int, size.split("x"))
        floor = 1e3 * width * height * 5 / bandwidth
        for K in arguments.classes:
            frames = [flight.frame(i, width, height, K) for i in range(FRAMES)]
            for frame in frames:
                prepare(frame)
            measured = measure(frames, K, arguments.rounds)
            for name, times in measured.items():
                ratio = times["later_ms"] / measured[BASELINE]["later_ms"]
                rows.append({"size": size, "K": K, "name": name, **times, "ratio": ratio, "floor_ms": floor})
                print(
                    f"{size:>10} {K:>4}  {name:<17} {times['first_ms']:9.1f} {times['later_ms']:9.1f} {ratio:6.2f}x"
                    f" {floor:9.2f}",
                    flush=True,
                )
    if arguments.json:
        write_json(arguments.json, {"read_bytes_per_second": bandwidth, "rows": rows})


if __name__ == "__main__":
    main()
