"""One line a backbone that a drone team can act on, from thresholds that stand here and in docs/metrics.md."""

from __future__ import annotations

import math

from semstab.model.statistics import (
    NEXT_FLIGHT,
    CeilingShare,
    ClassCeilingShare,
    Estimate,
    Flipping,
    HeadlineStatistics,
    Interval,
    Level,
    StabilityVerdict,
)
from semstab.statistics.intervals import LEAST_FRAMES

RELIABLE = 0.8
"""Krippendorff's alpha from which data may be relied on (Krippendorff 2018, Content Analysis, ch. 12)."""

TENTATIVE = 2 / 3
"""Alpha from which tentative conclusions are allowed; below, none (same source)."""

LEAST_CEILING = 0.5
"""A ceiling below which the share of it that is reached says little."""

DANGEROUS = 0.05
"""Largest share of the stable places that may be wrong."""

LEAST_VOXELS, LEAST_BLOCKS = 100, 16
"""Voxels seen twice or more, and blocks of them, below which there is no verdict."""

ADVICE: dict[Level, str] = {
    "stable": "its labels agree from frame to frame; act on them",
    "partly stable": "act on its labels but for those of the class named",
    "usable": "act on a label only where several frames agree",
    "unstable": "do not act on its labels",
    "undecided": "the data do not decide; fly with more overlap, or more of the scene",
    "too coarse": "voxels are too large for what the labels show; use smaller ones",
    "misleading": "do not take agreement for truth",
    "no verdict": "too few places were seen twice; fly with more overlap",
}
"""What to do at each level."""

ACTED_ON, LEAST_FLIPS = ("stable", "partly stable", "usable"), 0.001
"""Levels at which labels are acted on, and the share of places that flip from which on it is said beside them."""

ONE_CLASS = "hardly more than one class was predicted, so that agreement says nothing"


def verdict(
    backbone: str,
    *,
    headline: HeadlineStatistics,
    ceiling: CeilingShare | None,
    flips: Flipping | None = None,
    voxels: int,
    share: float,
    blocks: int,
) -> StabilityVerdict:
    """Judge by the intervals, never by values alone, from voxels with OP >= 2 only.

    headline       numbers of these voxels
    ceiling        alpha between frames and its ceiling; where that is not known, alpha is judged as it is
    flips          the locations about which frames do not agree: few of them hide in any mean
    voxels, share  how many they are, and of all voxels
    blocks         in how many cubes of space they lie
    """
    enough = voxels >= LEAST_VOXELS and blocks >= LEAST_BLOCKS
    level = _level(headline, ceiling) if enough else "no verdict"
    support = f"{voxels} places seen twice or more, {share:.0%} of the map"
    if level == "no verdict":
        return StabilityVerdict(level, f"{backbone}: no verdict, {ONE_CLASS if enough else ADVICE[level]}; {support}")
    psa, wrong = headline.psa, headline.wrong_of_stable
    found = [f"two frames agree on {psa.value:.0%} of the places ({psa.low:.0%} to {psa.high:.0%})"]
    found += [_alpha(headline.alpha_between)] if ceiling is None else _reached(ceiling)
    if not math.isnan(wrong.low):
        found.append(f"{wrong.value:.0%} of the stable places are wrong ({wrong.low:.0%} to {wrong.high:.0%})")
    if flips is not None and level in ACTED_ON:
        found += _flips(flips)
    basis = _basis(headline, ceiling)
    reason = basis.undecided if level == "undecided" and basis.undecided else ADVICE[level]
    return StabilityVerdict(level, f"{backbone}: {level}, {reason}: {', '.join(found)}; {support}; {_holds(basis)}")


def _basis(headline: HeadlineStatistics, ceiling: CeilingShare | None) -> Interval:
    """The interval that decides."""
    return headline.alpha_between if ceiling is None else ceiling.share


def _holds(basis: Interval) -> str:
    """For what the intervals hold."""
    if basis.question == NEXT_FLIGHT:
        return f"intervals are for the next flight, from {basis.frames} frames"
    frames = f"these {basis.frames} frames: fly {LEAST_FRAMES} or more" if basis.frames else "these frames: keep a log"
    return f"intervals are for {frames} to tell of the next flight"


def _alpha(alpha: Estimate) -> str:
    return f"alpha between frames {alpha.value:.2f} ({alpha.low:.2f} to {alpha.high:.2f}), its ceiling not known"


def _flips(flips: Flipping) -> list[str]:
    if flips.seen < 0.5:
        return ["most places were seen too seldom to tell which of them flip"]
    if not flips.share.value >= LEAST_FLIPS:
        return []
    share, part = flips.share, f", {flips.part:.0%} of that between {flips.a} and {flips.b}" if flips.a else ""
    far = f"{share.value:.1%} of the places of this map flip ({share.low:.1%} to {share.high:.1%})"
    return [f"not to act on: {far}{part}"]


def _reached(ceiling: CeilingShare) -> list[str]:
    share = ceiling.share
    far = f"({share.low:.0%} to {share.high:.0%}) of its ceiling, {ceiling.ceiling.value:.2f} by {ceiling.by}"
    chance = ", no better than chance," if share.value < 0 else ""
    said = [f"alpha between frames {ceiling.alpha.value:.2f}{chance} is {share.value:.0%} {far}"]
    if (worst := ceiling.worst) is not None:
        said.append(f"worst class {worst.name} {_class_share(worst)}")
    return said


def _class_share(row: ClassCeilingShare) -> str:
    if math.isnan(row.share.value):
        return "not known"
    chance = "no better than chance, " if row.share.value < 0 else ""
    return f"{chance}{row.share.value:.0%} ({row.share.low:.0%} to {row.share.high:.0%})"


def _level(headline: HeadlineStatistics, ceiling: CeilingShare | None) -> Level:
    basis = _basis(headline, ceiling)
    if math.isnan(basis.low):
        return "no verdict"
    if headline.wrong_of_stable.low > DANGEROUS:
        return "misleading"
    if basis.low < TENTATIVE or not basis.decided:
        return "unstable" if basis.decided and basis.high < TENTATIVE else "undecided"
    if ceiling is not None and not ceiling.ceiling.value >= LEAST_CEILING:
        return "too coarse"
    if basis.low < RELIABLE:
        return "usable"
    return "stable" if ceiling is None or _every_class_holds(ceiling) else "partly stable"


def _every_class_holds(ceiling: CeilingShare) -> bool:
    """Whether each class that matters allows at least tentative conclusions."""
    return all(row.share.low >= TENTATIVE for row in ceiling.classes if row.counts_for_verdict)
