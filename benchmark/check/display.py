"""A scene's check in the terminal, in 80 columns: the verdict, one table, advice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from semstab.check.coverage import FUSED_FRAMES, said
from semstab.check.scene_check import SceneCheck
from semstab.core.console import Console, wrapped
from semstab.data.labels import IGNORE_16BIT

STATES = {"sound": "green", "imprecise": "yellow", "unsound": "bold red", "unclear": "yellow"}
NOTHING = "-"
OVERLAP = (
    "in view: points of a frame inside the other image; co-visible: points that have depth there, too; error: median"
    " difference of the two depths; agree: points with the same label"
)
"""The meaning of the columns of the table of overlaps."""

OF_IMAGES = "predict them (--predict), or put the label maps of a model into its folder"
OF_SCANS = "put the labels of a model into predictions/MODEL (docs/tutorials/scans.md), or check the truth: --model gt"
"""Advice for a scene without labels."""

MOST_UNKNOWN = 4
MOST_COLUMNS = 100


def print_check(checked: SceneCheck, console: Console, *, verbose: bool = False) -> None:
    """Print the verdict, then what explains it; verbose: every table."""

    def say(text: str, indent: int, style: str = "") -> None:
        lines = wrapped(text, min(console.width, MOST_COLUMNS), begin="", hanging=indent)
        console.print("\n".join(lines), style=style, highlight=False, markup=False, soft_wrap=True)

    say(_heading(checked), 4, "bold")
    state = "unsound" if checked.problems_of_geometry else checked.verdict.state
    console.print()
    say(f"  {state.upper()}  {_conclusion(checked)}", 4, STATES[state])
    if not checked.labels:
        which = "only ground truth" if _of_truth(checked) else "none"
        say(f"  labels   {which}: {OF_SCANS if checked.of_scans else OF_IMAGES}", 11)
    for text in checked.problems_of_labels:
        say(f"  LABELS  {text}", 4, STATES["unsound"])
    if checked.placed is not None:
        say(f"  place    {checked.placed}", 11)
    for source in checked.sources:
        say(f"  {source}", 11)
    for note in checked.notes:
        say(f"  note: {note}", 4, "yellow")
    tables = _tables(checked)
    wrong_labels = any(labels.problem for labels in checked.labels)
    explaining = "labels" if wrong_labels else "overlap" if state in ("sound", "imprecise") else "conventions"
    for name in tables if verbose else [name for name in (explaining,) if name in tables]:
        title, table = tables[name]
        if verbose:
            console.print(f"\n  {title}", highlight=False, markup=False)
        console.print(Padding(table, (0, 0, 0, 2), expand=False))
        if name == "overlap":
            say(f"  {OVERLAP}", 4)
    for line in _advice(checked, verbose=verbose):
        say(f"  {line}", 11)
    if not verbose:
        say("  more     -v: axes of the poses, frames per voxel, labels; --json FILE: all numbers", 11)
    console.print()


def _heading(checked: SceneCheck) -> str:
    depth, (width, height) = checked.depth, checked.size
    if checked.of_scans:
        text = f"{checked.scene}    {checked.selected} of {checked.frames} scans of {width:,} points"
        return f"{text}, {depth.p5:.2g} to {depth.p95:.2g} m" if depth.valid else text
    text = f"{checked.scene}    {checked.selected} of {checked.frames} frames {width}x{height}"
    text += f", depth in {depth.valid:.0%} of the pixels"
    if depth.valid:
        text += f", {depth.p5:.2g} to {depth.p95:.2g} m"
    return text if checked.depth_from is None else f"{text}, from {checked.depth_from}"


def _tables(checked: SceneCheck) -> dict[str, tuple[str, Table]]:
    """Return titles and tables by name."""
    verdict, tables = checked.verdict, dict[str, tuple[str, Table]]()
    if checked.overlaps:
        tables["overlap"] = "overlap of frames, by their distance in the sequence", _overlap_table(checked)
    if verdict.fits:
        title = f"depth of {verdict.frames} frames reprojected into each other, {verdict.pairs} pairs"
        if checked.of_scans:
            title = f"points of {verdict.frames} scans, and the nearest ones of the others, {verdict.pairs} pairs"
        tables["conventions"] = title, _convention_table(checked)
    if checked.persistence:
        stride_text = f", every {_ordinal(checked.fused_stride)} pixel of each axis" if checked.fused_stride > 1 else ""
        whose = "all" if checked.fused_frames == checked.selected else f"{checked.fused_frames} evenly spaced"
        tables["persistence"] = (
            f"observation persistence, {whose} frames fused{stride_text}",
            _persistence_table(checked),
        )
    if checked.labels:
        tables["labels"] = "labels, % of the pixels", _label_table(checked)
    return tables


def _of_truth(checked: SceneCheck) -> bool:
    """Return whether the labels that were compared are the ground truth's, as no model has any."""
    return not checked.labels and any(row.agreement == row.agreement for row in checked.overlaps)


