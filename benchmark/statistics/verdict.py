"""The verdict on a model: a level of stability with its probability; docs/metrics.md explains the thresholds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from semstab.core.types import THIS_SCENE
from semstab.data.statistics import (
    Flipping,
    HeadlineStatistics,
    Interval,
    LabelledPairs,
    Level,
    MovedSpots,
    SpotAgreement,
    StabilityVerdict,
    short,
)
from semstab.statistics.intervals import LEAST_FRAMES, probability_above


@dataclass(frozen=True)
class Limits:
    """Limits of the verdict.

    Attributes:
        stable: Alpha from which data may be relied on (Krippendorff 2018, Content Analysis, ch. 12).
        usable: Alpha from which tentative conclusions are allowed.
        labelled: Least share of the locations that a stable model labels.
        class_locations: Least number of voxels that a class dominates to count, if no critical classes are named.
    """

    stable: float = 0.8
    usable: float = 2 / 3
    labelled: float = 0.9
    class_locations: float = 100.0


LIMITS = Limits()

DECIDED = 0.6
"""A level is stated if it has at least this probability."""

PROBABLE = 0.9
"""A class is named as unstable from this probability on."""

LEAST_CLASSES = 1.07
"""Effective number of classes (`SpotAgreement.effective_classes`) below which agreement tells almost nothing of a map:
where 97 % of it are one class, any two observations agree with a probability of .94, however good the labels are."""

DANGEROUS = 0.05
"""Largest share of the consistent locations that may be wrong."""

LEAST_SPOTS, LEAST_CUBES = 100, 16
"""Spots that two views saw or more, and cubes of space that hold them, below which there is no verdict: both are the
same whatever the voxels of the map, of which as many have to be seen twice."""

ADVICE: dict[Level, str] = {
    "stable": "its labels agree from frame to frame; act on them",
    "usable": "act on a label only where several frames agree",
    "unstable": "do not act on its labels",
    "undecided": "alpha is not known well enough for a level; take more frames",
    "uninformative": "nearly the whole map is one class, so that agreement says nothing",
    "misleading": "do not take agreement for truth",
    "no verdict": "too few locations were seen twice; more overlap between frames is needed",
}
"""Advice at each level."""

ACTED_ON, LEAST_FLIPS = ("stable", "usable"), 0.001
"""Levels at which labels are acted on, and the least share of locations that flip that is reported."""

NO_SPOTS = "no spots were sampled; give the observations of a `Sampler`"
TOO_FEW_VOXELS = "its map has too few locations to act on; use smaller voxels, or frames that overlap more"
FEATURES_ALONE = "it gives features and no labels; VSS, SBD, entropy, flicker and classes need labels"
EMPTY = "no spot was sampled: no pixel has both depth and a label that counts; see exclude, masks and the depth range"
STILL = "all frames show one view: the camera stood still, or moved by less than a sampled pixel shows (pixel_stride)"


ALL = LabelledPairs()


def level_probabilities(alpha: Interval, limits: Limits = LIMITS, pairs: LabelledPairs = ALL) -> Mapping[Level, float]:
    """Return how probable each level of all pairs of views is, from alpha of labelled ones; NaN without an interval."""

    def above(limit: float) -> float:
        least = pairs.of_labelled(limit)
        return 0.0 if least > 1 else probability_above(alpha, least, "agreement")

    if math.isnan(alpha.low):
        return dict.fromkeys(("stable", "usable", "unstable"), math.nan)
    reliable, tentative = above(limits.stable), above(limits.usable)
    return {"stable": reliable, "usable": tentative - reliable, "unstable": 1 - tentative}


def holds_all_levels(alpha: Interval, limits: Limits = LIMITS, pairs: LabelledPairs = ALL) -> bool:
    """Return whether the interval of alpha of all pairs holds both limits, so that it excludes no level."""
    return pairs.of_all(alpha.low) <= limits.usable and limits.stable <= pairs.of_all(alpha.high)


def why_undecided(alpha: Interval, limits: Limits = LIMITS) -> str:
    """Return why no level is stated: the interval holds both limits, or no level is probable enough."""
    if holds_all_levels(alpha, limits):
        return f"the interval holds both {short(limits.usable, digits=3)} and {short(limits.stable)}"
    levels = level_probabilities(alpha, limits).items()
    return f"no level has p {short(DECIDED)} ({', '.join(f'{name} {_below(p, DECIDED)}' for name, p in levels)})"


def _below(p: float, limit: float) -> str:
    """Return a probability with two digits, or with more digits if two would round it up to a limit."""
    for digits in range(2, 5):
        if p >= limit or round(p, digits) < limit:
            return short(p, digits=digits)
    return f"just below {short(limit)}"


def verdict(
    model: str,
    *,
    headline: HeadlineStatistics,
    spots: SpotAgreement | None,
    flips: Flipping | None = None,
    voxels: int,
    share: float,
    limits: Limits = LIMITS,
    moved: MovedSpots | None = None,
    labels: bool = True,
) -> StabilityVerdict:
    """Return the most probable level of alpha, and the level if what the model leaves out counts as disagreeing.

    It is undecided if the interval of alpha holds both limits, whatever the probabilities are, or if no level has the
    probability DECIDED. If movers were found, alpha is over what stayed. The second level is over all pairs of views of
    a spot: a pair of which one has no label disagrees.

    Args:
        model: Its name.
        headline: Numbers of the map.
        spots: The observations that alpha rests on; without them there is no verdict.
        flips: Locations about which frames do not agree: a few of them do not show in a mean.
        voxels: Voxels with OP >= 2.
        share: Their share of all voxels.
        limits: Limits of the levels.
        moved: Spots that moved.
        labels: Whether the model gives labels; without them there is no verdict.
    """
    support = f"{voxels} locations seen twice or more, {share:.0%} of the map"
    if reason := _missing(spots, voxels) if labels else FEATURES_ALONE:
        return StabilityVerdict("no verdict", math.nan, f"{model}: no verdict, {reason}; {support}")
    assert spots is not None
    of_all_spots, static = headline.alpha, moved if moved is not None and moved.are_found else None
    if static is not None:
        headline = dataclasses.replace(headline, alpha=static.alpha)
    level, probability = _level(headline, spots, limits)
    of_all, probability_of_all = _level(headline, spots, limits, spots.pairs)
    result = StabilityVerdict(level, probability, "", labelled=spots.pixels_labelled)
    if of_all != level:
        result = dataclasses.replace(result, of_all=of_all, probability_of_all=probability_of_all)
    acted_on = flips if result.decisive in ACTED_ON else None
    how_sure = "" if math.isnan(probability) or level == "undecided" else f" ({probability:.0%})"
    stated = result.difference or f"{level}{how_sure}"
    reasons = ", ".join(_reasons(level, headline, spots, static, of_all_spots, acted_on, limits))
    line = f"{model}: {stated}, {ADVICE[result.decisive]}: {reasons}; {support}; {_for(headline.alpha)}"
    return dataclasses.replace(result, line=line)


def _reasons(
    level: Level,
    headline: HeadlineStatistics,
    spots: SpotAgreement,
    static: MovedSpots | None,
    of_all_spots: Interval,
    flips: Flipping | None,
    limits: Limits,
) -> Iterator[str]:
    """Yield the numbers that the verdict rests on; `static` if alpha is over what stayed, `flips` if they count."""
    if level == "uninformative":
        yield f"{spots.largest_share:.0%} of the observations are {spots.largest_class}"
    yield _alpha(headline.alpha, spots, "alpha" if static is None else "alpha (static)")
    yield f"two views see the same class at {spots.agreeing(of_all_spots.value):.0%} of the spots"
    if static is not None:
        yield f"alpha of all spots {short(of_all_spots.value)}, of which {static.moved:.1%} moved"
    wrong = headline.wrong_of_consistent_op3
    if not math.isnan(wrong.low):
        yield f"{wrong.value:.0%} of the consistent locations are wrong ({wrong.low:.0%} to {wrong.high:.0%})"
    if spots.labelled < limits.labelled:
        yield f"{1 - spots.labelled:.0%} of the locations have no label in most frames"
    if flips is not None:
        yield from _flips(flips)


def _missing(spots: SpotAgreement | None, voxels: int) -> str:
    """Return why the model has no verdict; '' if it has one."""
    if spots is None:
        return NO_SPOTS
    if not spots.views:
        return EMPTY
    if spots.views < 2 <= spots.frames:
        return STILL
    if spots.spots < LEAST_SPOTS or spots.cubes < LEAST_CUBES:
        return ADVICE["no verdict"]
    return TOO_FEW_VOXELS if voxels < LEAST_SPOTS else ""


def _level(
    headline: HeadlineStatistics, spots: SpotAgreement, limits: Limits, pairs: LabelledPairs = ALL
) -> tuple[Level, float]:
    """Return the level of alpha of all pairs with its probability."""
    if spots.effective_classes < LEAST_CLASSES:
        return "uninformative", math.nan
    probabilities = dict(level_probabilities(headline.alpha, limits, pairs))
    level = max(probabilities, key=lambda name: probabilities[name])
    if math.isnan(probabilities[level]):
        return "no verdict", math.nan
    if headline.wrong_of_consistent_op3.low > DANGEROUS and level != "unstable":
        return "misleading", math.nan
    if probabilities[level] < DECIDED or holds_all_levels(headline.alpha, limits, pairs):
        return "undecided", probabilities[level]
    if level == "stable" and spots.labelled < limits.labelled:
        return "usable", probabilities["usable"] + probabilities["stable"]
    return level, probabilities[level]


def _for(basis: Interval) -> str:
    """Return the scope of the interval."""
    if basis.scope == THIS_SCENE:
        return f"for this scene flown again, from {basis.frames} frames"
    reason = f"{basis.frames} frames; another flight needs {LEAST_FRAMES} or more" if basis.frames else "no log"
    return f"for these frames alone ({reason})"


def _alpha(alpha: Interval, spots: SpotAgreement, name: str = "alpha") -> str:
    """Return 'alpha .71 (.69 to .73), probably unstable: car (98%)'."""
    chance = ", no better than chance" if alpha.value < 0 else ""
    unstable = [row for row in spots.critical_classes[:3] if row.unstable >= PROBABLE]
    names_text = ", ".join(f"{row.name} ({row.unstable:.0%})" for row in unstable)
    classes = f", probably unstable: {names_text}" if names_text else ""
    return f"{name} {alpha.text()}{chance}{classes}"


def _flips(flips: Flipping) -> list[str]:
    if flips.seen < 0.5:
        return ["most locations were seen too seldom to tell which of them flip"]
    if not flips.share.value >= LEAST_FLIPS:
        return []
    share, part = flips.share, f", {flips.part:.0%} of them between {flips.a} and {flips.b}" if flips.a else ""
    return [
        f"{share.value:.1%} of the locations of this map flip ({share.low:.1%} to {share.high:.1%}{part}): act on the"
        " others only"
    ]
