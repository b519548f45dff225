"""Define a table apart from its format: columns that print their numbers, and rows in groups."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from semstab.core.files import csv_text
from semstab.data.measures import Quantity
from semstab.data.statistics import without_zero
from semstab.report.means import RepeatSpread
from semstab.statistics import Estimate

UNDEFINED = "--"
"""The text of an undefined number in print; in JSON it is null, in CSV an empty field."""

ALL_VOXELS, OF_ROW = "All voxels", "Of these voxels"
"""Headings over columns of measures whose population is all voxels, or the population that the row names."""

POPULATIONS = {ALL_VOXELS: "_all", OF_ROW: "", "OP>=2": "_op2", "OP>=3": "_op3"}
"""Headings over columns of measures, and the suffix that their keys have for it."""

SHARE_DIGITS = 3
"""Least decimals of measures from 0 to 1; metres, percent and counts have fewer."""

Cell = str | int | float | RepeatSpread | Estimate
Row = tuple[Cell, ...]


@dataclass(frozen=True)
class Column:
    """A column: its key in CSV and JSON, its header in print, the decimals of its numbers (None: text).

    Attributes:
        better: The direction in which numbers are better.
        signed: True to print the sign of positive numbers, too.
        scientific: True to print powers of ten: '2e-16'.
        over: The heading that it shares with its neighbours.
    """

    key: str
    header: str
    digits: int | None = None
    better: Literal["", "higher", "lower"] = ""
    signed: bool = False
    scientific: bool = False
    over: str = ""

    @classmethod
    def for_quantity(cls, quantity: Quantity, *, compared: bool = False, over: str = "") -> Column:
        """Return the column of a measure, with the decimals of a summary or of a comparison.

        Its header holds its population, unless the heading `over` it does; its key does, unless each row has its own.
        """
        digits, title = quantity.digits[compared], quantity.title if over else quantity.full_title
        key = quantity.key + POPULATIONS[over] if over else quantity.name
        return cls(key, title, digits, quantity.better, over=over)

    def number(self, value: float) -> str:
        """Return the rounded number; UNDEFINED for NaN."""
        if math.isnan(value):
            return UNDEFINED
        if self.scientific and value:
            return f"{value:.{self.digits}e}"
        rounded = round(value, self.digits) + 0.0  # -0.0 + 0.0 is 0.0
        return f"{rounded:{'+' if self.signed and rounded else ''},.{self.digits}f}"

    def text(self, cell: Cell) -> str:
        """Return the cell in print.

        'road', '286,565', '0.957', '0.957 ± 0.002' over repeats, '0.957 (0.951, 0.962)'.
        """
        if isinstance(cell, str):
            return cell
        if isinstance(cell, Estimate):
            ends = "" if math.isnan(cell.low) else f" ({self.number(cell.low)}, {self.number(cell.high)})"
            return self.number(cell.value) + ends
        if not isinstance(cell, RepeatSpread):
            return self.number(cell)
        spread = "" if math.isnan(cell.sd) else f" ± {cell.sd:,.{self.digits}f}"
        return self.number(cell.mean) + spread

    def short_text(self, cell: Cell) -> str:
        """Return the cell on a screen: numbers of three decimals or more, which have no unit, without the leading 0."""
        text = self.text(cell)
        return without_zero(text) if self.digits is not None and self.digits >= SHARE_DIGITS else text


@dataclass(frozen=True)
class Group:
    """A group of rows under a name, with or without a last row that sums them up."""

    name: str
    rows: tuple[Row, ...]
    total: Row | None = None


@dataclass(frozen=True)
class Table:
    """A table of the study.

    Attributes:
        name: The name of its files.
        caption: A description of the numbers, and of the data over which means run.
        by: The kind of the groups ('model'), the leading column of CSV and JSON; '' for one group without a name.
        benchmark: The benchmark whose numbers these are, the last column of CSV; '' for none.
    """

    name: str
    title: str
    caption: str
    columns: tuple[Column, ...]
    groups: tuple[Group, ...]
    by: str = "model"
    benchmark: str = ""

    def only(self, *keys: str) -> Table:
        """Return the table with these columns alone."""
        positions = [k for k, column in enumerate(self.columns) if column.key in keys]

        def cut(row: Row) -> Row:
            return tuple(row[k] for k in positions)

        groups = tuple(Group(g.name, tuple(map(cut, g.rows)), g.total and cut(g.total)) for g in self.groups)
        return dataclasses.replace(self, columns=tuple(self.columns[k] for k in positions), groups=groups)

    def printed(self) -> Table:
        """Return the table without the columns that are empty in every row, as print shows it; files keep them."""
        rows = [row for _, row in self.rows()]
        empty = {
            column.key
            for k, column in enumerate(self.columns)
            if k > 0 and rows and all(column.text(row[k]) in ("", UNDEFINED) for row in rows)
        }
        return self.only(*(column.key for column in self.columns if column.key not in empty)) if empty else self

    def rows(self) -> Iterator[tuple[str, Row]]:
        """Yield each row, totals too, with the name of its group."""
        for group in self.groups:
            for row in (*group.rows, *([group.total] if group.total else [])):
                yield group.name, row


# A writer for each format: CSV, Markdown, LaTeX (booktabs) and JSON.

ARROWS = {"higher": "↑", "lower": "↓", "": ""}
LATEX_WIDTHS = (
    (53, "table", r"\small"),
    (60, "table", r"\footnotesize"),
    (112, "table*", r"\small"),
    (122, "table*", r"\footnotesize"),
)
"""The most characters in one column of the page, or in both; a wider table is scaled to both (graphicx)."""


def to_csv(table: Table) -> str:
    """Return comma-separated, rounded, without thousands separators; an undefined number is an empty field."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = [_csv_parts([row[k] for _, row in table.rows()]) for k in range(len(table.columns))]
    keys = [[f"{column.key}{part}" for part in names] for column, names in zip(table.columns, parts, strict=True)]
    last = [csv_text(table.benchmark)] if table.benchmark else []
    writer.writerow([*_leading(table, table.by), *itertools.chain(*keys), *(["benchmark"] if last else [])])
    for group, row in table.rows():
        cells = (_csv_cells(column, cell, names) for column, cell, names in zip(table.columns, row, parts, strict=True))
        writer.writerow([*_leading(table, group), *itertools.chain(*cells), *last])
    return text.getvalue()


