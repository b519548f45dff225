"""Rows of numbers are what went in."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from semstab.core.rows import FIRST, Rows


@pytest.mark.parametrize("count", [0, 1, FIRST, 5 * FIRST + 1])
def test_rows_are_what_went_in(count) -> None:
    expected = np.random.default_rng(0).random((count, 3))
    appended, extended = Rows(3), Rows(3, expected[:7])
    for row in expected:
        appended.append(row)
    extended.extend(expected[7:])
    for rows in (appended, extended, Rows(3, expected), pickle.loads(pickle.dumps(appended))):
        assert len(rows) == count
        assert list(rows) == expected.tolist()
        assert [rows.row(k) for k in range(-count, count)] == [*expected.tolist(), *expected.tolist()]
        for k in range(3):
            np.testing.assert_array_equal(rows.column(k), expected[:, k])
        for first, step in ((0, 1), (0, 3), (5, 1), (13, 20), (500, 1)):
            np.testing.assert_array_equal(rows.table(first, step), expected[first::step])
        rows.append([1.0, 2.0, 3.0])
        assert rows.row(-1) == [1.0, 2.0, 3.0]
        with pytest.raises(IndexError):
            rows.row(count + 1)


def test_a_column_taken_earlier_does_not_change() -> None:
    rows = Rows(2, np.zeros((3, 2)))
    before = rows.column(0)
    rows.put(0, np.arange(3.0))
    assert before.tolist() == [0, 0, 0]
    assert rows.table().tolist() == [[0, 0], [1, 0], [2, 0]]
