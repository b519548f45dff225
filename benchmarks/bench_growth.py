"""What a frame and a voxel cost as the frames, the voxels or the classes become 1, 2, 4 and 8 times as many.

    python benchmarks/bench_growth.py [--figure FILE.png] [--json FILE] [--backend numba] [--size 3840x2160]
                                      [--frames 4] [--voxels 1000000] [--classes 7] [--times 1 2 4 8]
                                      [--growing frames voxels classes]

Frames of a flight (flight.py) are fused at places 200 m apart, each as often as there are frames. One of three grows,
the others stay. 'ms' is the CPU time of a later frame, all of whose voxels are known, the median; 'bytes' is what the
process grew by, 'most' the most while the map is made a table, measured and written, and 'estimate' what is said before
of map and table, over that. Each row has a process of its own. An exponent of 0 is a cost that does not grow, of 1 one
that grows as fast: the slope of a line through logarithms.
"""

from __future__ import annotations

import argparse
import logging
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import flight
import numpy as np
from bench_scaling import VISITS, VOXEL_SIZE, at, finished
from bench_statistics import Watch, resident

from semstab import backends
from semstab.core.files import write_json
from semstab.engine.memory import MapMemory

GROWING = ("frames", "voxels", "classes")
VIEWS = 2
"""Frames with errors of their own."""


def measured(backend_name: str, size: tuple[int, int], frames: int, wanted: int, K: int) -> dict[str, float]:
    """The costs of a map of at least so many voxels, each place of which so many frames have seen."""
    logging.getLogger("semstab").setLevel(logging.ERROR)
    views = [flight.frame(i, *size, K, at=(0.0, 0.0)) for i in range(VIEWS)]
    warm_up = backends.create(backend_name, voxel_size=VOXEL_SIZE, num_classes=K)
    warm_up.integrate(views[0])
    finished(Watch(), warm_up)
    del warm_up
    watch = Watch()
    backend = backends.create(backend_name, voxel_size=VOXEL_SIZE, num_classes=K)
    places = voxels = observations = 0
    while voxels < wanted:
        for i in range(frames):
            report = backend.integrate(at(views[i % VIEWS], places))
            voxels, observations = report.map_voxels, observations + report.voxels
        places += 1
    held = resident() - watch.before
    times = []
    for place in np.random.default_rng(0).integers(0, places, VISITS):
        visit = at(views[0], int(place))
        started = time.process_time()
        backend.integrate(visit)
        times.append(1e3 * (time.process_time() - started))
    end = finished(watch, backend)
    most = max(value for name, value in end.items() if name.endswith("_bytes"))
    estimate = MapMemory(backend_name, K).tile(voxels, observations) / voxels
    return {"ms": median(times), "bytes": held / voxels, "most": most, "estimate": estimate / most, "seen": voxels}


def exponent(factors: list[float], costs: list[float]) -> float:
    """The slope of a line through the logarithms."""
    return float(np.polyfit(np.log(factors), np.log(costs), 1)[0])


def draw(rows: list[dict[str, Any]], file: Path) -> None:
    """Costs over factors, logarithmic; as wide as a column of text."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(3.4, 4.2), sharex=True, constrained_layout=True)
    styles = {"frames": ("#0072B2", "o-"), "voxels": ("#D55E00", "s--"), "classes": ("#009E73", "^:")}  # Okabe and Ito
    for axis, cost, unit in ((axes[0], "ms", "CPU ms a frame"), (axes[1], "bytes", "bytes a voxel")):
        for growing, (color, style) in styles.items():
            own = [row for row in rows if row["growing"] == growing]
            axis.plot([row["times"] for row in own], [row[cost] for row in own], style, color=color, label=growing)
        axis.set_xscale("log", base=2)
        axis.set_ylim(0, 1.15 * max(row[cost] for row in rows))
        axis.set_ylabel(unit, fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
    axes[1].set_xticks(ticks := sorted({row["times"] for row in rows}), [str(times) for times in ticks])
    axes[1].set_xlabel("times as many", fontsize=9)
    axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(file, dpi=200)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--voxels", type=int, default=1_000_000)
    parser.add_argument("--classes", type=int, default=7)
    parser.add_argument("--times", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--growing", nargs="+", choices=GROWING, default=GROWING)
    arguments = parser.parse_args()
    width, height = (int(number) for number in arguments.size.split("x"))
    rows: list[dict[str, Any]] = []
    print(f"{arguments.backend}, {arguments.size}")
    print(f"{'growing':>8} {'frames':>7} {'voxels':>11} {'K':>4} {'ms':>8} {'bytes':>6} {'most':>6} {'estimate':>8}")
    for growing in arguments.growing:
        for times in arguments.times:
            base = {"frames": arguments.frames, "voxels": arguments.voxels, "classes": arguments.classes}
            base[growing] *= times
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                row = pool.submit(measured, arguments.backend, (width, height), *base.values()).result()
            rows.append({"growing": growing, "times": times, **base, **row})
            print(
                f"{growing:>8} {base['frames']:>7} {row['seen']:>11,} {base['classes']:>4} {row['ms']:>8.1f}"
                f" {row['bytes']:>6.0f} {row['most']:>6.0f} {row['estimate']:>8.2f}",
                flush=True,
            )
    fits = {}
    print(f"\n{'exponent':>8} {'ms':>8} {'bytes':>6}")
    for growing in arguments.growing:
        own = [row for row in rows if row["growing"] == growing]
        factors = [row["seen"] if growing == "voxels" else row["times"] for row in own]
        fits[growing] = {cost: exponent(factors, [row[cost] for row in own]) for cost in ("ms", "bytes")}
        print(f"{growing:>8} {fits[growing]['ms']:>8.2f} {fits[growing]['bytes']:>6.2f}")
    if arguments.figure:
        draw(rows, arguments.figure)
    if arguments.json:
        write_json(arguments.json, {"backend": arguments.backend, "rows": rows, "exponents": fits})


if __name__ == "__main__":
    main()
