"""The time series of a unit, kept as numbers, is the rows that went in."""

from __future__ import annotations

import csv
import dataclasses
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semstab.data.results import FrameReport
from semstab.engine.series import COLUMNS, OF_FRAMES, FrameRow, Series

counts, numbers = st.integers(0, 2**53), st.floats()
reports = st.builds(
    FrameReport, **{field.name: counts if field.type == "int" else numbers for field in dataclasses.fields(FrameReport)}
)
rows = st.builds(FrameRow, reports, st.none() | st.floats(allow_nan=False), *[numbers] * 7, counts, numbers, numbers)


@given(st.lists(rows, max_size=5))
@settings(max_examples=20, deadline=None)
def test_rows_come_out_as_they_went_in(given_rows) -> None:
    series = Series()
    for row in given_rows:
        series.append(row)
    assert repr(list(series)) == repr([series[k] for k in range(len(series))]) == repr(given_rows)
    assert repr(series.drift.tolist()) == repr([row.report.drift for row in given_rows])
    assert repr(list(Series(series.numbers))) == repr(given_rows)
    with tempfile.TemporaryDirectory() as folder:
        series.save_csv(Path(folder) / "series.csv")
        header, *lines = csv.reader((Path(folder) / "series.csv").read_text().splitlines())
    assert header == [*(column.key for column in COLUMNS), *OF_FRAMES, "name"]
    written = [[*row.cells().values(), *[None] * len(OF_FRAMES), row.report.frame] for row in given_rows]
    assert lines == [["" if cell is None else str(cell) for cell in cells] for cells in written]


def test_a_row_takes_a_few_hundred_bytes() -> None:
    series, row = Series(), FrameRow(FrameReport(1, 2, 3, 4, 0.5, 0.1, 7), None, np.nan)
    count = 4097
    tracemalloc.start()
    for _ in range(count):
        series.append(row)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < 2 * 23 * 8 * count + 10_000
    assert series.numbers.shape == (count, 23)
    assert len(series) == count
    assert series[-1].report.map_voxels == series[0].report.map_voxels == 7