def to_markdown(table: Table) -> str:
    """Return a GitHub table under its title, with the caption below."""
    table = table.printed()
    headers = [_markdown(" ".join(filter(None, (c.over, c.header, ARROWS[c.better])))) for c in table.columns]
    rule = ["---" if column.digits is None else "---:" for column in table.columns]
    lines = [f"### {_markdown(table.title)}", "", _pipes(headers), _pipes(rule)]
    for heading, rows in sections(table):
        if heading:
            lines.append(_pipes([f"**{_markdown(heading)}**", *[""] * (len(table.columns) - 1)]))
        lines += [_pipes([_markdown(cell) for cell in row]) for row in rows]
    return "\n".join([*lines, "", _markdown(table.caption), ""])


def to_latex(table: Table) -> str:
    """Return a float with booktabs rules (it needs the package booktabs), in the layout of the paper's tables."""
    table = table.printed()
    width = _width(table)
    fitting = [kind[1:] for kind in LATEX_WIDTHS if width <= kind[0]]
    environment, size = fitting[0] if fitting else ("table*", r"\footnotesize")
    left, right = ("", "") if fitting else (r"\resizebox{\textwidth}{!}{", "}")
    blocks = []
    for heading, rows in sections(table):
        title = [rf"\multicolumn{{{len(table.columns)}}}{{l}}{{\emph{{{_latex(heading)}}}}} \\"] if heading else []
        blocks.append("\n".join([*title, *(" & ".join(_latex(cell) for cell in row) + r" \\" for row in rows)]))
    return "\n".join(
        [
            rf"\begin{{{environment}}}[t]",
            r"\centering",
            rf"\caption{{{_latex(table.title.removesuffix('.') + '.')} {_latex(table.caption)}}}",
            rf"\label{{tab:{table.name}}}",
            size,
            r"\setlength{\tabcolsep}{4pt}",
            left
            + rf"\begin{{tabular}}{{{''.join('l' if column.digits is None else 'r' for column in table.columns)}}}",
            r"\toprule",
            *_latex_headers(table),
            r"\midrule",
            "\n\\midrule\n".join(blocks),
            r"\bottomrule",
            r"\end{tabular}" + right,
            rf"\end{{{environment}}}",
            "",
        ]
    )


