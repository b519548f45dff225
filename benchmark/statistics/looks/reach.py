"""Agreement beside its ceiling: what two frames would agree on had their labels not depended on the view.

Voxels hold more than one thing, and frames see different parts of them: that sets a ceiling to agreement, which falls
as voxels grow. The share of it that a model reaches does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import shared_observations
from semstab.model.statistics import ClassReach, Estimate, Reach
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import alpha_columns, between_of, class_columns, class_of
from semstab.statistics.blocks import BlockBootstrap, Statistic, spatial_blocks
from semstab.statistics.looks.entries import Sample

Float64 = npt.NDArray[np.float64]

SUPPORT = 100.0
"""Places from which on a class matters to the verdict, where no critical classes are named."""


def reach_of(
    sample: Sample, table: VoxelTable, *, critical: Sequence[str] = (), least: float = SUPPORT, seed: int = 0
) -> Reach:
    """Alpha between frames in the sampled voxels beside that of the sample's limit, of all classes and of each.

    table     the whole map: how many places a class has
    critical  names of the classes that matter; where none is given, those with `least` places or more
    """
    seen, limit = shared_observations(sample.seen, sample.limit)
    table_seen = seen.table()
    again = table_seen.op >= 2
    bootstrap = BlockBootstrap(spatial_blocks(table_seen.index[again], table.voxel_size), seed=seed)
    columns = [alpha_columns(log.table())[again] for log in (seen, limit)]
    by_class = [class_columns(log)[again] for log in (seen, limit)]
    repeated = table.op >= 2
    places = (table.evidence[repeated] / table.op[repeated, None]).sum(axis=0)
    names = table.classes or tuple(str(k) for k in range(table.K))
    named = set(critical) & set(names)

    def reached(of: Statistic, parts: Sequence[Float64]) -> Estimate:
        both = np.concatenate(parts, axis=1)
        return bootstrap.estimate(both, _ratio_to_ceiling(of, parts[0].shape[1]), (-1.0, math.inf))

    return Reach(
        by=sample.by,
        voxels=int(np.count_nonzero(again)),
        alpha=bootstrap.estimate(columns[0], between_of, (-1.0, 1.0)),
        ceiling=bootstrap.estimate(columns[1], between_of, (-1.0, 1.0)),
        reached=reached(between_of, columns),
        classes=tuple(
            ClassReach(
                name,
                float(places[k]),
                name in named if named else bool(places[k] >= least),
                float(class_of(by_class[0][:, k].sum(axis=0))),
                float(class_of(by_class[1][:, k].sum(axis=0))),
                reached(class_of, [own[:, k] for own in by_class]),
            )
            for k, name in enumerate(names)
        ),
    )


def _ratio_to_ceiling(of: Statistic, C: int) -> Statistic:
    """The statistic of the first C sums over that of the others; undefined where these are no better than chance."""

    def ratio(sums: Float64) -> Float64:
        ceiling = of(sums[..., C:])
        return of(sums[..., :C]) / np.where(ceiling > 0, ceiling, np.nan)

    return ratio
