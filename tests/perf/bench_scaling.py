"""Time of a frame and memory of a voxel as the map grows: does a frame's cost depend on the size of the map?

    python tests/perf/bench_scaling.py [--json FILE] [--backend numba] [--voxels 100000 1000000 5000000 20000000]

The map grows by one 3840x2160 frame fused at ever new places, 200 m apart. At each size frames at places chosen at
random are fused again: all their voxels are known, and lie anywhere in the map. Memory is what the process grew by.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
from statistics import median

import flight
import numpy as np

import semstab
from semstab import backends
from semstab.runtime.files import write_json

VOXEL_SIZE, K, APART, VISITS = 0.2, 7, 200.0, 15


def at(frame: semstab.Frame, place: int) -> semstab.Frame:
    """The frame at another place, by a whole number of voxels; its index is the place's number."""
    T_wc = np.array(frame.T_wc)
    T_wc[:2, 3] += APART * (place % 100), APART * (place // 100)
    return dataclasses.replace(frame, index=place, T_wc=T_wc)


def resident() -> int:
    """Resident memory of this process, bytes."""
    with open("/proc/self/statm") as statm:  # noqa: PTH123
        return int(statm.read().split()[1]) * 4096


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--voxels", nargs="+", type=int, default=[100_000, 1_000_000, 5_000_000, 20_000_000])
    arguments = parser.parse_args()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    frame = flight.frame(0, *map(int, arguments.size.split("x")), K)
    warm_up = backends.create(arguments.backend, voxel_size=VOXEL_SIZE, num_classes=K)
    warm_up.integrate(frame)
    del warm_up
    before = resident()
    backend = backends.create(arguments.backend, voxel_size=VOXEL_SIZE, num_classes=K)
    rng = np.random.default_rng(0)
    rows, places, voxels = [], 0, 0
    print(f"{arguments.backend}, {arguments.size}, K = {K}\n{'voxels':>12} {'ms a frame':>11} {'bytes a voxel':>14}")
    for wanted in arguments.voxels:
        while voxels < wanted:
            voxels = backend.integrate(at(frame, places)).map_voxels
            places += 1
        visits = [at(frame, int(place)) for place in rng.integers(0, places, VISITS)]
        times = [flight.milliseconds(backend.integrate, visit) for visit in visits]
        size = (resident() - before) / voxels
        rows.append({"voxels": voxels, "ms": median(times), "bytes_a_voxel": size})
        print(f"{voxels:12,} {median(times):11.1f} {size:14.0f}", flush=True)
    if arguments.json:
        write_json(arguments.json, {"backend": arguments.backend, "rows": rows})


if __name__ == "__main__":
    main()
