"""Compiled loops over the pixels of labelled frames: one pass each where numpy takes five."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semstab.runtime.compiled import serial


@serial
def mark_valid(depth: Any, labels: Any, ignore: int, out: Any) -> None:
    """Mark the pixels with a valid depth and a label; all arrays are (n,)."""
    ignored = labels.dtype.type(ignore)
    for i in range(out.size):
        out[i] = (depth[i] > np.float32(0)) & (depth[i] < np.float32(math.inf)) & (labels[i] != ignored)


@serial
def count_changed(valid: Any, labels: Any, other_valid: Any, other_labels: Any) -> tuple[int, int]:
    """The number of pixels that are valid in both frames, and of those among them whose labels differ."""
    both = changed = 0
    for i in range(valid.size):
        common = valid[i] & other_valid[i]
        both += common
        changed += common & (labels[i] != other_labels[i])
    return both, changed


@serial
def count_changed_at(at: Any, valid: Any, labels: Any, other_valid: Any, other_labels: Any) -> tuple[int, int]:
    """Of the valid pixels those that see a valid pixel of the other view, `at`, and those whose label differs there."""
    seen = changed = 0
    for i in range(len(at)):
        j = max(at[i], 0)
        both = valid[i] & other_valid[j] & (at[i] >= 0)
        seen += both
        changed += both & (labels[i] != other_labels[j])
    return seen, changed


@serial
def has_other(labels: Any, count: int, ignore: int) -> bool:
    """Whether a map of ids (n,) holds one that is neither below `count` nor the ignore id."""
    first, ignored = labels.dtype.type(count), labels.dtype.type(ignore)
    other = False
    for i in range(labels.size):
        other |= (labels[i] >= first) & (labels[i] != ignored)
    return other
