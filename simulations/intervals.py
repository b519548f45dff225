"""How often do intervals hold what they are about?

    python simulations/intervals.py this-map [--trials 300] [--seed 0]
    python simulations/intervals.py next-flight [--trials 300] [--seed 0]
    python simulations/intervals.py differences [--trials 300] [--seed 0]
    python simulations/intervals.py correlogram [--trials 300] [--seed 0]

Prints a table in Markdown. What an interval is about is the number that very many such scenes and flights have
together: that of the sums of all trials.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from flights import Flight, fly, sample_of, sums_of, world

from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval, Question
from semstab.statistics.cluster_sums import FUNCTIONALS
from semstab.statistics.correlogram import correlogram
from semstab.statistics.intervals import difference, estimate
from semstab.statistics.observations import Views

KEYS = ("alpha", "psa", "accuracy")


@dataclasses.dataclass(frozen=True)
class Row:
    """What became of the trials of one condition: the value aimed at, and for each trial its interval."""

    name: str
    key: str
    target: float
    intervals: tuple[Interval, ...]

    def covered(self, which: Callable[[Interval], bool] = lambda _: True) -> float:
        """The share of the intervals that hold the target, among those for which `which` holds."""
        held = [i.low <= self.target <= i.high for i in self.intervals if which(i)]
        return float(np.mean(held)) if held else float("nan")

    def cells(self) -> list[str]:
        """As the table has them."""
        values = np.array([i.value for i in self.intervals])
        half = np.median([(i.high - i.low) / 2 for i in self.intervals])
        decided = np.array([i.decided for i in self.intervals])
        held = np.array([i.low <= self.target <= i.high for i in self.intervals])
        above = np.array([i.low > self.target for i in self.intervals])
        claimed = self.covered(lambda interval: interval.decided)
        return [
            self.name, self.key, f"{self.target:.3f}", f"{values.std():.3f}", f"{half:.3f}",
            _share(held.mean(), len(held)), f"{decided.mean():.2f}", _share(claimed, int(decided.sum())),
            f"{np.mean(decided & ~held):.3f}", f"{np.mean(decided & above):.3f}",
        ]  # fmt: skip


def _share(share: float, of: int) -> str:
    """With its standard error, no smaller than that of a share of 5 %."""
    return f"{share:.3f} ± {np.sqrt(max(share * (1 - share), 0.0475) / of):.3f}" if of else ""


HEAD = ["condition", "of", "target", "sd", "half width", "held", "claimed", "held of claimed", "wrong", "low end above"]


def trials(
    flight: Flight, count: int, seed: int, question: Question, keys: Sequence[str] = KEYS, name: str = ""
) -> list[Row]:
    """Scene after scene, each flown over once."""
    found: dict[str, list[Interval]] = {key: [] for key in keys}
    totals: dict[str, np.ndarray | float] = dict.fromkeys(keys, 0.0)
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        sums = sums_of(fly(flight, over, rng), over, flight)
        for key in keys:
            found[key].append(estimate(sums, key, question=question))
            totals[key] = totals[key] + sums.of(FUNCTIONALS[key].names).sum(axis=0)
    targets = {key: float(FUNCTIONALS[key].of(np.asarray(totals[key]))) for key in keys}
    return [Row(name, key, targets[key], tuple(found[key])) for key in keys]


# --- This map ---------------------------------------------------------------------------------------------------------


def this_map(count: int, seed: int) -> Iterator[Row]:
    """Floors of 2,000 to 50,000 voxels and a city, errors reaching half a voxel to twenty, all sorts of alpha."""
    for side in (45, 100, 224):
        for reach in (0.5, 2.0, 5.0, 10.0, 20.0):
            flight = Flight(side=side, reach=reach)
            yield from trials(flight, count, seed, THIS_MAP, ("alpha",), f"floor {side} x {side}, reach {reach:g}")
    for reach in (0.5, 2.0, 5.0):
        yield from trials(
            Flight(80, reach, city=True), count, seed, THIS_MAP, ("alpha",), f"city 80 x 80, reach {reach:g}"
        )
    yield from trials(Flight(100, 2.0, coin=True), count, seed, THIS_MAP, KEYS, "floor 100 x 100, a coin")
    for soft, K in ((True, 2), (False, 5)):
        name = "floor 100 x 100, reach 2, " + ("scores" if soft else f"{K} classes")
        yield from trials(Flight(100, 2.0, K=K, soft=soft), count, seed, THIS_MAP, ("alpha_between", "accuracy"), name)
    for ease in (2.0, 2.5, 3.0):
        yield from trials(
            Flight(100, 2.0, ease), count, seed, THIS_MAP, KEYS, f"floor 100 x 100, reach 2, ease {ease:g}"
        )


# --- The next flight --------------------------------------------------------------------------------------------------


def next_flight(count: int, seed: int) -> Iterator[Row]:
    """All frames see all, or each a strip; frames of six kinds; and other scenes, classes, scores, shares of errors."""
    for frames in (20, 30, 40, 60, 100):
        for quality in ("alike", "bad", "uneven", "lasting"):
            yield from _of_frames(Flight(45, 2.0, 1.0, frames, 5, quality), count, seed)
    for frames in (30, 60):
        for quality in ("alike", "bad", "uneven", "lasting"):
            yield from _of_frames(Flight(45, 2.0, 1.0, frames, frames, quality), count, seed)
        for quality in ("view", "direction"):
            yield from _of_frames(Flight(45, 2.0, 1.0, frames, 5, quality), count, seed)
    for quality in ("bad", "lasting", "direction"):
        yield from _of_frames(Flight(60, 2.0, 1.0, 40, 5, quality, city=True), count, seed, "city 60 x 60")
        yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, quality, K=5), count, seed, "five classes")
        yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, quality, soft=True), count, seed, "scores", "alpha_between")
        yield from _of_frames(Flight(45, 2.0, 2.2, 40, 5, quality), count, seed, "few errors")
        yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, quality), count, seed, "", "psa")
    yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, coin=True), count, seed, "a coin")
    for quality in ("bad", "lasting"):
        yield from _of_frames(Flight(224, 4.0, 1.0, 40, 5, quality), count, seed, "floor 224 x 224, reach 4")


def _of_frames(flight: Flight, count: int, seed: int, where: str = "", key: str = "alpha") -> Iterator[Row]:
    seen = "all see all" if flight.looks == flight.frames else "strips"
    name = ", ".join(filter(None, (f"{flight.frames} frames", flight.quality, seen, where)))
    yield from trials(flight, count, seed, NEXT_FLIGHT, (key,), name)


# --- Differences ------------------------------------------------------------------------------------------------------


def differences(count: int, seed: int) -> Iterator[Row]:
    """Two models that err equally often, on the same scene: in the same frames, or in two flights."""
    for side, looks in ((32, 60), (45, 5)):
        for quality in ("alike", "bad", "uneven", "lasting"):
            yield from _pairs(Flight(side, 1.5, 1.0, 60, looks, quality), count, seed)
    yield from _pairs(Flight(32, 1.5, 1.0, 15, 5, "alike"), count, seed, THIS_MAP, "this map")
    yield from _pairs(Flight(45, 1.5, 1.0, 40, 5, "uneven", K=5), count, seed, where="five classes")
    yield from _pairs(Flight(45, 1.5, 1.0, 40, 5, "uneven", soft=True), count, seed, where="scores")


def _pairs(flight: Flight, count: int, seed: int, question: Question = NEXT_FLIGHT, where: str = "") -> Iterator[Row]:
    key = "alpha_between" if flight.soft else "alpha"
    found: dict[str, list[Interval]] = {"same frames": [], "two flights": []}
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        other = dataclasses.replace(over, hard=world(flight, rng).hard)
        pair = [sums_of(fly(flight, scene, rng), scene, flight) for scene in (over, other)]
        found["same frames"].append(difference(*pair, key, question=question, same_frames=True))
        found["two flights"].append(difference(*pair, key, question=question, same_frames=False))
    seen = "all see all" if flight.looks == flight.frames else "strips"
    for flights, intervals in found.items():
        parts = (f"{flight.side} x {flight.side}, {flight.frames} frames", flight.quality, seen, where, flights)
        yield Row(", ".join(filter(None, parts)), f"{key} a - b", 0.0, tuple(intervals))


# --- Correlogram ------------------------------------------------------------------------------------------------------

APART = (1, 2, 4)
"""Frames that two looks are apart."""


def correlograms(count: int, seed: int) -> Iterator[Row]:
    """Bands of the bins in time. The target is the mean of all trials."""
    along = np.stack([np.linspace(0, 5.6, 40), np.full(40, 2.8), np.full(40, 10.0)], axis=1)
    views = Views(np.arange(40), along, np.full(40, math.nan))
    for quality in ("alike", "uneven", "lasting"):
        flight = Flight(45, 2.0, 1.0, 40, 10, quality)
        found: dict[int, list[Interval]] = {apart: [] for apart in APART}
        for trial in range(count):
            rng = np.random.default_rng([seed, trial])
            over = world(flight, rng)
            sample = sample_of(fly(flight, over, rng), over, flight, rng)
            bins = correlogram(dataclasses.replace(sample, views=views)).time
            for own, lag in zip(found.values(), bins, strict=False):
                own.append(lag.alpha)
        for apart, own in found.items():
            target = float(np.mean([alpha.value for alpha in own]))
            yield Row(f"40 frames, {quality}, strips, {apart} apart", "alpha_between", target, tuple(own))


# --- Table ------------------------------------------------------------------------------------------------------------

STUDIES = {"this-map": this_map, "next-flight": next_flight, "differences": differences, "correlogram": correlograms}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("|", " | ".join(HEAD), "|")
    print("|", " | ".join("---" for _ in HEAD), "|")
    for row in STUDIES[arguments.study](arguments.trials, arguments.seed):
        print("|", " | ".join(row.cells()), "|", flush=True)


if __name__ == "__main__":
    main()
