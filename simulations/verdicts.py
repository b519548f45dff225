"""How often is a verdict right that states its probability?

    python simulations/verdicts.py [--trials 60] [--seed 0]

Scenes with voxels at borders that hold two classes, as a sampler sees them, and models whose alpha lies near the
thresholds of the verdict. A verdict is right where alpha of eight flights over the same scene together is in its
level. Prints two tables in Markdown: right verdicts by stated probability, and the mean probability
of the right level by the length of the flight.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from flights import Flight, fly, number_of, sample_of, table_of, totals_of, world

from semstab.model.statistics import HeadlineStatistics, Level, StabilityVerdict
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.description import cell_agreement
from semstab.statistics.intervals import confidence_intervals, headline_specs
from semstab.statistics.verdict import LIMITS, level_probabilities, verdict

FLIGHTS = 8
FRAMES = (10, 20, 40, 80, 160)
EASES = {"alike": (0.8, 1.0, 1.3), "bad": (1.2, 1.5, 1.8), "lasting": (0.9, 1.2, 1.5), "objects": (0.9, 1.1, 1.4),
         "regimes": (1.3, 1.6, 1.9), "direction": (1.2, 1.5, 1.8)}  # fmt: skip
"""Models near the thresholds, by how their frames differ."""


def true_level(alpha: float) -> Level:
    """Return the level of an alpha that is known."""
    return "stable" if alpha >= LIMITS.stable else "usable" if alpha >= LIMITS.usable else "unstable"


def verdicts(flight: Flight, count: int, seed: int) -> Iterator[tuple[StabilityVerdict, Level, float]]:
    """Yield the verdict on a flight over scene after scene, the right level, and the probability that it was given."""
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over, total = world(flight, rng), []
        for _ in range(FLIGHTS):
            sample = sample_of(fly(flight, over, rng), over, flight, rng)
            table = table_of(sample.observations(2))
            sums = cluster_sums_of(table, cells=sample)
            total.append(totals_of(sums, "alpha"))
            if len(total) == 1:
                cells = cell_agreement(sample, sums, table)
                headline = HeadlineStatistics(*confidence_intervals(headline_specs(sums)))
                said = verdict("net", headline=headline, cells=cells, voxels=len(table), share=1.0, blocks=sums.cells)
        level = true_level(float(number_of(sum(total), "alpha")))
        yield said, level, level_probabilities(headline.alpha)[level]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    right: dict[int, list[bool]] = defaultdict(list)
    given: dict[int, list[float]] = defaultdict(list)
    undecided: dict[int, list[bool]] = defaultdict(list)
    for quality, eases in EASES.items():
        for ease in eases:
            for frames in FRAMES:
                flight = Flight(45, 2.0, ease, frames, 5, quality)
                for said, level, probability in verdicts(flight, arguments.trials, arguments.seed):
                    given[frames].append(probability)
                    undecided[frames].append(said.level == "undecided")
                    if not math.isnan(said.probability) and said.level != "undecided":
                        right[min(int(10 * said.probability), 9)].append(said.level == level)
    print("| stated probability | verdicts | right |\n| --- | ---: | ---: |")
    for tenth, own in sorted(right.items()):
        print(f"| {tenth / 10:.1f} to {(tenth + 1) / 10:.1f} | {len(own)} | {np.mean(own):.3f} |")
    print("\n| frames | mean probability of the right level | undecided |\n| ---: | ---: | ---: |")
    for frames in FRAMES:
        print(f"| {frames} | {np.mean(given[frames]):.3f} | {np.mean(undecided[frames]):.3f} |")


if __name__ == "__main__":
    main()
