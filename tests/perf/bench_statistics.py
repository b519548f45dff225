"""Time of the statistics over a simulated log, beside plain NumPy on the same work.

    python tests/perf/bench_statistics.py [--json FILE] [--observations 2000000] [--classes 7] [--disagree 0.3]

A floor of voxels is seen 6 times on average by 80 frames; on a share of the voxels frames err, some of them within the
voxel. Where all frames agree no order matters, and the permutations pass by. NumPy is timed on one order or resample of
the whole log, the compiled code on all that it makes; times are given for one of them, and the median of the rounds is
taken. The code is compiled before.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from statistics import median
from typing import Any

import flight
import numpy as np

from semstab import statistics
from semstab.model.voxels import Events, VoxelTable
from semstab.runtime.files import write_json
from semstab.statistics.agreement import alpha_columns, alpha_of, ratio_of
from semstab.statistics.drift import FRAME_ORDERS, LEAST_DRAWS

FRAMES, MEAN_OP = 80, 6
BASELINE = "plain NumPy"


def simulated(observations: int, K: int, disagree: float, seed: int = 0) -> Events:
    """A log of about that many observations; errors are anew in each frame, one in ten within a voxel."""
    rng = np.random.default_rng(seed)
    n = max(observations // MEAN_OP, 4)
    T = np.minimum(rng.geometric(1 / MEAN_OP, n), FRAMES)
    voxel = np.repeat(np.arange(n), T)
    age = np.arange(len(voxel)) - np.repeat(np.cumsum(T) - T, T)
    noisy = (rng.random(n) < disagree)[voxel]
    own = rng.integers(0, K, n)[voxel]
    label = np.where(noisy & (rng.random(len(voxel)) < 0.3), rng.integers(0, K, len(voxel)), own)
    evidence = np.eye(K)[label]
    mixed = np.flatnonzero(noisy & (rng.random(len(voxel)) < 0.1))
    evidence[mixed] = 0.75 * evidence[mixed] + 0.25 * np.eye(K)[rng.integers(0, K, len(mixed))]
    side = int(np.ceil(np.sqrt(n)))
    x, y = np.divmod(np.arange(n), side)
    frame = rng.integers(0, FRAMES - T + 1)[voxel] + age
    return Events(x, y, np.zeros(n), voxel, frame, evidence, np.ones(len(voxel)), 0.2)


def numpy_order(events: Events, rng: np.random.Generator) -> float:
    """Mean SBD with the observations of each voxel in one random order."""
    order = np.lexsort([rng.random(len(events)), events.voxel])
    shuffled = Events(
        events.ix, events.iy, events.iz, events.voxel, events.frame, events.evidence[order], events.pixels, 0.2
    )
    return float(shuffled.drift().sum())


def numpy_resample(table: VoxelTable, of_block: list[Any], rng: np.random.Generator) -> float:
    """Krippendorff's alpha of one resample of the blocks, from the rows of its voxels."""
    rows = np.concatenate([of_block[b] for b in rng.integers(len(of_block), size=len(of_block))])
    return float(alpha_of(alpha_columns(table)[rows].sum(axis=0)))


def measure(events: Events, rounds: int) -> list[dict[str, Any]]:
    """Rows of the table."""
    table = events.table()
    rng = np.random.default_rng(0)
    again = table.op >= 2
    blocks = statistics.spatial_blocks(table.index, table.voxel_size)
    of_block = [np.flatnonzero(blocks.of == b) for b in range(blocks.count)]
    bootstrap = statistics.BlockBootstrap(blocks)
    resamples = len(bootstrap.weights)
    drift = statistics.voxel_drift(table, events)
    noise = np.stack([np.where(again, drift.excess, 0.0), again], axis=1)

    def fixed_orders() -> Any:
        return statistics.voxel_drift(table, events, least=LEAST_DRAWS, most=LEAST_DRAWS, enough=10 * LEAST_DRAWS)

    work: list[tuple[str, str, int, Callable[[], Any]]] = [
        ("one order", BASELINE, 1, lambda: numpy_order(events, rng)),
        ("one order", f"compiled, {LEAST_DRAWS} a voxel", LEAST_DRAWS, fixed_orders),
        ("one order", f"compiled, {FRAME_ORDERS} of the frames", FRAME_ORDERS,
         lambda: statistics.scene_drift(table, events, drift)),
        ("one resample", BASELINE, 1, lambda: numpy_resample(table, of_block, rng)),
        ("one resample", f"block bootstrap, {resamples}", resamples,
         lambda: bootstrap.estimate(alpha_columns(table), alpha_of)),
        ("all of it", "p-value of each voxel", 1, lambda: statistics.voxel_drift(table, events)),
        ("all of it", "p-value of the scene", 1, lambda: statistics.scene_drift(table, events, drift)),
        ("all of it", "exact null from counts", 1, lambda: statistics.expected_sbd(table)),
        ("all of it", "interval of a mean", 1, lambda: bootstrap.estimate(noise, ratio_of)),
        ("all of it", "describe", 1, lambda: statistics.describe(table, events, table)),
    ]  # fmt: skip
    times = {(what, name): [] for what, name, *_ in work}
    for turn in range(rounds + 1):  # the first one compiles and warms up
        for what, name, parts, call in work:
            took = flight.milliseconds(call) / parts
            if turn:
                times[what, name].append(took)
    return [
        {
            "work": what,
            "name": name,
            "ms": median(taken),
            "ratio": median(taken) / median(times[what, BASELINE]) if (what, BASELINE) in times else None,
        }
        for (what, name), taken in times.items()
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--observations", type=int, default=2_000_000)
    parser.add_argument("--classes", type=int, default=7)
    parser.add_argument("--disagree", type=float, default=0.3, help="share of the voxels on which frames err")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    events = simulated(arguments.observations, arguments.classes, arguments.disagree)
    rows = measure(events, arguments.rounds)
    print(f"{len(events):,} observations of {len(events.ix):,} voxels, K = {arguments.classes}")
    print(f"{'work':<14}{'implementation':<32}{'ms':>12}{'of NumPy':>12}")
    for row in rows:
        ratio = "" if row["ratio"] is None else f"1/{1 / row['ratio']:.0f}" if row["ratio"] < 0.1 else "1"
        print(f"{row['work']:<14}{row['name']:<32}{row['ms']:12,.1f}{ratio:>12}")
    if arguments.json:
        write_json(arguments.json, {"observations": len(events), "voxels": len(events.ix), "rows": rows})


if __name__ == "__main__":
    main()
