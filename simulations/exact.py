"""Is alpha that of the surface? It is known exactly in scenes of solids, whatever the model errs on.

    python simulations/simulate.py exact [--only PATTERN] [--seeds 4] [--points 20000] [--size 90 120] [--limit]

What is measured: alpha of the labels that two views give the same point of a surface. A point stands for an equal area
of the surfaces that at least two labelled views see, and weighs by the number T of these views, as a unit does in
Krippendorff's alpha: of T labels, a share of T (T - 1) pairs agrees; by chance as many agree as of all labels pooled.

The exact value is that of points drawn evenly over the surfaces (`exact_scenes.py`). A frame sees one where a ray from
its camera meets nothing nearer and the point lies in its image (`exact_views.py`). The point's label is that at its
exact image coordinates, not that of a pixel: errors (`exact_errors.py`) are functions of these. The same functions at
the middles of pixels make the images of labels from which the tool estimates alpha. Noise of depth and errors of poses
change what the tool sees and not the exact value. A scanner sees a point between its rays too: its label is that of
a ray to it.

Prints a table in Markdown, a row for each condition: the exact value, its Monte Carlo error, what the tool says less
the exact value with the standard error of that mean over the seeds, and how many intervals hold the exact value. Each
seed is a scene, a path, and errors of its own. Classes are 6, of a street 8, where a row does not name them. Images of
a street have twice as many pixels along each axis as others (`--size`).
"""

from __future__ import annotations

import argparse
import fnmatch
import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from exact_errors import ERRORS, IGNORED, Labeller, unlabelled
from exact_scenes import Array, Ints, yard
from exact_views import PATHS, ExactFlight, ImagePoints, Pinhole, flight

from semstab.data.frames import Frame
from semstab.data.statistics import Interval
from semstab.statistics import Sampler
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.intervals import estimate

LIMIT, LIMIT_OF_FEW, FEW = 0.02, 0.03, 5
"""Largest difference, that with few frames, and how many are not few."""

DRAWS = 60
"""Most draws of points, until as many as are wanted are seen twice."""

FINER = {"street": 2, "sparse": 2}
"""How many times more pixels along each axis images have along a path: there things are far away, and small."""

RING, STEP = np.radians(1.0), np.radians(1.6)
"""Between the rings, and between the rays of a ring, of a scanner that gives a camera depth at 4 % of its pixels."""


@dataclass(frozen=True)
class Condition:
    """A row of the table.

    Attributes:
        path: One of PATHS.
        error: One of ERRORS.
        frames: How many.
        K: Classes.
        unlabelled: Share of the pixels.
        noise: Of depth, relative, each pixel by itself.
        turn: Error of each pose: by how many pixels the middle of the image moves.
    """

    path: str
    error: str
    frames: int = 30
    K: int = 6
    unlabelled: float = 0.0
    noise: float = 0.0
    turn: float = 0.0

    @property
    def name(self) -> str:
        """First words of a row."""
        usual = 6 if PATHS[self.path][0] is yard else 8
        parts = {
            f"{self.K} classes": usual != self.K,
            f"{self.unlabelled:.0%} unlabelled": self.unlabelled > 0,
            f"depth {self.noise:.1%}": self.noise > 0,
            f"poses {self.turn:g} px": self.turn > 0,
        }
        return ", ".join([f"{self.path}, {self.error}", *(text for text, there in parts.items() if there)])


def conditions() -> list[Condition]:
    """Return all conditions."""
    rows = [Condition(path, error) for path in ("orbit", "oblique") for error in ERRORS]
    rows += [Condition("strips", error) for error in ("none", "pixels", "blobs", "border", "burst", "range", "radius")]
    rows += [Condition("street", error, K=8) for error in ("none", "blobs", "border", "lasting", "range", "angle")]
    few = itertools.product(("orbit", "oblique"), ("none", "blobs", "border", "range"), (3, 10))
    rows += [Condition(path, error, frames) for path, error, frames in few]
    rows += [Condition("orbit", error, K=K) for error in ("blobs", "range") for K in (2, 20, 150)]
    unnamed = itertools.product(("orbit", "oblique"), ("none", "blobs", "range"))
    rows += [Condition(path, error, unlabelled=0.5) for path, error in unnamed]
    for path, error in itertools.product(("orbit", "oblique"), ("none", "blobs", "range")):
        rows += [Condition(path, error, noise=noise) for noise in (0.003, 0.01)]
        rows += [Condition(path, error, turn=turn) for turn in (1.0, 3.0)]
    rows += [Condition(path, error, K=8) for path in ("sparse", "scan") for error in ("none", "range")]
    return rows


