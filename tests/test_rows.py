"""Rows of numbers are what went in, in memory or in a file, and memory is bounded however many they are."""

from __future__ import annotations

import pickle
import tempfile
import tracemalloc

import numpy as np
import pytest

from semstab.core import rows
from semstab.core.rows import Rows


@pytest.fixture
def few_kept(monkeypatch) -> None:
    """Four blocks of eight rows in memory at most."""
    monkeypatch.setattr(rows, "BLOCK", 8)
    monkeypatch.setattr(rows, "KEPT", 4)


def disk_is_full(*_arguments: object) -> int:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("count", [0, 1, 8, 9, 31, 33, 100])
@pytest.mark.usefixtures("few_kept")
def test_rows_are_what_went_in(count) -> None:
    expected = np.random.default_rng(0).random((count, 3))
    found = Rows(3)
    for row in expected:
        found.append(row)
    for each in (found, Rows(3, expected), pickle.loads(pickle.dumps(found))):
        assert len(each) == count
        assert list(each) == expected.tolist()
        assert [each.row(k) for k in range(-count, count)] == [*expected.tolist(), *expected.tolist()]
        for k in range(3):
            np.testing.assert_array_equal(each.column(k), expected[:, k])
        for first, step in ((0, 1), (0, 3), (5, 1), (13, 20), (200, 1)):
            np.testing.assert_array_equal(each.table(first, step), expected[first::step])
        each.append([1.0, 2.0, 3.0])
        assert each.row(-1) == [1.0, 2.0, 3.0]


@pytest.mark.usefixtures("few_kept")
@pytest.mark.parametrize("call", ["pwrite", "open"])
def test_rows_stay_in_memory_while_the_disk_is_full(monkeypatch, call) -> None:
    expected, found = np.arange(300.0).reshape(100, 3), Rows(3)
    for k, row in enumerate(expected):
        with monkeypatch.context() as full:
            if 50 <= k < 80:
                full.setattr(rows.os, call, disk_is_full) if call == "pwrite" else full.setattr(
                    rows.tempfile, "TemporaryFile", disk_is_full
                )
            found.append(row)
    np.testing.assert_array_equal(found.table(), expected)


def test_memory_does_not_grow_with_the_rows(monkeypatch) -> None:
    monkeypatch.setattr(rows, "KEPT", 4)
    found, row = Rows(21), [1.0] * 21
    for _ in range(8 * rows.BLOCK):
        found.append(row)
    tracemalloc.start()
    for _ in range(40 * rows.BLOCK):
        found.append(row)
    assert tracemalloc.get_traced_memory()[1] < 3 * rows.BLOCK * 21 * 8
    assert sum(len(block) for block in found.blocks()) == len(found) == 48 * rows.BLOCK
    assert tracemalloc.get_traced_memory()[1] < 4 * rows.BLOCK * 21 * 8 + 10_000
    tracemalloc.stop()


def test_what_is_large_is_where_tmpdir_says(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    monkeypatch.setattr(rows, "SMALL", 0)
    room = rows.room_for(8)
    room.write(np.array([7.0]), 0)
    assert room.read(np.float64, 1, 0) == 7.0
