"""The summary of a run or a study in the terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from semstab.check import Verdict
from semstab.config import BACKENDS, BASE
from semstab.engine.observer import Observer
from semstab.engine.units import Plan
from semstab.metrics import macro_mean, pool, split_last
from semstab.model.measures import VSS, measures
from semstab.model.records import Failure, Record, Result, UnitContent
from semstab.model.results import STAGES, Agreement, Means, UnitSummary
from semstab.report.averages import Sweep, describe, levels, over_all, over_recurrent, pooled
from semstab.report.narrative import HARDLY_ANY, remarks
from semstab.report.remedies import Remedies, Remedy, advice, remedies
from semstab.report.tables.remedies import COLUMNS, marked
from semstab.report.tables.remedies import row as remedy_row
from semstab.report.terminal_statistics import comparison_lines, lines
from semstab.task import Task

NOTHING = "-"

FUSION_STAGES = ("association", "update")
"""Parts of fusion; frames are decoded beside it, and waited for where that takes longer."""

RARE = 100
"""Voxels below which a class is too rare to be called the worst."""

MOST_CLASSES = 10
"""So many classes a backbone are shown, the least steady first; the others are in the tables."""


def print_summary(result: Result, console: Console) -> None:
    """The scene table, the strata, the agreement of the backends, and how to read them."""
    shown = [record.summary for record in result.select()]
    console.print(_scene_table(shown))
    console.print(_strata_table(shown))
    console.print(_class_table(result))
    for sweep in result.sweeps():
        console.print(_sweep_table(result, describe(sweep)))
    if len(named := _named(result)) > len(shown):
        console.print(_backends_table(named))
    if result.compared:
        console.print(_compared_table(result.compared))
    drawn = [row for row in result.agreement if row.one_in > 1]
    if told := [row for row in result.agreement if row not in drawn or not row.agrees]:
        console.print(_agreement_table(told))
    if drawn:
        console.print(f"{_drawn(drawn)}\n", highlight=False, markup=False)
    console.print(_stages_line(shown), highlight=False)
    for text in _statistics(result):
        console.print(text, highlight=False, markup=False, soft_wrap="\n" in text.rstrip())  # tables keep their lines
    for text in remarks(result):
        console.print(f"- {text}", highlight=False, markup=False)
    console.print()
    for run in shown:
        if run.frames_left_out:
            text = f"{run.unit.scene}, {run.unit.backbone}: {run.frames_left_out} of"
            text += f" {run.frames + run.frames_left_out} selected frames were left out: they lack a file or a pose"
            console.print(text, soft_wrap=True, markup=False)
        if (cut := run.scores_left_out) is not None:
            text = f"{run.unit.scene}, {run.unit.backbone}: top_k leaves out {cut.mean:.2%} of a pixel's scores on"
            text += f" average, {cut.most:.2%} at most: no voxel's belief or VSS changes by more than that"
            console.print(text, soft_wrap=True, markup=False, highlight=False)
        if run.frames_empty:
            text = f"{run.unit.scene}, {run.unit.backbone}: {run.frames_empty} of {run.frames} frames hold no pixel"
            console.print(f"{text} with both depth and a label", soft_wrap=True, markup=False)
    once = sum(_once(run) for run in shown) / sum(run.table.voxels for run in shown)
    if once < HARDLY_ANY:
        return
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


def narrow_table(title: str, names: Sequence[str], numbers: Sequence[str]) -> Table:
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
    table = narrow_table(escape(_title(runs)), ("scene",), numbers)
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
    table = narrow_table(title, ("persistence",), ("voxels", "%", *_headers()))
    for backbone, rows in _by_backbone(runs):
        table.add_row(escape(backbone), style="bold")
        voxels = sum(run.table.voxels for run in rows)
        for strata in zip(*(run.table.strata for run in rows), strict=True):
            table.add_row(*_stratum_cells(pool(strata, voxels)))
        for part in split_last([run.table for run in rows]):
            table.add_row(*_stratum_cells(part), style="dim")
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
    """Mean milliseconds a frame: of fusion, with its parts where they are known, and of what is done beside it."""
    means = {stage: macro_mean([run.stages_ms.get(stage, math.nan) for run in runs]) for stage in STAGES}
    known = {stage: f"{stage} {value:.1f}" for stage, value in means.items() if not math.isnan(value)}
    parts = ", ".join(known.pop(stage) for stage in FUSION_STAGES if stage in known)
    fusion = _number(macro_mean([run.fuse_ms_per_frame for run in runs]), 1)
    beside = "".join(f", {text}" for text in known.values())
    return f"ms a frame: fusion {fusion}{f' ({parts})' if parts else ''}{beside}\n"


def _class_table(result: Result) -> Table:
    """Classes that there are, by how well frames agree on them, the worst first; rare ones at the end."""
    maps = {backbone: result.select(backbone=backbone) for backbone in result.backbones}
    seen = {name: [row for row in pooled(records).classes if row.voxels] for name, records in maps.items()}
    title = "by class, the least steady first"
    if any(row.voxels < RARE for there in seen.values() for row in there):
        title += f", those of fewer than {RARE} voxels last"
    title += ", all scenes pooled" if len(result.scenes) > 1 else ""
    known = any(_class_alphas(result.select()).values())
    table = narrow_table(title, ("class",), ("voxels", "%", *_headers(), *(["alpha\n↑"] if known else [])))
    for backbone, there in seen.items():
        alphas = _class_alphas(maps[backbone])
        there.sort(key=lambda row: (row.voxels < RARE, alphas.get(row.name, 1.0), row[VSS]))
        table.add_row(escape(backbone), style="bold")
        for row in there[:MOST_CLASSES]:
            name, *cells = _stratum_cells(row)
            table.add_row(escape(name), *cells, *([_number(alphas.get(row.name, math.nan), 2)] if known else []))
        if len(there) > MOST_CLASSES:
            table.add_row(f"  ... {len(there) - MOST_CLASSES} more")
    return table


def _class_alphas(records: Sequence[Record]) -> dict[str, float]:
    """Krippendorff's alpha of each class, the macro mean over scenes, where it is known."""
    found: dict[str, list[float]] = {}
    for statistics in (record.statistics for record in records if record.statistics is not None):
        for row in statistics.agreement.classes:
            found.setdefault(row.name, []).append(row.alpha)
    means = {name: macro_mean(values) for name, values in found.items()}
    return {name: alpha for name, alpha in means.items() if not math.isnan(alpha)}


