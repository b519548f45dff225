"""One rule on one scene, or over all: what the data show of it, and what follows."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from semstab.gating.measures import GateMeasure
from semstab.gating.rules import Rule
from semstab.model.statistics import NEXT_FLIGHT, THIS_MAP, Interval, Question
from semstab.statistics.sampling import (
    LEAST_FRAMES,
    InfluenceSums,
    coverage,
    difference,
    estimate,
    of_places_alone,
    same_flight,
)
from semstab.statistics.sampling.intervals import LEAST_DEGREES, TOO_FEW

Verdict = Literal["passes", "fails", "undecided"]
Frames = Literal["random", "fixed"]

LEAST = 8
"""Of fewer frames nothing is concluded: a frame in three may be of a kind that none of them shows."""

DOUBT = 0.1
"""Where errors or the quality of frames may reach as far as the data, each end is missed so much less often: what holds
even then is concluded."""

AS_LONG = "what frames are like lasts about as long as the flight: fly longer"
NOTHING = "it has no value: nothing that it is of was seen twice"
UNKNOWN_FRAMES = "its frames are not known: run it with --statistics"
SCORES = "labels beside scores, which spread their evidence: run both as labels"
FEW = "{frames} frames are too few: fly {least} or more"


def verdict(rule: Rule, found: Interval) -> Verdict:
    """What an interval, each of whose ends is passed with the gate's level, says of a rule.

    Passes where the whole of it keeps to the limit. Fails where none of it does; a loss fails as soon as it is shown
    and not shown to be smaller than the limit.
    """
    if found.undecided or math.isnan(found.low) or math.isnan(found.high):
        return "undecided"
    low, high, limit = (found.low, found.high, rule.limit) if rule.below else (-found.high, -found.low, -rule.limit)
    if high < limit:
        return "passes"
    return "fails" if low > (min(limit, 0.0) if rule.bounds_a_loss else limit) else "undecided"


def change(
    new: InfluenceSums,
    base: InfluenceSums,
    measure: GateMeasure,
    k: int | None,
    level: float,
    frames: Frames = "random",
) -> Interval:
    """New less base, each end of its interval missed with probability `level`."""
    key, both = measure.key, 1 - 2 * level
    new, base = comparable(new, base)
    if key == "coverage":
        found = coverage(new, base, both)
    else:
        paired = frames == "fixed" or same_flight(new, base)
        found = difference(new, base, key, k, _question(key, k, frames), same_frames=paired, level=both)
    return of_frames(found, _frames(new, base))


def value(new: InfluenceSums, measure: GateMeasure, k: int | None, level: float, frames: Frames = "random") -> Interval:
    """The number itself, each end of its interval missed with probability `level`."""
    key = measure.key
    return of_frames(estimate(new, key, k, _question(key, k, frames), 1 - 2 * level), _frames(new))


def _question(key: str, k: int | None, frames: Frames) -> Question:
    return THIS_MAP if frames == "fixed" or of_places_alone(key, k) else NEXT_FLIGHT


def comparable(new: InfluenceSums, base: InfluenceSums) -> tuple[InfluenceSums, InfluenceSums]:
    """Both without what only one of them knows of the ground truth."""
    if new.truth == base.truth:
        return new, base
    return new.without_truth(), base.without_truth()


def doubtful(found: Interval) -> bool:
    """Whether nothing may be concluded only because errors, or the quality of frames, may reach as far as the data."""
    final = ("frames are too few", NOTHING, UNKNOWN_FRAMES, SCORES)
    return bool(found.undecided) and not any(reason in found.undecided for reason in final)


def negative(found: Interval) -> Interval:
    """Of the opposite number."""
    return dataclasses.replace(found, value=0.0 - found.value, low=0.0 - found.high, high=0.0 - found.low)


def of_frames(found: Interval, frames: int) -> Interval:
    """With this gate's own least number of frames: a rule is judged for frames like these."""
    few = TOO_FEW.format(least=LEAST_FRAMES)
    reasons = [reason for reason in found.undecided.split("; ") if reason and reason != few]
    if not reasons and found.question == NEXT_FLIGHT and found.degrees < LEAST_DEGREES:
        reasons.append(AS_LONG)
    if math.isnan(found.value):
        reasons.append(NOTHING)
    if frames < LEAST:
        reasons.append(FEW.format(frames=frames, least=LEAST) if frames else UNKNOWN_FRAMES)
    return dataclasses.replace(found, frames=frames, undecided="; ".join(reasons))


def _frames(*sums: InfluenceSums) -> int:
    return min(own.frames * own.step for own in sums)
