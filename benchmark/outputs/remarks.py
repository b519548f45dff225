"""What a reader should know before believing a run: where its voxel size lies, and what one class does to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.model.records import Result
from semstab.model.results import SizeAlpha, UnitSummary, VoxelAdvice

DOMINANT = 0.6
"""Share of the voxels from which a class that means 'nothing' drowns the others."""

VOID_LIKE = ("none", "background", "void", "unlabel", "unknown", "ignore", "other", "clutter", "misc", "empty")
"""What the names of classes begin with that mean 'nothing in particular'."""

COARSE = 5.0
"""Voxels so many times the smallest that suits the data blur what the frames could tell apart."""


def remarks(result: Result) -> Iterator[str]:
    """One line each."""
    yield from dict.fromkeys(_size(scene, found, len(result.scenes)) for scene, found in result.advice.items())
    for run in (record.summary for record in result.select()):
        if (told := _over_sizes(run.sizes)) is not None:
            yield f"{_name(run, result)}: {told}"
    yield from dict.fromkeys(told for record in result.select() if (told := _void_like(record.summary)) is not None)


def _name(run: UnitSummary, result: Result) -> str:
    return f"{run.unit.scene}, {run.unit.backbone}" if len(result.scenes) > 1 else run.unit.backbone


def _size(scene: str, found: VoxelAdvice, scenes: int) -> str:
    """Where the voxel size lies."""
    where = f"{scene}: " if scenes > 1 and not found.chosen else ""
    if found.chosen:
        return (
            f"voxels of {found.voxel_size:g} m: the smallest in which half of the points fall again when another frame"
            " sees them (semstab-bench check); --voxel-size takes another"
        )
    text = f"{where}voxels of {found.voxel_size:g} m: {found.stays:.0%} of the points fall into the same one again"
    if found.suggested is None:
        return f"{text} when another frame sees them, in none of any size half of them: are depth and poses right?"
    text += " when another frame sees them"
    if found.voxel_size < found.suggested:
        return f"{text}, so that noise tears places apart; check suggests {found.suggested:g} m"
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


def _void_like(run: UnitSummary) -> str | None:
    """What to do about a class that means nothing and covers most of the map."""
    largest = max(run.table.classes, key=lambda row: row.voxels)
    if largest.share <= DOMINANT or not largest.name.lower().startswith(VOID_LIKE):
        return None
    return (
        f"{run.unit.backbone}: '{largest.name}' is {largest.share:.0%} of the voxels, and most of what the numbers say;"
        f" --set 'exclude.classes=[{largest.name}]' leaves it out"
    )
