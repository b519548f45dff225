"""Does alpha move with the pixels that are looked at, and does its level hold where one class is nearly all?

    python simulations/simulate.py alpha strides [--scenes 3] [--seed 0]
    python simulations/simulate.py alpha shares [--scenes 12] [--flights 16] [--seed 0]

Flights of `orbit_views.py`, with errors of eight kinds. `strides` prints alpha and its level with every pixel, and with
every second and third one of each axis. `shares` flies scenes again and again of which one class covers nearly all: an
interval is right that holds what all flights over a scene give together, and a verdict that names its level. Both
print a table in Markdown. What alpha should be is known exactly in other scenes: `exact.py`, `exact_coverage.py`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from levels import level_of, stated
from orbit_views import KINDS, K, OrbitViews, field, frames, predicted, scene

from semstab.statistics import Sampler
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import estimate

STRIDES, NTH = (1, 2, 3), {2: "2nd", 3: "3rd"}
RATES = {
    "pixel": (0.02, 0.3), "block": (0.02, 0.3), "persistent": (0.1, 0.4), "view": (0.02, 0.3), "class": (0.02, 0.3),
    "boundary": (0.05, 0.4), "burst": (0.05, 0.4), "lasting": (0.02, 0.3),
}  # fmt: skip
"""Rates of errors, from a model that is stable to one that is not."""


def sums(views: OrbitViews, labels: np.ndarray, stride: int = 1) -> ClusterSums:
    """Return the sums of a flight."""
    sampler = Sampler(K)
    for frame in frames(views, labels, stride):
        sampler.add(frame)
    return sums_of_spots(sampler.sample())


def strides(scenes: int, seed: int) -> None:
    """Print alpha and its level at each stride."""
    names = ["every pixel" if stride == 1 else f"every {NTH[stride]} pixel" for stride in STRIDES]
    print(f"| errors | {' | '.join(names)} | largest difference |\n|---|{'---|' * (len(names) + 1)}")
    for kind in KINDS:
        for trial in range(scenes):
            rng = np.random.default_rng([seed, trial])
            views, rate = scene(rng), 0.0 if kind == "none" else RATES[kind][1] * (trial + 1) / scenes
            labels = predicted(views, kind, rate, trial, 0)
            found = [value(sums(views, labels, stride), "alpha") for stride in STRIDES]
            cells = [f"{alpha:.3f} {level_of(alpha)}" for alpha in found]
            print(f"| {kind}, {rate:.2f} | {' | '.join(cells)} | {max(found) - min(found):.3f} |", flush=True)


SHARES = (0.9, 0.95, 0.96, 0.97, 0.98, 0.99, 0.995, 0.999)
"""Shares of the largest class."""


def of_share(views: OrbitViews, share: float, rng: np.random.Generator) -> OrbitViews:
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
                truth = min(float(np.mean([value(flight, "alpha") for flight in flown])), 1.0)
                for flight in flown:
                    alpha = estimate(flight, "alpha")
                    level, probability = stated(alpha)
                    inside = alpha.low - 1e-9 <= truth <= alpha.high + 1e-9
                    decided = level != "undecided"
                    rows.append((inside, alpha.high - alpha.low, probability, level == level_of(truth), decided))
                    evidence = flight.answers[0]["evidence"].sum(axis=0)
                    chance.append(((evidence / evidence.sum()) ** 2).sum())
        inside, wide, probability, right, decided = (np.array(column) for column in zip(*rows, strict=True))
        sure = decided & (probability >= 0.9)
        print(
            f"| {share:.1%} | {np.mean(chance):.3f} | {inside.mean():.3f} | {np.nanmedian(wide):.2f} |"
            f" {right[sure].mean():.3f} ({sure.sum()}) | {np.mean(~decided):.2f} |",
            flush=True,
        )


def main(table: Literal["strides", "shares"], scenes: int | None = None, flights: int = 16, seed: int = 0) -> None:
    if table == "strides":
        strides(scenes or 3, seed)
    else:
        shares(scenes or 12, flights, seed)
