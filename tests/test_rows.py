"""Rows of numbers are what went in."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.core.arrays import GrowingRows


@pytest.mark.parametrize("count", [0, 1, 300])
def test_rows_are_what_went_in(count) -> None:
    expected = np.random.default_rng(0).random((count, 3))
    rows = GrowingRows(3, expected[:7])
    for row in expected[7:]:
        rows.append(row)
    columns = [rows.column(k) for k in range(3)]
    rows.append([1.0, None, 3.0])
    np.testing.assert_array_equal(columns, expected.T)  # a column that was taken before does not change
    assert [rows.row(k) for k in range(count)] == rows.table()[:-1].tolist() == expected.tolist()
    assert str(rows.row(-1)) == str(rows.row(count)) == "[1.0, nan, 3.0]"
    with pytest.raises(IndexError):
        rows.row(count + 1)
