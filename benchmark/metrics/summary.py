"""The means of a voxel table: over all voxels, by OP stratum, over recurrent voxels, by dominant class."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from semstab.model.measures import Float64, Int32, Measure, MeasureMeans, chunks, dominant, mean, measures
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
    K, names = table.K, table.classes or tuple(str(k) for k in range(table.K))
    by_stratum, by_class, by_recurrence = _Sums(len(edges) + 1), _Sums(K), _Sums(2)
    steps = [edges[-1], *(step for step in STEPS if step > edges[-1])]
    by_step = _Sums(len(steps) + 1)
    for rows in chunks(table):
        values = {measure: measure.of(rows) for measure in measures()}
        by_stratum.add(values, rows.op, np.searchsorted(edges, rows.op))
        by_step.add(values, rows.op, np.searchsorted(steps, rows.op))
        by_class.add(values, rows.op, dominant(rows))
        by_recurrence.add(values, rows.op, (rows.op >= RECURRENT).astype(np.int64))
    observations = int(table.op.sum(dtype=np.int64))
    return TableSummary(
        K=K,
        voxel_size=table.voxel_size,
        points=int(table.pixels.sum()),
        observations=observations,
        voxels=len(table),
        mean_op=observations / len(table) if len(table) else math.nan,
        means=by_stratum.of(slice(None)),
        strata=tuple(by_stratum.means(name, g, len(table)) for g, (name, _, _) in enumerate(strata(edges))),
        recurrent=by_recurrence.means(f"OP>={RECURRENT}", 1, len(table)),
        classes=tuple(by_class.means(name, k, len(table)) for k, name in enumerate(names)),
        well_seen=tuple(
            by_step.means(name, g, len(table))
            for g, (name, _, _) in enumerate(strata(steps))
            if g and by_step.voxels[g]
        ),
    )


class _Sums:
    """Sums of every measure over groups of voxels, which come in parts."""

    def __init__(self, groups: int) -> None:
        self.voxels = np.zeros(groups, np.int64)
        self.total = {measure: np.zeros(groups) for measure in measures()}
        self.defined = {measure: np.zeros(groups, np.int64) for measure in measures()}
        self.often = {measure: np.zeros(groups, np.int64) for measure in measures() if measure.lowest_op > 1}

    def add(self, values: Mapping[Measure, Float64], op: Int32, group: npt.NDArray[np.int64]) -> None:
        """Values (n,) of each measure for voxels of these OP and groups (n,)."""
        G = len(self.voxels)
        self.voxels += np.bincount(group, minlength=G)
        for measure, value in values.items():
            known = ~np.isnan(value)
            self.total[measure] += np.bincount(group[known], weights=value[known], minlength=G)
            self.defined[measure] += np.bincount(group[known], minlength=G)
        for measure, count in self.often.items():
            count += np.bincount(group[op >= measure.lowest_op], minlength=G)  # noqa: PLW2901 - in place

    def of(self, groups: slice) -> MeasureMeans:
        """The means over some groups together."""
        counts = {measure: int(self.defined[measure][groups].sum()) for measure in self.total}
        value = {m.key: float(self.total[m][groups].sum()) / n if n else math.nan for m, n in counts.items()}
        return MeasureMeans(value, {m.key: int(count[groups].sum()) for m, count in self.often.items()})

    def means(self, name: str, group: int, voxels: int) -> Means:
        """Those of one group, as a share of so many voxels."""
        n = int(self.voxels[group])
        return Means(name, n / voxels if voxels else math.nan, n, self.of(slice(group, group + 1)))


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
