"""One line a backbone that a drone team can act on, from thresholds that stand here and in docs/metrics.md."""

from __future__ import annotations

import math

from semstab.model.statistics import UNDEFINED, Estimate, StabilityVerdict

RELIABLE = 0.8
"""Krippendorff's alpha from which data may be relied on (Krippendorff 2018, Content Analysis, ch. 12)."""

TENTATIVE = 2 / 3
"""Alpha from which tentative conclusions are allowed; below, none (same source)."""

DANGEROUS = 0.05
"""Largest share of the stable places that may be wrong."""

LEAST_VOXELS, LEAST_BLOCKS = 100, 16
"""Voxels seen twice or more, and blocks of them, below which there is no verdict."""

ADVICE = {
    "stable": "its labels agree from frame to frame; act on them",
    "usable": "act on a label only where several frames agree",
    "unstable": "do not act on its labels",
    "undecided": "the data do not decide; fly with more overlap, or more of the scene",
    "misleading": "do not take agreement for truth",
    "no verdict": "too few places were seen twice; fly with more overlap",
}
"""What to do at each level."""

ONE_CLASS = "hardly more than one class was predicted, so that agreement says nothing"


def verdict(
    backbone: str,
    *,
    alpha: Estimate,
    psa: Estimate,
    voxels: int,
    share: float,
    blocks: int,
    wrong_of_stable: Estimate = UNDEFINED,
) -> StabilityVerdict:
    """Judge by the intervals, never by values alone, from voxels with OP >= 2 only.

    alpha, psa       of these voxels
    voxels, share    how many they are, and of all voxels
    blocks           in how many blocks they lie
    wrong_of_stable  share of the stable voxels that are wrong, where ground truth tells
    """
    level = _level(alpha, wrong_of_stable, voxels, blocks)
    support = f"{voxels} places seen twice or more, {share:.0%} of the map"
    if level == "no verdict":
        enough = voxels >= LEAST_VOXELS and blocks >= LEAST_BLOCKS
        return StabilityVerdict(level, f"{backbone}: no verdict, {ONE_CLASS if enough else ADVICE[level]}; {support}")
    found = [
        f"two frames agree on {psa.value:.0%} of the places ({psa.low:.0%} to {psa.high:.0%})",
        f"alpha {alpha.value:.2f} ({alpha.low:.2f} to {alpha.high:.2f})",
    ]
    if not math.isnan(wrong_of_stable.low):
        wrong = wrong_of_stable
        found.append(f"{wrong.value:.0%} of the stable places are wrong ({wrong.low:.0%} to {wrong.high:.0%})")
    return StabilityVerdict(level, f"{backbone}: {level}, {ADVICE[level]}: {', '.join(found)}; {support}")


def _level(alpha: Estimate, wrong_of_stable: Estimate, voxels: int, blocks: int) -> str:
    if voxels < LEAST_VOXELS or blocks < LEAST_BLOCKS or math.isnan(alpha.low):
        return "no verdict"
    if wrong_of_stable.low > DANGEROUS:
        return "misleading"
    if alpha.low >= RELIABLE:
        return "stable"
    if alpha.low >= TENTATIVE:
        return "usable"
    return "unstable" if alpha.high < TENTATIVE else "undecided"