def _sweep_table(result: Result, sweep: Sweep) -> Table:
    """What a sweep came to: of all voxels, of the recurrent ones, how many these are, and how far frames agree."""
    numbers = (f"{VSS.word}\nall", f"{VSS.word}\nOP>=3", "OP>=3\n%", "alpha\n↑")
    table = narrow_table(sweep.title, (sweep.header,), numbers)
    for backbone in result.backbones:
        found = levels(result, sweep.name, backbone)
        if found:
            table.add_row(escape(backbone), style="bold")
        for level in found:
            means = (level.mean(over_all(VSS)), level.mean(over_recurrent(VSS)))
            share, alpha = 100 * level.mean(lambda p: p.recurrent.share), level.mean(lambda p: p.alpha.value)
            cells = (*(_number(mean, VSS.digits[0]) for mean in means), _number(share, 2), _number(alpha, 2))
            table.add_row(f"  {sweep.text(level.value)}", *cells)
    return table


def _named(result: Result) -> list[UnitSummary]:
    """The units of all backends that were asked for, not of one that others are only checked against."""
    others = [record.summary for record in result.select(BACKENDS) if record.statistics is not None]
    return [*(record.summary for record in result.select()), *others]


def _backends_table(runs: Sequence[UnitSummary]) -> Table:
    numbers = ("voxels", "mean\nOP", *_headers()[:2], "OP>=3\n%", "ms a\nframe")
    title = "fusion backends, the same frames" + (", all scenes" if len(_scenes(runs)) > 1 else "")
    table = narrow_table(title, ("backend",), numbers)
    for backbone, rows in _by_backbone(runs):
        table.add_row(escape(backbone), style="bold")
        for name in dict.fromkeys(run.unit.backend for run in rows):
            own = [run for run in rows if run.unit.backend == name]
            voxels, mean_op, *means, _, recurrent = _scene_cells(own)  # two measures leave room for the name
            fusion = _number(macro_mean([run.fuse_ms_per_frame for run in own]), 1)
            table.add_row(escape(f"  {name}"), voxels, mean_op, *means[:2], recurrent, fusion)
    return table


