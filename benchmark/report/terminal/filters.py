"""The answer of a filter study: the recommended filter, and a row for each."""

from __future__ import annotations

from rich.console import Console

from semstab.core.console import WIDTH, wrapped
from semstab.data.records import Result
from semstab.data.statistics import short
from semstab.report.filter_study import advice, filter_studies
from semstab.report.tables.filters import row as filter_row
from semstab.report.tables.table import Cell
from semstab.report.terminal.layout import number

ALPHA_DIGITS = 3

FILTER_HEADS = (
    ("", "chan-", "flick", "", "next", "accu-", "", "same,", "", "", "", ""),
    ("filter", "ged %", "%", "alpha", "%", "racy", "mIoU", "wrong", "lag", "cov.", "ms", ""),
)
"""The two lines above the rows of filters: 'next' is the next frame, 'same, wrong' consistent but wrong labels."""


def _cell(value: Cell, digits: int) -> str:
    """Return a cell in print; alpha, the one with three digits, without the 0 before its point."""
    if not isinstance(value, float):
        return str(value)
    return short(value, digits=digits) if digits == ALPHA_DIGITS else number(value, digits)


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
            cells = [_cell(c, d) for c, d in zip(row[1:-1], digits, strict=True)]
            line = f"    {name:<17}{''.join(f'{cell:>6}' for cell in cells)}  {row[-1]}"
            console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)
    text = (
        "Alpha rises with any memory: it recommends nothing here. 'worse': less flicker, at the pixel or"
        " the location, and labels that are right less often."
    )
    console.print("\n".join(["", *wrapped(text, WIDTH, begin="", hanging=0)]), highlight=False, markup=False)
