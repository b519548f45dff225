"""The columns of cluster sums: which sums there are, and where each one stands."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from semstab.metrics.correctness import BINS

MOST_CLASSES = 64
"""The largest number of classes for which sums by class are stored."""

PLAIN = (
    "voxels", "psa", "observations", "agreeing", "own", "twice", "twice_agreeing", "recurrent", "vss", "entropy",
    "square",
)  # fmt: skip
BY_CLASS_ALONE = ("class_apart", "class_own")
DRIFT = ("sbd_excess", "sbd_known")
WITH_TRUTH = ("known", "right", "observed", "observed_right", "consistent", "consistent_wrong")
BY_TRUE_CLASS = ("class_known", "class_right", "class_predicted")
CALIBRATION = ("calibrated", "gap")
OF_MEANING, POINTS = ("similar", "similar_own", "twice_similar", "norm"), ("toward", "against")
"""Sums of labels as points, whose distances are those of the classes: see `semstab.statistics.meaning`."""
OF_TRUTH = (*WITH_TRUTH, *BY_TRUE_CLASS, *CALIBRATION)
WITHOUT_FRAMES = (*DRIFT, *CALIBRATION)
"""Sums that belong to no frame: they stand in rows whose frame is -1, as do sums of the register of measures."""


OF_FEATURES = ("voxels", "observations", "agreeing", "own", "twice", "twice_agreeing", "evidence")
"""Sums of features at spots; evidence is of the parts of vectors along the sum of all vectors."""


def of_measure(key: str) -> tuple[str, str]:
    """Return the names of the sums of a measure of the register: its total, and over how many voxels."""
    return f"{key}_sum", f"{key}_count"


@functools.lru_cache(maxsize=16)
def layout(K: int, *, truth: bool, measured: tuple[str, ...] = (), meaning: bool = False) -> Mapping[str, slice]:
    """Return the columns of the sums by name: K columns for sums by class, one for each bin for `gap`, else one.

    Columns of the measures with the keys `measured` come last, and those of distances between classes, `meaning`.
    """
    by_class = K <= MOST_CLASSES
    widths = [(name, 1) for name in PLAIN] + [("evidence", K)]
    widths += [(name, K) for name in BY_CLASS_ALONE] if by_class else []
    widths += [(name, 1) for name in DRIFT]
    if truth:
        widths += [(name, 1) for name in WITH_TRUTH]
        widths += [(name, K) for name in BY_TRUE_CLASS] if by_class else []
        widths += [("calibrated", 1), ("gap", BINS)]
    widths += [(name, 1) for key in measured for name in of_measure(key)]
    widths += [*((name, 1) for name in OF_MEANING), *((name, K) for name in POINTS)] if meaning else []
    return side_by_side(dict(widths))


def layout_of_features() -> Mapping[str, slice]:
    """Return the columns of the sums of features by name, one each."""
    return side_by_side(dict.fromkeys(OF_FEATURES, 1))


def side_by_side(widths: Mapping[str, int]) -> Mapping[str, slice]:
    """Return the columns of each name, given the number of columns of each name."""
    ends = itertools.accumulate(widths.values())
    slices = {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}
    return MappingProxyType(slices)


class FirstColumns(NamedTuple):
    """The first column of each sum over observations, for compiled loops; -1 where the sums have none of that name."""

    voxels: int
    psa: int
    observations: int
    agreeing: int
    own: int
    twice: int
    twice_agreeing: int
    recurrent: int
    vss: int
    entropy: int
    evidence: int
    class_apart: int
    class_own: int
    known: int
    right: int
    observed: int
    observed_right: int
    consistent: int
    consistent_wrong: int
    class_known: int
    class_right: int
    class_predicted: int

    @classmethod
    def for_classes(cls, K: int, *, truth: bool) -> FirstColumns:
        """Return the first columns of a layout with K classes."""
        columns = layout(K, truth=truth)
        return cls(*(columns[name].start if name in columns else -1 for name in cls._fields))


def width(columns: Mapping[str, slice]) -> int:
    """Return how many columns a layout has."""
    return max(int(part.stop) for part in columns.values())


def column_names(columns: Mapping[str, slice]) -> list[str]:
    """Return the name of each column of a layout in a file: NAME, or NAME_k for class or bin k."""
    return [
        f"{name}_{k}" if where.stop - where.start > 1 else name
        for name, where in columns.items()
        for k in range(where.stop - where.start)
    ]
