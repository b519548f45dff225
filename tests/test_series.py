"""The time series of a unit, kept as numbers, is the rows that went in."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semstab.engine.series import FrameRow, Series, to_csv
from semstab.model.results import FrameReport

counts, numbers = st.integers(0, 2**53), st.floats()
reports = st.builds(
    FrameReport,
    **{field.name: counts if field.type == "int" else numbers for field in dataclasses.fields(FrameReport)},
)
rows = st.builds(FrameRow, reports, st.none() | st.floats(allow_nan=False), *[numbers] * 5, counts, numbers, numbers)


@given(st.lists(rows, max_size=5))
@settings(max_examples=20, deadline=None)
def test_rows_come_out_as_they_went_in(given_rows) -> None:
    series = Series()
    for row in given_rows:
        series.append(row)
    assert repr(list(series)) == repr(given_rows)
    assert to_csv(series) == to_csv(given_rows)
    assert repr(list(Series(series.numbers))) == repr(given_rows)


def test_a_row_takes_a_few_numbers() -> None:
    series = Series()
    for _ in range(1000):
        series.append(FrameRow(FrameReport(1, 2, 3, 4, 0.5, 0.1, 7), None, np.nan))
    assert series.numbers.nbytes == 1000 * 21 * 8
