"""Write warnings and notes on a result, in sentences; a sentence without numbers to support it is left out."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence

import yaml

from semstab.backends import rule_of
from semstab.comparison.caution import suspicions
from semstab.config import BACKENDS
from semstab.data.features import OF_FEATURES
from semstab.data.measures import VSS
from semstab.data.records import Record, Result
from semstab.data.results import VoxelAdvice
from semstab.data.statistics import OutlyingFrames, short
from semstab.datasets import GROUND_TRUTH
from semstab.metrics import macro_mean
from semstab.report.means import ENOUGH, by_model, pooled
from semstab.report.tables.backends import one_in
from semstab.report.tables.stability import comparable
from semstab.statistics.frame_disagreement import LEAST_FRAMES, LEAST_PLACES

MOSTLY_ONCE = 0.5
"""The share of voxels seen once from which on there is a warning."""

TOO_LARGE = 25
"""The multiple of the suggested voxel size from which on there is a warning."""

MOSTLY_MOVING = 0.5
"""The share of the disagreement at locations of classes that move from which on there is a warning."""

ONE_CLASS = 0.9
"""The share of a class from which on it determines most of the numbers."""


def noted(result: Result) -> Iterator[str]:
    """Yield what `check` notes of the scenes: labels or images that are not registered to the depth, and the like."""
    for scene, notes in result.notes.items():
        yield from (f"{scene}: {text}" if len(result.scenes) > 1 else text for text in notes)


def warnings(result: Result) -> Iterator[str]:
    """Yield the facts without which a run would be misread, the most important first, each with a remedy."""
    runs = result.select()
    for run in runs:
        if run.frames_left_out:
            yield (
                f"{_name(run, result)}: {run.frames_left_out} of {run.frames + run.frames_left_out} selected frames"
                " have no file or no pose and are left out: semstab-bench check"
            )
        if run.frames_empty:
            yield (
                f"{_name(run, result)}: {run.frames_empty} of {run.frames} frames have no pixel with both depth and"
                " a label: semstab-bench check"
            )
        if run.statistics is not None and run.statistics.moved is not None and run.statistics.moved.misplaced:
            yield f"{_name(run, result)}: {run.statistics.moved.of_poses}; semstab-bench check names them, too"
        spots = None if run.statistics is None else run.statistics.spots
        if spots is not None and 2 * spots.views <= spots.frames:
            yield (
                f"{_name(run, result)}: {spots.frames} frames show {spots.views} distinct views: the camera stands"
                " still, or frames repeat; the statistics count views, not frames"
            )
        if (cut := run.scores_left_out) is not None:
            yield (
                f"{_name(run, result)}: top_k leaves out {cut.mean:.2%} of a pixel's scores on average,"
                f" {cut.most:.2%} at most; no belief changes by more than that"
            )
    seen_once = sum(row.voxels for run in runs for row in run.map_summary.strata if row.name == "OP=1")
    once = seen_once / max(1, sum(run.map_summary.voxels for run in runs))
    if once >= MOSTLY_ONCE:
        yield (
            f"{once:.0%} of the voxels were seen in one frame only, and look stable for that reason; larger voxels"
            " (--voxel-size) or more overlap help"
        )
    yield from dict.fromkeys(text for scene, advice in result.advice.items() if (text := _size(scene, advice, result)))
    stable = [record for record in result.select() if _is_untested(record)]
    if stable:
        names = ", ".join(dict.fromkeys(record.unit.model for record in stable))
        yield f"stable means that frames of {names} agree, not that they are right: no ground truth was compared"
    yield from _not_counting_frames(result)
    if mixed(runs):
        yield (
            "VSS, entropy and voxel alpha of labels and of soft scores cannot be compared; with scores reduced to"
            " labels: semstab-bench show RUN reduced"
        )
    for record in result.select():
        yield from (f"{_name(record, result)}: {text}" for text in (*_suspicions(record), *_traffic(record)))
    yield from _one_class_covers(runs)


def _not_counting_frames(result: Result) -> Iterator[str]:
    """Yield which maps have evidence by another rule than the mean, of which what counts frames is not known."""
    units = (*result.select(), *result.select(BACKENDS))
    labelled = [run for run in units if run.taxonomy != OF_FEATURES.name]
    assessed = [(run.unit.backend, run.statistics) for run in labelled if run.statistics is not None]
    names = [name for name, stats in assessed if stats.repeated.voxels and math.isnan(stats.agreement.psa_op2.value)]
    if names:
        yield (
            f"{', '.join(dict.fromkeys(names))}: this rule does not count frames, so that PSA, voxel alpha, consistent"
            " locations and the null of SBD are unknown"
        )


def _one_class_covers(runs: Sequence[Record]) -> Iterator[str]:
    """Yield which classes cover most of a map, so that they determine most of its numbers."""
    covering: dict[str, list[tuple[str, float]]] = {}
    for run in (run for run in runs if run.taxonomy != OF_FEATURES.name):
        if max(row.share for row in run.map_summary.classes) >= ONE_CLASS:
            largest = max(run.map_summary.classes, key=lambda row: row.voxels)
            covering.setdefault(largest.name, []).append((run.unit.model, largest.share))
    for name, shares in covering.items():
        all_of_them = len(shares) == len(runs)
        of_models = "" if all_of_them else f" of {', '.join(dict.fromkeys(model for model, _ in shares))}"
        more = " or more" if len({f"{share:.0%}" for _, share in shares}) > 1 else ""
        least = min(share for _, share in shares)
        covers = (
            f"'{name}' covers {round(100 * least)}%{more} of the map{of_models}, and determines most of its numbers"
        )
        if least >= NOTHING_ELSE:
            yield f"{covers}; what is left without it is too little to assess: take another model, or another scene"
        else:
            yield f"{covers}; read the numbers by class, or leave it out: {_excluding(name)}"


NOTHING_ELSE = 0.99
"""The share of a map from which on a class leaves nothing else to assess."""


def _excluding(*classes: str) -> str:
    """Return the option that leaves out classes, as a shell takes it."""
    listed = yaml.safe_dump(list(classes), default_flow_style=True, width=math.inf).strip()
    return f"--set {shlex.quote(f'exclude.classes={listed}')}"


MOST_FRAMES = 12
"""The most frames that are named in a sentence; the table `frames` has all."""


def outlying_line(outlying: OutlyingFrames, of: str = "", *, most: int = MOST_FRAMES) -> str:
    """Return which frames stand out, by the names of their files, in order of the sequence; `of` says of what.

    'frames that stand out, net: 2 of 40, frame-07 frame-31'.
    """
    head = f"frames that stand out{f', {of}' if of else ' from the frames around them'}"
    if not outlying.judged:
        return f"{head}: not known, fewer than {LEAST_FRAMES} views share {LEAST_PLACES} places with two others"
    unjudged = f" ({outlying.unjudged} not judged: they share too few places)" if outlying.unjudged else ""
    if not outlying.frames:
        return f"{head}: none of {outlying.judged}{unjudged}"
    names = [outlier.name for outlier in sorted(outlying.frames, key=lambda outlier: outlier.frame)]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{head}: {len(names)} of {outlying.judged}{unjudged}, {' '.join(names[:most])}{more}"


def not_assessed(run: Record) -> str:
    """Return why agreement does not assess a map: nearly all of it is one class; '' if agreement assesses it."""
    statistics = run.statistics
    if statistics is None or statistics.spots is None or statistics.verdict.level != "uninformative":
        return ""
    share, name = statistics.spots.largest_share, statistics.spots.largest_class
    return f"uninformative: {nearly_all(share)} of the observations of {run.unit.model} are {name}"


def nearly_all(share: float) -> str:
    """Return a share in percent, rounded; one that is not all of it is never 100: '99 %', 'more than 99.9 %'."""
    if share < 0.995:
        return f"{100 * share:.0f} %"
    return "all" if share >= 1 else f"more than {math.floor(1000 * share) / 10:g} %"


def _is_untested(record: Record) -> bool:
    """Return whether a map has the verdict stable, but was not compared with the ground truth."""
    statistics = record.statistics
    return bool(
        statistics
        and "stable" in (statistics.verdict.level, statistics.verdict.of_all)
        and statistics.correctness is None
        and record.unit.model != GROUND_TRUTH
    )


def _suspicions(record: Record) -> Iterator[str]:
    """Yield reasons why frames may agree although the labels are poor; of the ground truth none."""
    if record.unit.model != GROUND_TRUTH:
        yield from suspicions(record)


def _traffic(record: Record) -> Iterator[str]:
    """Yield a warning where most disagreement is at classes that move, and frames agree much better without them."""
    spots = None if record.statistics is None else record.statistics.spots
    if spots is None or (moving := spots.moving) is None or moving.disagreement < MOSTLY_MOVING:
        return
    yield (
        f"{moving.disagreement:.0%} of the disagreement is where the map has classes that move"
        f" ({', '.join(moving.classes)}); without these locations alpha is {short(moving.alpha)}:"
        f" {_excluding(*moving.classes)}"
    )


def _name(run: Record, result: Result) -> str:
    return f"{run.unit.scene}, {run.unit.model}" if len(result.scenes) > 1 else run.unit.model


def _size(scene: str, advice: VoxelAdvice, result: Result) -> str:
    """Return a warning if the voxel size does not suit the data, else an empty text."""
    where = f"{scene}: " if len(result.scenes) > 1 else ""
    if advice.suggested is None:
        return (
            f"{where}at any voxel size, fewer than half of the points fall into the same voxel again when another frame"
            " sees them: semstab-bench check examines depth and poses"
        )
    size = f"voxels of {advice.voxel_size:g} m"
    if advice.voxel_size >= TOO_LARGE * advice.suggested:
        return (
            f"{where}{size} are {advice.voxel_size / advice.suggested:.0f} times as large as the data need, so that one"
            f" holds several things: --voxel-size {advice.suggested:g}"
        )
    if advice.chosen or advice.suggested <= advice.voxel_size:
        return ""
    return (
        f"{where}{size} are smaller than the noise of depth and poses, which puts one point into several:"
        f" --voxel-size {advice.suggested:g}"
    )


def mixed(runs: Sequence[Record]) -> bool:
    """Return whether some runs are of hard labels and others of soft scores."""
    return len({run.reduced is None for run in runs}) > 1


def notes(result: Result) -> Iterator[str]:
    """Yield the facts about several models, scenes or backends that no table shows."""
    records = result.select()
    yield from _ranking(result)
    yield from _least_seen(records)
    yield from _implementations(result)


def _ranking(result: Result) -> Iterator[str]:
    """Yield that the order of the models by VSS changes if only recurrent voxels count."""
    records = comparable(result)
    means = {name: pooled(rows) for name, rows in by_model(records).items()}
    if mixed(result.select()):
        return
    if not means or any(voxels.recurrent.voxels < ENOUGH for voxels in means.values()):
        return
    all_voxels = _order({name: voxels.every[VSS] for name, voxels in means.items()})
    recurrent = _order({name: voxels.recurrent[VSS] for name, voxels in means.items()})
    taxonomy = records[0].taxonomy
    if all_voxels != recurrent:
        yield (
            f"VSS of all voxels misleads: in one taxonomy ({taxonomy}) its order is {all_voxels}, and {recurrent} for"
            " OP>=3."
        )


def _order(values: Mapping[str, float]) -> str:
    return " > ".join(sorted(values, key=lambda name: -values[name]))


def _least_seen(records: Sequence[Record]) -> Iterator[str]:
    """Yield the paradox between scenes: the scene with the highest mean VSS may be the one seen least."""
    for model, rows in by_model(records).items():
        tables = {row.unit.scene: row.map_summary for row in rows if row.map_summary.voxels}
        if len(tables) < 2:
            continue
        steadiest = max(tables, key=lambda name: tables[name][VSS])
        if steadiest == min(tables, key=lambda name: tables[name].mean_op):
            yield (
                f"The mean VSS of all voxels of {model} is highest in {steadiest} ({tables[steadiest][VSS]:.3f} at any"
                f" OP), which is the scene seen least often, {tables[steadiest].mean_op:.2f} frames per voxel: voxels"
                " seen once look stable for that reason."
            )


def _implementations(result: Result) -> Iterator[str]:
    """Yield which fusion implementations differ from the base one."""
    rows = {
        name: [row.agrees for row in result.agreement if row.backends == (result.backend, name)]
        for name in dict.fromkeys(row.backends[1] for row in result.agreement)
    }
    if equal := [name for name, agrees in rows.items() if all(agrees)]:
        sampled = one_in([row for row in result.agreement if row.backends[1] in equal])
        sample = f" ({sampled} voxels were compared)" if sampled else ""
        make = "makes" if len(equal) == 1 else "make"
        yield f"{' and '.join(equal)} {make} the same maps as {result.backend}{sample}."
    for name, agrees in rows.items():
        if not all(agrees):
            yield f"{name} and {result.backend} disagree in {agrees.count(False)} of {len(agrees)} comparisons."
    for name in dict.fromkeys(row.backends[1] for row in result.compared):
        pairs = [row for row in result.compared if row.backends[1] == name]
        missing = macro_mean([row.only_in[0] / max(1, row.voxels[0]) for row in pairs])
        other = macro_mean([row.differences["label"].mean for row in pairs])
        base = pairs[0].backends[0]
        way = (
            "fuses by another rule" if rule_of(name) != rule_of(base) else "associates pixels and voxels in another way"
        )
        yield (
            f"{name} {way} than {base}. It does not have"
            f" {missing:.0%} of its voxels, and gives another label to {other:.1%} of those that both have."
        )
