"""Two flights over one made scene: is agreement across the flights right, and what changed found?

    python simulations/simulate.py visits [--seeds 4] [--points 20000] [--only PATTERN]

Both flights circle a yard of boxes, slopes and poles on paths of their own, 30 frames each. Labels err as in `exact`; a
*place* has the same error in both flights. In rows with a share, the labels of that share of the places (cubes of 2 m)
are of another class in the second flight. With *boxes*, three boxes of the first flight are gone in the second one, and
three others are new. The exact values are of points that are drawn on the surface and met by each view without any
pixel; *said - exact* and the standard error of its mean are over scenes, and so is how often the interval of the cost
holds the exact cost. *found* is the share of the spots on boxes that are gone or new which are called so, of those that
two views or more of the other flight tell; *wrong* the share of the spots called gone or new that are a pixel (.3 m) or
more from all such boxes.
"""

from __future__ import annotations

import argparse
import fnmatch
from dataclasses import dataclass

import numpy as np
from exact import Condition, frames
from exact_errors import ERRORS, IGNORED, Labeller
from exact_scenes import Array, ExactScene, Ints, Solid, rectangle, yard
from exact_views import PATHS, ExactFlight, ImagePoints, Pinhole

from semstab.data.statistics import TwoVisits
from semstab.statistics.visit_agreement import two_visits
from semstab.statistics.visits import GONE, NEW, VisitedSpots, VisitSampler, by_turns

EDGE = 2.0
"""Edge of the cubes whose labels change, metres."""

NEAR, PIXEL = 0.05, 0.3
"""Metres from a box within which a spot is on it; and within which it may be, as a pixel at its edge is so wide."""


@dataclass(frozen=True)
class Visits:
    """A condition.

    Attributes:
        path: Of both flights.
        error: Of both flights, one of ERRORS.
        share: Of the places whose labels change.
        boxes: Number of boxes that go, and that come.
        frames: Of each flight.
    """

    path: str
    error: str
    share: float = 0.0
    boxes: int = 0
    frames: int = 30

    @property
    def name(self) -> str:
        """Return the first cell of a row."""
        changed = f", {self.share:.0%} change" if self.share else ""
        return f"{self.path}, {self.error}{changed}{', boxes' if self.boxes else ''}"


CONDITIONS = (
    *(Visits(path, error) for path in ("orbit", "oblique") for error in ("none", "pixels", "blobs", "border", "place")),
    *(Visits("orbit", error, share) for share in (0.1, 0.3) for error in ("none", "blobs", "border")),
    *(Visits(path, error, boxes=3) for path in ("orbit", "strips") for error in ("none", "blobs")),
    Visits("orbit", "blobs", 0.1, 3),
)
K = 6


@dataclass(frozen=True, eq=False)
class MadeVisits:
    """Two flights with their labels, and the solids of each that the other one lacks."""

    flights: tuple[ExactFlight, ExactFlight]
    labellers: tuple[Labeller, Labeller]
    alone: tuple[list[Solid], list[Solid]]
    common_faces: int

    @classmethod
    def from_visits(cls, visits: Visits, seed: int, size: tuple[int, int]) -> MadeVisits:
        """Make them."""
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, 82]).spawn(7)]
        of_scene, boxes, *paths = streams[:4]
        both = yard(K, of_scene).solids
        alone = tuple([_box(boxes) for _ in range(visits.boxes)] for _ in range(2))
        scenes = [ExactScene([*both, *solids]) for solids in alone]
        course, sensor = PATHS[visits.path][1], Pinhole(size[1], size[0])
        flights = [
            ExactFlight(scene, sensor, course(visits.frames, rng)) for scene, rng in zip(scenes, paths, strict=True)
        ]
        errors = ERRORS[visits.error]
        at_place = [np.random.default_rng([seed, 7]) for _ in range(2)]  # errors of a place are the same
        drawn = at_place if visits.error == "place" else streams[4:6]
        first, second = (errors(flown, K, rng) for flown, rng in zip(flights, drawn, strict=True))
        changed = _changing(second, visits.share, streams[6])
        faces = sum(len(solid.polygons) for solid in both)
        return cls((flights[0], flights[1]), (first, changed), (alone[0], alone[1]), faces)


def _box(rng: np.random.Generator) -> Solid:
    size, middle = rng.uniform(2, 4, 2), rng.uniform(-9, 9, 2)
    outline = rectangle(middle - size / 2, middle + size / 2, rng.uniform(0, np.pi))
    return Solid.prism(outline, rng.uniform(1, 3), *rng.integers(0, K, 2).tolist())


def _changing(labeller: Labeller, share: float, rng: np.random.Generator) -> Labeller:
    """Return labels of the next class in a share of the cubes of space."""
    chosen = rng.random((64, 64, 64)) < share

    def label(view: ImagePoints) -> Ints:
        labels, cube = labeller(view), np.floor(view.point / EDGE + 1e-6).astype(int) % 64
        other = chosen[tuple(cube.T)] & (labels != IGNORED)
        return np.where(other, (labels + 1) % K, labels)

    return label


