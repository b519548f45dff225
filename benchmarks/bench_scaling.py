"""Time of a frame and memory of a voxel as the map grows: does a frame's cost depend on the size of the map?

    python benchmarks/bench_scaling.py [--json FILE] [--backend numba] [--classes 7] [--voxels 100000 ...]

The map grows by one 3840x2160 frame fused at ever new places, 200 m apart. At each size frames at places chosen at
random are fused again: all their voxels are known, and lie anywhere in the map. Memory is what the process grew by, of
the map, and the most while it is made a table, measured and written; their CPU time is beside it.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import flight
import numpy as np
from bench_statistics import Watch, resident

import semstab
from semstab import backends
from semstab.core.files import write_json
from semstab.engine.measurement import save_voxels
from semstab.metrics import summarise

VOXEL_SIZE, APART, VISITS = 0.2, 200.0, 15


def at(frame: semstab.Frame, place: int) -> semstab.Frame:
    """The frame at another place, by a whole number of voxels; its index is the place's number."""
    T_wc = np.array(frame.T_wc)
    T_wc[:2, 3] += APART * (place % 100), APART * (place // 100)
    return dataclasses.replace(frame, index=place, T_wc=T_wc)


def finished(watch: Watch, backend: Any) -> dict[str, float]:
    """CPU time of table, summary and file together, microseconds a voxel, and the most bytes a voxel meanwhile."""
    watch.seconds.clear()
    watch.peak.clear()
    table = watch("table", backend.table)
    watch("summary", lambda: summarise(table))
    with tempfile.TemporaryDirectory() as folder:
        watch("write", lambda: save_voxels(table, Path(folder) / "map.parquet"))
    return {f"{name}_us": 1e6 * seconds / len(table) for name, seconds in watch.seconds.items()} | {
        f"{name}_bytes": peak / len(table) for name, peak in watch.peak.items()
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--classes", type=int, default=7)
    parser.add_argument("--voxels", nargs="+", type=int, default=[100_000, 1_000_000, 5_000_000, 20_000_000])
    arguments = parser.parse_args()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    K = arguments.classes
    frame = flight.frame(0, *map(int, arguments.size.split("x")), K)
    warm_up = backends.create(arguments.backend, voxel_size=VOXEL_SIZE, num_classes=K)
    warm_up.integrate(frame)
    finished(Watch(), warm_up)
    del warm_up
    watch = Watch()
    backend = backends.create(arguments.backend, voxel_size=VOXEL_SIZE, num_classes=K)
    rng = np.random.default_rng(0)
    rows, places, voxels = [], 0, 0
    print(f"{arguments.backend}, {arguments.size}, K = {K}")
    print(f"{'voxels':>12} {'ms a frame':>11} {'bytes a voxel':>14}", end="")
    print(f"{'table us':>10}{'summary us':>12}{'write us':>10}{'most bytes':>12}")
    for wanted in arguments.voxels:
        while voxels < wanted:
            voxels = backend.integrate(at(frame, places)).map_voxels
            places += 1
        visits = [at(frame, int(place)) for place in rng.integers(0, places, VISITS)]
        times = [flight.milliseconds(backend.integrate, visit) for visit in visits]
        size = (resident() - watch.before) / voxels
        end = finished(watch, backend)
        rows.append({"voxels": voxels, "ms": median(times), "bytes_a_voxel": size, **end})
        most = max(end["table_bytes"], end["summary_bytes"], end["write_bytes"])
        print(f"{voxels:12,} {median(times):11.1f} {size:14.0f}", end="")
        print(f"{end['table_us']:10.2f}{end['summary_us']:12.2f}{end['write_us']:10.2f}{most:12.0f}", flush=True)
    if arguments.json:
        write_json(arguments.json, {"backend": arguments.backend, "rows": rows})


if __name__ == "__main__":
    main()
