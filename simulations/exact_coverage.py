"""Do intervals hold the exact alpha of the scene flown again, and is a level right as often as its probability says?

    python simulations/simulate.py exact-coverage [--only PATTERN] [--scenes 8] [--flights 25] [--save FLIGHTS.csv]
    python simulations/simulate.py exact-coverage --load FLIGHTS.csv

Each condition has scenes of `exact_scenes.py`, and each of these is flown again: along another course, with other draws
of the errors. A course has other places and directions of the cameras, and a circle begins at another angle; errors of
a *place* stay where they are. From scene to scene errors grow, from a fifth of those of `exact_errors.py` to 1.2 times
these. The target is the exact alpha (`exact.py`) that the flights over a scene have on average. A single flight is one
of 25 in that average, so that its target is 2 % nearer to it than the average of very many flights is.

Prints tables in Markdown. By condition: the exact alpha of the scenes, from least to most; what a flight says less the
exact alpha, on average, with the standard error over scenes; how many intervals hold the exact alpha, and how many what
all flights over the scene say on average, so that a shift of all flights does not count; and the width of intervals
over 3.92 standard deviations of what single flights say, the median of scenes. Behind ± stands the Monte Carlo error:
that of the scenes, or that of as many independent flights if it is larger. By tenths of the stated probability: how
often the level of the scene's exact alpha is the one that a flight states.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import fnmatch
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from exact import Condition, exact, frames, said
from exact_errors import ERRORS, unlabelled
from exact_scenes import Array, ExactScene
from exact_views import PATHS, ExactFlight, Pinhole
from levels import level_of, stated

STRENGTH = 0.2, 1.2
"""Errors of the first and of the last scene, as a multiple of those that `exact_errors.py` describes."""

SIZE, FRAMES, POINTS = (120, 160), 16, 2500
"""Height and width of the images, frames of a flight, and points from which its exact alpha is counted."""

CIRCLES, STAYS = ("orbit", "oblique"), ("place",)
"""Courses that may begin at any angle, and errors that the same scene has on each flight."""

EVERY = 3.92
"""Standard deviations that hold 95 % of a normal distribution."""


@dataclasses.dataclass(frozen=True)
class Flown:
    """A flight.

    Attributes:
        condition: Its name.
        scene: Number of the scene.
        exact: Alpha of the surface, as this flight sees it.
        said, low, high: Alpha and its interval, as the tool says.
        level: What a verdict states.
        probability: Of that level.
    """

    condition: str
    scene: int
    exact: float
    said: float
    low: float
    high: float
    level: str
    probability: float


def conditions() -> list[Condition]:
    """Return the kinds of errors in an orbit, and some of them along other courses."""
    errors = [error for error in ERRORS if error not in ("none", "strong range")]
    rows = [Condition("orbit", error, FRAMES) for error in errors]
    rows += [Condition("strips", error, FRAMES) for error in ("blobs", "range")]
    rows += [Condition("oblique", "range", FRAMES), Condition("street", "range", FRAMES, K=8)]
    return rows


# --- Flights ----------------------------------------------------------------------------------------------------------


def again(condition: Condition, scene: ExactScene, rng: np.random.Generator) -> ExactFlight:
    """Return a flight over a scene, along a course of its own."""
    poses = PATHS[condition.path][1](condition.frames, rng)
    if condition.path in CIRCLES:
        poses = _about_the_vertical(rng.uniform(0, 2 * np.pi)) @ poses
    return ExactFlight(scene, Pinhole(SIZE[1], SIZE[0]), poses)


def _about_the_vertical(angle: float) -> Array:
    turn, c, s = np.eye(4), np.cos(angle), np.sin(angle)
    turn[:2, :2] = [[c, -s], [s, c]]
    return turn


def flights(condition: Condition, scenes: int, count: int, seed: int) -> Iterator[Flown]:
    """Yield flights over scene after scene, with errors that grow from scene to scene."""
    for number in range(scenes):
        of_scene, staying, *of_flights = np.random.SeedSequence([seed, number]).spawn(count + 2)
        scene = PATHS[condition.path][0](condition.K, np.random.default_rng(of_scene))
        strength = STRENGTH[0] + (STRENGTH[1] - STRENGTH[0]) * (number + 0.5) / scenes
        for flight in of_flights:
            course, errors, noise, draws = map(np.random.default_rng, flight.spawn(4))
            flown = again(condition, scene, course)
            if condition.error in STAYS:
                errors = np.random.default_rng(staying)
            labeller = unlabelled(ERRORS[condition.error](flown, condition.K, errors, strength), 0.0, flown, noise)
            true = exact(flown, labeller, POINTS, draws).value
            alpha = said(list(frames(flown, labeller, condition, noise)), condition.K)
            yield Flown(condition.name, number, true, alpha.value, alpha.low, alpha.high, *stated(alpha))


# --- Tables -----------------------------------------------------------------------------------------------------------

HEAD = (
    "condition", "flights", "exact, least to most", "said - exact", "intervals hold the exact alpha",
    "hold what flights say on average", "width, times the ideal",
)  # fmt: skip


def by_scene(rows: Sequence[Flown]) -> list[list[Flown]]:
    """Return the flights over each scene."""
    return [[row for row in rows if row.scene == number] for number in sorted({row.scene for row in rows})]


def mean(rows: Iterable[Flown], of: Callable[[Flown], float]) -> float:
    """Return the mean of a number of some flights."""
    return float(np.mean([of(row) for row in rows]))


def held(flown: Sequence[Flown], target: float) -> float:
    """Return the share of the intervals that hold a number."""
    return mean(flown, lambda row: row.low - 1e-9 <= target <= row.high + 1e-9)


def cells(name: str, rows: Sequence[Flown]) -> list[str]:
    """Return the row of a condition."""
    scenes = by_scene(rows)
    true = np.array([mean(flown, lambda row: row.exact) for flown in scenes])
    told = np.array([mean(flown, lambda row: row.said) for flown in scenes])
    ideal = [EVERY * np.std([row.said for row in flown], ddof=1) for flown in scenes]
    width = [mean(flown, lambda row: row.high - row.low) for flown in scenes]
    off = told - true

    def share(targets: Array) -> str:
        holds = np.array([held(flown, target) for flown, target in zip(scenes, targets, strict=True)])
        return f"{holds.mean():.3f} ± {max(_error(holds), np.sqrt(0.0475 / len(rows))):.3f}"

    return [
        name, str(len(rows)), f"{true.min():.2f} to {true.max():.2f}", f"{off.mean():+.3f} ± {_error(off):.3f}",
        share(true), share(told), f"{np.median(np.array(width) / np.maximum(ideal, 1e-9)):.2f}",
    ]  # fmt: skip


def _error(values: Array) -> float:
    """Return the standard error of a mean."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