def _compared_table(compared: Sequence[Agreement]) -> Table:
    """How backends differ that associate pixels and voxels in another way: mean differences of a voxel of both."""
    symbols = {"op": "OP", **{measure.key: measure.symbol for measure in measures() if not measure.lowest_op > 1}}
    numbers = ("first\nonly", "other\nonly", "label\ndiffers", *(f"mean\nΔ{s}" for s in symbols.values()))
    table = narrow_table("backends that differ by design, voxel by voxel", ("scene, backbone",), numbers)
    for pair in dict.fromkeys(row.backends for row in compared):
        table.add_row(escape("\n".join(pair)), style="bold")
        for row in (row for row in compared if row.backends == pair):
            share = [f"{100 * only / max(1, n):.1f}%" for only, n in zip(row.only_in, row.voxels, strict=True)]
            means = [_number(row.differences[name].mean, 3) for name in symbols]
            label = f"{100 * row.differences['label'].mean:.1f}%"
            table.add_row(escape(f"  {row.scene}, {row.backbone}"), *share, label, *means)
    return table


def _agreement_table(agreement: Sequence[Agreement]) -> Table:
    symbols = {"op": "OP", **{measure.key: measure.symbol for measure in measures()}, "evidence": "e"}
    numbers = ("voxels\nin one", *(f"Δ{symbol}" for symbol in symbols.values()), "")
    short = [f"{measure.symbol} {measure.word}" for measure in measures() if measure.short]
    title = f"agreement: largest differences of a voxel ({', '.join([*short, 'e evidence'])})"
    table = narrow_table(title, ("scene, backbone",), numbers)
    for pair in dict.fromkeys(row.backends for row in agreement):
        table.add_row(escape(" · ".join(pair)), style="bold")
        for row in (row for row in agreement if row.backends == pair):
            largest = [row.differences[name].max for name in symbols]
            differences = [f"{difference:.0e}" if difference else "0" for difference in largest]
            verdict = "[green]agree[/]" if row.agrees else "[bold red]DISAGREE[/]"
            table.add_row(escape(f"  {row.scene}, {row.backbone}"), f"{sum(row.only_in):,}", *differences, verdict)
    return table


def _drawn(sampled: Sequence[Agreement]) -> str:
    """How the backends fared that were checked on a sample of the voxels."""
    backends = _listed([*dict.fromkeys(row.backends[0] for row in sampled)])
    voxels, bad = sum(row.voxels[1] for row in sampled), sum(not row.agrees for row in sampled)
    found = f"{bad} of {len(sampled)} maps differ" if bad else "none differs"
    return (
        f"check: {backends} against the numpy reference on {voxels:,} voxels drawn at random, one in"
        f" {sampled[0].one_in}: {found} (--check numpy: on all of them)"
    )


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


# What a run or a study looks like in the terminal while it works, and what failed.

SECONDS_A_LINE = 10.0
"""Where there is no terminal for a bar, progress is a line that often."""


