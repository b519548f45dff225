"""Agreement at a stated distance of two looks, and from the nearest to the farthest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from semstab.model.records import Result
from semstab.model.statistics import Correlogram, Estimate, LagBin, MapStatistics
from semstab.outputs.tables.statistics import by_scene
from semstab.outputs.tables.table import Column, Table
from semstab.statistics.looks.correlogram import STANDARD
from semstab.statistics.sampling import LEAST_FRAMES


def correlogram(result: Result) -> list[Table]:
    """Alpha between frames where views differ by a stated angle, and for the nearest and the farthest looks."""
    low, high = STANDARD
    stated = f"{low:g} to {high:g} degrees apart"
    columns = (
        Column("standard", "found", 3, "higher", over=stated),
        Column("standard_ceiling", "ceiling", 3, over=stated),
        Column("standard_pairs", "pairs", 0, over=stated),
        *(Column(f"{axis}_{end}", f"{end}", 3, over=f"By {axis}") for axis in _AXES for end in ("nearest", "farthest")),
    )
    numbers = (
        _of(lambda found: found.standard.alpha),
        _of(lambda found: found.standard.ceiling),
        _of(lambda found: found.standard.pairs or math.nan),
        *(_of(_end(axis, last)) for axis in _AXES for last in (0, -1)),
    )
    caption = (
        "Alpha between frames of pairs of looks at a place, by how far apart they are: models and flights compare at a"
        " stated angle between the directions of view, not over whatever pairs a flight has. Nearest, farthest: the"
        " first and the last bin with enough pairs in time (frames), angle, ratio of the ranges, and distance of the"
        " cameras. In sampled voxels; intervals at 95%, for the next flight"
        f" if {LEAST_FRAMES} frames of a bin tell of it, else for this map."
    )
    return by_scene(result, "correlogram", "Agreement by distance of the looks", caption, columns, numbers)


_AXES = ("time", "angle", "range", "baseline")


def _of(take: Callable[[Correlogram], float | Estimate]) -> Callable[[MapStatistics], float | Estimate]:
    return lambda found: math.nan if found.correlogram is None else take(found.correlogram)


def _end(axis: str, last: int) -> Callable[[Correlogram], float]:
    def value(found: Correlogram) -> float:
        bins: Sequence[LagBin] = getattr(found, axis)
        return bins[last].alpha.value if len(bins) > 1 else math.nan

    return value
