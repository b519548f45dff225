"""What a study found, in sentences; one that has no numbers to stand on is left out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from semstab.metrics import macro_mean
from semstab.model.measures import VSS
from semstab.model.records import Record, Result
from semstab.model.results import SizeAlpha, UnitSummary, VoxelAdvice
from semstab.report.averages import ENOUGH, Pooled, by_backbone, pooled
from semstab.report.findings import Answer, Finding
from semstab.report.tables.stability import comparable

# What a reader should know before believing a run: where its voxel size lies, and what one class does to it.

DOMINANT = 0.6
"""Share of the voxels from which a class that means 'nothing' drowns the others."""

VOID_LIKE = ("none", "background", "void", "unlabel", "unknown", "ignore", "other", "clutter", "misc", "empty")
"""What the names of classes begin with that mean 'nothing in particular'."""

ONE_CLASS, SEEN_AGAIN, FEW_BLOCKS = 0.9, 0.3, 60
"""Share of one class above which, share of voxels seen twice below which, and blocks of space below which an open
verdict has its reason in them."""

HARDLY_ANY = 0.1
"""A share of voxels seen once below which they need no remark."""

COARSE = 5.0
"""Voxels so many times the smallest that suits the data blur what the frames could tell apart."""


def remarks(result: Result) -> Iterator[str]:
    """One line each."""
    yield from dict.fromkeys(_size(scene, found, len(result.scenes)) for scene, found in result.advice.items())
    for run in (record.summary for record in result.select()):
        if (cause := _cause(run)) is not None:
            yield f"{_name(run, result)}: {cause}"
        if run.worst_frames:
            frames = ", ".join(f"{frame.frame} ({frame.drift:.3f})" for frame in run.worst_frames)
            yield f"{_name(run, result)}: frames that moved the map most (bits a voxel seen before): {frames}"
        if (told := _over_sizes(run.sizes)) is not None:
            yield f"{_name(run, result)}: {told}"
    yield from _soft_and_hard([record.summary for record in result.select()], result)
    yield from dict.fromkeys(told for record in result.select() if (told := _void_like(record.summary)) is not None)


def _name(run: UnitSummary, result: Result) -> str:
    return f"{run.unit.scene}, {run.unit.backbone}" if len(result.scenes) > 1 else run.unit.backbone


def _size(scene: str, found: VoxelAdvice, scenes: int) -> str:
    """Where the voxel size lies."""
    where = f"{scene}: voxels" if scenes > 1 and not found.chosen else ""
    if found.chosen:
        return (
            f"Voxels of {found.voxel_size:g} m: the smallest in which half of the points fall again when another frame"
            " sees them (semstab-bench check); --voxel-size takes another"
        )
    text = (
        f"{where or 'Voxels'} of {found.voxel_size:g} m: {found.stays:.0%} of the points fall into the same one again"
    )
    if found.suggested is None:
        return f"{text} when another frame sees them, in none of any size half of them: are depth and poses right?"
    text += " when another frame sees them"
    if found.voxel_size < found.suggested:
        return f"{text}, so that noise tears places apart; check suggests {found.suggested:g} m"
    if found.voxel_size == found.suggested:
        return f"{text}; check suggests the same"
    if found.voxel_size > COARSE * found.suggested:
        return f"{text}; {found.suggested:g} m would do, and tell apart what these blur"
    return f"{text}; check suggests {found.suggested:g} m"


def _over_sizes(sizes: Sequence[SizeAlpha]) -> str | None:
    """How alpha changes with the voxel size."""
    known = [size for size in sizes if size.alpha == size.alpha]
    if len(known) < 2:
        return None
    alphas = ", ".join(f"{size.alpha:.2f} at {size.voxel_size:g} m" for size in known)
    return f"over voxel sizes, from {known[0].frames} frames: alpha {alphas}"


def _soft_and_hard(runs: Sequence[UnitSummary], result: Result) -> Iterator[str]:
    """What soft scores are to be compared by, where others are hard labels."""
    if not mixed(runs):
        return
    yield (
        "Hard labels and soft scores do not compare by VSS, entropy or alpha: scores spread their evidence. Compare the"
        " labels with the scores reduced to each pixel's likeliest class:"
    )
    for run in runs:
        own, reduced = run.table, run.reduced
        if reduced is not None:
            numbers = f"VSS {reduced.vss:.3f}, {reduced.recurrent_vss:.3f} for OP>=3, alpha {reduced.alpha:.2f}"
            yield f"{_name(run, result)}, reduced: {numbers}"
        else:
            alpha = "" if run.statistics is None else f", alpha {run.statistics.agreement.alpha.value:.2f}"
            yield f"{_name(run, result)}: VSS {own[VSS]:.3f}, {own.recurrent[VSS]:.3f} for OP>=3{alpha}"


def mixed(runs: Sequence[UnitSummary]) -> bool:
    """Whether some are of hard labels, others of soft scores."""
    return len({run.reduced is None for run in runs}) > 1


def _cause(run: UnitSummary) -> str | None:
    """Why the verdict is not clear, and what would help; None where it is."""
    found = run.statistics
    if found is None or found.verdict.level not in ("undecided", "no verdict"):
        return None
    largest = max(run.table.classes, key=lambda row: row.voxels)
    if largest.share >= ONE_CLASS:
        return (
            f"not clear, for '{largest.name}' covers {largest.share:.0%} of the voxels: another scene would tell more"
        )
    if found.repeated.share < SEEN_AGAIN:
        return f"not clear, for few looks: {found.repeated.share:.0%} of the voxels were seen twice; more overlap helps"
    if found.blocks.count < FEW_BLOCKS:
        blocks = f"{found.blocks.count} blocks of {found.blocks.size:.3g} m"
        return f"not clear, for the scene is small: {blocks} to judge by; more of it helps, more frames do not"
    return None


def _void_like(run: UnitSummary) -> str | None:
    """What to do about a class that means nothing and covers most of the map."""
    largest = max(run.table.classes, key=lambda row: row.voxels)
    if largest.share <= DOMINANT or not largest.name.lower().startswith(VOID_LIKE):
        return None
    return (
        f"{run.unit.backbone}: '{largest.name}' is {largest.share:.0%} of the voxels, and most of what the numbers say;"
        f" --set 'exclude.classes=[{largest.name}]' leaves it out"
    )


def reading(result: Result, found: Sequence[Finding]) -> list[str]:
    """The summary of a study for somebody who will not read its tables."""
    records = result.select()
    if not records:
        return ["No unit at the study's own settings was finished: there is nothing to say yet."]
    means = {name: pooled(rows) for name, rows in by_backbone(records).items()}
    return [
        *verdicts(result),
        *(remark if remark.endswith(":") else f"{remark}." for remark in remarks(result)),  # may begin with a name
        *_once(pooled(records)),
        *(sentence for name, voxels in means.items() for sentence in _recurrent(name, voxels)),
        *_ranking(result),
        *_flicker(records),
        *_least_seen(records),
        *_findings(found),
        *_implementations(result),
    ]


def verdicts(result: Result) -> list[str]:
    """On each backbone."""
    return [sentence for rows in by_backbone(result.select()).values() for sentence in _verdict(rows)]


def _once(voxels: Pooled) -> Iterator[str]:
    if voxels.once >= HARDLY_ANY:
        yield (
            f"{voxels.once:.0%} of the voxels were seen once. They look stable because no second look could contradict"
            " them: read every measure where voxels recur (OP>=3)."
        )


def _recurrent(backbone: str, voxels: Pooled) -> Iterator[str]:
    if voxels.recurrent.voxels >= ENOUGH:
        yield (
            f"Where {backbone} had three looks or more ({voxels.recurrent.share:.0%} of its voxels),"
            f" {1 - voxels.recurrent[VSS]:.1%} of the evidence goes against the voxel's own class; over all voxels it"
            f" seems to be {1 - voxels.every[VSS]:.1%}."
        )
    else:
        yield f"{backbone} has {voxels.recurrent.voxels:,} voxels with three looks or more: too few to judge it by."


def _verdict(records: Sequence[Record]) -> Iterator[str]:
    """The verdict on a backbone; of several scenes, in how many each level was reached."""
    judged = [record.statistics.verdict for record in records if record.statistics is not None]
    if len(judged) == 1:
        yield f"{judged[0].line}."
    elif judged:
        levels = Counter(verdict.level for verdict in judged)
        parts = (f"{level} in {n} scene{'' if n == 1 else 's'}" for level, n in levels.items())
        yield f"Verdict on {records[0].unit.backbone}: {', '.join(parts)}."


def _ranking(result: Result) -> Iterator[str]:
    """Does the order of the backbones change where only recurrent voxels count?"""
    records = comparable(result)
    means = {name: pooled(rows) for name, rows in by_backbone(records).items()}
    if mixed([record.summary for record in result.select()]):
        return
    if not means or any(voxels.recurrent.voxels < ENOUGH for voxels in means.values()):
        return
    every = _order({name: voxels.every[VSS] for name, voxels in means.items()})
    recurrent = _order({name: voxels.recurrent[VSS] for name, voxels in means.items()})
    taxonomy = records[0].summary.taxonomy
    if every == recurrent:
        yield f"In one taxonomy ({taxonomy}) the order by VSS is {every}, over all voxels and for OP>=3 alike."
    else:
        yield f"In one taxonomy ({taxonomy}) the order by VSS is {every} over all voxels, but {recurrent} for OP>=3."


def _order(values: Mapping[str, float]) -> str:
    return " > ".join(sorted(values, key=lambda name: -values[name]))


def _flicker(records: Sequence[Record]) -> Iterator[str]:
    parts = []
    for backbone, rows in by_backbone(records).items():
        plain = macro_mean([row.image_space.flicker_percent for row in rows])
        compensated = macro_mean([row.image_space.compensated_flicker_percent for row in rows])
        if not math.isnan(compensated):
            parts.append(f"{backbone} {plain:.0f}% ({compensated:.0f}%)")
    if parts:
        yield (
            "Share of the pixels whose label changes from one sampled frame to the next, and in brackets what is left"
            f" of it where the camera's motion is taken out: {', '.join(parts)}."
        )


def _least_seen(records: Sequence[Record]) -> Iterator[str]:
    """The paradox between scenes: the one that looks steadiest may be the one that was hardly looked at."""
    for backbone, rows in by_backbone(records).items():
        tables = {row.unit.scene: row.summary.table for row in rows if row.summary.table.voxels}
        if len(tables) < 2:
            continue
        steadiest = max(tables, key=lambda name: tables[name][VSS])
        if steadiest == min(tables, key=lambda name: tables[name].mean_op):
            yield (
                f"{backbone} looks steadiest in {steadiest} (VSS {tables[steadiest][VSS]:.3f}), which is also the scene"
                f" seen least: {tables[steadiest].mean_op:.2f} frames a voxel."
            )


def _findings(found: Sequence[Finding]) -> Iterator[str]:
    tested = [row for row in found if row.verdict is not Answer.UNTESTED]
    parts = (f"{row.claim[0].lower()}{row.claim[1:].rstrip('.')} ({row.said})" for row in tested)
    if tested:
        yield f"The paper's findings here: {'; '.join(parts)}."


def _implementations(result: Result) -> Iterator[str]:
    """Which fusion implementations leave the base one's maps."""
    rows = {
        name: [row.agrees for row in result.agreement if row.backends == (result.backend, name)]
        for name in dict.fromkeys(row.backends[1] for row in result.agreement)
    }
    if same := [name for name, agrees in rows.items() if all(agrees)]:
        drawn = max(row.one_in for row in result.agreement if row.backends[1] in same)
        sample = f", as far as one voxel in {drawn} tells" if drawn > 1 else ""
        leave = "leaves" if len(same) == 1 else "leave"
        yield f"{' and '.join(same)} {leave} the same maps as {result.backend}{sample}."
    for name, agrees in rows.items():
        if not all(agrees):
            yield f"{name} and {result.backend} disagree in {agrees.count(False)} of {len(agrees)} comparisons."
    for name in dict.fromkeys(row.backends[1] for row in result.compared):
        pairs = [row for row in result.compared if row.backends[1] == name]
        missing = macro_mean([row.only_in[0] / max(1, row.voxels[0]) for row in pairs])
        other = macro_mean([row.differences["label"].mean for row in pairs])
        yield (
            f"{name}, which associates otherwise than {pairs[0].backends[0]}, lacks {missing:.0%} of its voxels, and"
            f" gives another label to {other:.1%} of those that both have."
        )
