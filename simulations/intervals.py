"""How often do intervals hold what they are about?

    python simulations/intervals.py these-frames [--trials 300] [--seed 0]
    python simulations/intervals.py this-scene [--trials 300] [--seed 0]
    python simulations/intervals.py other-scenes [--trials 300] [--seed 0]
    python simulations/intervals.py locations [--trials 300] [--seed 0]
    python simulations/intervals.py differences [--trials 300] [--seed 0]
    python simulations/intervals.py correlogram [--trials 300] [--seed 0]

Prints a table in Markdown. The target of an interval is the number that very many flights have together: over the same
scene for 'this scene' and numbers by location, over all scenes for the others.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from flights import Flight, fly, number_of, sample_of, sums_of, totals_of, world

from semstab.core.types import OTHER_SCENES, THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.statistics import Interval
from semstab.statistics.correlogram import correlogram
from semstab.statistics.intervals import difference, estimate

KEYS = ("voxel_alpha", "psa", "accuracy")


FLIGHTS = 8
"""Flights over each scene, of which the first has the interval and all together the target of scope 'this scene'."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What became of the trials of one condition: for each its value, interval and target, and the spread of values."""

    name: str
    key: str
    spread: float
    targets: np.ndarray
    intervals: tuple[Interval, ...]

    def covered(self) -> float:
        """Return the share of the intervals that hold their target."""
        return float(np.mean([i.low <= t <= i.high for i, t in zip(self.intervals, self.targets, strict=True)]))

    def cells(self) -> list[str]:
        """Return the row of the table."""
        half = np.median([(i.high - i.low) / 2 for i in self.intervals])
        decided = np.mean([i.decided for i in self.intervals])
        error = math.sqrt(0.0475 / len(self.intervals))
        return [
            self.name, self.key, f"{self.targets.mean():.3f}", f"{self.spread:.4f}", f"{half:.3f}",
            f"{half / 1.96 / self.spread:.2f}", f"{self.covered():.3f} ± {error:.3f}", f"{decided:.2f}",
        ]  # fmt: skip


HEAD = ["condition", "of", "target", "sd", "half width", "half width / 1.96 sd", "held", "claimed"]


def trials(
    flight: Flight,
    count: int,
    seed: int,
    scope: Scope,
    keys: Sequence[str] = KEYS,
    name: str = "",
    interval: Scope | None = None,
) -> list[Row]:
    """Simulate scene after scene: 'this scene' has a target of its own in each, the others one of all.

    The interval's scope is the same, unless it is given.
    """
    flights = FLIGHTS if scope == THIS_SCENE else 1
    intervals: dict[str, list[Interval]] = {key: [] for key in keys}
    values: dict[str, list[list[float]]] = {key: [] for key in keys}
    totals: dict[str, list[np.ndarray]] = {key: [] for key in keys}
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        flown = [sums_of(fly(flight, over, rng), over, flight, rng) for _ in range(flights)]
        for key in keys:
            columns = np.array([totals_of(sums, key) for sums in flown])
            intervals[key].append(estimate(flown[0], key, scope=interval or scope))
            values[key].append([*number_of(columns, key)])
            totals[key].append(columns.sum(axis=0))
    rows = []
    for key in keys:
        scenes, one = np.array(totals[key]), np.array(values[key])
        if scope == THIS_SCENE:
            targets, spread = number_of(scenes, key), math.sqrt(one.var(axis=1, ddof=1).mean())
        else:
            targets, spread = np.full(count, float(number_of(scenes.sum(axis=0), key))), float(one.std(ddof=1))
        rows.append(Row(name, key, spread, targets, tuple(intervals[key])))
    return rows


# --- These frames -----------------------------------------------------------------------------------------------------


def these_frames(count: int, seed: int) -> Iterator[Row]:
    """Floors of 2,000 to 50,000 voxels and a city, errors reaching half a voxel to twenty, all sorts of alpha."""
    for side in (45, 100, 224):
        for reach in (0.5, 2.0, 5.0, 10.0, 20.0):
            flight, name = Flight(side=side, reach=reach), f"floor {side} x {side}, reach {reach:g}"
            yield from trials(flight, count, seed, THESE_FRAMES, ("voxel_alpha",), name)
    for reach in (0.5, 2.0, 5.0):
        yield from trials(
            Flight(80, reach, city=True), count, seed, THESE_FRAMES, ("voxel_alpha",), f"city 80 x 80, reach {reach:g}"
        )
    yield from trials(Flight(100, 2.0, coin=True), count, seed, THESE_FRAMES, KEYS, "floor 100 x 100, a coin")
    for soft, K in ((True, 2), (False, 5)):
        name = "floor 100 x 100, reach 2, " + ("scores" if soft else f"{K} classes")
        flight, keys = Flight(100, 2.0, K=K, soft=soft), ("voxel_alpha", "accuracy")
        yield from trials(flight, count, seed, THESE_FRAMES, keys, name)
    for ease in (2.0, 2.5, 3.0):
        yield from trials(
            Flight(100, 2.0, ease), count, seed, THESE_FRAMES, KEYS, f"floor 100 x 100, reach 2, ease {ease:g}"
        )


# --- This scene, and other scenes -------------------------------------------------------------------------------------


QUALITIES = ("alike", "bad", "uneven", "lasting", "regimes", "heavy", "objects", "view", "direction")


def this_scene(count: int, seed: int) -> Iterator[Row]:
    """Simulate the same scene flown again: frames of nine kinds, of which all see all or each sees a strip."""
    yield from _flown(count, seed, THIS_SCENE)


