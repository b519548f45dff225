"""Sorting and telling apart small whole numbers, in linear time where they are dense."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int64

SPARSE = 8
"""A table may have so many places for one number."""


STRETCH = 1 << 16
"""Places are counted so many at a time: what stays in a core's cache costs no new memory."""


def ranked(numbers: npt.NDArray[np.integer]) -> Int64:
    """The order (n,) that sorts numbers from 0 on, stably.

    By radix where they have 16 bits at most; else with the place of each in its lowest bits, as far as there is room
    for it: whole numbers are sorted several times as fast as places.
    """
    most, bits = int(numbers.max(initial=0)), len(numbers).bit_length()
    if most < 1 << 16 or most >> (63 - bits):
        order: Int64 = np.argsort(numbers.astype(np.min_scalar_type(most)), kind="stable")
        return order
    placed = _placed(numbers, bits)
    placed &= (1 << bits) - 1
    return placed


def ordered(numbers: npt.NDArray[np.integer]) -> tuple[Int64, Int64]:
    """The numbers, ascending, and what `ranked` says of them."""
    bits = len(numbers).bit_length()
    if int(numbers.max(initial=0)) >> (63 - bits):
        order = ranked(numbers)
        return numbers[order].astype(np.int64), order
    placed = _placed(numbers, bits)
    order = placed & ((1 << bits) - 1)
    placed >>= bits
    return placed, order


def _placed(numbers: npt.NDArray[np.integer], bits: int) -> Int64:
    """The numbers, ascending, with the place of each in so many lowest bits."""
    placed = numbers.astype(np.int64)
    placed <<= bits
    for first in range(0, len(placed), STRETCH):
        some = placed[first : first + STRETCH]
        some |= np.arange(first, first + len(some))
    placed.sort()
    return placed


def numbered(values: npt.NDArray[np.integer]) -> tuple[Int64, Int64]:
    """The distinct values, ascending, and which of them each is: np.unique, by a table where they are dense."""
    if not len(values) or values.min() < 0 or values.max() >= SPARSE * len(values):
        found, of = np.unique(values, return_inverse=True)
        return found.astype(np.int64), of.astype(np.int64)
    found = distinct(values)
    number = np.empty(int(found[-1]) + 1, np.int64)
    number[found] = np.arange(len(found))
    return found, number[values]


def distinct(values: npt.NDArray[np.integer]) -> Int64:
    """The distinct values, ascending: np.unique, by a table where they are dense."""
    if not len(values) or values.min() < 0 or values.max() >= SPARSE * len(values):
        return np.unique(values).astype(np.int64)
    there = np.zeros(int(values.max()) + 1, np.bool_)
    there[values] = True
    return np.flatnonzero(there)


def distinct_rows(rows: npt.NDArray[np.integer]) -> tuple[Int64, Int64]:
    """Each row of whole numbers (n, C) once, ascending, and which of them each is: np.unique by one number a row."""
    low = rows.min(axis=0, initial=0).astype(np.int64)
    size = [int(n) for n in rows.max(axis=0, initial=0) - low + 1]
    if math.prod(size) >= 2**63:
        found, of = np.unique(rows, axis=0, return_inverse=True)
        return found.astype(np.int64), of.ravel()
    key = np.zeros(len(rows), np.int64)
    for column, least, many in zip(rows.T, low, size, strict=True):
        key = key * many + (column - least)
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    return rows[first].astype(np.int64), of.astype(np.int64)
