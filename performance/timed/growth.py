"""Costs of a frame and of a voxel as the number of frames, voxels or classes grows by factors of 1, 2, 4 and 8.

Frames of a flight (flight.py) are fused at places 200 m apart, each as often as there are frames. One of three grows,
the others stay. 'ms' is the CPU time of a later frame, all of whose voxels are known, the median; 'bytes' is what the
process grew by, 'most' the most while the map is made a table, measured and written, and 'estimate' what is said before
of map and table, over that. Each row has a process of its own. An exponent of 0 is a cost that does not grow, of 1 one
that grows as fast: the slope of a line through logarithms.
"""

from __future__ import annotations

import dataclasses
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, Literal

import flight
import measuring
import numpy as np

import semstab
from semstab import backends
from semstab.core.process import resident_bytes
from semstab.engine.measurement import save_voxels
from semstab.engine.memory import MapMemory
from semstab.metrics import summarise

VOXEL_SIZE, APART, VISITS = 0.2, 200.0, 15
VIEWS = 2
"""Frames with errors of their own."""


def at(frame: semstab.Frame, place: int) -> semstab.Frame:
    """The frame at another place, by a whole number of voxels; its index is the place's number."""
    T_wc = np.array(frame.T_wc)
    T_wc[:2, 3] += APART * (place % 100), APART * (place // 100)
    return dataclasses.replace(frame, index=place, T_wc=T_wc)


def finished(watch: measuring.Watch, backend: Any) -> int:
    """The most bytes while the map is made a table, measured and written."""
    table = watch("table", backend.table)
    watch("summary", lambda: summarise(table))
    with tempfile.TemporaryDirectory() as folder:
        watch("write", lambda: save_voxels(table, Path(folder) / "map.parquet"))
    return max(watch.peak.values())


def measured(backend_name: str, size: tuple[int, int], frames: int, wanted: int, K: int) -> dict[str, float]:
    """Return the costs of a map of at least `wanted` voxels, each place of which `frames` frames have seen."""
    views = [flight.frame(i, *size, K, at=(0.0, 0.0)) for i in range(VIEWS)]
    warm_up = backends.create(backend_name, voxel_size=VOXEL_SIZE, num_classes=K)
    warm_up.integrate(views[0])
    finished(measuring.Watch(), warm_up)
    del warm_up
    watch = measuring.Watch()
    backend = backends.create(backend_name, voxel_size=VOXEL_SIZE, num_classes=K)
    places = voxels = observations = 0
    while voxels < wanted:
        for i in range(frames):
            report = backend.integrate(at(views[i % VIEWS], places))
            voxels, observations = report.map_voxels, observations + report.voxels
        places += 1
    held = resident_bytes() - watch.before
    visits = np.random.default_rng(0).integers(0, places, VISITS)
    ms = median(measuring.cpu_ms(backend.integrate, at(views[0], int(place))) for place in visits)
    most = finished(watch, backend) / voxels
    estimate = MapMemory(backend_name, K).tile(voxels, observations) / voxels
    return {"seen": voxels, "ms": ms, "bytes": held / voxels, "most": most, "estimate": estimate / most}


def draw(rows: list[dict[str, Any]], file: Path) -> None:
    """Costs over factors, logarithmic; as wide as a column of text."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(3.4, 4.2), sharex=True, constrained_layout=True)
    styles = {"frames": ("#0072B2", "o-"), "voxels": ("#D55E00", "s--"), "classes": ("#009E73", "^:")}  # Okabe and Ito
    for axis, cost, unit in ((axes[0], "ms", "CPU ms a frame"), (axes[1], "bytes", "bytes a voxel")):
        for growing, (color, style) in styles.items():
            of_kind = [row for row in rows if row["growing"] == growing]
            axis.plot(
                [row["times"] for row in of_kind], [row[cost] for row in of_kind], style, color=color, label=growing
            )
        axis.set_xscale("log", base=2)
        axis.set_ylim(0, 1.15 * max(row[cost] for row in rows))
        axis.set_ylabel(unit, fontsize=9)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
    axes[1].set_xticks(ticks := sorted({row["times"] for row in rows}), [str(times) for times in ticks])
    axes[1].set_xlabel("times as many", fontsize=9)
    axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(file, dpi=200)


def main(
    backend: str = "numba",
    size: str = "3840x2160",
    frames: int = 4,
    voxels: int = 1_000_000,
    classes: int = 7,
    times: tuple[int, ...] = (1, 2, 4, 8),
    growing: tuple[Literal["frames", "voxels", "classes"], ...] = ("frames", "voxels", "classes"),
    figure: Path | None = None,
) -> Any:
    table = measuring.MarkdownTable(
        growing="", frames="", seen=",", classes="", ms=".1f", bytes=".0f", most=".0f", estimate=".2f"
    )
    for what in growing:
        for factor in times:
            base = {"frames": frames, "voxels": voxels, "classes": classes}
            base[what] *= factor
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                row = pool.submit(measured, backend, measuring.sides(size), *base.values()).result()
            table.add(growing=what, times=factor, **base, **row)
    print()
    fits = measuring.MarkdownTable(exponent="", ms=".2f", bytes=".2f")
    for what in growing:
        of_kind = [row for row in table.rows if row["growing"] == what]
        factors = np.log([row["seen" if what == "voxels" else "times"] for row in of_kind])
        slopes = {
            cost: float(np.polyfit(factors, np.log([row[cost] for row in of_kind]), 1)[0]) for cost in ("ms", "bytes")
        }
        fits.add(exponent=what, **slopes)
    if figure:
        draw(table.rows, figure)
    return {"backend": backend, "rows": table.rows, "exponents": fits.rows}
