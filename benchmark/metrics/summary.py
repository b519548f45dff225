"""The means of a voxel table: over all voxels, by OP stratum, over recurrent voxels, by dominant class."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int32, Int64, UInt8
from semstab.data.evidence import stretches
from semstab.data.information import by_group
from semstab.data.measures import RECURRENT, MeasureMeans, Voxels, bits, dominant, mean, measures, sbd
from semstab.data.results import Means, Recurrent, TableSummary
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError

STRATA = (1, 2, 5)
"""Upper edges of the paper's strata: OP=1, OP=2, 3<=OP<=5, OP>5."""

STEPS = tuple(m * 10**e for e in range(6) for m in (1, 2, 5))
"""Upper edges of OP that divide the last stratum."""

LOW_PERSISTENCE, DRIFTING, UNCERTAIN, STABLE = range(4)

CATEGORIES = ("low persistence", "drifting", "uncertain", "stable")
"""Names by id, in the order in which they are assigned."""

CATEGORY_COLORS = ((153, 153, 153), (240, 228, 66), (213, 94, 0), (0, 114, 178))
"""RGB by id: grey, and yellow, vermillion and blue of the colour-blind safe palette by Okabe and Ito (2008)."""

NOT_ASSESSED = (190, 190, 190)
"""RGB of all categories of a map about whose stability its frames say nothing."""

MOST_CONFUSED = 1024
"""Most classes of a taxonomy whose confusions are summed up."""

CROWDED, PARTS = 0.5, 3
"""A last stratum that holds more than the share CROWDED of the voxels is split into PARTS parts of about equal size."""


def summarise(table: VoxelTable, edges: Sequence[int] = STRATA) -> TableSummary:
    """Summarise a table (paper, tables of multi-scene, persistence-stratified and class-wise stability).

    edges are the strata's upper bounds of OP, ascending; a last stratum holds the voxels above. Each mean runs over the
    voxels where its measure is defined; over no voxel it is NaN.
    """
    return TableSums.from_table(table, edges).summary(table.voxel_size, table.classes, edges)


@dataclass(frozen=True, eq=False)
class TableSums:
    """The sums behind a map's summary; the sums of the parts of a map add up to the sums of the map.

    Attributes:
        total: (3,) points, observations, voxels.
        stratum, kind, recurrence, step: Sums of every measure by stratum, by dominant class, of the voxels below OP 3
            and the recurrent ones, and by finer strata beyond the last edge: see `_by_group`.
        category: Voxels in each of CATEGORIES.
        confusion: (K, K) evidence for a class (column) in the voxels that another one dominates (row); (0, 0) beyond
            MOST_CONFUSED classes.
    """

    total: Float64
    stratum: Float64
    kind: Float64
    recurrence: Float64
    step: Float64
    category: Float64
    confusion: Float64

    @classmethod
    def nothing(cls, K: int, edges: Sequence[int] = STRATA) -> TableSums:
        """Return the sums of no voxel, of K classes."""
        groups = (len(edges) + 1, K, 2, len(_steps(edges)) + 1)
        stratum, kind, recurrence, step = (np.zeros((1 + 3 * len(measures()), n)) for n in groups)
        C = K if K <= MOST_CONFUSED else 0
        return cls(np.zeros(3), stratum, kind, recurrence, step, np.zeros(len(CATEGORIES)), np.zeros((C, C)))

    @classmethod
    def from_table(cls, table: VoxelTable, edges: Sequence[int] = STRATA) -> TableSums:
        """Return the sums of a table."""
        table = table.summing_to_op()
        steps = _steps(edges)
        groups = (len(edges) + 1, table.K, 2, len(steps) + 1)
        sums = [np.zeros((1 + 3 * len(measures()), n)) for n in groups]
        finest, observations = sorted({*edges, RECURRENT - 1, *steps}), 0.0
        category, K = np.zeros(len(CATEGORIES)), table.K if table.K <= MOST_CONFUSED else 0
        confusion = np.zeros((K, K))
        by_op = np.zeros((1 + 3 * len(measures()), len(finest) + 1))
        for stretch in stretches(len(table)):
            rows = Voxels(table.op[stretch], table.evidence.take(stretch).measured(), table.drift_sum[stretch])
            values = [measure.of(rows) for measure in measures()]
            sums[1] += _by_group(values, rows.op, dominant(rows), table.K)
            by_op += _by_group(values, rows.op, groups_of(rows.op, finest), by_op.shape[1])
            observations += float(rows.op.sum(dtype=np.int64))
            category += np.bincount(categorise(rows.op, sbd(rows), bits(rows)), minlength=len(CATEGORIES))
            if K:
                start, label, weight = rows.evidence.entries
                pair = np.repeat(dominant(rows), np.diff(start)) * K + label
                confusion += np.bincount(pair, weights=weight, minlength=K * K).reshape(K, K)
        for group_sums, bounds in ((sums[0], edges), (sums[2], [RECURRENT - 1]), (sums[3], steps)):
            np.add.at(group_sums.T, np.searchsorted(bounds, [*finest, np.iinfo(np.int32).max]), by_op.T)
        total = [table.pixels.sum(), observations, by_op[0].sum()]
        return cls(np.array(total, dtype=np.float64), sums[0], sums[1], sums[2], sums[3], category, confusion)

    def arrays(self) -> dict[str, Float64]:
        """Return all arrays by name, as `read` takes them."""
        return {f"table {name}": value for name, value in vars(self).items()}

    @classmethod
    def read(cls, arrays: Mapping[str, Float64]) -> TableSums:
        """Read the sums from arrays, which may contain others."""
        return cls(**{field.name: arrays[f"table {field.name}"] for field in dataclasses.fields(cls)})

    def __add__(self, other: TableSums) -> TableSums:
        return TableSums(*(value + more for value, more in zip(vars(self).values(), vars(other).values(), strict=True)))

    def summary(self, voxel_size: float, classes: Sequence[str], edges: Sequence[int] = STRATA) -> TableSummary:
        """Return the summary; the edges are those of the sums."""
        points, observations, voxels = (int(value) for value in self.total)
        K = self.kind.shape[1]
        names = classes or tuple(str(k) for k in range(K))

        def means(name: str, sums: Float64, group: int) -> Means:
            n = int(sums[0, group])
            return Means(name, n / voxels if voxels else math.nan, n, MeasureMeans.of_sums(sums[1:, group]))

        return TableSummary(
            K=K,
            voxel_size=voxel_size,
            points=points,
            observations=observations,
            voxels=voxels,
            mean_op=observations / voxels if voxels else math.nan,
            means=MeasureMeans.of_sums(self.stratum.sum(axis=1)[1:]),
            strata=tuple(means(name, self.stratum, g) for g, (name, _, _) in enumerate(strata(edges))),
            recurrent=Recurrent(**vars(means(f"OP>={RECURRENT}", self.recurrence, 1))),
            classes=tuple(means(name, self.kind, k) for k, name in enumerate(names)),
            well_seen=tuple(
                means(name, self.step, g)
                for g, (name, _, _) in enumerate(strata(_steps(edges)))
                if g and self.step[0, g]
            ),
            categories={name: float(n) / voxels for name, n in zip(CATEGORIES, self.category, strict=True) if voxels},
            confused_with=dict(self._confused(names)),
        )

    def _confused(self, names: Sequence[str]) -> Iterator[tuple[str, str]]:
        off_diagonal = self.confusion * (1 - np.eye(len(self.confusion)))
        for name, row in zip(names, off_diagonal, strict=False):
            if row.max() > 0:
                yield name, names[int(row.argmax())]


