"""Do simpler methods than the model of random effects give intervals that hold as often, and are no wider?

    python simulations/simulate.py simpler this-scene [--trials 30] [--seed 2]
    python simulations/simulate.py simpler other-scenes [--trials 40] [--seed 2]

Each flight of `intervals.py` gets its interval by each method, from the same influences x_gf of locations g and frames
f. Prints a table in Markdown: the share of intervals that hold their target, and the median half width beside the
model's. A method may replace the model if it holds 94 % of the targets wherever the model does, and is at most 1.1
times as wide.

- `frames`: jackknife over frames; of other scenes the two-way variance by frames and cubes (Cameron, Gelbach and Miller
  2011, Journal of Business and Economic Statistics 29)
- `within`: the same without the means of locations, which the same scene flown again has again
- `blocks`: the first with blocks of about sqrt(F) successive frames, which may be correlated
- `bootstrap`: of cubes and of blocks of frames, each drawn with replacement (Owen 2007, Annals of Applied Statistics 1)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Literal
from unittest import mock

import cases
import intervals as study
import numpy as np
from flights import SimulatedFlight, fly, number_of, sums_of, totals_of, world

from semstab.core.types import OTHER_SCENES, THIS_SCENE, Scope
from semstab.statistics import intervals
from semstab.statistics.variance import Influences, Spread, spread_of

REPLICATES = 400


def frames(grid: Influences, scope: Scope) -> Spread:
    """Two-way clusters: V = V_frames, or V_frames + V_cubes - V_cells."""
    return _clustered(grid, grid.cell, scope)


def within(grid: Influences, scope: Scope) -> Spread:
    """Two-way clusters of what is left of frames beside the means of locations."""
    return _clustered(grid, _residual(grid), scope)


def blocks(grid: Influences, scope: Scope) -> Spread:
    """Two-way clusters of cubes and of blocks of successive frames."""
    return _clustered(grid, _blocked(grid.cell), scope)


def bootstrap(grid: Influences, scope: Scope) -> Spread:
    """Return the variance over resampled cubes and blocks of frames."""
    rng, cell = np.random.default_rng(0), _blocked(grid.cell)
    G, B = cell.shape
    by_block = rng.multinomial(B, np.full(B, 1 / B), REPLICATES) - 1.0
    replicates = by_block @ cell.sum(axis=0)
    if scope == OTHER_SCENES:
        by_cube = rng.multinomial(G, np.full(G, 1 / G), REPLICATES)
        replicates = ((by_cube @ cell) * by_block).sum(axis=1) + (by_cube - 1.0) @ grid.block
    return Spread(float(replicates.var(ddof=1)), B - 1)


def _residual(grid: Influences) -> np.ndarray:
    """Return x_gf less the mean of its location, (G, F)."""
    location = grid.cell.sum(axis=1) / np.maximum(grid.size.sum(axis=1), 1e-300)
    return np.asarray(grid.cell - grid.size * location[:, None])


def _blocked(cell: np.ndarray) -> np.ndarray:
    """Return the sums (G, B) over blocks of successive frames."""
    F = cell.shape[1]
    return np.stack([part.sum(axis=1) for part in np.array_split(cell, max(2, math.isqrt(F)), axis=1)], axis=1)


def _clustered(grid: Influences, cell: np.ndarray, scope: Scope) -> Spread:
    G, F = cell.shape
    of_frames = F / (F - 1) * float((cell.sum(axis=0) ** 2).sum())
    if scope == THIS_SCENE:
        return Spread(of_frames, F - 1)
    of_cubes, of_both = G / (G - 1) * float((grid.block**2).sum()), float((cell**2).sum())
    return Spread(max(of_frames + of_cubes - of_both, of_frames, of_cubes), min(F, G) - 1)


METHODS: Mapping[str, Callable[[Influences, Scope], Spread]] = {
    "model": spread_of, "frames": frames, "within": within, "blocks": blocks, "bootstrap": bootstrap,
}  # fmt: skip


def conditions(scope: Scope) -> Iterator[tuple[str, SimulatedFlight, str]]:
    """Yield the name, the flight and the number of each condition of `intervals.py`."""
    later: list[tuple[str, SimulatedFlight, str]] = []

    def note(
        flight: SimulatedFlight, _count: int, _seed: int, _scope: Scope, keys: tuple[str, ...], name: str
    ) -> list[object]:
        later.extend((name, flight, key) for key in keys)
        return []

    with mock.patch.object(study, "trials", note):
        list((study.this_scene if scope == THIS_SCENE else study.other_scenes)(0, 0))
    yield from later


def rows(flight: SimulatedFlight, key: str, count: int, seed: int, scope: Scope) -> Mapping[str, tuple[float, float]]:
    """Return of each method the share of intervals that hold their target, and the median of half their width."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in METHODS}
    totals = []
    for trial in range(count):
        rng = np.random.default_rng([seed, trial])
        over = world(flight, rng)
        flights = study.FLIGHTS if scope == THIS_SCENE else 1
        flown = [sums_of(fly(flight, over, rng), over, flight, rng) for _ in range(flights)]
        totals.append(sum(totals_of(sums, key) for sums in flown))
        for name, method in METHODS.items():
            with mock.patch.object(intervals, "spread_of", method):
                interval = intervals.estimate(flown[0], key, scope=scope)
            found[name].append((interval.low, interval.high))
    target = number_of(np.array(totals) if scope == THIS_SCENE else np.sum(totals, axis=0)[None], key)
    result = {}
    for name, ends in found.items():
        low, high = np.array(ends).T
        result[name] = float(((low <= target) & (target <= high)).mean()), float(np.median((high - low) / 2))
    return result


def main(study: Literal["this-scene", "other-scenes"], trials: int = 30, seed: int = 2) -> None:
    scope = THIS_SCENE if study == "this-scene" else OTHER_SCENES
    others = [name for name in METHODS if name != "model"]
    cases.head(["condition", "of", "model held", *(f"{name} {what}" for name in others for what in ("held", "width"))])
    for name, flight, key in conditions(scope):
        found = rows(flight, key, trials, seed, scope)
        cells = [name, key, f"{found['model'][0]:.3f}"]
        for other in others:
            cells += [f"{found[other][0]:.3f}", f"{found[other][1] / found['model'][1]:.2f}"]
        cases.row(cells)
