"""The summary of a run or a study in the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from semstab.config import BACKENDS
from semstab.metrics import macro_mean, pool
from semstab.model.measures import measures
from semstab.model.records import Result
from semstab.model.results import STAGES, Agreement, Means, UnitSummary
from semstab.outputs.statistics_text import comparison_lines, lines

NOTHING = "-"


def print_summary(result: Result, console: Console) -> None:
    """The scene table, the strata, the agreement of the backends, and how to read them."""
    shown = [record.summary for record in result.select()]
    console.print(_scene_table(shown))
    console.print(_strata_table(shown))
    if result.agreement:
        console.print(_agreement_table(result.agreement))
    console.print(_stages_line(shown))
    for text in _statistics(result):
        console.print(text, highlight=False, markup=False)
    for run in shown:
        if run.frames_left_out:
            text = f"{run.unit.scene}, {run.unit.backbone}: {run.frames_left_out} of"
            text += f" {run.frames + run.frames_left_out} selected frames were left out: they lack a file or a pose"
            console.print(text, soft_wrap=True, markup=False)
        if run.frames_empty:
            text = f"{run.unit.scene}, {run.unit.backbone}: {run.frames_empty} of {run.frames} frames hold no pixel"
            console.print(f"{text} with both depth and a label", soft_wrap=True, markup=False)
    once = sum(_once(run) for run in shown) / sum(run.table.voxels for run in shown)
    console.print(
        f"{once:.0%} of the voxels were seen once: they say nothing about stability. "
        f"Read {_listed([measure.word for measure in measures()])} by OP, or for OP>=3."
    )


def _statistics(result: Result) -> Iterator[str]:
    """The verdict on each backbone, scene by scene; with `--statistics` all that was found, and the comparisons."""
    units = [record.summary for record in (*result.select(), *result.select(BACKENDS))]
    for base in result.select():
        group = (base.unit.scene, base.unit.backbone)
        same = [run for run in units if (run.unit.scene, run.unit.backbone) == group]
        judged = [run.statistics for run in same if run.statistics is not None]
        if judged:
            fullest = max(judged, key=lambda found: found.sections)
            if fullest.sections:
                yield "\n".join([*_headline(f"{base.unit.scene}, {base.unit.backbone}"), *lines(fullest), ""])
            else:
                scene = f"{base.unit.scene}, " if len(result.scenes) > 1 else ""
                yield f"{scene}{fullest.verdict.line}\n"
    for compared in result.comparisons:
        title = f"{compared.scene}: {_listed(compared.backbones)}"
        yield "\n".join([*_headline(title), *comparison_lines(compared), ""])


def _headline(title: str) -> tuple[str, str]:
    return title, "-" * len(title)


def _once(run: UnitSummary) -> int:
    return sum(row.voxels for row in run.table.strata if row.name == "OP=1")


def _table(title: str, names: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table that fits 80 columns: no lines between columns, headers of two lines."""
    table = Table(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True
    )
    for name in names:
        table.add_column(name, vertical="bottom", overflow="fold")  # names give way, numbers do not
    for name in numbers:
        table.add_column(name, justify="right", vertical="bottom", no_wrap=True)
    return table


def _scene_table(runs: Sequence[UnitSummary]) -> Table:
    numbers = ("voxels", "mean\nOP", *_headers(), "flicker\n%", "OP>=3\n%")
    table = _table(escape(_title(runs)), ("scene",), numbers)
    for backbone, rows in _by_backbone(runs):
        table.add_row(escape(backbone), style="bold")
        for run in rows:
            table.add_row(escape(f"  {run.unit.scene}"), *_scene_cells([run]))
        if len(rows) > 1:
            table.add_row("  total/mean", *_scene_cells(rows))
    return table


def _scene_cells(runs: Sequence[UnitSummary]) -> list[str]:
    """One scene's numbers, or the totals and macro means of several (each scene counts once)."""
    tables = [run.table for run in runs]
    return [
        f"{sum(table.voxels for table in tables):,}",
        _number(macro_mean([table.mean_op for table in tables]), 2),
        *(_number(macro_mean([table[m] for table in tables]), m.digits[0]) for m in measures()),
        _number(macro_mean([run.flicker_percent for run in runs]), 2),
        _number(100 * macro_mean([table.recurrent.share for table in tables]), 2),
    ]