def _steps(edges: Sequence[int]) -> list[int]:
    return [edges[-1], *(step for step in STEPS if step > edges[-1])]


def _by_group(values: Sequence[Float64], op: Int32, group: Int64, groups: int) -> Float64:
    """Return (1 + 3 M, groups) of the values (n,) of M measures.

    The first row counts voxels. Then each measure has its sum, the number of voxels with a defined value, and the
    number of voxels whose OP is high enough for it.
    """
    levels = sorted({1, *(measure.lowest_op for measure in measures())})
    enough = [np.where(op >= level, 1.0, np.nan) for level in levels]
    sums, defined = by_group(group, [*values, *enough], groups)
    often = dict(zip(levels, defined.T[len(values) :], strict=True))
    rows = [often[1]]
    for measure, total, count in zip(measures(), sums.T, defined.T, strict=False):
        rows += [total, count, often[measure.lowest_op]]
    return np.stack(rows)


def groups_of(op: Int32, edges: Sequence[int]) -> Int64:
    """Return the stratum of OP (n,) of each voxel: the number of edges below its OP."""
    group: Int64 = np.searchsorted(edges, np.arange(int(op.max(initial=0)) + 1))[op]
    return group


def strata(edges: Sequence[int]) -> list[tuple[str, int, int]]:
    """Return name, lowest and highest OP of each stratum.

    >>> strata([1, 2, 5])[2:]
    [('3<=OP<=5', 3, 5), ('OP>5', 6, 2147483647)]
    """
    lows = [1, *(edge + 1 for edge in edges)]
    rows = [(f"OP={low}" if low == high else f"{low}<=OP<={high}", low, high) for low, high in zip(lows, edges)]  # noqa: B905
    return [*rows, (f"OP>{edges[-1]}", lows[-1], np.iinfo(np.int32).max)]


def split_last(tables: Sequence[TableSummary]) -> list[Means]:
    """Return the last stratum of several tables together in about equal parts, where most of their voxels are in it.

    They add to the strata, whose edges are the paper's: `well_seen` names the finer ones.
    """
    voxels = sum(table.voxels for table in tables)
    steps: dict[str, list[Means]] = {}
    for row in (row for table in tables for row in table.well_seen):
        steps.setdefault(row.name, []).append(row)
    ordered = [pool(steps[name], voxels) for name in sorted(steps, key=_lowest)]
    total = sum(row.voxels for row in ordered)
    if total <= CROWDED * voxels or len(ordered) < 2:
        return []
    parts: list[list[Means]] = [[]]
    for row in ordered:
        if sum(part.voxels for part in parts[-1]) + row.voxels / 2 > total / PARTS and parts[-1] and len(parts) < PARTS:
            parts.append([])
        parts[-1].append(row)
    if len(parts) < 2:
        return []
    return [dataclasses.replace(pool(part, voxels), name=_range(part[0].name, part[-1].name)) for part in parts]