def to_terminal(table: Table, width: int = 0) -> str:
    """Return title, rows and caption for a terminal, as wide as the rows need, or folded to `width` columns."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as Grid

    table = table.printed()
    grid = Grid(title=escape(table.title), title_justify="left", box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for column in table.columns:
        header = "\n".join(filter(None, (column.over, f"{column.header} {ARROWS[column.better]}".strip())))
        number = column.digits is not None
        grid.add_column(
            escape(header), justify="right" if number else "left", vertical="bottom", no_wrap=number, overflow="fold"
        )
    for heading, rows in sections(table, Column.short_text):
        if heading:
            grid.add_row(f"[bold]{escape(heading)}[/]")
        for row in rows:
            grid.add_row(*map(escape, row))
    text = io.StringIO()
    console = Console(file=text, width=width or 400, color_system=None)
    console.print(grid)
    lines = [line.rstrip() for line in text.getvalue().splitlines()]
    return "\n".join([*lines, *textwrap.wrap(table.caption, width or 80)])


def to_json(table: Table) -> dict[str, Any]:
    """Return the JSON object, in full precision.

    A cell over repeats is {mean, sd, repeats}, a cell with an interval {value, low, high}.
    """
    return {
        "name": table.name,
        "title": table.title,
        "caption": table.caption,
        "rows": [
            ({table.by: group} if table.by else {})
            | {column.key: _json_cell(cell) for column, cell in zip(table.columns, row, strict=True)}
            for group, row in table.rows()
        ],
    }


def sections(table: Table, text: Callable[[Column, Cell], str] = Column.text) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield the rows between two rules: the rows of a group under its name, then its total.

    A single group has no heading. `text` prints a cell.
    """

    def cells(row: tuple[Cell, ...]) -> list[str]:
        return [text(column, cell) for column, cell in zip(table.columns, row, strict=True)]

    for group in table.groups:
        yield group.name if len(table.groups) > 1 else "", [cells(row) for row in group.rows]
        if group.total is not None:
            yield "", [cells(group.total)]


def _json_cell(cell: Cell) -> Any:
    return dataclasses.asdict(cell) if isinstance(cell, RepeatSpread | Estimate) else cell


def _leading(table: Table, cell: str) -> list[str]:
    """Return the leading column, where the groups have names."""
    return [csv_text(cell)] if table.by else []


def _csv_parts(cells: Sequence[Cell]) -> list[str]:
    """Return the suffixes of the fields of a column.

    Its own field comes first, then that of the standard deviation over repeats, or those of the interval.
    """
    if any(isinstance(cell, RepeatSpread) for cell in cells):
        return ["", "_sd"]
    return ["", "_low", "_high"] if any(isinstance(cell, Estimate) for cell in cells) else [""]


def _csv_cells(column: Column, cell: Cell, parts: Sequence[str]) -> list[str]:
    if isinstance(cell, str):
        return [csv_text(cell), *[""] * (len(parts) - 1)]
    if isinstance(cell, Estimate):
        values = [cell.value, cell.low, cell.high]
    else:
        values = [cell.mean, cell.sd] if isinstance(cell, RepeatSpread) else [cell, math.nan, math.nan]
    return ["" if math.isnan(value) else column.number(value).replace(",", "") for value in values[: len(parts)]]


def _pipes(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _markdown(text: str) -> str:
    """Return text that Markdown shows unchanged."""
    text = re.sub(r"([\\`*_\[\]|#~])", r"\\\1", relations(" ".join(text.split())))
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def relations(text: str) -> str:
    """Return text with the signs for 'at most' and 'at least', where a format has them."""
    return text.replace("<=", "≤").replace(">=", "≥")


def _width(table: Table) -> int:
    """Return the number of characters of the widest line, with two for the space between columns."""
    cells = [
        [column.header, *(column.text(row[k]) for _, row in table.rows())] for k, column in enumerate(table.columns)
    ]
    return sum(2 + max(map(len, column)) for column in cells)


def _latex_headers(table: Table) -> list[str]:
    """Return the headers, under a line of the headings that columns share, if any."""
    headers = " & ".join(_latex(f"{column.header} {ARROWS[column.better]}") for column in table.columns) + r" \\"
    if not any(column.over for column in table.columns):
        return [headers]
    shared, rules, first = [], [], 1
    for over, columns in itertools.groupby(table.columns, lambda column: column.over):
        width = len(list(columns))
        shared.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex(over)}}}")
        rules += [rf"\cmidrule(lr){{{first}-{first + width - 1}}}"] if over else []
        first += width
    return [" & ".join(shared) + r" \\", " ".join(rules), headers]


_LATEX = {
    "\N{MINUS SIGN}": "$-$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": "$<$", ">": "$>$", "≤": r"$\leq$", "≥": r"$\geq$",
    "±": r"$\pm$", "√": r"$\surd$", "°": r"$^\circ$", "Δ": r"$\Delta$", "·": r"$\cdot$", '"': "''", "|": r"$|$",
}  # fmt: skip


def _latex(text: str) -> str:
    """Return text that LaTeX shows unchanged; a hyphen before a number becomes a minus sign, and ± has no spaces."""
    text = re.sub(r"(?<=\d) ± (?=\d)", "±", relations(" ".join(text.split())))
    text = re.sub(r"(^|(?<=\d )\(|, )-(?=\d)", "\\1\N{MINUS SIGN}", text)
    return "".join(_LATEX.get(character, character) for character in text)


TEXT_WRITERS: dict[str, Callable[[Table], str]] = {"csv": to_csv, "md": to_markdown, "tex": to_latex}
