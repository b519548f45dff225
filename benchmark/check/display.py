"""A scene's check in the terminal: tables of 80 columns, then the verdict."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from semstab.check.coverage import FUSED_FRAMES
from semstab.check.scene_check import SceneCheck

STATES = {"sound": "green", "unsound": "bold red", "unclear": "yellow"}
NOTHING = "-"
MOST_UNKNOWN = 4


def print_check(checked: SceneCheck, console: Console) -> None:
    """What was found out about a scene; of an unsound one no more than what is wrong, and the labels."""
    console.print(_heading(checked))
    for title, table in _tables(checked):
        console.print(title, style="bold")
        console.print(table)
    for line in _advice(checked):
        console.print(line)
    for remark in checked.remarks:
        console.print(f"[yellow]look:[/] {escape(remark)}\n", highlight=False)
    state = "unsound" if checked.problems else checked.verdict.state
    console.print(f"[bold]{escape(checked.scene)}:[/] [{STATES[state]}]{state}[/]: {escape(_conclusion(checked))}\n")


def _heading(checked: SceneCheck) -> str:
    depth, (width, height) = checked.depth, checked.size
    text = (
        f"[bold]{escape(checked.scene)}[/]: {checked.selected} of {checked.frames} frames of {width}x{height};"
        f" depth in {depth.valid:.0%} of the pixels"
    )
    if depth.valid:
        text += f", {depth.p5:.3g} to {depth.p95:.3g} m (5% to 95%)"
    if checked.depth_from is not None:
        text += f"; from {escape(checked.depth_from)}"
    if checked.motion is None:
        return text
    (least, most), (from_, to) = checked.motion.shift, checked.motion.turn
    return (
        f"{text}; from frame to compared frame the camera moves {least:.1%} to {most:.0%} of the depth"
        f" and turns {from_:.0f} to {to:.0f} degrees"
    )


def _tables(checked: SceneCheck) -> Iterator[tuple[str, Table]]:
    """Titles and tables."""
    verdict = checked.verdict
    if verdict.fits:
        yield (
            f"depth of {verdict.frames} frames reprojected into each other, {verdict.pairs} pairs",
            _convention_table(checked),
        )
    if checked.overlaps:
        yield "what frames share, by their distance among the selected ones", _overlap_table(checked)
    if checked.persistence:
        every = f", every {_ordinal(checked.fused_stride)} pixel of each axis" if checked.fused_stride > 1 else ""
        whose = "all" if checked.fused_frames == checked.selected else f"{checked.fused_frames} evenly spaced"
        yield f"observation persistence, {whose} frames fused{every}", _persistence_table(checked)
    if checked.labels:
        yield "labels, % of the pixels", _label_table(checked)


def _convention_table(checked: SceneCheck) -> Table:
    table = _table(("read",), ("error\n%", "co-visible\n%", "points"))
    for name, fit in checked.verdict.fits:
        table.add_row(escape(name), _percent(fit.error, 2), _percent(fit.share, 1), f"{fit.points:,}")
    return table


def _overlap_table(checked: SceneCheck) -> Table:
    numbers = ("pairs", "in view\n%", "co-visible\n%", "error\n%", "labels agree\n%")
    table = _table(("frames apart",), numbers)
    for row in checked.overlaps:
        low, high = row.apart
        shares = (row.in_view, row.covisible)
        table.add_row(
            str(low) if low == high else f"{low} to {high}",
            str(row.pairs),
            *(_percent(share, 1) for share in shares),
            _percent(row.error, 2),
            _percent(row.agreement, 1),
        )
    return table


def _persistence_table(checked: SceneCheck) -> Table:
    shares = ("OP=1\n%", "OP=2\n%", "3<=OP<=5\n%", "OP>5\n%")
    table = _table(("voxel\nm",), ("voxels", "mean\nOP", *shares, "same voxel\nseen again %"))
    for row in checked.persistence:
        cells = (_percent(share, 1) for share in row.shares)
        table.add_row(f"{row.voxel_size:g}", f"{row.voxels:,}", _number(row.mean_op), *cells, _percent(row.stays, 0))
    return table


def _label_table(checked: SceneCheck) -> Table:
    table = _table(("class",), [escape(labels.backbone) for labels in checked.labels])
    names = dict.fromkeys(name for labels in checked.labels for name in labels.classes)
    for name in names:
        table.add_row(escape(name), *(_percent(labels.classes.get(name, math.nan), 2) for labels in checked.labels))
    table.add_row("(ignored)", *(_percent(labels.ignored, 2) for labels in checked.labels), style="dim")
    unknown = sorted({i for labels in checked.labels for i in labels.unknown})
    for i in unknown[:MOST_UNKNOWN]:
        shares = (_percent(labels.unknown.get(i, 0.0), 2) for labels in checked.labels)
        table.add_row(f"id {i}: no class", *shares, style="red")
    if len(unknown) > MOST_UNKNOWN:
        table.add_row(f"{len(unknown) - MOST_UNKNOWN} more such ids", style="red")
    return table


def _advice(checked: SceneCheck) -> Iterator[str]:
    if checked.persistence and checked.fused_frames < checked.selected:
        times = checked.selected / checked.fused_frames
        yield (
            f"OP is that of {checked.fused_frames} frames (at most {FUSED_FRAMES} are fused here); all"
            f" {checked.selected} see a voxel about {times:.2g} times as often.\n"
        )
    if checked.noise is not None:
        yield (
            f"Depth is off by {_metres(checked.noise.between)} between frames, by {_metres(checked.noise.within)}"
            f" within one (medians); a pixel covers {_metres(checked.noise.footprint)}."
        )
    suggestion = checked.suggestion
    if suggestion is None:
        return
    yield "Suggested:"
    if suggestion.voxel_size is not None:
        yield f"  voxel_size: {suggestion.voxel_size:g}, {suggestion.voxel_size_reason}"
        yield f"  pixel_stride: {suggestion.pixel_stride}, {suggestion.pixel_stride_reason}"
    yield f"  frames.stride: {suggestion.frame_stride}, {suggestion.frame_stride_reason}\n"


def _conclusion(checked: SceneCheck) -> str:
    if checked.problems:
        return "; ".join(checked.problems)
    verdict = checked.verdict
    if not verdict.undetermined:
        return verdict.text
    because = f" ({verdict.reason})" if verdict.reason else ""
    return f"{verdict.text}. What these frames cannot rule out{because}: {'; '.join(verdict.undetermined)}"


def _table(names: Sequence[str], numbers: Sequence[str]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for name in names:
        table.add_column(name, vertical="bottom", overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", vertical="bottom")
    return table


def _percent(share: float, digits: int) -> str:
    return NOTHING if math.isnan(share) else f"{100 * share:.{digits}f}"


def _number(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.2f}"


def _metres(value: float) -> str:
    """A length in the unit that reads best."""
    if math.isnan(value):
        return NOTHING
    return f"{value:.3g} m" if value >= 1 else f"{100 * value:.3g} cm" if value >= 0.1 else f"{1e3 * value:.3g} mm"


def _ordinal(n: int) -> str:
    """'2nd', '3rd', '11th'."""
    last = 0 if n % 100 in (11, 12, 13) else n % 10
    return f"{n}{_ENDINGS.get(last, 'th')}"


_ENDINGS = {1: "st", 2: "nd", 3: "rd"}
