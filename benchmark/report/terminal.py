"""Print the answer on one screen of 80 columns, progress while a run works, and failures."""

from __future__ import annotations

import itertools
import math
import re
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from semstab.check import Verdict
from semstab.config import BASE
from semstab.core.types import THESE_FRAMES
from semstab.data.measures import headlines, measures
from semstab.data.records import Failure, Record, RegionFlicker, Result
from semstab.data.results import Agreement, UnitSummary
from semstab.data.statistics import UNDEFINED, Estimate, short
from semstab.engine.executors import InProcess
from semstab.engine.observer import Observer
from semstab.engine.units import Plan
from semstab.metrics import CATEGORIES, macro_mean
from semstab.report.filter_study import advice, filter_studies
from semstab.report.means import ENOUGH
from semstab.report.narrative import nearly_all, noted, outlying_line, warnings
from semstab.report.ranking import answers
from semstab.report.tables import tables
from semstab.report.tables.filters import row as filter_row
from semstab.report.tables.stability import one_in
from semstab.report.tables.table import to_terminal
from semstab.statistics.intervals import LEAST_FRAMES
from semstab.statistics.verdict import DANGEROUS, DECIDED, LIMITS, level_probabilities
from semstab.task import Task

WIDTH = 80

MAJORITY = 0.5
"""A class with this share of the map or more is not listed beside others of several models: all disagree with it."""

CONFUSED = "confused with"
CLASS_HEAD = ("classes that disagree most", "alpha", CONFUSED, "of map", "disagreement")
CLASS_COLUMNS, LEAST_CLASS = 32, 28
"""The columns of a line of classes beside its two names, and the least of the first name."""

CONTRIBUTES = 0.01
"""The least share of the disagreement of a class that is listed."""

MOST_CLASSES = {1: 5, 2: 3}
"""The number of classes that are listed for each model, by the number of rows above; else 1."""

OF_MAP = "of each map"
MOST_MAPS = 2
"""The most maps whose shares are printed beneath the rows; tables and report have all."""

MOST_WARNINGS = 3
LEVELS = f"  act on labels from alpha {short(LIMITS.stable)} on, with care from {short(LIMITS.usable)}"
STAGE_NAMES = {
    "read": "reading",
    "check": "data check",
    "reference": "check of the backend",
    "voxel sizes": "other voxel sizes",
    "write": "writing",
}


