"""What the columns of influence sums are, and what was right in them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from semstab.core.types import Float64

MOST_CLASSES = 64
"""Sums by class are kept up to so many classes."""

BINS = 15
"""Of the reliability diagram: voxels whose largest belief lies in (b / BINS, (b + 1) / BINS]."""

PLAIN = (
    "voxels", "psa", "observations", "agreeing", "own", "twice", "twice_agreeing", "recurrent", "vss", "entropy",
)  # fmt: skip
DRIFT = ("sbd_excess", "sbd_known")
WITH_TRUTH = ("known", "right", "looks", "looks_right", "stable", "stable_wrong")
BY_TRUE_CLASS = ("class_known", "class_right", "class_predicted")
OF_PLACES = (*DRIFT, "judged", "gap")
"""Sums that belong to no frame: they stand in rows whose frame is -1."""


@functools.lru_cache(maxsize=16)
def layout(K: int, *, truth: bool) -> Mapping[str, slice]:
    """Which columns of the sums each name stands for; those by class have K columns, `gap` one for each bin."""
    by_class = K <= MOST_CLASSES
    widths = [(name, 1) for name in PLAIN] + [("evidence", K)]
    widths += [(name, K) for name in ("class_apart", "class_own")] if by_class else []
    widths += [(name, 1) for name in DRIFT]
    if truth:
        widths += [(name, 1) for name in WITH_TRUTH]
        widths += [(name, K) for name in BY_TRUE_CLASS] if by_class else []
        widths += [("judged", 1), ("gap", BINS)]
    ends = np.cumsum([width for _, width in widths])
    found = {name: slice(int(end) - width, int(end)) for (name, width), end in zip(widths, ends, strict=True)}
    return MappingProxyType(found)


def width(K: int, *, truth: bool) -> int:
    """How many columns there are."""
    return max(int(part.stop) for part in layout(K, truth=truth).values())


# --- Numbers of right and wrong ---------------------------------------------------------------------------------------


def iou_of(sums: Float64) -> Float64:
    """Intersection over union (...,) of a class from how often it is right, a count, the true and the predicted."""
    right, _, true, predicted = np.moveaxis(sums, -1, 0)
    union = true + predicted - right
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio: Float64 = np.where(union.real > 0, right / union, np.nan)
    return ratio


def miou_of(sums: Float64) -> Float64:
    """Its mean (...,) over the classes that are true or predicted anywhere; a count twice, then the same three."""
    right, true, predicted = np.split(sums[..., 2:], 3, axis=-1)
    union = true + predicted - right
    there = union.real > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Float64 = np.where(there, right / np.where(there, union, 1), 0).sum(axis=-1) / there.sum(axis=-1)
    return mean


def ece_of(sums: Float64) -> Float64:
    """Expected calibration error (...,) from a count twice, and from right less confidence, summed in each bin."""
    gap = sums[..., 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        error: Float64 = (np.sign(gap.real) * gap).sum(axis=-1) / sums[..., 1]
    return error
