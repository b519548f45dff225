"""Compiled loops over the pixels of labelled frames: one pass each where numpy takes five."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semstab.core.compiled import serial


@serial
def mark_valid(depth: Any, labels: Any, ignore: int, out: Any) -> None:
    """Mark the pixels with a valid depth and a label; all arrays are (n,)."""
    ignored = labels.dtype.type(ignore)
    for i in range(out.size):
        out[i] = (depth[i] > np.float32(0)) & (depth[i] < np.float32(math.inf)) & (labels[i] != ignored)


@serial
def count_changed(valid: Any, labels: Any, other_valid: Any, other_labels: Any) -> tuple[int, int]:
    """Return the number of pixels that are valid in both frames, and of those among them whose labels differ."""
    num_valid = changed = 0
    for i in range(valid.size):
        common = valid[i] & other_valid[i]
        num_valid += common
        changed += common & (labels[i] != other_labels[i])
    return num_valid, changed


@serial
def count_changed_at(at: Any, valid: Any, labels: Any, other_valid: Any, other_labels: Any) -> tuple[int, int]:
    """Count the valid pixels that see a valid pixel of the other view, `at`, and those whose label differs there."""
    num_covisible = changed = 0
    for i in range(len(at)):
        j = max(at[i], 0)
        is_covisible = valid[i] & other_valid[j] & (at[i] >= 0)
        num_covisible += is_covisible
        changed += is_covisible & (labels[i] != other_labels[j])
    return num_covisible, changed


@serial
def has_other(labels: Any, count: int, ignore: int) -> bool:
    """Return whether a map of ids (n,) holds one that is neither below `count` nor the ignore id."""
    first, ignored = labels.dtype.type(count), labels.dtype.type(ignore)
    other = False
    for i in range(labels.size):
        other |= (labels[i] >= first) & (labels[i] != ignored)
    return other


@serial
def put_topmost(cells: Any, rows: Any, height: Any, image: Any) -> None:
    """Put into each cell of an image (H, W), negative where empty, the row that is highest, of several the last one.

    - `cells`, `rows`: (m, 2) a cell and (m,) a row that covers it
    - `height`: by row; NaN is above all
    """
    for k in range(len(rows)):
        i, j, row = cells[k, 0], cells[k, 1], rows[k]
        before = image[i, j]
        if before < 0 or height[row] >= height[before] or math.isnan(height[row]):
            image[i, j] = row


# Compiled loops over rows of evidence: one pass over their entries where NumPy takes many over dense rows.


@serial
def concentrate(
    starts: Any, label: Any, weight: Any, largest: Any, lead: Any, bits: Any, dominant: Any, squares: Any
) -> None:
    """Fill largest, lead, bits, dominant and squares (n,), see `Concentration`."""
    for i in range(starts.shape[0] - 1):
        total = square = top = second = spread = 0.0
        best = 0
        for e in range(starts[i], starts[i + 1]):
            w = weight[e]
            total += w
            square += w * w
            if w > top:
                second, top, best = top, w, label[e]
            elif w > second:
                second = w
        for e in range(starts[i], starts[i + 1]):
            if 0.0 < weight[e] < total:
                p = weight[e] / total
                spread -= p * np.log2(p)
        squares[i], dominant[i], bits[i] = square, best, max(spread, 0.0)
        largest[i], lead[i] = top / total, top / total - second / total


@serial
def copy_rows(first: Any, end: Any, to: Any, label: Any, weight: Any, to_label: Any, to_weight: Any) -> None:
    """Copy the entries of rows, each from `first` to before `end` (n,), to where they begin in others, `to` (n,)."""
    for i in range(first.shape[0]):
        for e in range(first[i], end[i]):
            at = to[i] + e - first[i]
            to_label[at], to_weight[at] = label[e], weight[e]


@serial
def add_by_group(group: Any, one: Any, two: Any, three: Any, four: Any, block: int, sums: Any, defined: Any) -> None:
    """Add four columns (n,), of what is not NaN, to the sums (4, G) of each group (n,), and count it; -1 is no group.

    Rounding adds up within a block of rows only.
    """
    part, count = np.zeros((sums.shape[1], 4)), np.zeros((sums.shape[1], 4))
    for first in range(0, group.shape[0], block):
        for i in range(first, min(first + block, group.shape[0])):
            g = group[i]
            if g < 0:
                continue
            for c, value in enumerate((one[i], two[i], three[i], four[i])):
                is_defined = value == value  # noqa: PLR0124 - NaN is not
                part[g, c] += value if is_defined else 0.0
                count[g, c] += 1.0 if is_defined else 0.0
        for g in range(sums.shape[1]):
            for c in range(4):
                sums[c, g] += part[g, c]
                defined[c, g] += count[g, c]
                part[g, c] = count[g, c] = 0.0


@serial
def bound_groups(of: Any, bounds: Any) -> None:
    """Fill bounds[1:] of (n + 1,) with where each of n groups ends; of (m,) are numbers from 0 on, ascending."""
    for row in range(of.shape[0]):
        bounds[of[row] + 1] = row + 1


# Compiled loop over voxels of two maps.


@serial
def find_common(first: Any, second: Any, in_first: Any, in_second: Any) -> int:
    """Write the rows of the voxels that two maps share, (n,) and (m,), and return how many they share.

    Voxel indices (n, 3) and (m, 3) are in order, and no voxel is there twice.
    """
    i = j = shared = 0
    while i < len(first) and j < len(second):
        order = first[i, 0] - second[j, 0]
        order = first[i, 1] - second[j, 1] if order == 0 else order
        order = first[i, 2] - second[j, 2] if order == 0 else order
        if order == 0:
            in_first[shared], in_second[shared] = i, j
            shared += 1
        i += order <= 0
        j += order >= 0
    return shared