# --- The exact value --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Exact:
    """Alpha of a surface.

    Attributes:
        value: Alpha.
        error: Its standard error, because points are drawn.
        points: Points seen twice.
        views: Labelled views of such a point, on average.
    """

    value: float
    error: float
    points: int
    views: float


def alpha_of(unit: Ints, label: Ints) -> Exact:
    """Return Krippendorff's nominal alpha.

    Args:
        unit: (n,) the point of each label; those with one label do not count.
        label: (n,) from 0.
    """
    _, unit, times = np.unique(unit, return_inverse=True, return_counts=True)
    again = times[unit] >= 2
    _, unit, times = np.unique(unit[again], return_inverse=True, return_counts=True)
    label, n = label[again], len(unit)
    if n == 0:
        return Exact(np.nan, np.nan, 0, np.nan)
    of = np.bincount(label).astype(float)
    pairs, count = np.unique(unit * len(of) + label, return_counts=True)
    agreeing = np.bincount(pairs // len(of), count * (count - 1.0)) / (times - 1)  # T times the share of a point
    chance = ((of**2).sum() - n) / (n * (n - 1.0))
    expected, observed = 1 - chance, 1 - agreeing.sum() / n
    if expected == 0:
        return Exact(np.nan, np.nan, len(times), n / len(times))
    share = of / n
    by_point = (times - agreeing - observed * times) / n
    by_chance = -2 * (np.bincount(unit, share[label]) - times * (share**2).sum()) / n
    influence = -by_point / expected + observed / expected**2 * by_chance
    error = float(np.sqrt((influence**2).sum()))
    return Exact(float(1 - observed / expected), error, len(times), n / len(times))


def exact(flown: ExactFlight, labeller: Labeller, points: int, rng: np.random.Generator) -> Exact:
    """Return alpha of the surface: draw until `points` points have two labels."""
    units, labels, drawn, twice, n = [], [], 0, 0, points
    for _ in range(DRAWS):
        point, face = flown.scene.draw(n, rng)
        times = np.zeros(n, int)
        for frame in range(len(flown.poses)):
            some, view = flown.meet(frame, point, face)
            label = labeller(view)
            labelled = label != IGNORED
            times[some[labelled]] += 1
            units.append(drawn + some[labelled])
            labels.append(label[labelled])
        drawn, twice = drawn + n, twice + int((times >= 2).sum())
        if twice >= points:
            break
        n = min(int(1.05 * (points - twice) * drawn / max(twice, 1)) + 100, 4 * points)
    return alpha_of(np.concatenate(units), np.concatenate(labels))


# --- What the tool sees, and says -------------------------------------------------------------------------------------


def frames(flown: ExactFlight, labeller: Labeller, condition: Condition, rng: np.random.Generator) -> Iterator[Frame]:
    """Yield what the tool sees."""
    H, W = flown.sensor.height, flown.sensor.width
    for view, T_wc in zip(flown.images, flown.poses, strict=True):
        labels, there = labeller(view).astype(np.uint8), view.face >= 0
        noise = 1 + condition.noise * rng.standard_normal(len(there))
        if not isinstance(flown.sensor, Pinhole):
            points = flown.sensor.rays(view.u, view.v)[there] * (view.t * noise)[there, None]
            yield Frame(view.frame, points=points.astype(np.float32), T_wc=T_wc, labels=labels[there])
            continue
        K = flown.sensor.intrinsics
        visible = there & _hit(flown.sensor, view) if condition.path == "sparse" else there
        depth = np.where(visible, view.t * noise, 0.0).astype(np.float32)
        pose = T_wc.copy()
        pose[:3, :3] = T_wc[:3, :3] @ _turned(condition.turn / K.fx, rng)
        yield Frame(view.frame, depth.reshape(H, W), K, pose, labels=labels.reshape(H, W))


def _hit(camera: Pinhole, view: ImagePoints) -> npt.NDArray[np.bool_]:
    """Return the pixels (n,) that rays of a scanner next to the camera hit."""
    up, aside = np.meshgrid(np.arange(-np.pi / 4, np.pi / 4, RING), np.arange(-np.pi / 4, np.pi / 4, STEP))
    ways = np.stack([np.cos(up) * np.sin(aside), -np.sin(up), np.cos(up) * np.cos(aside)], axis=-1).reshape(-1, 3)
    u, v = (np.rint(x).astype(int) for x in camera.project(ways))
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    hit = np.zeros((camera.height, camera.width), bool)
    hit[v[inside], u[inside]] = True
    return hit.ravel()


def _turned(angle: float, rng: np.random.Generator) -> Array:
    """Return a rotation about a random axis across the line of sight."""
    way = rng.uniform(0, 2 * np.pi)
    x, y = np.cos(way), np.sin(way)
    cross = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def said(series: list[Frame], K: int) -> Interval:
    """Return the tool's alpha."""
    sampler = Sampler(K)
    for frame in series:
        sampler.add(frame)
    return estimate(sums_of_spots(sampler.sample()), "alpha")


# --- The table --------------------------------------------------------------------------------------------------------


def trial(condition: Condition, seed: int, size: tuple[int, int], points: int) -> tuple[Exact, Interval]:
    """Return the exact value and what the tool says, of a new scene."""
    streams = np.random.SeedSequence([seed, condition.frames]).spawn(5)
    scene, errors, without, noise, draws = map(np.random.default_rng, streams)
    finer = FINER.get(condition.path, 1)
    flown = flight(condition.path, condition.frames, condition.K, (finer * size[0], finer * size[1]), scene)
    labeller = ERRORS[condition.error](flown, condition.K, errors)
    labeller = unlabelled(labeller, condition.unlabelled, flown, without)
    made_frames = list(frames(flown, labeller, condition, noise))
    return exact(flown, labeller, points, draws), said(made_frames, condition.K)


def row(condition: Condition, seeds: int, size: tuple[int, int], points: int) -> tuple[list[str], bool]:
    """Return the cells of a row, and whether its difference is within the limit."""
    found = [trial(condition, seed, size, points) for seed in range(seeds)]
    off = np.array([told.value - true.value for true, told in found])
    held = sum(told.low - 1e-9 <= true.value <= told.high + 1e-9 for true, told in found)
    error = f"{off.std(ddof=1) / np.sqrt(seeds):.3f}" if seeds > 1 else "-"
    cells = [
        condition.name, str(condition.frames), f"{np.mean([true.views for true, _ in found]):.1f}",
        f"{np.mean([true.value for true, _ in found]):.3f}", f"{np.mean([true.error for true, _ in found]):.4f}",
        f"{off.mean():+.3f}", error, f"{held} of {seeds}",
    ]  # fmt: skip
    return cells, bool(abs(off.mean()) <= (LIMIT_OF_FEW if condition.frames < FEW else LIMIT))


HEAD = ("condition", "frames", "views", "exact", "its error", "said - exact", "standard error", "intervals hold it")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", metavar="PATTERN", help="as 'orbit*' or '*range*'")
    parser.add_argument("--seeds", type=int, default=4, help="scenes of each condition")
    parser.add_argument("--points", type=int, default=20000, help="points of the surface, at least")
    parser.add_argument("--size", type=int, nargs=2, default=(90, 120), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--limit", action="store_true", help="exit with 1 if a difference is beyond the limit")
    arguments = parser.parse_args()
    print("|", " | ".join(HEAD), "|\n|---|" + "---:|" * (len(HEAD) - 1))
    beyond = []
    for condition in conditions():
        if fnmatch.fnmatch(condition.name, arguments.only):
            cells, within = row(condition, arguments.seeds, tuple(arguments.size), arguments.points)
            print("|", " | ".join(cells), "|", flush=True)
            beyond += [] if within else [f"{condition.name}, {condition.frames} frames"]
    if beyond:
        print(f"\nBeyond {LIMIT} (fewer than {FEW} frames: {LIMIT_OF_FEW}): {'; '.join(beyond)}", file=sys.stderr)
    sys.exit(bool(beyond) and arguments.limit)


if __name__ == "__main__":
    main()
