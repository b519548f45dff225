"""The means of a voxel table: over all voxels, by OP stratum, over recurrent voxels, by dominant class."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from semstab.model.measures import MeasureMeans, dominant, mean, measures
from semstab.model.results import RECURRENT, Means, TableSummary
from semstab.model.voxels import VoxelTable

STRATA = (1, 2, 5)
"""Upper edges of the paper's strata: OP=1, OP=2, 3<=OP<=5, OP>5."""

STEPS = tuple(m * 10**e for e in range(6) for m in (1, 2, 5))
"""Upper edges of OP by which the last stratum is told apart."""

CROWDED, PARTS = 0.5, 3
"""A last stratum that holds more than this share of the voxels is split into so many about equal parts."""


def summarise(table: VoxelTable, edges: Sequence[int] = STRATA) -> TableSummary:
    """Summarise a table (paper, tables of multi-scene, persistence-stratified and class-wise stability).

    edges are the strata's upper bounds of OP, ascending; a last stratum holds what lies above. Each mean runs over the
    voxels where its measure is defined; over no voxel it is NaN.
    """
    values = {measure: measure.of(table) for measure in measures()}
    label = dominant(table)
    names = table.classes or tuple(str(k) for k in range(table.K))

    def means(name: str, where: npt.NDArray[np.bool_]) -> Means:
        n = int(np.count_nonzero(where))
        return Means(name, n / len(table) if len(table) else math.nan, n, MeasureMeans.over(values, table.op, where))

    observations = int(table.op.sum(dtype=np.int64))
    return TableSummary(
        K=table.K,
        voxel_size=table.voxel_size,
        points=int(table.pixels.sum()),
        observations=observations,
        voxels=len(table),
        mean_op=observations / len(table) if len(table) else math.nan,
        means=MeasureMeans.over(values, table.op, np.ones(len(table), dtype=np.bool_)),
        strata=tuple(means(name, (table.op >= low) & (table.op <= high)) for name, low, high in strata(edges)),
        recurrent=means(f"OP>={RECURRENT}", table.op >= RECURRENT),
        classes=tuple(means(name, label == k) for k, name in enumerate(names)),
        well_seen=tuple(
            means(name, (table.op >= low) & (table.op <= high))
            for name, low, high in strata([edges[-1], *(step for step in STEPS if step > edges[-1])])[1:]
            if np.any((table.op >= low) & (table.op <= high))
        ),
    )


def strata(edges: Sequence[int]) -> list[tuple[str, int, int]]:
    """Name, lowest and highest OP of each stratum.

    >>> strata([1, 2, 5])[2:]
    [('3<=OP<=5', 3, 5), ('OP>5', 6, 2147483647)]
    """
    lows = [1, *(edge + 1 for edge in edges)]
    rows = [(f"OP={low}" if low == high else f"{low}<=OP<={high}", low, high) for low, high in zip(lows, edges)]  # noqa: B905
    return [*rows, (f"OP>{edges[-1]}", lows[-1], np.iinfo(np.int32).max)]


def split_last(tables: Sequence[TableSummary]) -> list[Means]:
    """The last stratum of several tables together in about equal parts, where most of their voxels are in it.

    Beside the strata, whose edges are the paper's: `well_seen` names the finer ones.
    """
    voxels = sum(table.voxels for table in tables)
    steps: dict[str, list[Means]] = {}
    for row in (row for table in tables for row in table.well_seen):
        steps.setdefault(row.name, []).append(row)
    ordered = [pool(steps[name], voxels) for name in sorted(steps, key=_lowest)]
    seen = sum(row.voxels for row in ordered)
    if seen <= CROWDED * voxels or len(ordered) < 2:
        return []
    parts: list[list[Means]] = [[]]
    for row in ordered:
        if sum(own.voxels for own in parts[-1]) + row.voxels / 2 > seen / PARTS and parts[-1] and len(parts) < PARTS:
            parts.append([])
        parts[-1].append(row)
    if len(parts) < 2:
        return []
    return [dataclasses.replace(pool(part, voxels), name=_range(part[0].name, part[-1].name)) for part in parts]


def _lowest(name: str) -> int:
    """The lowest OP of a stratum, by its name."""
    return int(re.findall(r"\d+", name)[0])


def _range(first: str, last: str) -> str:
    """The name of a stratum from the names of its first and last step."""
    low, highest = _lowest(first), re.findall(r"\d+", last)[-1]
    return f"{low}<=OP<={highest}" if "<=" in last else f"OP>={low}"


def pool(groups: Sequence[Means], voxels: int) -> Means:
    """The means over the voxels of several tables' groups together; `voxels` counts all voxels of these tables.

    Strata and class tables of several scenes pool their voxels; scene tables give macro means instead.
    """
    n = sum(group.voxels for group in groups)
    rows, first = [(group.means, group.voxels) for group in groups], groups[0].means
    weights = {key: [means.voxels.get(key, of_all) for means, of_all in rows] for key in first.value}
    value = {key: _weighted([means.value[key] for means, _ in rows], own) for key, own in weights.items()}
    pooled = MeasureMeans(value, {key: sum(weights[key]) for key in first.voxels})
    return Means(groups[0].name, n / voxels if voxels else math.nan, n, pooled)


def macro_mean(values: Sequence[float]) -> float:
    """The mean over scenes, each counting once, of those where the value is defined; NaN where none is."""
    return mean(np.array(values, dtype=np.float64))


def _weighted(values: Sequence[float], weights: Sequence[int]) -> float:
    total = sum(weights)
    return sum(v * w for v, w in zip(values, weights, strict=True) if w) / total if total else math.nan