def print_summary(
    result: Result, console: Console, *, out: Path | None = None, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the answer, then the files to open; `verbose` adds every table of the run."""
    for line in screen(result, out=out, seconds=seconds, width=console.width):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for table in tables(result) if verbose else ():
        console.print(f"\n{to_terminal(table)}", highlight=False, markup=False, soft_wrap=True)


def screen(
    result: Result, *, out: Path | None = None, seconds: float | None = None, width: int = WIDTH
) -> Iterator[str]:
    """Yield the lines of a run or a study for a terminal of so many columns; sentences are wrapped at 80.

    They are verdicts, the classes that disagree most, warnings, the check, the time and the files to open.
    """
    records, width = result.select(), max(width, WIDTH)
    if len(records) == 1:
        yield from _one(result, records[0], width)
    else:
        yield from _several(result, records, width)
    for sweep in result.sweeps():
        yield f"  sweep over {sweep.replace('_', ' ')}: semstab-bench show {out or 'RUN'} sensitivity_{sweep}"
    if any(record.video_measures is not None for record in records):
        yield f"  VC and TC as published: semstab-bench show {out or 'RUN'} video_measures"
    for text in list(warnings(result))[:MOST_WARNINGS]:
        named = text.replace("show RUN", f"show {out or 'RUN'}")
        yield from textwrap.wrap(f"warning: {named}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    if result.benchmark:
        yield f"  benchmark {result.benchmark}"
    yield from _checks(result)
    yield from _where(result, out, seconds)


# --- One model on one scene -------------------------------------------------------------------------------------------


def _one(result: Result, record: Record, width: int) -> Iterator[str]:
    run, statistics = record.summary, record.summary.statistics
    yield from _head(f"{run.unit.scene} / {run.unit.model}", result, [run], width)
    if statistics is not None:
        yield from _verdict(run)
    recurrent, shares = run.table.recurrent, run.table.categories
    if shares:
        low, drifting, uncertain, stable = percents([shares[name] for name in CATEGORIES])
        yield f"  map  {stable} stable  {uncertain} uncertain  {drifting} drifting  {low} seen less than 3 times"
    yield from _flicker(record)
    yield ""
    yield from _classes([record], width)
    yield from _outlying([record])
    if recurrent.voxels >= ENOUGH:
        means = (f"{m.word} {short(recurrent[m], digits=m.digits[0])} {m.unit}".rstrip() for m in measures())
        yield f"  paper (OP>=3)  {'  '.join(means)}"
    else:
        yield f"  paper (OP>=3)  -, {recurrent.voxels:,} voxels are too few (at least {ENOUGH:,})"
    yield ""


def _head(name: str, result: Result, runs: Sequence[UnitSummary], width: int) -> Iterator[str]:
    """Yield the data that was fused: '40 frames, 7 classes, 0.2 m voxels', whether depth and poses agree, and notes."""
    first = runs[0]
    frames = sorted({run.frames for run in runs})
    counts = f"{frames[0]} to {frames[-1]}" if len(frames) > 1 else f"{frames[0]}"
    cells = [run.statistics.cells for run in runs if run.statistics is not None]
    views = min((own.views for own in cells if own is not None and own.views < own.frames), default=None)
    seen = "" if views is None else f" of {views} distinct views"
    chosen = " (chosen)" if any(advice.chosen for advice in result.advice.values()) else ""
    classes = " and ".join(map(str, sorted({run.table.K for run in runs})))
    what = f"{counts} frames{seen}, {classes} classes, {_metres(first.table.voxel_size)} voxels{chosen}"
    beside = "    ".join(filter(None, (_geometry(result), _scope(runs))))
    line = f"{name}    {what}    {beside}".rstrip()
    yield line if len(line) <= width else f"{name}    {what}\n  {beside}".rstrip()
    for text in noted(result):
        yield from textwrap.wrap(f"note: {text}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    yield ""


def _geometry(result: Result) -> str:
    scenes = result.manifest.get("geometry")
    states = [state for state in scenes.values() if isinstance(state, Mapping)] if isinstance(scenes, Mapping) else []
    if not states:
        return ""
    sound = all(state.get("state") == "sound" for state in states)
    return "geometry ok" if sound else "geometry unclear: semstab-bench check"


def _scope(runs: Sequence[UnitSummary]) -> str:
    """Return that intervals and verdicts are for the frames of a run alone, where these are too few for more."""
    alphas = [run.statistics.headline.alpha for run in runs if run.statistics is not None]
    few = [alpha for alpha in alphas if alpha.scope == THESE_FRAMES and alpha.frames]
    of = "" if len(few) == len(alphas) else f" in {len(few)} of {len(alphas)} rows"
    return f"intervals for these frames alone{of}: fewer than {LEAST_FRAMES} views" if few else ""


def _verdict(run: UnitSummary) -> Iterator[str]:
    """Yield the level, the number that it rests on, and the meaning of that number."""
    statistics = run.statistics
    assert statistics is not None
    level, alpha = statistics.verdict.level.upper(), statistics.headline.alpha
    if statistics.verdict.level == "no verdict":
        yield from textwrap.wrap(statistics.verdict.line, WIDTH, initial_indent="  ", subsequent_indent="    ")
        return
    yield f"  {level} {statistics.verdict.stated}".rstrip() + f"    alpha {short(alpha.value)}{_interval(alpha)}"
    wrong = statistics.headline.wrong_of_consistent
    told = f"{_percent(wrong.value)}{_interval(wrong, 100)} of the consistent locations are wrong"
    if statistics.verdict.level == "misleading":
        yield from textwrap.wrap(
            f"{told}, more than {_percent(DANGEROUS)}: do not take agreement for truth",
            WIDTH,
            initial_indent="  ",
            subsequent_indent="  ",
        )
    elif statistics.verdict.level == "uninformative" and statistics.cells is not None:
        share, name = nearly_all(statistics.cells.largest_share), statistics.cells.largest_class
        yield f"  {share} of the observations are {name}: agreement does not assess such a map"
    else:
        yield LEVELS
    silent = 0.0 if statistics.cells is None else 1 - statistics.cells.labelled
    if statistics.verdict.level == "usable" and alpha.value >= LIMITS.stable and silent > 1 - LIMITS.labelled:
        yield f"  {_percent(silent)} of the locations have no label in most frames: such a map is usable at most"
    if statistics.verdict.level == "undecided":
        levels = ", ".join(f"{name} {short(p)}" for name, p in level_probabilities(alpha).items())
        yield f"  no level has p {short(DECIDED)} ({levels}): more frames decide it"
    yield f"  two views see the same class at {_percent(statistics.agreeing)} of the spots"
    if not math.isnan(wrong.value) and statistics.verdict.level != "misleading":
        yield f"  {told}"
    if statistics.ranges is not None and statistics.ranges.is_told:
        yield f"  {statistics.ranges.text}"
    yield ""


def _flicker(record: Record) -> Iterator[str]:
    compensated = record.image_space.compensated_flicker_percent
    if not math.isnan(compensated):
        what, _, often = record.image_space.changing.partition(" ")
        yield f"  flicker  {compensated:.1f} % of the {what} change class {often} (motion removed)"


def _interval(estimate: Estimate, scale: float = 1.0) -> str:
    if math.isnan(estimate.low) or math.isnan(estimate.high):
        return ""
    if scale == 1.0:
        return f" ({estimate.of} {short(estimate.low)} to {short(estimate.high)})"
    return f" ({scale * estimate.low:z.0f} to {scale * estimate.high:z.0f} %)"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.0f} %"


def percents(shares: Sequence[float]) -> list[str]:
    """Return shares of one whole in percent, rounded so that they sum to what the shares do; '-' where undefined.

    Those whose rounding down loses most are rounded up.
    """
    if any(map(math.isnan, shares)):
        return [_percent(share) for share in shares]
    whole = [math.floor(100 * share) for share in shares]
    lost = sorted(range(len(shares)), key=lambda k: whole[k] - 100 * shares[k])
    for k in lost[: round(100 * math.fsum(shares)) - sum(whole)]:
        whole[k] += 1
    return [f"{n} %" for n in whole]


def _metres(size: float) -> str:
    return f"{1000 * size:g} mm" if size < 0.01 else f"{size:g} m"


# --- Several ----------------------------------------------------------------------------------------------------------


def columns() -> list[tuple[str, str]]:
    """Return the head and the unit of each number in a model's row, see `row_of`."""
    shown = [(measure.title, measure.unit or "OP>=3") for measure in headlines()]
    texts = [("model", ""), ("verdict", ""), (f"alpha ({UNDEFINED.of})", "")]
    return [*texts, ("agree", "%"), ("flicker", "%"), *shown, ("mIoU", "%")]


TEXTS = 3
"""The number of columns of text, which are aligned left; numbers are aligned right."""

LEAST_NAME = 9
"""The least columns of a model's name, which is cut where the terminal has no room for all of it."""


def _several(result: Result, records: Sequence[Record], width: int) -> Iterator[str]:
    """Yield which model is more stable where that is known, then a row for each scene and model."""
    listed = ", ".join(result.scenes[:3]) + (", ..." if len(result.scenes) > 3 else "")
    yield from _head(listed, result, [record.summary for record in records], width)
    for text in (told := list(answers(result))):
        yield from textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="    ")
    if told:
        yield ""
    known = any(not math.isnan(miou(record)) for record in records)
    shown, begin = columns() if known else columns()[:-1], common_beginning([*result.models])
    heads, rows = [*zip(*shown, strict=True)], [row_of(record, begin)[: len(shown)] for record in records]
    lines = iter(laid_out([*heads, *rows], width))
    yield next(lines)
    yield next(lines)
    scene = None
    for record, line in zip(records, lines, strict=True):
        if len(result.scenes) > 1 and record.unit.scene != scene:
            yield f"  {(scene := record.unit.scene)}"
        yield line
    if begin:
        yield f"  names of models begin with '{begin}'"
    if any(record.summary.table.recurrent.voxels < ENOUGH for record in records):
        titles = ", ".join(measure.title for measure in headlines())
        yield f"  {titles} -: fewer than {ENOUGH:,} voxels were seen 3 times or more"
    yield LEVELS
    if len(records) <= MOST_MAPS and any(record.summary.table.categories for record in records):
        yield from ("", *_map_shares(records, width, begin), "")
    yield from _classes(records, width, begin)
    yield from _outlying(records)
    for record in records:
        ranges = None if record.summary.statistics is None else record.summary.statistics.ranges
        if ranges is not None and ranges.is_told:
            scene = f" in {record.unit.scene}" if len(result.scenes) > 1 else ""
            yield f"  {record.unit.model}{scene}: {ranges.text}"
    yield ""


