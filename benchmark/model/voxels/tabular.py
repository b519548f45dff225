"""Columns as tables of Arrow and pandas, and the small tables that a notebook shows."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.errors import MissingDependencyError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Cell = str | int | float


def to_arrow(columns: Mapping[str, Any]) -> pa.Table:
    """The columns; what is undefined is null."""
    import pyarrow as pa

    return pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})


def to_pandas(columns: Mapping[str, Any]) -> pd.DataFrame:
    """The columns; names are categories. Raises MissingDependencyError without pandas."""
    try:
        import pandas  # noqa: F401  what Arrow needs for it
    except ImportError as error:
        raise MissingDependencyError("data frames need pandas; pip install pandas, or take to_arrow()") from error
    return to_arrow(columns).to_pandas()


def named(rows: npt.NDArray[np.integer[Any]], names: Sequence[str]) -> pa.DictionaryArray:
    """A column of names by their rows."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(rows.astype(np.int32), list(names))


def as_html(title: str, headers: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """A table with a caption; whatever names hold is shown as it is."""
    head = "".join(f"<th>{html.escape(header)}</th>" for header in headers)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(_text(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    caption = f'<caption style="text-align: left; white-space: nowrap">{html.escape(title)}</caption>'
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def number(value: float, digits: int) -> str:
    """With so many decimals; '-' where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _text(cell: Cell) -> str:
    return f"{cell:,}" if isinstance(cell, int) else str(cell)
