"""How often do tests of drift find some where there is none?

    python simulations/drift.py [--trials 60]

Flights over a floor (flights.py) whose frames are alike or differ, whose errors last, or depend on the view; the model
does not change. Prints a table in Markdown: the share of flights whose scene is tested at all, in which it is found to
drift (p <= 0.05) by SBD and by the trend, and the share of the voxels that are named as trending of those tested.
"""

from __future__ import annotations

import argparse

import numpy as np
from flights import Flight, fly, log_of, world

from semstab.statistics.drift import TESTABLE, benjamini_hochberg, in_stretches, order_test, rounded_up, voxel_drift
from semstab.statistics.sections import FALSE_DISCOVERIES

KINDS = ("alike", "bad", "uneven", "heavy", "lasting", "regimes", "objects", "view", "direction")
FLIGHTS = ((40, 20), (80, 40), (60, 60), (120, 120))
"""Frames, and how many of them see a voxel."""


def trial(flight: Flight, seed: int) -> tuple[bool, bool, bool, int, int]:
    """Whether the scene is tested, drifts by SBD and by trend; voxels that are tested and that trend."""
    rng = np.random.default_rng(seed)
    over = world(flight, rng)
    log = log_of(fly(flight, over, rng), over, flight)
    test = order_test(log.table(), log, frame_orders=99)
    log = in_stretches(log, test.lasting) if test.lasting > 1 else log
    table = log.table()
    p = np.where(table.op >= TESTABLE, voxel_drift(table, log, sample=1).trend_p, np.nan)
    trending = benjamini_hochberg(rounded_up(p)) <= FALSE_DISCOVERIES
    return (
        not np.isnan(test.trend_p), test.p_value <= 0.05, test.trend_p <= 0.05,
        np.count_nonzero(~np.isnan(p)), np.count_nonzero(trending),
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=60)
    trials = parser.parse_args().trials
    print("| frames | frames, seen in | tested | by SBD | by trend | trending voxels |\n|---|---|---|---|---|---|")
    for kind in KINDS:
        for frames, looks in FLIGHTS:
            flight = Flight(32, 2.0, 1.0, frames, looks, kind)
            found = np.array([trial(flight, seed) for seed in range(trials)], float)
            told, by_sbd, by_trend = found[:, :3].mean(axis=0)
            share = found[:, 4].sum() / max(found[:, 3].sum(), 1)
            voxels = f"{share:.3f}" if found[:, 3].any() else "none tested"
            print(f"| {kind} | {frames}, {looks} | {told:.2f} | {by_sbd:.3f} | {by_trend:.3f} | {voxels} |", flush=True)


if __name__ == "__main__":
    main()