LONG_NAME = 16
"""Characters from which on a model's name is written without what all names begin with."""


def common_beginning(names: Sequence[str]) -> str:
    """Return what the names of models begin with, up to a sign between words; '' where that makes none much shorter."""
    same = itertools.takewhile(lambda letters: len({*letters}) == 1, zip(*names, strict=False))
    found = re.match(r".*[ _-]", "".join(letters[0] for letters in same))
    begin = found[0] if found and len(names) > 1 else ""
    return begin if len(begin) > LEAST_NAME and max(map(len, names)) > LONG_NAME and begin not in names else ""


def _map_shares(records: Sequence[Record], width: int, begin: str) -> Iterator[str]:
    """Yield a row for each map: how much of it is stable, uncertain, drifting, and seen too rarely to tell."""
    known = [record for record in records if record.summary.table.categories]
    rows = [percents([record.summary.table.categories[name] for name in reversed(CATEGORIES)]) for record in known]
    heads = ("stable", "uncertain", "drifting", "seen less than 3 times")
    scenes = len({record.unit.scene for record in known}) > 1
    models = [record.unit.model.removeprefix(begin) for record in known]
    named = [f"{each.unit.scene}, {name}" if scenes else name for each, name in zip(known, models, strict=True)]
    names = [_cut(name, width - sum(map(len, heads)) - 2 * len(heads) - 2) for name in named]
    first = max(map(len, (OF_MAP, *names)))
    for name, row in ((OF_MAP, heads), *zip(names, rows, strict=True)):
        cells = (f"{share:>{len(head)}}" for share, head in zip(row, heads, strict=True))
        yield "  ".join(["", f"{name:<{first}}", *cells])