def said(made: MadeVisits, visits: Visits) -> tuple[VisitedSpots, TwoVisits]:
    """Return what the tool says."""
    sampler, like = VisitSampler(K), Condition(visits.path, visits.error, visits.frames, K)
    series = [frames(*pair, like, np.random.default_rng(0)) for pair in zip(made.flights, made.labellers, strict=True)]
    for visit, frame in by_turns(*series, (visits.frames, visits.frames)):
        sampler.add_of(visit, frame)
    visited = sampler.visits()
    return visited, two_visits(visited)


def exact_across(made: MadeVisits, points: int, rng: np.random.Generator) -> Array:
    """Return alpha within the first flight, within the second one, and across, of points that did not change."""
    point, face = made.flights[0].scene.draw(points, rng)
    common = face < made.common_faces
    point, face = point[common], face[common]
    counts = np.zeros((2, len(point), K))
    for visit, (flown, labeller) in enumerate(zip(made.flights, made.labellers, strict=True)):
        for frame in range(len(flown.poses)):
            some, view = flown.meet(frame, point, face)
            label = labeller(view)
            labelled = label != IGNORED
            np.add.at(counts[visit], (some[labelled], label[labelled]), 1)
    counts = counts[:, (counts.sum(axis=2) >= 2).all(axis=0)]
    times = counts.sum(axis=2)
    weight, (p, q) = times.sum(axis=0), counts / times[..., None]
    within = ((counts * (counts - 1)).sum(axis=2) / (times * (times - 1))) @ weight / weight.sum()
    across = (p * q).sum(axis=1) @ weight / weight.sum()
    P, Q = (shares.T @ weight / weight.sum() for shares in (p, q))
    chance = np.array([P @ P, Q @ Q, P @ Q])
    return 1 - (1 - np.append(within, across)) / (1 - chance)


def changes(made: MadeVisits, visited: VisitedSpots) -> Array:
    """Return counts of spots: on boxes of one flight that the other one tells, those found; all found, wrong ones."""
    point, counts = visited.spots.point, np.zeros(4)
    found = np.isin(visited.change, (GONE, NEW))
    on = np.zeros(len(point), bool)
    for visit, solids in enumerate(made.alone):
        its = np.zeros(len(point), bool)
        for solid in solids:
            away = np.abs((point @ solid.normals.T - solid.offsets).max(axis=1))
            its |= away < NEAR
            on |= away < PIXEL
        told = its & (visited.votes[1 - visit].votes >= 2) & (visited.votes[visit].seen >= 2)
        counts[:2] += told.sum(), (told & (visited.change == (GONE, NEW)[visit])).sum()
    counts[2:] = found.sum(), (found & ~on).sum()
    return counts


def row(visits: Visits, seeds: int, points: int, size: tuple[int, int]) -> list[str]:
    """Return the cells of a row."""
    off, true, held, counts = [], [], 0, np.zeros(4)
    for seed in range(seeds):
        made = MadeVisits.from_visits(visits, seed, size)
        visited, told = said(made, visits)
        exact = exact_across(made, points, np.random.default_rng(seed))
        cost = exact[:2].mean() - exact[2]
        alphas = [told.alpha.first.value, told.alpha.second.value, told.alpha.across.value, told.alpha.cost.value]
        true.append([*exact, cost])
        off.append(np.array(alphas) - true[-1])
        held += told.alpha.cost.low - 1e-9 <= cost <= told.alpha.cost.high + 1e-9
        counts += changes(made, visited)
    cells = [visits.name]
    for k in range(4):
        cells += [f"{np.mean(true, axis=0)[k]:.3f}", f"{np.mean(off, axis=0)[k]:+.3f}"]
    error = f"{np.std(off, axis=0, ddof=1)[3] / np.sqrt(seeds):.3f}" if seeds > 1 else "-"
    found = f"{counts[1] / counts[0]:.2f}" if counts[0] else "-"
    wrong = f"{counts[3] / counts[2]:.3f}" if counts[2] else "-"
    return [*cells, error, f"{held} of {seeds}", found, wrong]


HEAD = (
    "condition", "within A", "said - exact", "within B", "said - exact", "across", "said - exact", "cost",
    "said - exact", "standard error", "intervals hold it", "found", "wrong",
)  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="as 'orbit*' or '*boxes'")
    parser.add_argument("--seeds", type=int, default=4, help="scenes of each condition")
    parser.add_argument("--points", type=int, default=20000, help="points of the surface")
    parser.add_argument("--size", type=int, nargs=2, default=(90, 120), metavar=("HEIGHT", "WIDTH"))
    arguments = parser.parse_args()
    print("|", " | ".join(HEAD), "|\n|---|" + "---:|" * (len(HEAD) - 1))
    for visits in CONDITIONS:
        if fnmatch.fnmatch(visits.name, arguments.only):
            cells = row(visits, arguments.seeds, arguments.points, tuple(arguments.size))
            print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
