"""Does alpha move with voxels and pixels, and is its level right?

    python simulations/alpha.py invariance [--scenes 3] [--seed 0]
    python simulations/alpha.py levels [--scenes 12] [--flights 16] [--seed 0]
    python simulations/alpha.py shares [--scenes 12] [--flights 16] [--seed 0]

Flights of `pictures.py`, with errors of eight kinds. `invariance` prints alpha and its level by voxel size and pixel
stride. `levels` flies each scene again and again: alpha is right that all flights together give, an interval is right
that holds it, and a verdict that names its level. It prints two tables in Markdown: by kind, and by stated probability.
`shares` does the same where one class covers nearly the whole map: up to which share do the intervals hold?
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
from pictures import KINDS, K, Views, field, frames, predicted, scene

from semstab import backends
from semstab.data.statistics import Level
from semstab.statistics import Sampler, describe
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import estimate
from semstab.statistics.verdict import DECIDED, LIMITS, level_probabilities

SIZES, STRIDES = (0.125, 0.25, 0.5, 1.0), (1, 2, 3)
RATES = {
    "pixel": (0.02, 0.3), "block": (0.02, 0.3), "persistent": (0.1, 0.4), "view": (0.02, 0.3), "class": (0.02, 0.3),
    "boundary": (0.05, 0.4), "burst": (0.05, 0.4), "lasting": (0.02, 0.3),
}  # fmt: skip
"""Rates of errors, from a model that is stable to one that is not."""


def sums(views: Views, labels: np.ndarray, stride: int = 1) -> ClusterSums:
    """Return the sums of a flight."""
    sampler = Sampler(K)
    for frame in frames(views, labels, stride):
        sampler.add(frame)
    return sums_of_spots(sampler.sample())


def level_of(alpha: float) -> Level:
    """Return the level of an alpha that is known."""
    return "stable" if alpha >= LIMITS.stable else "usable" if alpha >= LIMITS.usable else "unstable"


def invariance(scenes: int, seed: int) -> None:
    """Print alpha and its level at each voxel size and stride."""
    cases = [(size, 1) for size in SIZES] + [(0.5, stride) for stride in STRIDES[1:]]
    names = [f"{size:g} m" if stride == 1 else f"every {stride}th pixel" for size, stride in cases]
    print(f"| errors | {' | '.join(names)} | largest difference |")
    print(f"|---|{'---|' * (len(names) + 1)}")
    for kind in KINDS:
        for trial in range(scenes):
            rng = np.random.default_rng([seed, trial])
            views, rate = scene(rng), 0.0 if kind == "none" else RATES[kind][1] * (trial + 1) / scenes
            labels = predicted(views, kind, rate, trial, 0)
            cells, found = [], []
            for size, stride in cases:
                backend, sampler = backends.create("numba", voxel_size=size, num_classes=K), Sampler(K)
                for frame in frames(views, labels, stride):
                    backend.integrate(frame)
                    sampler.add(frame)
                summary = describe(backend.table(), spots=sampler.sample())
                found.append(summary.headline.alpha.value)
                cells.append(f"{found[-1]:.3f} {level_of(found[-1])}")
            print(f"| {kind}, {rate:.2f} | {' | '.join(cells)} | {max(found) - min(found):.3f} |", flush=True)


def levels(scenes: int, flights: int, seed: int) -> None:
    """Print how often intervals hold alpha, and verdicts its level."""
    by_kind: dict[str, list[tuple[bool, float, float, Level, float, Level, float]]] = defaultdict(list)
    for kind in KINDS[1:]:
        for trial in range(scenes):
            rng = np.random.default_rng([seed, trial])
            views, (low, high) = scene(rng), RATES[kind]
            rate = low + (high - low) * (trial + rng.random()) / scenes
            flown = [sums(views, predicted(views, kind, rate, trial, flight)) for flight in range(flights)]
            values = np.array([value(own, "alpha") for own in flown])
            truth = min(float(values.mean()), 1.0)
            width = 3.92 * values.std(ddof=1)
            for own in flown:
                alpha = estimate(own, "alpha")
                said = level_probabilities(alpha)
                level = max(said, key=lambda name: said[name])
                inside = alpha.low - 1e-9 <= truth <= alpha.high + 1e-9
                by_kind[kind].append(
                    (inside, alpha.high - alpha.low, width, level, said[level], level_of(truth), truth)
                )
    print("| errors | interval holds it | width, times the ideal | stated 90 % or more, right | undecided |")
    print("|---|---:|---:|---:|---:|")
    for kind, rows in by_kind.items():
        sure = [row for row in rows if row[4] >= 0.9]
        right = np.mean([row[3] == row[5] for row in sure]) if sure else math.nan
        ideal = np.median([row[1] / row[2] for row in rows if row[2] > 1e-6] or [math.nan])
        undecided = np.mean([row[4] < DECIDED for row in rows])
        held = np.mean([row[0] for row in rows])
        print(f"| {kind} | {held:.3f} | {ideal:.2f} | {right:.3f} ({len(sure)}) | {undecided:.2f} |")
    print("\n| stated | right | flights | right, lasting errors | flights |\n|---|---:|---:|---:|---:|")
    everything = [(kind == "lasting", *row) for kind, rows in by_kind.items() for row in rows]
    for low in (0.6, 0.7, 0.8, 0.9):
        line = [f"{low:.0%} to {low + 0.1:.0%}"]
        for lasting in (False, True):
            high = low + 0.1 if low < 0.85 else 1.1
            own = [row[4] == row[6] for row in everything if row[0] == lasting and low <= row[5] < high]
            line += [f"{np.mean(own):.2f}" if own else "-", str(len(own))]
        print(f"| {' | '.join(line)} |")


SHARES = (0.9, 0.95, 0.96, 0.97, 0.98, 0.99, 0.995, 0.999)
"""Shares of the largest class."""


def of_share(views: Views, share: float, rng: np.random.Generator) -> Views:
    """Return the views with two classes: patches about 3 m wide, and all around them a class of that share."""
    rough = field(views.points, rng, 3.0)
    return replace(views, labels=(rough > np.quantile(rough[views.there], share)).astype(np.int64))


def shares(scenes: int, flights: int, seed: int) -> None:
    """Print how far intervals and verdicts hold by the share of the largest class.

    Errors are as frequent at the patches as around them: of both classes as many labels are wrong, at every share.
    """
    print("| largest class | chance | interval holds alpha | wide, median | stated 90 % or more, right | undecided |")
    print("|---:|---:|---:|---:|---:|---:|")
    for share in SHARES:
        rows, chance = [], []
        for kind in ("pixel", "block", "burst", "lasting"):
            for trial in range(scenes):
                rng = np.random.default_rng([seed, trial])
                views, (low, high) = of_share(scene(rng), share, rng), RATES[kind]
                rate = low + (high - low) * (trial + rng.random()) / scenes
                flown = []
                for flight in range(flights):
                    missed = predicted(views, kind, rate, trial, flight) != views.labels
                    added = predicted(views, kind, rate * (1 - share) / share, trial, flights + flight) != views.labels
                    labels = np.where(np.where(views.labels == 1, missed, added), 1 - views.labels, views.labels)
                    flown.append(sums(views, labels))
                truth = min(float(np.mean([value(own, "alpha") for own in flown])), 1.0)
                for own in flown:
                    alpha = estimate(own, "alpha")
                    said = level_probabilities(alpha)
                    level = max(said, key=lambda name: said[name])
                    inside = alpha.low - 1e-9 <= truth <= alpha.high + 1e-9
                    rows.append((inside, alpha.high - alpha.low, said[level], level == level_of(truth)))
                    fine = own.near
                    assert fine is not None
                    evidence = fine["evidence"].sum(axis=0)
                    chance.append(((evidence / evidence.sum()) ** 2).sum())
        inside, wide, stated, right = (np.array(column) for column in zip(*rows, strict=True))
        sure = stated >= 0.9
        print(
            f"| {share:.1%} | {np.mean(chance):.3f} | {inside.mean():.3f} | {np.nanmedian(wide):.2f} |"
            f" {right[sure].mean():.3f} ({sure.sum()}) | {np.mean(stated < DECIDED):.2f} |",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=["invariance", "levels", "shares"])
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--flights", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.table == "invariance":
        invariance(arguments.scenes or 3, arguments.seed)
    elif arguments.table == "shares":
        shares(arguments.scenes or 12, arguments.flights, arguments.seed)
    else:
        levels(arguments.scenes or 12, arguments.flights, arguments.seed)


if __name__ == "__main__":
    main()
