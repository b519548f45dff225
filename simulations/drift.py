"""How often does the scene's test of drift reject where there is none?

    python simulations/drift.py [--runs 200]

Groups of 12 voxels that are first seen together, in frames whose errors are anew in each or last (autocorrelation 0.8),
common to a group or to a frame. Share of scenes of which a p-value is told, and with p <= 0.05, of the test by SBD and
of that by the trend.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from simulated_events import log_of

from semstab.model.events import Events
from semstab.statistics import scene_drift, voxel_drift

CASES = ((40, 20, 6), (40, 40, 6), (200, 80, 20), (200, 200, 10))
"""Frames, in how many of them a group is seen, groups."""

GROUP = 12


def scene(rng: np.random.Generator, case: tuple[int, int, int], common: str, lasting: float) -> Events:
    """The log of a scene without drift."""
    F, T, groups = case
    z = np.zeros(F)
    for f, anew in enumerate(rng.standard_normal(F)):
        z[f] = anew if f == 0 else lasting * z[f - 1] + np.sqrt(1 - lasting**2) * anew
    p = 1 / (1 + np.exp(1.5 - z))
    start = rng.integers(0, F - T + 1, groups)[:, None]
    seen = (np.arange(F) >= start) & (np.arange(F) < start + T)
    wrong = rng.random((groups, 1 if common == "group" else GROUP, F)) < p
    labels = np.where(seen[:, None], wrong, -1)
    return log_of(np.broadcast_to(labels, (groups, GROUP, F)).reshape(-1, F), K=2)


def rejected(case: tuple[int, int, int], common: str, lasting: float, runs: int) -> tuple[float, float, float]:
    """Share of the scenes that have a p-value, and that are found to drift, by SBD and by the trend."""
    rng, found = np.random.default_rng(1), []
    for _ in range(runs):
        events = scene(rng, case, common, lasting)
        table = events.table()
        test = scene_drift(table, events, voxel_drift(table, events, draws=1, most=1), frame_orders=99)
        found.append((not np.isnan(test.p_value), test.p_value <= 0.05, test.trend_p <= 0.05))
    told, by_sbd, by_trend = np.mean(found, axis=0)
    return float(told), float(by_sbd), float(by_trend)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    runs = parser.parse_args().runs
    print("| frames, seen in | errors | told | by SBD | by trend |\n|---|---|---|---|---|")
    for case in CASES:
        for common in ("group", "frame"):
            for lasting in (0.0, 0.8):
                told, by_sbd, by_trend = rejected(case, common, lasting, runs)
                errors = f"of a {common}, {'lasting' if lasting else 'anew'}"
                print(f"| {case[0]}, {case[1]} | {errors} | {told:.2f} | {by_sbd:.3f} | {by_trend:.3f} |", flush=True)


if __name__ == "__main__":
    main()
