"""The remedies in the terminal: a table within 80 columns, and what to use."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from semstab.model.records import Result
from semstab.outputs.remedies import Remedies, Remedy, advice, remedies
from semstab.outputs.tables.remedies import COLUMNS, marked, row

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
    name, *numbers = row(remedy)
    columns = zip(COLUMNS[1:], DIGITS, numbers, strict=True)
    shown = [f"{value:.{digits}f}" if value == value else "-" for _, digits, value in columns]  # noqa: PLR0124
    return [escape(str(name)).replace("+", "\n +"), *shown]
