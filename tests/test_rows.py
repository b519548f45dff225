"""Rows of numbers are what went in."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from semstab.core.rows import Rows


@pytest.mark.parametrize("count", [0, 1, 321])
def test_rows_are_what_went_in(count) -> None:
    expected = np.random.default_rng(0).random((count, 3))
    appended, continued = Rows(3), Rows(3, expected[:7])
    for row in expected:
        appended.append(row)
    for row in expected[7:]:
        continued.append(row)
    for rows in (appended, continued, Rows(3, expected), pickle.loads(pickle.dumps(appended))):
        assert len(rows) == count
        assert list(rows) == expected.tolist()
        assert [rows.row(k) for k in range(-count, count)] == [*expected.tolist(), *expected.tolist()]
        np.testing.assert_array_equal(rows.table(), expected)
        columns = [rows.column(k) for k in range(3)]
        rows.append([1.0, 2.0, 3.0])
        np.testing.assert_array_equal(columns, expected.T)  # a column that was taken before does not change
        assert rows.row(-1) == [1.0, 2.0, 3.0]
        with pytest.raises(IndexError):
            rows.row(count + 1)