def _convention_table(checked: SceneCheck) -> Table:
    table = _table(("depth and poses read",), ("error\n%", "co-visible\n%", "points"))
    for name, fit in checked.verdict.fits:
        table.add_row(escape(name), _percent(fit.error, 2), _percent(fit.share, 1), f"{fit.points:,}")
    return table


def _overlap_table(checked: SceneCheck) -> Table:
    of_model = f" of {checked.labels[0].model}" if len(checked.labels) > 1 else " of gt" if _of_truth(checked) else ""
    numbers = ("pairs", "in view\n%", "co-visible\n%", "error\n%", f"labels{of_model}\nagree %")
    table = _table(("frames apart",), numbers)
    for row in checked.overlaps:
        shares = (row.in_view, row.covisible)
        table.add_row(
            said(row.apart),
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
    table = _table(("class",), [escape(labels.model) for labels in checked.labels])
    names = dict.fromkeys(name for labels in checked.labels for name in labels.classes)
    for name in names:
        table.add_row(escape(name), *(_percent(labels.classes.get(name, math.nan), 2) for labels in checked.labels))
    table.add_row("(ignored)", *(_percent(labels.ignored, 2) for labels in checked.labels), style="dim")
    unknown = sorted({i for labels in checked.labels for i in labels.unknown})
    for i in unknown[:MOST_UNKNOWN]:
        shares = (_percent(labels.unknown.get(i, 0.0), 2) for labels in checked.labels)
        name = f"id {i}" if i < IGNORE_16BIT else f"score {i - IGNORE_16BIT}"
        table.add_row(f"{name}: no class", *shares, style="red")
    if len(unknown) > MOST_UNKNOWN:
        table.add_row(f"{len(unknown) - MOST_UNKNOWN} more such ids", style="red")
    return table


def _advice(checked: SceneCheck, *, verbose: bool) -> Iterator[str]:
    for finding in checked.label_findings:
        if finding.open is not None:
            yield f"labels   {finding.model}: {finding.open}"
    if verbose and checked.motion is not None:
        (least, most), (from_, to) = checked.motion.shift, checked.motion.turn
        yield (
            f"camera   moves {least:.1%} to {most:.0%} of the depth and turns {from_:.0f} to {to:.0f} degrees from"
            " frame to compared frame"
        )
    if verbose and checked.persistence and checked.fused_frames < checked.selected:
        times = checked.selected / checked.fused_frames
        yield (
            f"OP       is counted over {checked.fused_frames} frames (at most {FUSED_FRAMES} are fused here); all"
            f" {checked.selected} frames see a voxel about {times:.2g} times as often"
        )
    if checked.noise is not None and checked.of_scans:
        between, within, spacing = map(_metres, (checked.noise.between, checked.noise.within, checked.noise.footprint))
        yield (
            f"noise    points lie {between} from the nearest point of another scan, {within} from the nearest point"
            f" of their own scan; rays are {spacing} apart"
        )
    elif checked.noise is not None:
        yield (
            f"noise    depth differs by {_metres(checked.noise.between)} between frames, and by"
            f" {_metres(checked.noise.within)} within a frame; a pixel covers {_metres(checked.noise.footprint)}"
        )
    suggestion = checked.suggestion
    if suggestion is None:
        return
    if suggestion.voxel_size is not None:
        yield f"voxels   use --voxel-size {suggestion.voxel_size:g}: {suggestion.voxel_size_reason}"
        if verbose and not checked.of_scans:
            yield f"pixels   use --pixel-stride {suggestion.pixel_stride}: {suggestion.pixel_stride_reason}"
    stride = suggestion.frame_stride
    yield f"frames   use {f'--frames ::{stride}' if stride > 1 else 'all'}: {suggestion.frame_stride_reason}"


def _conclusion(checked: SceneCheck) -> str:
    if checked.problems_of_geometry:
        return "; ".join(checked.problems_of_geometry)
    verdict = checked.verdict
    if not verdict.undetermined:
        return verdict.text
    because = f" ({verdict.reason})" if verdict.reason else ""
    return f"{verdict.text}. These frames cannot rule out{because}: {'; '.join(verdict.undetermined)}"


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
    """Return a length in the unit that reads best."""
    if math.isnan(value):
        return NOTHING
    return f"{value:.3g} m" if value >= 1 else f"{100 * value:.3g} cm" if value >= 0.1 else f"{1e3 * value:.3g} mm"


def _ordinal(n: int) -> str:
    """Return '2nd', '3rd', '11th'."""
    last = 0 if n % 100 in (11, 12, 13) else n % 10
    return f"{n}{_ENDINGS.get(last, 'th')}"


_ENDINGS = {1: "st", 2: "nd", 3: "rd"}
