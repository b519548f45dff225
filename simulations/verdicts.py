"""How often is a verdict wrong, ceiling, classes and all?

    python simulations/verdicts.py [--trials 200] [--seed 0]

Scenes with voxels at borders that hold two classes, as a sampler sees them. Models reach a little less of their ceiling
than a level of the verdict asks for: how many flights are said to be of that level, or of a better one?
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
from flights import Flight, fly, sample_of, table_of, world

from semstab.model.statistics import HeadlineStatistics
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import FUNCTIONALS, sums_for, value
from semstab.statistics.intervals import confidence_intervals, headline_specs
from semstab.statistics.verdict import ceiling_share, verdict

BETTER = {"stable": ("stable", "partly stable"), "usable": ("stable", "partly stable", "usable")}
"""At each level, what says as much or more."""

CASES = {
    "stable": (
        Flight(45, 2.0, 1.26, 40, 5, "alike"),
        Flight(45, 2.0, 1.68, 40, 5, "bad"),
        Flight(45, 2.0, 1.40, 40, 5, "lasting"),
        Flight(45, 2.0, 1.65, 40, 5, "direction"),
        Flight(60, 2.0, 1.30, 60, 5, "lasting", city=True),
        Flight(45, 2.0, 1.20, 40, 5, "uneven", K=4),
        Flight(45, 2.0, 1.26, 12, 5, "alike"),
    ),
    "usable": (
        Flight(45, 2.0, 0.92, 40, 5, "lasting"),
        Flight(32, 1.5, 0.76, 12, 5, "alike"),
    ),
}
"""Flights that reach a little less than each level asks for; what they reach stands in the table."""


def levels(flight: Flight, count: int, seed: int) -> tuple[float, Counter[str]]:
    """The share of its ceiling that very many flights reach together, and the verdicts on each."""
    found: Counter[str] = Counter()
    total: np.ndarray | float = 0.0
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        sample = sample_of(fly(flight, over, rng), over, flight, rng)
        table = table_of(sample.seen)
        sums = cluster_sums_of(table, sample=sample.shared())
        reach = ceiling_share(sample, table, sums)
        assert np.isclose(reach.share.value, value(sums, "reached"))
        judged = HeadlineStatistics(*confidence_intervals(headline_specs(sums)))
        said = verdict("net", headline=judged, ceiling=reach, voxels=len(table), share=1.0, blocks=sums.cells)
        found[said.level] += 1
        total = total + sums_for(sums, "reached").sum(axis=0)
    return float(FUNCTIONALS["reached"].of(np.asarray(total))), found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| flights | reached | level | wrongly of that level | verdicts |\n| --- | --- | --- | --- | --- |")
    for level, flights in CASES.items():
        for flight in flights:
            reached, found = levels(flight, arguments.trials, arguments.seed)
            wrong = sum(found[name] for name in BETTER[level]) / arguments.trials
            scene = f"{'city' if flight.city else 'floor'} {flight.side} x {flight.side}, {flight.K} classes"
            said = ", ".join(f"{name} {times / arguments.trials:.2f}" for name, times in found.most_common())
            name = f"{scene}, {flight.frames} frames, {flight.quality}"
            print(f"| {name} | {reached:.3f} | {level} | {wrong:.3f} | {said} |", flush=True)


if __name__ == "__main__":
    main()
