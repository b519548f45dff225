"""How many frames does it take to find a loss, and how often is a loss found without a loss?

    python simulations/simulate.py power [--trials 100] [--only TEXT]

Two models fly the same frames over the same scene (flights.py) and err independently of each other, at the same hard
places or at places half of which are others; the new model agrees less by a given loss of PSA in the mean of scenes.
`compare` finds a loss where p < 0.05, `gate` where the rule 'psa drop < 0.01' fails.
Prints a table in Markdown: the share of flights in which each does.
"""

from __future__ import annotations

import dataclasses
import itertools

import cases
import numpy as np
from flights import SimulatedFlight, fly, sums_of, world
from scipy.optimize import brentq

from semstab.comparison.differences import sums_difference
from semstab.data.statistics import CONFIDENCE
from semstab.gating.evaluation import bounded
from semstab.gating.result import verdict
from semstab.gating.rules import parse
from semstab.statistics.cluster_sums import value

RULE = parse("psa drop < 0.01")
KINDS, FRAMES, LOSSES = ("alike", "uneven", "objects", "lasting"), (20, 40, 80, 150), (0.0, 0.02, 0.05, 0.1)
SIDE, EASE, WORLDS = 32, 1.0, 6


def psa_at(ease: float, kind: str) -> float:
    """PSA of a model, over several scenes; the same random numbers at every ease."""
    flight = SimulatedFlight(SIDE, 2.0, ease, 60, 60, kind)
    found = []
    for seed in range(WORLDS):
        rng = np.random.default_rng([7, seed])
        over = world(flight, rng)
        found.append(value(sums_of(fly(flight, over, rng), over, flight), "psa"))
    return float(np.mean(found))


def main(trials: int = 100, only: str = "") -> None:
    names = [
        f"{'no loss' if not loss else f'{100 * loss:g} points'}: {by}" for loss in LOSSES for by in ("compare", "gate")
    ]
    cases.head(["frames", *names])
    for kind in (kind for kind in KINDS if only in kind):
        eases = [EASE if not loss else ease_of(kind, loss) for loss in LOSSES]
        for frames, elsewhere in itertools.product(FRAMES, (False, True)):
            flight = SimulatedFlight(SIDE, 2.0, EASE, frames, frames, kind)
            cells = [part for ease in eases for part in found(flight, ease, trials, elsewhere=elsewhere)]
            where = "at other places" if elsewhere else "at the same places"
            cases.row([f"{frames}, {kind}, {where}", *cells])


def ease_of(kind: str, loss: float) -> float:
    """How easy a scene is to a model whose PSA is lower by so much."""
    base = psa_at(EASE, kind)
    return float(brentq(lambda ease: psa_at(ease, kind) - base + loss, -2, EASE, xtol=0.01))


def found(flight: SimulatedFlight, ease: float, trials: int, *, elsewhere: bool) -> list[str]:
    """Return the shares of trials in which compare and gate find a loss; empty for equal models, errors elsewhere."""
    if elsewhere and ease == EASE:
        return ["", ""]
    hits = np.zeros(2)
    for trial in range(trials):
        rng = np.random.default_rng([trial, flight.frames])
        over = world(flight, rng)
        hard = (over.hard + world(flight, rng).hard) / 2**0.5 if elsewhere else over.hard
        scenes = over, dataclasses.replace(over, hard=hard)
        old, new = (
            sums_of(fly(flight, scene, rng, at), over, flight) for scene, at in zip(scenes, (EASE, ease), strict=True)
        )
        change = sums_difference("psa", new, old)
        hits += change.p_value < 1 - CONFIDENCE and change.value < 0, verdict(RULE, bounded(RULE, new, old)) == "fails"
    return [f"{hit:.2f}" for hit in hits / trials]