GROUPS = ("burst", "lasting")
"""Errors with a column of their own; before them come all others."""


def group_of(row: Flown) -> str:
    """Return the column that a flight counts in."""
    error = row.condition.split(", ")[1]
    return error if error in GROUPS else "others"


def tenths(rows: Sequence[Flown]) -> Iterator[list[str]]:
    """Yield how often the stated level is that of the scene's exact alpha, by tenths of its probability."""
    names = dict.fromkeys(row.condition for row in rows)
    scenes = [flown for name in names for flown in by_scene([row for row in rows if row.condition == name])]
    right = [
        (group_of(row), row.probability, row.level == level_of(mean(flown, lambda row: row.exact)))
        for flown in scenes
        for row in flown
        if row.level != "undecided"
    ]
    for low in np.arange(6, 10) / 10:
        line = [f"{low:.0%} to {low + 0.1:.0%}"]
        for group in ("others", *GROUPS):
            in_tenth = [
                (p, is_right) for name, p, is_right in right if name == group and low <= p < low + 0.1 + (low > 0.85)
            ]
            line += (
                [f"{np.mean([x for _, x in in_tenth]):.2f}, stated {np.mean([p for p, _ in in_tenth]):.2f}"]
                if in_tenth
                else ["-"]
            )
            line += [str(len(in_tenth))]
        yield line
    line = ["undecided"]
    for group in ("others", *GROUPS):
        undecided = [flown.level == "undecided" for flown in rows if group_of(flown) == group]
        line += [f"{np.mean(undecided):.2f} of {len(undecided)}" if undecided else "-", str(sum(undecided))]
    yield line


def show(head: Sequence[str]) -> None:
    """Print the head of a table."""
    print("|", " | ".join(head), "|\n|---|" + "---:|" * (len(head) - 1), flush=True)


def writer_to(file: TextIO) -> Any:
    """Return a CSV writer of flights as tuples, behind their header."""
    writer = csv.writer(file)
    writer.writerow(field.name for field in dataclasses.fields(Flown))
    return writer


def load(path: Path) -> list[Flown]:
    """Return flights that were saved."""
    kinds = {"scene": int, "condition": str, "level": str}
    with path.open(newline="") as file:
        return [
            Flown(**{key: kinds.get(key, float)(text) for key, text in row.items()}) for row in csv.DictReader(file)
        ]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="as 'orbit*' or '*range*'")
    parser.add_argument("--scenes", type=int, default=8, help="of each condition")
    parser.add_argument("--flights", type=int, default=25, help="over each scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, metavar="FLIGHTS.csv", help="write a line for each flight")
    parser.add_argument("--load", type=Path, metavar="FLIGHTS.csv", help="print the tables of flights that were saved")
    arguments = parser.parse_args()
    rows: list[Flown] = []
    file = arguments.save.open("w", newline="") if arguments.save else None
    writer = writer_to(file) if file else None
    saved = load(arguments.load) if arguments.load else None
    show(HEAD)
    for condition in conditions():
        if not fnmatch.fnmatch(condition.name, arguments.only):
            continue
        if saved is None:
            of_condition = list(flights(condition, arguments.scenes, arguments.flights, arguments.seed))
        else:
            of_condition = [flown for flown in saved if flown.condition == condition.name]
        if of_condition:
            print("|", " | ".join(cells(condition.name, of_condition)), "|", flush=True)
        if writer and file:
            writer.writerows(map(dataclasses.astuple, of_condition))
            file.flush()
        rows += of_condition
    print()
    show(("stated", "right", "verdicts", "right, bursts", "verdicts", "right, lasting errors", "verdicts"))
    for line in tenths(rows):
        print("|", " | ".join(line), "|")


if __name__ == "__main__":
    main()
