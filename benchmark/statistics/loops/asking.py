"""Asking for a voxel's rows of the log before they are read, where voxels do not go in the order of the log."""

from __future__ import annotations

from semstab.backends.shared.pixel_keys import touch
from semstab.core.compiled import serial

LINE = 64
"""Bytes that come into the cache together."""

SOON = 4
"""How many voxels ahead entries are asked for; their bounds, which tell where they lie, twice as many."""


@serial
def ask_for_bounds(log, first, T):
    """Ask for the bounds of a voxel's T rows of the log (starts, label, weight), from `first` on."""
    starts = log[0]
    for row in range(first, first + T, LINE // 8):
        touch(starts, row)
    touch(starts, first + T)


@serial
def ask_for_entries(log, first, T):
    """Ask for a voxel's entries in the log, whose bounds are at hand."""
    starts, label, weight = log
    begin, end = starts[first], starts[first + T]
    for e in range(begin, end, LINE // 8):
        touch(weight, e)
    for e in range(begin, end, LINE // 2):
        touch(label, e)
    touch(weight, end - 1)
