"""How often do intervals hold what they are about?

    python tests/simulation/intervals.py this-map [--trials 300] [--seed 0]
    python tests/simulation/intervals.py next-flight [--trials 300] [--seed 0]
    python tests/simulation/intervals.py differences [--trials 300] [--seed 0]

Prints a table in Markdown. What an interval is about is the number that very many such scenes and flights have
together: that of the sums of all trials.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from flights import Flight, fly, sums_of, world

from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval, Question
from semstab.statistics.sampling import InfluenceSums, difference, estimate
from semstab.statistics.sampling.influence import FUNCTIONALS

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
        decided = np.mean([i.decided for i in self.intervals])
        share = self.covered()
        error = np.sqrt(max(share * (1 - share), 0.01) / len(values))
        return [
            self.name, self.key, f"{self.target:.3f}", f"{values.std():.3f}", f"{half:.3f}", f"{share:.3f}",
            f"{error:.3f}", f"{np.mean([i.low > self.target for i in self.intervals]):.3f}", f"{decided:.2f}",
        ]  # fmt: skip


HEAD = ["condition", "of", "target", "sd", "half width", "coverage", "mc error", "low end above", "decided"]


def trials(
    flight: Flight, count: int, seed: int, question: Question, keys: Sequence[str] = KEYS, name: str = ""
) -> list[Row]:
    """Scene after scene, each flown over once."""
    found: dict[str, list[Interval]] = {key: [] for key in keys}
    totals: dict[str, np.ndarray | float] = dict.fromkeys(keys, 0.0)
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        sums = sums_of(fly(flight, over, rng), over)
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
    for ease in (2.0, 2.5, 3.0):
        yield from trials(
            Flight(100, 2.0, ease), count, seed, THIS_MAP, KEYS, f"floor 100 x 100, reach 2, ease {ease:g}"
        )


# --- The next flight --------------------------------------------------------------------------------------------------


def next_flight(count: int, seed: int) -> Iterator[Row]:
    """All frames see all, or each a strip; frames of five kinds."""
    for frames in (20, 40, 60, 100):
        for looks in (frames, 5):
            for quality in ("alike", "bad", "uneven", "lasting", "view"):
                flight = Flight(32, 1.5, 1.0, frames, looks, quality)
                if quality == "view" and looks == frames:
                    continue
                name = f"{frames} frames, {quality}, {'all see all' if looks == frames else 'strips'}"
                yield from trials(flight, count, seed, NEXT_FLIGHT, ("alpha",), name)


# --- Differences ------------------------------------------------------------------------------------------------------


def differences(count: int, seed: int) -> Iterator[Row]:
    """Two models that err equally often, on the same scene: in the same frames, or in two flights."""
    for quality in ("alike", "bad", "uneven", "lasting"):
        for same in (True, False):
            flight = Flight(32, 1.5, 1.0, 64, 64, quality)
            found: list[Interval] = []
            for trial in range(count):
                rng = np.random.default_rng([seed, trial])
                over = world(flight, rng)
                other = dataclasses.replace(over, hard=world(flight, rng).hard)
                pair = [sums_of(fly(flight, scene, rng), over) for scene in (over, other)]
                found.append(_difference(pair, same))
            where = "same frames" if same else "two flights"
            yield Row(f"64 frames, {quality}, {where}", "alpha a - b", 0.0, tuple(found))


def _difference(pair: Sequence[InfluenceSums], same: bool) -> Interval:
    return difference(pair[0], pair[1], "alpha", same_frames=same)


# --- Table ------------------------------------------------------------------------------------------------------------

STUDIES = {"this-map": this_map, "next-flight": next_flight, "differences": differences}


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