def _strata_table(runs: Sequence[UnitSummary]) -> Table:
    title = "by observation persistence" + (", all scenes pooled" if len(_scenes(runs)) > 1 else "")
    table = _table(title, ("persistence",), ("voxels", "%", *_headers()))
    for backbone, rows in _by_backbone(runs):
        table.add_row(escape(backbone), style="bold")
        voxels = sum(run.table.voxels for run in rows)
        for strata in zip(*(run.table.strata for run in rows), strict=True):
            table.add_row(*_stratum_cells(pool(strata, voxels)))
        table.add_row(*_stratum_cells(pool([run.table.recurrent for run in rows], voxels)), style="italic")
    return table


def _stratum_cells(row: Means) -> list[str]:
    return [
        f"  {row.name}",
        f"{row.voxels:,}",
        _number(100 * row.share, 2),
        *(_number(row[m], m.digits[0]) for m in measures()),
    ]


def _headers() -> list[str]:
    """Each measure over an arrow that says which way is good, and its unit."""
    arrows = [(measure, "↑" if measure.better == "higher" else "↓") for measure in measures()]
    return [f"{m.word} {arrow}\n{m.unit}" if m.unit else f"{m.word}\n{arrow}" for m, arrow in arrows]


def _stages_line(runs: Sequence[UnitSummary]) -> str:
    """Mean milliseconds a frame by stage, of those that are known; decoding goes on beside them in worker threads."""
    means = {stage: macro_mean([run.stages_ms.get(stage, math.nan) for run in runs]) for stage in STAGES}
    decode = means.pop("decode")
    known = [f"{stage} {value:.1f}" for stage, value in means.items() if not math.isnan(value)]
    fusion = _number(macro_mean([run.fuse_ms_per_frame for run in runs]), 1)
    return f"ms a frame: fusion {fusion} ({', '.join(known)}); beside them decode {_number(decode, 1)}\n"


def _agreement_table(agreement: Sequence[Agreement]) -> Table:
    symbols = {"op": "OP", **{measure.key: measure.symbol for measure in measures()}, "evidence": "e"}
    numbers = ("voxels\nin one", *(f"Δ{symbol}" for symbol in symbols.values()), "")
    short = [f"{measure.symbol} {measure.word}" for measure in measures() if measure.short]
    title = f"agreement: largest differences of a voxel ({', '.join([*short, 'e evidence'])})"
    table = _table(title, ("scene, backbone",), numbers)
    for pair in dict.fromkeys(row.backends for row in agreement):
        table.add_row(escape(" · ".join(pair)), style="bold")
        for row in (row for row in agreement if row.backends == pair):
            largest = [row.differences[name].max for name in symbols]
            differences = [f"{difference:.0e}" if difference else "0" for difference in largest]
            verdict = "[green]agree[/]" if row.agrees else "[bold red]DISAGREE[/]"
            table.add_row(escape(f"  {row.scene}, {row.backbone}"), f"{sum(row.only_in):,}", *differences, verdict)
    return table


def _listed(words: Sequence[str]) -> str:
    """'a, b and c'."""
    *most, last = words
    return f"{', '.join(most)} and {last}" if most else last


def _title(runs: Sequence[UnitSummary]) -> str:
    first = runs[0]
    return (
        f"{first.unit.backend}, voxels of {first.table.voxel_size:g} m, {first.taxonomy} (K = {first.table.K}), "
        f"{first.frames} frames a scene"
    )


def _by_backbone(runs: Sequence[UnitSummary]) -> list[tuple[str, list[UnitSummary]]]:
    names = list(dict.fromkeys(run.unit.backbone for run in runs))
    return [(name, [run for run in runs if run.unit.backbone == name]) for name in names]


def _scenes(runs: Sequence[UnitSummary]) -> set[str]:
    return {run.unit.scene for run in runs}


def _number(value: float, digits: int) -> str:
    return NOTHING if math.isnan(value) else f"{value:.{digits}f}"
