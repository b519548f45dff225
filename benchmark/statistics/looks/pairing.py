"""Compiled passes over pairs of looks: how far they agree, and their sums by bin, cube and group of frames."""

from __future__ import annotations

from semstab.runtime.compiled import serial


@serial
def products(starts, label, weight, first, lag, out):
    """s . s' (m,) of the looks of these numbers, and those `lag` later, by the entries of their evidence."""
    for i in range(len(first)):
        a, b = starts[first[i]], starts[first[i] + lag]
        end_a, end_b = starts[first[i] + 1], starts[first[i] + lag + 1]
        total = 0.0
        while a < end_a and b < end_b:
            if label[a] == label[b]:
                total += weight[a] * weight[b]
            ahead_a, ahead_b = label[a] <= label[b], label[b] <= label[a]
            a, b = a + ahead_a, b + ahead_b
        out[i] = total


@serial
def add_looks(looks, which, into, product, squares, starts, label, weight):
    """Add looks, those of these numbers: what `between_of` is a function of, each to the sums of its row, -1 for none.

    looks    (rows, 3 + K) sums of s . s' with the other look, of looks, of ||s||^2, and of s
    squares  ||s||^2 of every look, product (m,) of these
    """
    for i in range(len(which)):
        if into[i] >= 0:
            row, one = looks[into[i]], which[i]
            row[0] += product[i]
            row[1] += 1.0
            row[2] += squares[one]
            for entry in range(starts[one], starts[one + 1]):
                row[3 + label[entry]] += weight[entry]
