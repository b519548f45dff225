"""How often do intervals of voxel alpha, PSA, accuracy and numbers by location hold what they are about?

    python simulations/simulate.py intervals this-scene [--trials 300] [--seed 0]
    python simulations/simulate.py intervals other-scenes [--trials 300] [--seed 0]
    python simulations/simulate.py intervals locations [--trials 300] [--seed 0]

Alpha, which is of spots, is in `exact_coverage.py`. Prints a table in Markdown. The target of an interval is the number
that very many flights have together: over the same scene for 'this scene' and numbers by location, over all scenes for
the others.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Literal

import cases
import numpy as np
from flights import SimulatedFlight, fly, number_of, sums_of, totals_of, world

from semstab.core.types import OTHER_SCENES, THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.statistics import Interval
from semstab.statistics.intervals import estimate

KEYS = ("voxel_alpha", "psa", "accuracy")


FLIGHTS = 8
"""Flights over each scene, of which the first has the interval and all together the target of scope 'this scene'."""


@dataclasses.dataclass(frozen=True)
class IntervalRow:
    """Results of the trials of one condition: for each its value, interval and target, and the spread of values."""

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
    flight: SimulatedFlight,
    count: int,
    seed: int,
    scope: Scope,
    keys: Sequence[str] = KEYS,
    name: str = "",
    interval: Scope | None = None,
) -> list[IntervalRow]:
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
        rows.append(IntervalRow(name, key, spread, targets, tuple(intervals[key])))
    return rows


# --- This scene, and other scenes -------------------------------------------------------------------------------------


QUALITIES = ("alike", "bad", "uneven", "lasting", "regimes", "heavy", "objects", "view", "direction")


def this_scene(count: int, seed: int) -> Iterator[IntervalRow]:
    """Simulate the same scene flown again: frames of nine kinds, of which all see all or each sees a strip."""
    yield from _flown(count, seed, THIS_SCENE)


def other_scenes(count: int, seed: int) -> Iterator[IntervalRow]:
    """Simulate other scenes, also with errors that reach up to a fifth of the scene."""
    yield from _flown(count, seed, OTHER_SCENES)
    for reach in (0.5, 5.0, 10.0):
        for quality in ("alike", "bad", "lasting", "objects"):
            yield from _of_frames(
                SimulatedFlight(45, reach, 1.0, 40, 5, quality), count, seed, OTHER_SCENES, f"reach {reach:g}"
            )


def _flown(count: int, seed: int, scope: Scope) -> Iterator[IntervalRow]:
    for frames in (20, 40, 80, 150):
        for quality in QUALITIES:
            yield from _of_frames(SimulatedFlight(45, 2.0, 1.0, frames, 5, quality), count, seed, scope)
    for frames in (20, 60):
        for quality in ("alike", "bad", "lasting", "regimes", "objects"):
            yield from _of_frames(SimulatedFlight(32, 2.0, 1.0, frames, frames, quality), count, seed, scope)
    for quality in ("bad", "lasting", "objects"):
        yield from _of_frames(
            SimulatedFlight(60, 2.0, 1.0, 40, 5, quality, city=True), count, seed, scope, "city 60 x 60"
        )
        yield from _of_frames(SimulatedFlight(45, 2.0, 1.0, 40, 5, quality, K=5), count, seed, scope, "five classes")
        yield from _of_frames(
            SimulatedFlight(45, 2.0, 1.0, 40, 5, quality, soft=True), count, seed, scope, "scores", "voxel_alpha"
        )
        yield from _of_frames(SimulatedFlight(45, 2.0, 2.2, 40, 5, quality), count, seed, scope, "few errors")
        yield from _of_frames(SimulatedFlight(45, 2.0, 1.0, 40, 5, quality), count, seed, scope, "", "psa")


def _of_frames(
    flight: SimulatedFlight, count: int, seed: int, scope: Scope, where: str = "", key: str = "voxel_alpha"
) -> Iterator[IntervalRow]:
    overlap = "all see all" if flight.observations == flight.frames else "strips"
    name = ", ".join(filter(None, (f"{flight.frames} frames", flight.quality, overlap, where)))
    yield from trials(flight, count, seed, scope, (key,), name)


BY_LOCATION = ("wrong_of_consistent", "entropy")


def locations(count: int, seed: int) -> Iterator[IntervalRow]:
    """Numbers whose frames do not show how they vary: by locations, as they are printed, and by frames.

    The target of both is what many flights over the same scene have together.
    """
    for quality in QUALITIES:
        flight, name = SimulatedFlight(45, 2.0, 1.0, 40, 5, quality, K=5), f"40 frames, {quality}, strips, five classes"
        for scope, by in ((THESE_FRAMES, "by location"), (THIS_SCENE, "by frame")):
            yield from trials(flight, count, seed, THIS_SCENE, BY_LOCATION, f"{name}, {by}", interval=scope)


# --- Table ------------------------------------------------------------------------------------------------------------

STUDIES = {
    "this-scene": this_scene,
    "other-scenes": other_scenes,
    "locations": locations,
}


def main(study: Literal["this-scene", "other-scenes", "locations"], trials: int = 300, seed: int = 0) -> None:
    cases.head(HEAD)
    for row in STUDIES[study](trials, seed):
        cases.row(row.cells())
