"""Sums by frame and cube of space, from which statistics, their intervals and differences follow.

They add up over clusters, and are a small file: comparisons and gates need no voxels.
"""

from semstab.statistics.cluster_sums.columns import (
    DRIFT,
    MOST_CLASSES,
    FirstColumns,
    layout,
    layout_of_features,
    of_measure,
    side_by_side,
    width,
)
from semstab.statistics.cluster_sums.functionals import (
    ALPHA_SUMS,
    BY_CLASS,
    FUNCTIONALS,
    Functional,
    Scale,
    Statistic,
    chance_of,
    columns_of,
    frames_of,
    functional,
    lever_from,
    lever_of,
    mean_functional,
    parts_of,
    summed,
    value,
)
from semstab.statistics.cluster_sums.index import (
    MOST_CELLS,
    MOST_GROUPS,
    ClusterIndex,
    count_distinct,
    cubes_of,
    distinct_rows,
    most_groups,
)
from semstab.statistics.cluster_sums.sums import ClusterSums, aligned

__all__ = [
    "ALPHA_SUMS",
    "BY_CLASS",
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
    "count_distinct",
    "cubes_of",
    "distinct_rows",
    "frames_of",
    "functional",
    "layout",
    "layout_of_features",
    "lever_from",
    "lever_of",
    "mean_functional",
    "most_groups",
    "of_measure",
    "parts_of",
    "side_by_side",
    "summed",
    "value",
    "width",
]