def other_scenes(count: int, seed: int) -> Iterator[Row]:
    """Simulate other scenes, also with errors that reach up to a fifth of the scene."""
    yield from _flown(count, seed, OTHER_SCENES)
    for reach in (0.5, 5.0, 10.0):
        for quality in ("alike", "bad", "lasting", "objects"):
            yield from _of_frames(Flight(45, reach, 1.0, 40, 5, quality), count, seed, OTHER_SCENES, f"reach {reach:g}")


def _flown(count: int, seed: int, scope: Scope) -> Iterator[Row]:
    for frames in (20, 40, 80, 150):
        for quality in QUALITIES:
            yield from _of_frames(Flight(45, 2.0, 1.0, frames, 5, quality), count, seed, scope)
    for frames in (20, 60):
        for quality in ("alike", "bad", "lasting", "regimes", "objects"):
            yield from _of_frames(Flight(32, 2.0, 1.0, frames, frames, quality), count, seed, scope)
    for quality in ("bad", "lasting", "objects"):
        yield from _of_frames(Flight(60, 2.0, 1.0, 40, 5, quality, city=True), count, seed, scope, "city 60 x 60")
        yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, quality, K=5), count, seed, scope, "five classes")
        yield from _of_frames(
            Flight(45, 2.0, 1.0, 40, 5, quality, soft=True), count, seed, scope, "scores", "voxel_alpha"
        )
        yield from _of_frames(Flight(45, 2.0, 2.2, 40, 5, quality), count, seed, scope, "few errors")
        yield from _of_frames(Flight(45, 2.0, 1.0, 40, 5, quality), count, seed, scope, "", "psa")


def _of_frames(
    flight: Flight, count: int, seed: int, scope: Scope, where: str = "", key: str = "voxel_alpha"
) -> Iterator[Row]:
    seen = "all see all" if flight.observations == flight.frames else "strips"
    name = ", ".join(filter(None, (f"{flight.frames} frames", flight.quality, seen, where)))
    yield from trials(flight, count, seed, scope, (key,), name)


BY_LOCATION = ("wrong_of_consistent", "entropy")


def locations(count: int, seed: int) -> Iterator[Row]:
    """Numbers whose frames do not show how they vary: by locations, as they are printed, and by frames.

    The target of both is what many flights over the same scene have together.
    """
    for quality in QUALITIES:
        flight, name = Flight(45, 2.0, 1.0, 40, 5, quality, K=5), f"40 frames, {quality}, strips, five classes"
        for scope, by in ((THESE_FRAMES, "by location"), (THIS_SCENE, "by frame")):
            yield from trials(flight, count, seed, THIS_SCENE, BY_LOCATION, f"{name}, {by}", interval=scope)


# --- Differences ------------------------------------------------------------------------------------------------------


def differences(count: int, seed: int) -> Iterator[Row]:
    """Two models that err equally often, on the same scene: in the same frames, or in two flights."""
    for side, observations in ((32, 60), (45, 5)):
        for quality in ("alike", "bad", "uneven", "lasting"):
            yield from _pairs(Flight(side, 1.5, 1.0, 60, observations, quality), count, seed)
    yield from _pairs(Flight(32, 1.5, 1.0, 15, 5, "alike"), count, seed, THESE_FRAMES, "these frames")
    yield from _pairs(Flight(45, 1.5, 1.0, 40, 5, "uneven", K=5), count, seed, where="five classes")
    yield from _pairs(Flight(45, 1.5, 1.0, 40, 5, "uneven", soft=True), count, seed, where="scores")


def _pairs(flight: Flight, count: int, seed: int, scope: Scope = THIS_SCENE, where: str = "") -> Iterator[Row]:
    key = "voxel_alpha"
    found: dict[str, list[Interval]] = {"same frames": [], "two flights": []}
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        other = dataclasses.replace(over, hard=world(flight, rng).hard)
        pair = [sums_of(fly(flight, scene, rng), scene, flight, rng) for scene in (over, other)]
        found["same frames"].append(difference(*pair, key, scope=scope, same_frames=True))
        found["two flights"].append(difference(*pair, key, scope=scope, same_frames=False))
    seen = "all see all" if flight.observations == flight.frames else "strips"
    for flights, intervals in found.items():
        parts = (f"{flight.side} x {flight.side}, {flight.frames} frames", flight.quality, seen, where, flights)
        spread = float(np.std([interval.value for interval in intervals]))
        yield Row(", ".join(filter(None, parts)), f"{key} a - b", spread, np.zeros(count), tuple(intervals))


# --- Correlogram ------------------------------------------------------------------------------------------------------

APART = (1, 2, 4)
"""Frames that two observations are apart."""


def correlograms(count: int, seed: int) -> Iterator[Row]:
    """Bands of the bins in time. The target is the mean of all trials."""
    for quality in ("alike", "uneven", "lasting"):
        flight = Flight(45, 2.0, 1.0, 40, 10, quality)
        found: dict[int, list[Interval]] = {apart: [] for apart in APART}
        for trial in range(count):
            rng = np.random.default_rng([seed, trial])
            over = world(flight, rng)
            bins = correlogram(sample_of(fly(flight, over, rng), over, flight, rng)).time
            for own, lag in zip(found.values(), bins, strict=False):
                own.append(lag.alpha)
        for apart, own in found.items():
            values = np.array([alpha.value for alpha in own])
            targets = np.full(count, values.mean())
            yield Row(f"40 frames, {quality}, strips, {apart} apart", "alpha", values.std(), targets, tuple(own))


# --- Table ------------------------------------------------------------------------------------------------------------

STUDIES = {
    "these-frames": these_frames,
    "this-scene": this_scene,
    "other-scenes": other_scenes,
    "locations": locations,
    "differences": differences,
    "correlogram": correlograms,
}


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
