"""The verdict on one model on one scene: level, alpha, accuracy, shares of the map, flicker, the paper's means."""

from __future__ import annotations

import math
from collections.abc import Iterator

from semstab.core.console import wrapped
from semstab.data.measures import measures
from semstab.data.records import Record, Result
from semstab.data.statistics import Estimate, MapStatistics, short
from semstab.metrics import CATEGORIES
from semstab.report.means import ENOUGH
from semstab.report.narrative import nearly_all
from semstab.report.terminal.disagreement import class_lines, outlying_lines
from semstab.report.terminal.features import features_alone
from semstab.report.terminal.head import head_lines
from semstab.report.terminal.layout import ALPHA, percent, percents
from semstab.statistics.verdict import ADVICE, DANGEROUS, LIMITS, why_undecided

MEANS = (
    "VSS: agreement of a voxel's frames, 1 is perfect; SBD: change of a voxel's belief per frame; entropy: 0 sure, 1"
    " unsure; margin: best class minus second"
)
"""The meaning of the paper's means."""

JUDGED = ("stable", "usable", "unstable")
"""The levels with which the screen says what to do."""


def one_model(result: Result, record: Record, width: int) -> Iterator[str]:
    """Yield the verdict, the shares of the map, flicker, the classes that disagree most, and the paper's means."""
    statistics = record.statistics
    yield from head_lines(f"{record.unit.scene} / {record.unit.model}", result, [record], width)
    if statistics is not None and statistics.features is not None and statistics.features.alone:
        yield from features_alone(statistics.features, record)
        return
    if statistics is not None:
        yield from _verdict(statistics)
    recurrent, shares = record.map_summary.recurrent, record.map_summary.categories
    if shares:
        low, drifting, uncertain, stable = percents([shares[name] for name in CATEGORIES])
        yield f"  voxels  {stable} stable  {uncertain} uncertain  {drifting} drifting  {low} in less than 3 frames"
    if recurrent.voxels >= ENOUGH:
        means = (f"{m.word} {short(recurrent[m], digits=m.digits[0])} {m.unit}".rstrip() for m in measures())
        yield from wrapped(f"in 3 frames or more: {', '.join(means)}")
        yield from wrapped(MEANS)
    else:
        yield from wrapped(
            f"VSS and SBD are not shown: 3 frames or more saw {recurrent.voxels:,} voxels, and {ENOUGH:,} are needed"
        )
    yield from _flicker(record)
    yield ""
    yield from class_lines([record], width)
    yield from outlying_lines([record])
    yield ""


def _verdict(statistics: MapStatistics) -> Iterator[str]:
    """Yield the level, the number that it rests on, and the meaning of that number."""
    level, alpha = statistics.verdict.level.upper(), statistics.decisive_alpha
    name = "alpha" if statistics.static is None else "alpha (static)"
    if statistics.verdict.level == "no verdict":
        yield from wrapped(statistics.verdict.line)
        return
    yield f"  {level} {statistics.verdict.in_words}".rstrip() + f"    {name} {short(alpha.value)}{_interval(alpha)}"
    wrong = wrong_text(statistics)
    if statistics.verdict.level == "misleading":
        yield from wrapped(wrong, hanging=2)
    elif statistics.verdict.level == "uninformative" and statistics.spots is not None:
        share, name = nearly_all(statistics.spots.largest_share), statistics.spots.largest_class
        yield f"  {share} of the observations are {name}: agreement does not assess such a map"
    else:
        yield from wrapped(ALPHA)
    if difference := statistics.verdict.difference:
        yield from wrapped(f"{difference}: what has no label counts as disagreeing there")
    silent = 0.0 if statistics.spots is None else 1 - statistics.spots.labelled
    if statistics.verdict.level == "usable" and alpha.value >= LIMITS.stable and silent > 1 - LIMITS.labelled:
        yield f"  {percent(silent)} of the locations have no label in most frames: such a map is usable at most"
    if statistics.verdict.level == "undecided":
        yield from wrapped(f"{why_undecided(alpha)}: more frames decide it")
    for text in statistics.moving_lines:
        yield from wrapped(text)
    same = f"two views see the same class at {percent(statistics.agreeing)} of the spots"
    advice = f"{ADVICE[statistics.verdict.decisive]}: " if statistics.verdict.level in JUDGED else ""
    yield from wrapped(f"{advice}{same}")
    if wrong and statistics.verdict.level != "misleading":
        yield f"  {wrong}"
    meaning = None if statistics.spots is None else statistics.spots.meaning
    for section in (statistics.told_ranges, statistics.groupings, meaning, statistics.features):
        if section is not None:
            yield from wrapped(section.text)
    yield ""


def wrong_text(statistics: MapStatistics) -> str:
    """Return the share of the consistent locations that are wrong, and what follows from it; '' without truth."""
    if not (share := share_of_wrong(statistics)):
        return ""
    wrong = f"{share} of the voxels whose frames agree have a wrong class"
    misleads = statistics.verdict.level == "misleading"
    return f"{wrong}, more than {percent(DANGEROUS)}: do not take agreement for truth" if misleads else wrong


def share_of_wrong(statistics: MapStatistics) -> str:
    """Return the share of the consistent locations that are wrong: '5 % (3 to 6 %)'; '' without truth."""
    wrong = statistics.headline.wrong_of_consistent_op3
    return "" if math.isnan(wrong.value) else f"{percent(wrong.value)}{_interval(wrong, 100)}"


def _flicker(record: Record) -> Iterator[str]:
    compensated = record.image_space.compensated_flicker_percent
    if not math.isnan(compensated):
        what, _, often = record.image_space.changing.partition(" ")
        yield f"  flicker {compensated:.1f} % of the {what} change class {often} (motion removed)"


def _interval(estimate: Estimate, scale: float = 1.0) -> str:
    if math.isnan(estimate.low) or math.isnan(estimate.high):
        return ""
    if scale == 1.0:
        return f" ({estimate.interval_name} {short(estimate.low)} to {short(estimate.high)})"
    return f" ({scale * estimate.low:z.0f} to {scale * estimate.high:z.0f} %)"
