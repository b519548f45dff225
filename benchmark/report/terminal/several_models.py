"""Several models on one scene: which one is more stable, and a row of numbers for each."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from semstab.core.console import wrapped
from semstab.data.measures import headlines
from semstab.data.records import Record, Result
from semstab.data.statistics import UNDEFINED, short
from semstab.metrics import CATEGORIES
from semstab.predict.prompts import VocabularyChanges
from semstab.report.means import ENOUGH
from semstab.report.ranking import order_of_models
from semstab.report.terminal.disagreement import class_lines, outlying_lines
from semstab.report.terminal.head import head_lines
from semstab.report.terminal.layout import common_beginning, cut, laid_out, legend, number, percent, percents
from semstab.report.terminal.one_model import share_of_wrong
from semstab.statistics.verdict import DANGEROUS


def columns() -> list[tuple[str, str]]:
    """Return the head and the unit or the population of each number in a model's row, see `row_of`."""
    measure_columns = [(m.title, "OP>=3") for m in headlines()]
    texts = [("model", ""), ("verdict", "p: probability"), (f"alpha ({UNDEFINED.interval_name})", "")]
    return [*texts, ("agree", "%"), ("flicker", "%"), *measure_columns, ("mIoU", "OP>=2")]


def row_of(record: Record, begin: str = "") -> list[str]:
    """Return a model's row under `columns`, its name without a beginning."""
    statistics = record.statistics
    level, alpha, agree = "-", "", math.nan
    if statistics is not None:
        level, alpha = str(statistics.verdict), statistics.headline.alpha.text()
        agree = 100 * statistics.agreeing
        if statistics.features is not None and statistics.features.alone:
            level, alpha, agree = "features", statistics.features.alpha.text(), math.nan
    recurrent = record.map_summary.recurrent
    means = {m: recurrent[m] if recurrent.voxels >= ENOUGH else math.nan for m in headlines()}
    measure_texts = [short(value, digits=m.digits[0]) for m, value in means.items()]
    flicker = record.image_space.compensated_flicker_percent
    agreeing, flickering, overlap = number(agree, 0), number(flicker, 1), short(miou(record), digits=3)
    return [record.unit.model.removeprefix(begin), level, alpha, agreeing, flickering, *measure_texts, overlap]


def miou(record: Record) -> float:
    """Return the mIoU of the fused labels seen twice or more; NaN without ground truth."""
    statistics = record.statistics
    return math.nan if statistics is None or statistics.correctness is None else statistics.correctness.miou_op2.value


def names_text(record: Record) -> str:
    """Return how many names of a vocabulary are in use: '19 names, worth 6.2 of equal share'; '' of others."""
    spots = None if record.statistics is None else record.statistics.spots
    if "@" not in record.unit.model or spots is None:
        return ""
    return f"{record.map_summary.K} names, worth {spots.effective_classes:.1f} of equal share"


OF_MAP = "voxels"
MOST_MAPS = 2
"""The most maps whose shares are printed beneath the rows; tables and report have all."""


def several_models(result: Result, records: Sequence[Record], width: int) -> Iterator[str]:
    """Yield which model is more stable where that is known, then a row for each model."""
    yield from head_lines(result.scenes[0], result, records, width)
    for text in (sentences := list(order_of_models(result))):
        yield from wrapped(text)
    if sentences:
        yield ""
    has_truth = any(not math.isnan(miou(record)) for record in records)
    row_columns, begin = columns() if has_truth else columns()[:-1], common_beginning([*result.models])
    heads, rows = [*zip(*row_columns, strict=True)], [row_of(record, begin)[: len(row_columns)] for record in records]
    yield from laid_out([*heads, *rows], width)
    if begin:
        yield f"  names of models begin with '{begin}'"
    if any(record.map_summary.recurrent.voxels < ENOUGH for record in records):
        titles = ", ".join(measure.title for measure in headlines())
        yield from wrapped(f"-: fewer than {ENOUGH:,} voxels were seen in 3 frames or more, too few for {titles}")
    yield from legend(has_truth=has_truth)
    if len(records) <= MOST_MAPS and any(record.map_summary.categories for record in records):
        yield from ("", *_map_shares(records, width, begin), "")
    told = [record for record in records if not _is_change_of(record, [*result.models])]
    yield from class_lines(told, width, begin)
    yield from outlying_lines(told)
    yield from _wrong_lines(records)
    if len(told) < len(records):
        yield from wrapped("what each change of names does: semstab-bench show RUN prompts")
    for record in told:
        statistics = record.statistics
        if statistics is None:
            continue
        ranges = "" if statistics.told_ranges is None else statistics.told_ranges.text
        merged = "" if statistics.groupings is None else statistics.groupings.text
        meaning = statistics.spots.meaning if statistics.spots is not None else None
        features = "" if statistics.features is None else statistics.features.text
        names = names_text(record)
        texts = (
            statistics.verdict.difference,
            names,
            ranges,
            merged,
            "" if meaning is None else meaning.text,
            features,
        )
        for text in filter(None, (*statistics.moving_lines, *texts)):
            yield from wrapped(f"{record.unit.model}: {text}")
    yield ""


def _is_change_of(record: Record, models: Sequence[str]) -> bool:
    """Return whether it is a vocabulary of the run with other names."""
    full, changes = VocabularyChanges.of_model(record.unit.model)
    return bool(changes) and full in models


def _wrong_lines(records: Sequence[Record]) -> Iterator[str]:
    """Yield the share of the consistent locations that are wrong, of each model; nothing without ground truth."""
    assessed = [(record.unit.model, stats) for record in records if (stats := record.statistics) is not None]
    shares = {model: share_of_wrong(stats) for model, stats in assessed if stats.verdict.level != "no verdict"}
    if texts := [f"{model} {share}" for model, share in shares.items() if share]:
        misleads = any(stats.verdict.level == "misleading" for _, stats in assessed)
        more = f"; more than {percent(DANGEROUS)} is MISLEADING: do not take agreement for truth" if misleads else ""
        yield from wrapped(f"wrong class although frames agree: {', '.join(texts)} of such voxels{more}")


def _map_shares(records: Sequence[Record], width: int, begin: str) -> Iterator[str]:
    """Yield a row for each map: how much of it is stable, uncertain, drifting, and seen too rarely to tell."""
    with_categories = [record for record in records if record.map_summary.categories]
    rows = [
        percents([record.map_summary.categories[name] for name in reversed(CATEGORIES)]) for record in with_categories
    ]
    heads = ("stable", "uncertain", "drifting", "in less than 3 frames")
    models = [record.unit.model.removeprefix(begin) for record in with_categories]
    names = [cut(name, width - sum(map(len, heads)) - 2 * len(heads) - 2) for name in models]
    first = max(map(len, (OF_MAP, *names)))
    for name, row in ((OF_MAP, heads), *zip(names, rows, strict=True)):
        cells = (f"{share:>{len(head)}}" for share, head in zip(row, heads, strict=True))
        yield "  ".join(["", f"{name:<{first}}", *cells])