def laid_out(rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Return rows of cells as lines, each column as wide as its cells; names of models are cut to fit the width."""
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sizes[0] = min(sizes[0], max(LEAST_NAME, width - 2 - sum(sizes[1:]) - len(sizes[1:])))
    lines = []
    for name, *cells in rows:
        sized = zip(cells, sizes[1:], strict=True)
        aligned = (f"{c:<{n}}" if k < TEXTS else f"{c:>{n}}" for k, (c, n) in enumerate(sized, 1))
        lines.append(" ".join(["", f" {_cut(name, sizes[0]):<{sizes[0]}}", *aligned]).rstrip())
    return lines


def _cut(name: str, size: int) -> str:
    """Return a name without its middle where it is too long: names differ at their ends."""
    if len(name) <= size:
        return name
    first = (size - 3) // 2
    return f"{name[:first]}...{name[first + 3 - size :]}"


def row_of(record: Record, begin: str = "") -> list[str]:
    """Return a model's row under `columns`, its name without a beginning."""
    run, statistics = record.summary, record.summary.statistics
    level, alpha, agree = "-", "", math.nan
    if statistics is not None:
        level, alpha = str(statistics.verdict), statistics.headline.alpha.text()
        agree = 100 * statistics.agreeing
    recurrent = run.table.recurrent
    means = {m: recurrent[m] if recurrent.voxels >= ENOUGH else math.nan for m in headlines()}
    shown = [short(value, digits=m.digits[0]) for m, value in means.items()]
    flicker = record.image_space.compensated_flicker_percent
    agreeing, flickering, overlap = _number(agree, 0), _number(flicker, 1), _number(100 * miou(record), 1)
    return [run.unit.model.removeprefix(begin), level, alpha, agreeing, flickering, *shown, overlap]


def miou(record: Record) -> float:
    """Return the mIoU of the fused labels seen twice or more; NaN without ground truth."""
    statistics = record.summary.statistics
    return math.nan if statistics is None or statistics.correctness is None else statistics.correctness.miou.value


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:z.{digits}f}"


