"""How often does a gate err, and how much does it take to be decided?

    python simulations/simulate.py gate [--trials 200] [--seed 0] [--only TEXT] [--scope "these frames"]

Two models on the same frames of the same scene find the same places hard, with --scope "other scenes" each its own.
Scenes, frames and errors are independent in each trial. Prints a table in Markdown of the rule 'alpha drop < margin' at
the 5 % level: without a difference, which must not fail, and with a true loss of the margin, which must not pass. The
margin is the loss that all trials of the second pair have together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Literal

import cases
import numpy as np
from flights import SimulatedFlight, World, fly, number_of, sums_of, totals_of, world

from semstab.core.types import OTHER_SCENES, THIS_SCENE, Scope
from semstab.data.statistics import Interval
from semstab.gating.evaluation import bounded
from semstab.gating.result import verdict
from semstab.gating.rules import parse
from semstab.statistics.cluster_sums import ClusterSums

EASES = (1.0, 1.0, 0.8)
"""How easy a scene is to the baseline and to two new models: as easy, harder."""

RULE = parse("alpha drop < 0.02")
LEVEL = 0.05


def conditions() -> Iterator[tuple[str, SimulatedFlight]]:
    """Yield name and flight."""
    for frames, side in ((15, 32), (30, 32), (15, 64), (64, 32)):
        observations = frames if frames < 64 else 16
        for quality in ("alike", "bad", "uneven", "lasting"):
            yield (
                f"{frames} frames, {side} x {side}, {quality}",
                SimulatedFlight(side, 1.5, 1.0, frames, observations, quality),
            )


def models(flight: SimulatedFlight, same: bool, rng: np.random.Generator) -> list[ClusterSums]:
    """The sums of the baseline and of each new model."""
    over = world(flight, rng)
    found = []
    for ease in EASES:
        hard = over.hard if same else world(flight, rng).hard
        scene: World = dataclasses.replace(over, hard=hard)
        found.append(sums_of(fly(flight, scene, rng, ease), over))
    return found


def rates(flight: SimulatedFlight, trials: int, seed: int, scope: Scope = THIS_SCENE) -> list[float]:
    """The margin, then shares of trials: without a difference failed, passed; with it passed, failed, undecided."""
    found: list[list[Interval]] = []
    totals = 0.0
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial])
        base, *new = all_models = models(flight, scope != OTHER_SCENES, rng)
        totals += np.array([totals_of(model, "alpha") for model in all_models])
        found.append([bounded(RULE, model, base, level=LEVEL, scope=scope) for model in new])
    alphas = number_of(totals, "alpha")
    margin = float(alphas[0] - alphas[2])
    rule = dataclasses.replace(RULE, limit=margin)
    said = [[verdict(rule, model) for model in column] for column in zip(*found, strict=True)]
    asked = [(0, "fails"), (0, "passes"), (1, "passes"), (1, "fails"), (1, "undecided")]
    return [margin, *(float(np.mean([model == what for model in said[which]])) for which, what in asked)]


HEAD = [
    "condition", "margin", "no difference: fails", "passes", "loss of the margin: passes", "fails", "undecided",
]  # fmt: skip


def main(
    trials: int = 200,
    seed: int = 0,
    only: str = "",
    scope: Literal["these frames", "this scene", "other scenes"] = THIS_SCENE,
) -> None:
    cases.head(HEAD)
    for name, flight in conditions():
        if only in name:
            cases.row([name, *(f"{x:.3f}" for x in rates(flight, trials, seed, scope))])