class ProgressBar(Observer):
    """One bar for all of it, in frames that go into maps."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
        )
        self.bar = Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True)
        self.work = self.bar.add_task("starting", total=None)
        self.notes: list[str] = []
        self._said = time.monotonic()

    def run_started(self, plan: Plan, finished: Mapping[str, UnitContent]) -> None:
        """Show the bar: the frames of every unit that is to be computed are its total."""
        units = plan.distinct()
        if finished:
            self.bar.console.print(f"kept from before: {len(finished)} of {len(units)} units", style="dim")
        for scene in plan.scenes.values():
            if scene.depth_from is not None:
                self.notes.append(f"{scene.name}: depth from {scene.depth_from}")
        missing = units.keys() - finished.keys()
        self.bar.update(self.work, total=sum(units[identity].frames for identity in missing))
        if self.bar.console.is_interactive:
            self.bar.start()

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Remember, until the run is through, what could not be told."""
        if verdict.state == "unclear":
            self.notes.append(f"{task.scene.name}: {verdict.text}")

    def advanced(self, frames: int, what: str) -> None:
        """So many frames further."""
        self.bar.update(self.work, advance=frames, description=what[:40])
        if not self.bar.console.is_interactive and time.monotonic() - self._said > SECONDS_A_LINE:
            self._said = time.monotonic()
            (work,) = self.bar.tasks
            self.bar.console.print(
                f"{what}: {work.completed:.0f} of {work.total:.0f} frames", markup=False, soft_wrap=True
            )

    def run_finished(self, result: Result) -> None:
        """Take the bar away, and say what is to be known of the scenes."""
        self.close()
        for note in self.notes if not result.failures else ():
            self.bar.console.print(note, style="dim", soft_wrap=True, markup=False)

    def close(self) -> None:
        """Take the bar away, also where the run was interrupted."""
        if self.bar.live.is_started:
            self.bar.stop()


def failure_lines(result: Result) -> Iterator[str]:
    """One line for what failed for the same reason."""
    reasons: dict[str, list[Failure]] = {}
    for failure in result.failures:
        reasons.setdefault(failure.message, []).append(failure)
    for message, failures in reasons.items():
        places = list(dict.fromkeys(f"{failure.unit.scene}, {failure.unit.backbone}" for failure in failures))
        varied = [name for failure in failures if (name := _named_task(failure))]
        where = "" if message.startswith(places[0]) else f"{_first_of(places)}: "
        what = f"{_first_of(varied)}: " if varied else ""
        yield f"{where}{what}{message}"


def _first_of(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _named_task(failure: Failure) -> str:
    """What was varied; nothing of a unit at the base settings."""
    if failure.variation.sweep == BASE:
        return ""
    value = failure.variation.value
    return f"{failure.variation.sweep} {failure.unit.backend if value is None else f'{value:g}'}"


# The remedies in the terminal: a table within 80 columns, and what to use.

HEADERS = (
    "flick\n%",
    "alpha",
    "fore-\nsight\n%",
    "accu-\nracy\n%",
    "mIoU\n%",
    "stable\nwrong\n%",
    "lag",
    "cov.\n%",
    "ms",
)
DIGITS = (1, 3, 1, 1, 1, 1, 1, 0, 0)


def print_remedies(result: Result, console: Console) -> None:
    """A table a model; '*' is the filter to use, '!' one that steadies the labels and makes them worse."""
    for found in remedies(result):
        console.print(_table(found))
        for sentence in advice(found):
            console.print(sentence, highlight=False, markup=False)
        console.print(
            "\n* to use; ! steadier and worse. Alpha rises with any memory: it chooses nothing here.\n", highlight=False
        )


def _table(found: Remedies) -> Table:
    table = Table(
        title=f"remedies for {escape(found.model)}", title_justify="left", title_style="bold", box=SIMPLE_HEAD,
        pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    table.add_column("", no_wrap=True)
    table.add_column("filter", vertical="bottom", overflow="fold")
    for header in HEADERS:
        table.add_column(header, justify="right", vertical="bottom", no_wrap=True)
    for remedy in (found.unfiltered, *found.filtered):
        best = remedy == found.best
        table.add_row(marked(found, remedy), *_cells(remedy), style="bold" if best else "")
    return table


def _cells(remedy: Remedy) -> list[str]:
    name, *numbers = remedy_row(remedy)
    columns = zip(COLUMNS[1:], DIGITS, numbers, strict=True)
    shown = [f"{value:.{digits}f}" if value == value else "-" for _, digits, value in columns]  # noqa: PLR0124
    return [escape(str(name)).replace("+", "\n +"), *shown]