# --- Both -------------------------------------------------------------------------------------------------------------


def _classes(records: Sequence[Record], width: int, begin: str = "") -> Iterator[str]:
    """Yield the classes with most of the disagreement, and which class is not listed; names without a beginning."""
    names = list(dict.fromkeys(record.unit.model for record in records))
    most, alone = MOST_CLASSES.get(len(records), 1), len(names) == 1
    rows: list[tuple[str, str, str, str, str]] = []
    left_out: dict[str, None] = {}
    for name in names:
        own = [record for record in records if record.unit.model == name]
        classes, shares = class_means(own), _class_shares(own)
        others = {k: v for record in own for k, v in record.summary.table.confused_with.items()}
        listed = sorted(
            (key for key, (_, disagreement) in classes.items() if disagreement >= CONTRIBUTES and key in shares),
            key=lambda key: -classes[key][1],
        )
        small = [key for key in listed if shares.get(key, 0.0) < MAJORITY]
        if not alone and small:
            left_out |= dict.fromkeys(key for key in listed if key not in small)
            listed = small
        for key in listed[:most]:
            label, (alpha, disagreement) = key if alone else f"{name.removeprefix(begin)}: {key}", classes[key]
            of_map, of_all = f"{100 * shares.get(key, 0.0):.0f} %", f"{100 * disagreement:.0f} %"
            rows.append((f"  {label}", short(alpha), others.get(key, ""), of_map, of_all))
    if rows:
        room = width - CLASS_COLUMNS
        first = max(LEAST_CLASS, min(room * 2 // 3, max(len(row[0]) for row in rows)))
        second = max(len(CONFUSED), min(room - first, max(len(row[2]) for row in rows)))
        for label, alpha_, other, of_map, of_all in (CLASS_HEAD, *rows):
            line = f"  {_cut(label, first):<{first}}{alpha_:>5}   {_cut(other, second):<{second}}"
            yield f"{line}{of_map:>8}{of_all:>14}"
    if left_out:
        yield f"    {', '.join(left_out)}: half of the map or more, not listed"


def class_means(records: Sequence[Record]) -> dict[str, tuple[float, float]]:
    """Return alpha of each class and its share of the disagreement, macro means over scenes, where both are known."""
    known: dict[str, list[tuple[float, float]]] = {}
    for statistics in (record.statistics for record in records if record.statistics is not None):
        for row in () if statistics.cells is None else statistics.cells.classes:
            if not (math.isnan(row.alpha.value) or math.isnan(row.disagreement)):
                known.setdefault(row.name, []).append((row.alpha.value, row.disagreement))
    return {name: (macro_mean([a for a, _ in own]), macro_mean([d for _, d in own])) for name, own in known.items()}


def _outlying(records: Sequence[Record]) -> Iterator[str]:
    """Yield the frames that stand out; of several maps only where there are some."""
    for record in records:
        found = None if record.statistics is None else record.statistics.outlying_frames
        if found is None or (len(records) > 1 and not found.frames):
            continue
        scene = record.unit.scene if len({each.unit.scene for each in records}) > 1 else ""
        of = ", ".join(name for name in (scene, record.unit.model) if name) if len(records) > 1 else ""
        yield from textwrap.wrap(
            outlying_line(found, of), WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
        )


def _class_shares(records: Sequence[Record]) -> dict[str, float]:
    """Return the share of the map that each class dominates."""
    voxels: dict[str, int] = {}
    for row in (row for record in records for row in record.summary.table.classes):
        voxels[row.name] = voxels.get(row.name, 0) + row.voxels
    total = sum(record.summary.table.voxels for record in records)
    return {name: n / max(1, total) for name, n in voxels.items()}


def _checks(result: Result) -> Iterator[str]:
    """Yield the agreement of the backends: one line for each pair."""
    for pair in dict.fromkeys(row.backends for row in result.agreement):
        rows = [row for row in result.agreement if row.backends == pair]
        yield from textwrap.wrap(_check(pair, rows), WIDTH, initial_indent="  ", subsequent_indent="    ")
    for row in result.compared:
        relabelled = 100 * row.differences["label"].mean
        yield f"  {row.backends[1]} differs from {row.backends[0]} by design: {relabelled:.1f} % of the labels"


def _check(pair: tuple[str, str], rows: Sequence[Agreement]) -> str:
    checked, reference = pair
    voxels, bad = sum(row.voxels[-1] for row in rows), [row for row in rows if not row.agrees]
    share = f", {one_in(rows)}" if one_in(rows) else ""
    if not voxels and not bad:
        return f"{checked} was not checked against {reference}: no voxel was drawn{share}"
    drawn = f" drawn at random{share}" if share else ""
    if not bad:
        return f"checked {checked} against {reference} on {voxels:,} voxels{drawn}: equal"
    row = bad[0]
    only = f"; {sum(row.only_in):,} voxels in one only" if any(row.only_in) else ""
    return (
        f"{checked} and {reference} DISAGREE in {len(bad)} of {len(rows)} maps: {row.scene}, {row.model}:"
        f" {row.first or 'the agreement in summary.json shows where'}{only}"
    )


def _where(result: Result, out: Path | None, seconds: float | None) -> Iterator[str]:
    """Yield the time that the run took, and the files and commands that come next."""
    if seconds is not None:
        stages = {STAGE_NAMES.get(k, k): v for k, v in result.manifest.get("seconds", {}).items() if k != "all"}
        longest = sorted(stages, key=lambda name: -stages[name])[:3]
        parts = ", ".join(f"{name} {stages[name]:.0f}" for name in longest if stages[name] >= 1)
        here = result.manifest.get("units", {}).get("executor") == InProcess.name
        what = f"longest stages{'' if here else ', all workers'}"  # of all workers they may exceed the run's time
        yield f"  {seconds:.0f} s{f' ({what}: {parts})' if parts else ''}"
    if speeds := _speeds(result):
        yield from textwrap.wrap(f"predicted: {speeds}", WIDTH, initial_indent="  ", subsequent_indent="    ")
    if out is None:
        return
    if (out / "report.html").exists():
        yield f"  report  {out / 'report.html'}"
    if (out / "recording.rrd").exists():
        yield f"  viewer  semstab-bench view {out}"
    yield f"  more    semstab-bench show {out}"


def _speeds(result: Result) -> str:
    """Return the frames a second that each network predicts; '' where labels were read."""
    took: dict[str, list[float]] = {}
    for record in result.select():
        milliseconds = record.summary.stages_ms.get("network", math.nan)
        if milliseconds > 0:
            took.setdefault(record.unit.model, []).append(milliseconds)
    return ", ".join(f"{model} {1e3 / macro_mean(each):.3g} frames/s" for model, each in took.items())


# --- While it works, and what failed ---------------------------------------------------------------------------------

SECONDS_A_LINE = 10.0
"""The seconds between two lines of progress, where there is no terminal for a bar."""


class ProgressBar(Observer):
    """A progress bar for the whole run, in frames that are fused."""

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
        self._printed = time.monotonic()

    def run_started(self, plan: Plan, finished: Mapping[str, Record | RegionFlicker]) -> None:
        """Show the bar: the frames of every unit that is to be computed are its total."""
        units = plan.distinct()
        if finished:
            self.bar.console.print(f"finished earlier: {len(finished)} of {len(units)} units", style="dim")
        for scene in plan.scenes.values():
            if scene.depth_from is not None:
                self.notes.append(f"{scene.name}: depth from {scene.depth_from}")
            if scene.placed is not None:
                self.notes.append(f"{scene.name}: {scene.placed}")
        missing = units.keys() - finished.keys()
        self.begin(sum(len(units[identity].task.indices) for identity in missing))

    def begin(self, frames: int) -> None:
        """Show the bar, of so many frames."""
        self.bar.update(self.work, total=frames)
        if self.bar.console.is_interactive:
            self.bar.start()

    def geometry_checked(self, task: Task, verdict: Verdict) -> None:
        """Store an unclear or imprecise result until the run is finished."""
        if verdict.state in ("unclear", "imprecise"):
            self.notes.append(f"{task.scene.name}: {verdict.text}")

    def advanced(self, frames: int, what: str) -> None:
        """Advance the bar by a number of frames."""
        self.bar.update(self.work, advance=frames, description=what[:40])
        if not self.bar.console.is_interactive and time.monotonic() - self._printed > SECONDS_A_LINE:
            self._printed = time.monotonic()
            (work,) = self.bar.tasks
            self.bar.console.print(
                f"{what}: {work.completed:.0f} of {work.total:.0f} frames", markup=False, soft_wrap=True
            )

    def run_finished(self, result: Result) -> None:
        """Remove the bar, and print the notes on the scenes."""
        self.close()
        for note in self.notes if not result.failures else ():
            self.bar.console.print(note, style="dim", soft_wrap=True, markup=False)

    def close(self) -> None:
        """Remove the bar, also if the run was interrupted."""
        if self.bar.live.is_started:
            self.bar.stop()


def failure_lines(result: Result) -> Iterator[str]:
    """Yield one line for all failures with the same reason."""
    reasons: dict[str, list[Failure]] = {}
    for failure in result.failures:
        reasons.setdefault(failure.message, []).append(failure)
    for message, failures in reasons.items():
        units = list(dict.fromkeys(f"{failure.unit.scene}, {failure.unit.model}" for failure in failures))
        varied = [name for failure in failures if (name := _named_task(failure))]
        where = "" if message.startswith(units[0]) else f"{_first_of(units)}: "
        what = f"{_first_of(varied)}: " if varied else ""
        yield f"{where}{what}{message}"


def _first_of(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _named_task(failure: Failure) -> str:
    """Return the setting that was varied; an empty text for a unit at the base settings."""
    if failure.variation.sweep == BASE:
        return ""
    value = failure.variation.value
    return f"{failure.variation.sweep} {failure.unit.backend if value is None else f'{value:g}'}"


def print_answer(
    result: Result, console: Console, *, out: Path | None = None, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the answer of a run or a study: of a filter study the recommended filters."""
    if filter_studies(result):
        print_filter_study(result, console)
    else:
        print_summary(result, console, out=out, seconds=seconds, verbose=verbose)


FILTER_HEADS = (
    ("", "chan-", "flick", "", "next", "accu-", "", "same,", "", "", "", ""),
    ("filter", "ged %", "%", "alpha", "%", "racy", "mIoU", "wrong", "lag", "cov.", "ms", ""),
)
"""The two lines above the rows of filters: 'next' is the next frame, 'same, wrong' consistent but wrong labels."""


def print_filter_study(result: Result, console: Console) -> None:
    """Print the recommended filter for each model, then a row for each filter."""
    for study in filter_studies(result):
        for sentence in advice(study):
            console.print(sentence, highlight=False, markup=False)
        console.print(f"\n  filters for {study.model}", highlight=False, markup=False)
        rows = [filter_row(study, filtered) for filtered in (study.unfiltered, *study.filtered)]
        for row in (*FILTER_HEADS, *rows):
            *first, last = str(row[0]).split("+")
            for part in first:
                console.print(f"    {part}", highlight=False, markup=False)
            name = f" +{last}" if first else last
            digits = (2, 1, 3, 1, 1, 1, 1, 1, 0, 0)
            cells = [_number(c, d) if isinstance(c, float) else str(c) for c, d in zip(row[1:-1], digits, strict=True)]
            line = f"    {name:<17}{''.join(f'{cell:>6}' for cell in cells)}  {row[-1]}"
            console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)
    text = (
        "Alpha rises with any memory: it recommends nothing here. 'worse': less flicker, at the pixel or"
        " the location, and labels that are right less often."
    )
    console.print("\n".join(["", *textwrap.wrap(text, WIDTH)]), highlight=False, markup=False)
