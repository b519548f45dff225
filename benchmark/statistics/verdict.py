"""Is a backbone stable on a scene? A level with its probability; docs/metrics.md explains the thresholds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from semstab.core.types import THIS_SCENE
from semstab.model.statistics import CeilingShare, Flipping, HeadlineStatistics, Interval, Level, StabilityVerdict
from semstab.statistics.cluster_sums import Scale
from semstab.statistics.intervals import LEAST_FRAMES, probability_above


@dataclass(frozen=True)
class Limits:
    """What a verdict asks for.

    stable, usable  Krippendorff's alpha, or share of its ceiling, from which data may be relied on, and from which
                    tentative conclusions are allowed (Krippendorff 2018, Content Analysis, ch. 12)
    labelled        part of the locations that a stable model labels at least
    class_locations voxels that a class dominates from which on it is judged, where no critical classes are named
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

LEAST_CEILING = 0.5
"""A ceiling below which the share of it that is reached says little."""

DANGEROUS = 0.05
"""Largest share of the stable locations that may be wrong."""

LEAST_VOXELS, LEAST_BLOCKS = 100, 16
"""Voxels seen twice or more, and blocks of them, below which there is no verdict."""

ADVICE: dict[Level, str] = {
    "stable": "its labels agree from frame to frame; act on them",
    "usable": "act on a label only where several frames agree",
    "unstable": "do not act on its labels",
    "undecided": "no level is probable enough; take more frames",
    "too coarse": "voxels are too large for what the labels show; use smaller ones",
    "misleading": "do not take agreement for truth",
    "no verdict": "too few locations were seen twice; more overlap between frames is needed",
}
"""What to do at each level."""

ACTED_ON, LEAST_FLIPS = ("stable", "usable"), 0.001
"""Levels at which labels are acted on, and the share of locations that flip from which on it is named."""

ONE_CLASS = "hardly more than one class was predicted, so that agreement says nothing"


def level_probabilities(interval: Interval, scale: Scale, limits: Limits = LIMITS) -> Mapping[Level, float]:
    """Return how probable each level is, given alpha or its share of the ceiling; NaN without an interval."""
    reliable, tentative = (
        probability_above(interval, threshold, scale) for threshold in (limits.stable, limits.usable)
    )
    return {"stable": reliable, "usable": tentative - reliable, "unstable": 1 - tentative}


def verdict(
    backbone: str,
    *,
    headline: HeadlineStatistics,
    ceiling: CeilingShare | None,
    flips: Flipping | None = None,
    voxels: int,
    share: float,
    blocks: int,
    labelled: float = math.nan,
    limits: Limits = LIMITS,
) -> StabilityVerdict:
    """Return the most probable level, from voxels with OP >= 2 only.

    headline       numbers of these voxels
    ceiling        alpha between frames and its ceiling; where that is not known, alpha is judged as it is
    flips          the locations about which frames do not agree: few of them hide in any mean
    voxels, share  how many they are, and of all voxels
    blocks         in how many cubes of space they lie
    labelled       part of the locations with depth that have a label; a model that labels too few is at most usable
    """
    basis = headline.alpha_between if ceiling is None else ceiling.share
    level: Level = "no verdict"
    probability = math.nan
    if voxels >= LEAST_VOXELS and blocks >= LEAST_BLOCKS:
        level, probability = _level(headline, ceiling, level_probabilities(basis, "agreement", limits))
    silent = labelled < limits.labelled
    if silent and level == "stable":
        level, probability = "usable", level_probabilities(basis, "agreement", limits)["usable"] + probability
    support = f"{voxels} locations seen twice or more, {share:.0%} of the map"
    if level == "no verdict":
        enough = voxels >= LEAST_VOXELS and blocks >= LEAST_BLOCKS
        reason = ONE_CLASS if enough else ADVICE[level]
        return StabilityVerdict(level, math.nan, f"{backbone}: no verdict, {reason}; {support}")
    psa, wrong = headline.psa, headline.wrong_of_stable
    parts = [f"two frames agree at {psa.value:.0%} of the locations ({psa.low:.0%} to {psa.high:.0%})"]
    parts.append(_alpha(headline.alpha_between) if ceiling is None else _share_of_ceiling(ceiling))
    if not math.isnan(wrong.low):
        parts.append(f"{wrong.value:.0%} of the stable locations are wrong ({wrong.low:.0%} to {wrong.high:.0%})")
    if silent:
        parts.append(f"{1 - labelled:.0%} of the locations have no label in most frames")
    if flips is not None and level in ACTED_ON:
        parts += _flips(flips)
    how_sure = "" if math.isnan(probability) else f" ({probability:.0%})"
    return StabilityVerdict(
        level,
        probability,
        f"{backbone}: {level}{how_sure}, {ADVICE[level]}: {', '.join(parts)}; {support}; {_for(basis)}",
    )


def _level(
    headline: HeadlineStatistics, ceiling: CeilingShare | None, probabilities: Mapping[Level, float]
) -> tuple[Level, float]:
    level = max(probabilities, key=lambda name: probabilities[name])
    if math.isnan(probabilities[level]):
        return "no verdict", math.nan
    if headline.wrong_of_stable.low > DANGEROUS and level != "unstable":
        return "misleading", math.nan
    if ceiling is not None and not ceiling.ceiling.value >= LEAST_CEILING and level != "unstable":
        return "too coarse", math.nan
    return level if probabilities[level] >= DECIDED else "undecided", probabilities[level]


def _for(basis: Interval) -> str:
    """Return what the interval is about."""
    if basis.scope == THIS_SCENE:
        return f"for this scene flown again, from {basis.frames} frames"
    reason = f"{basis.frames} frames; {LEAST_FRAMES} or more tell of another flight" if basis.frames else "no log"
    return f"for these frames alone ({reason})"


def _alpha(alpha: Interval) -> str:
    return f"alpha between frames {alpha.value:.2f} ({alpha.low:.2f} to {alpha.high:.2f}), its ceiling not known"


def _flips(flips: Flipping) -> list[str]:
    if flips.seen < 0.5:
        return ["most locations were seen too seldom to tell which of them flip"]
    if not flips.share.value >= LEAST_FLIPS:
        return []
    share, part = flips.share, f", {flips.part:.0%} of that between {flips.a} and {flips.b}" if flips.a else ""
    far = f"{share.value:.1%} of the locations of this map flip ({share.low:.1%} to {share.high:.1%})"
    return [f"not to act on: {far}{part}"]


def _share_of_ceiling(ceiling: CeilingShare) -> str:
    share = ceiling.share
    chance = ", no better than chance," if share.value < 0 else ""
    far = f"({share.low:.0%} to {share.high:.0%}) of its ceiling, {ceiling.ceiling.value:.2f}"
    named = ", ".join(
        f"{row.name} ({row.unstable:.0%})" for row in ceiling.judged_classes[:3] if row.unstable >= PROBABLE
    )
    classes = f", probably unstable: {named}" if named else ""
    return f"alpha between frames {ceiling.alpha.value:.2f}{chance} is {share.value:.0%} {far}{classes}"
