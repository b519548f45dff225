"""Sums by frame and cube of space, from which statistics, their intervals and differences follow.

They add up over clusters, and are a small file: comparisons and gates need no voxels.
"""

from semstab.statistics.cluster_sums.columns import BINS, DRIFT, MOST_CLASSES, FirstColumns, layout, of_measure, width
from semstab.statistics.cluster_sums.functionals import (
    BY_CLASS,
    CELLS,
    FUNCTIONALS,
    Functional,
    Scale,
    Statistic,
    chance_of,
    columns_of,
    frames_of,
    functional,
    of_space_alone,
    parts_of,
    summed,
    value,
)
from semstab.statistics.cluster_sums.index import (
    MOST_CELLS,
    MOST_GROUPS,
    ClusterIndex,
    cubes_of,
    distinct_rows,
    most_groups,
)
from semstab.statistics.cluster_sums.sums import ClusterSums, aligned

__all__ = [
    "BINS",
    "BY_CLASS",
    "CELLS",
    "DRIFT",
    "FUNCTIONALS",
    "MOST_CELLS",
    "MOST_CLASSES",
    "MOST_GROUPS",
    "ClusterIndex",
    "ClusterSums",
    "FirstColumns",
    "Functional",
    "Scale",
    "Statistic",
    "aligned",
    "chance_of",
    "columns_of",
    "cubes_of",
    "distinct_rows",
    "frames_of",
    "functional",
    "layout",
    "most_groups",
    "of_measure",
    "of_space_alone",
    "parts_of",
    "summed",
    "value",
    "width",
]