def _lowest(name: str) -> int:
    """Return the lowest OP of a stratum, by its name."""
    return int(re.findall(r"\d+", name)[0])


def _range(first: str, last: str) -> str:
    """Return the name of a stratum from the names of its first and last step."""
    low, highest = _lowest(first), re.findall(r"\d+", last)[-1]
    return f"{low}<=OP<={highest}" if "<=" in last else f"OP>={low}"


def pool(groups: Sequence[Means], voxels: int) -> Means:
    """Return the means over the voxels of several tables' groups together; `voxels` counts all voxels of these tables.

    Strata and class tables of several scenes pool their voxels; scene tables give macro means instead.
    """
    n = sum(group.voxels for group in groups)
    rows, first = [(group.means, group.voxels) for group in groups], groups[0].means
    weights = {key: [means.voxels.get(key, of_all) for means, of_all in rows] for key in first.value}
    value = {
        key: _weighted([means.value[key] for means, _ in rows], voxel_counts) for key, voxel_counts in weights.items()
    }
    pooled = MeasureMeans(value, {key: sum(weights[key]) for key in first.voxels})
    return Means(groups[0].name, n / voxels if voxels else math.nan, n, pooled)


def macro_mean(values: Sequence[float]) -> float:
    """Return the mean over the scenes with a defined value, each counting once, or NaN without such scenes."""
    return mean(np.array(values, dtype=np.float64))


def _weighted(values: Sequence[float], weights: Sequence[int]) -> float:
    total = sum(weights)
    return sum(v * w for v, w in zip(values, weights, strict=True) if w) / total if total else math.nan


# Categories of voxels: low persistence, drifting, uncertain or stable (paper, Qualitative Analysis).


@dataclass(frozen=True)
class CategoryThresholds:
    """The limits between one category and the next.

    Attributes:
        min_op: Fewer observations are low persistence; the paper calls a voxel recurrent from OP = 3 on.
        drifting_bits: SBD from which on the belief still moves. The paper's models have 0.041 and 0.019
            bits on average over recurrent voxels. One dissent among three labels has 0.095 bits or more; one among four
            0.046 if it comes last, 0.113 if it comes second.
        uncertain_bits: Entropy of the belief from which on it is ambiguous. In bits, because the normalised entropy of
            the same split falls with K: a vote of 3 to 1 between two classes has 0.811 bits, one of 4 to 1 0.722.

    Raises:
        ConfigError: If one of them is out of range.
    """

    min_op: int = RECURRENT
    drifting_bits: float = 0.05
    uncertain_bits: float = 0.8

    def __post_init__(self) -> None:
        if self.min_op < 1:
            raise ConfigError(f"min_op = {self.min_op}: use 1 or more")
        for name in ("drifting_bits", "uncertain_bits"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} = {value:g}: it must be positive, in bits")


def categories(table: VoxelTable, thresholds: CategoryThresholds | None = None) -> UInt8:
    """Return the category of each voxel (n,), an index into CATEGORIES; the first of these that applies.

    - low persistence: OP < min_op, too few observations
    - drifting: SBD >= drifting_bits, observations still move the belief
    - uncertain: entropy >= uncertain_bits, the belief has settled on no clear answer
    - stable: a clear answer, and little movement

    Drifting comes first because nearly all drifting voxels are ambiguous as well, but not the other way round: with
    more observations a voxel that stays ambiguous goes from drifting to uncertain.
    """
    return categorise(table.op, sbd(table), bits(table), thresholds)


def categorise(
    op: Int32,
    sbd: Float64,
    bits: Float64,
    thresholds: CategoryThresholds | None = None,
) -> UInt8:
    """Return the category (n,) by OP, SBD in bits and entropy in bits, (n,) each; see `categories`."""
    limits = thresholds or CategoryThresholds()
    category = np.full(len(op), STABLE, dtype=np.uint8)
    category[bits >= limits.uncertain_bits] = UNCERTAIN
    category[sbd >= limits.drifting_bits] = DRIFTING
    category[op < limits.min_op] = LOW_PERSISTENCE
    return category


def category_shares(table: VoxelTable, thresholds: CategoryThresholds | None = None) -> dict[str, float]:
    """Return the share of the voxels in each category, 0 to 1, by name; NaN for an empty map."""
    counts = np.bincount(categories(table, thresholds), minlength=len(CATEGORIES))
    return {name: float(n / len(table)) if len(table) else math.nan for name, n in zip(CATEGORIES, counts, strict=True)}
