"""A table apart from its format: columns that know how their numbers are printed, and rows in groups."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from semstab.model.measures import Quantity
from semstab.outputs.averages import Spread
from semstab.statistics import Estimate

UNDEFINED = "--"
"""What stands in print where a number is undefined; in JSON it is null, in CSV an empty field."""

Cell = str | int | float | Spread | Estimate
Row = tuple[Cell, ...]


@dataclass(frozen=True)
class Column:
    """A column: its key in CSV and JSON, its header in print, the decimals of its numbers (None: text).

    better      which way is good
    signed      a positive number has its sign as well
    scientific  in powers of ten: '2e-16'
    over        the heading that it shares with its neighbours
    """

    key: str
    header: str
    digits: int | None = None
    better: Literal["", "higher", "lower"] = ""
    signed: bool = False
    scientific: bool = False
    over: str = ""

    @classmethod
    def of(cls, quantity: Quantity, *, compared: bool = False, prefix: str = "", over: str = "") -> Column:
        """Of a measure: with the decimals of a summary, or of a comparison."""
        digits = quantity.digits[compared]
        return cls(prefix + quantity.key, quantity.title, digits, quantity.better, over=over)

    def number(self, value: float) -> str:
        """The rounded number; UNDEFINED where there is none."""
        if math.isnan(value):
            return UNDEFINED
        if self.scientific and value:
            return f"{value:.{self.digits}e}"
        rounded = round(value, self.digits) + 0.0  # -0.0 + 0.0 is 0.0
        return f"{rounded:{'+' if self.signed and rounded else ''},.{self.digits}f}"

    def text(self, cell: Cell) -> str:
        """The cell in print: 'road', '286,565', '0.957', '0.957 ± 0.002' over repeats, '0.957 (0.951, 0.962)'."""
        if isinstance(cell, str):
            return cell
        if isinstance(cell, Estimate):
            ends = "" if math.isnan(cell.low) else f" ({self.number(cell.low)}, {self.number(cell.high)})"
            return self.number(cell.value) + ends
        if not isinstance(cell, Spread):
            return self.number(cell)
        spread = "" if math.isnan(cell.sd) else f" ± {cell.sd:,.{self.digits}f}"
        return self.number(cell.mean) + spread


@dataclass(frozen=True)
class Group:
    """Rows that belong together under a name, with a last row that sums them up, where there is one."""

    name: str
    rows: tuple[Row, ...]
    total: Row | None = None


@dataclass(frozen=True)
class Table:
    """A table of the study.

    name     of its files
    caption  what the numbers are, and over what the means run
    by       what the groups are ('backbone'), the leading column of CSV and JSON; '' for one group without a name
    """

    name: str
    title: str
    caption: str
    columns: tuple[Column, ...]
    groups: tuple[Group, ...]
    by: str = "backbone"

    def rows(self) -> Iterator[tuple[str, Row]]:
        """Each row, totals too, with the name of its group."""
        for group in self.groups:
            for row in (*group.rows, *([group.total] if group.total else [])):
                yield group.name, row
