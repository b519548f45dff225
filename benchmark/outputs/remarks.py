"""What a reader should know before believing a run: where its voxel size lies, and what one class does to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.model.measures import VSS
from semstab.model.records import Result
from semstab.model.results import SizeAlpha, UnitSummary, VoxelAdvice

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
