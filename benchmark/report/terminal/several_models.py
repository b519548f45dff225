"""Several models or scenes: which one is more stable, and a row of numbers for each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from semstab.data.measures import headlines
from semstab.data.records import Record, Result
from semstab.data.statistics import UNDEFINED, short
from semstab.metrics import CATEGORIES
from semstab.report.means import ENOUGH
from semstab.report.ranking import answers
from semstab.report.terminal.disagreement import class_lines, outlying_lines
from semstab.report.terminal.head import head_lines
from semstab.report.terminal.layout import LEVELS, common_beginning, cut, laid_out, number, percents, wrapped


def columns() -> list[tuple[str, str]]:
    """Return the head and the unit of each number in a model's row, see `row_of`."""
    shown = [(measure.title, measure.unit or "OP>=3") for measure in headlines()]
    texts = [("model", ""), ("verdict", ""), (f"alpha ({UNDEFINED.of})", "")]
    return [*texts, ("agree", "%"), ("flicker", "%"), *shown, ("mIoU", "%")]


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
    agreeing, flickering, overlap = number(agree, 0), number(flicker, 1), number(100 * miou(record), 1)
    return [run.unit.model.removeprefix(begin), level, alpha, agreeing, flickering, *shown, overlap]


def miou(record: Record) -> float:
    """Return the mIoU of the fused labels seen twice or more; NaN without ground truth."""
    statistics = record.summary.statistics
    return math.nan if statistics is None or statistics.correctness is None else statistics.correctness.miou.value


OF_MAP = "of each map"
MOST_MAPS = 2
"""The most maps whose shares are printed beneath the rows; tables and report have all."""


def several_models(result: Result, records: Sequence[Record], width: int) -> Iterator[str]:
    """Yield which model is more stable where that is known, then a row for each scene and model."""
    listed = ", ".join(result.scenes[:3]) + (", ..." if len(result.scenes) > 3 else "")
    yield from head_lines(listed, result, [record.summary for record in records], width)
    for text in (told := list(answers(result))):
        yield from wrapped(text)
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
    yield from class_lines(records, width, begin)
    yield from outlying_lines(records)
    for record in records:
        statistics = record.summary.statistics
        if statistics is None:
            continue
        ranges = "" if statistics.told_ranges is None else statistics.told_ranges.text
        where = f" in {record.unit.scene}" if len(result.scenes) > 1 else ""
        for text in filter(None, (statistics.verdict.difference, ranges)):
            yield from wrapped(f"{record.unit.model}{where}: {text}")
    yield ""


def _map_shares(records: Sequence[Record], width: int, begin: str) -> Iterator[str]:
    """Yield a row for each map: how much of it is stable, uncertain, drifting, and seen too rarely to tell."""
    known = [record for record in records if record.summary.table.categories]
    rows = [percents([record.summary.table.categories[name] for name in reversed(CATEGORIES)]) for record in known]
    heads = ("stable", "uncertain", "drifting", "seen less than 3 times")
    scenes = len({record.unit.scene for record in known}) > 1
    models = [record.unit.model.removeprefix(begin) for record in known]
    named = [f"{each.unit.scene}, {name}" if scenes else name for each, name in zip(known, models, strict=True)]
    names = [cut(name, width - sum(map(len, heads)) - 2 * len(heads) - 2) for name in named]
    first = max(map(len, (OF_MAP, *names)))
    for name, row in ((OF_MAP, heads), *zip(names, rows, strict=True)):
        cells = (f"{share:>{len(head)}}" for share, head in zip(row, heads, strict=True))
        yield "  ".join(["", f"{name:<{first}}", *cells])
