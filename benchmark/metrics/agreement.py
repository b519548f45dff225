"""Agreement of the maps of two fusion implementations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.events import Events
from semstab.data.measures import dominant, measures
from semstab.data.results import Agreement, Deviation, Mismatch, UnitName
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError

# The same voxels in several maps.


def shared_rows(*tables: VoxelTable) -> list[Int64]:
    """Return rows of the voxels that all tables hold, one array per table, in the same order of voxels.

    Raises:
        DataError: If the tables differ in K or voxel size.
    """
    require_same_grid(*tables)
    if same_voxels(*tables):
        return [np.arange(len(tables[0]))] * len(tables)
    from semstab.data.kernels import find_common

    first = tables[0].index
    rows = [np.arange(len(first))]
    for table in tables[1:]:
        in_first, in_table = np.empty((2, min(len(first), len(table))), np.int64)
        n = find_common(first, table.index, in_first, in_table)
        first, rows = first[in_first[:n]], [*(of[in_first[:n]] for of in rows), in_table[:n]]
    return rows


def same_voxels(first: VoxelTable, *others: VoxelTable) -> bool:
    """Return whether all tables have the same voxels."""
    names = ("ix", "iy", "iz")
    return all(np.array_equal(getattr(first, name), getattr(other, name)) for other in others for name in names)


def observations(log: Events, rows: Int64) -> Events:
    """Return these rows of a log, ascending, with the voxels that they are of."""
    voxels, of = np.unique(log.voxel[rows], return_inverse=True)
    columns: dict[str, Any] = {name: getattr(log, name)[voxels] for name in ("ix", "iy", "iz")}
    columns |= {"frame": log.frame[rows], "evidence": log.evidence.take(rows), "pixels": log.pixels[rows]}
    return dataclasses.replace(log, **columns, voxel=of)


def rows_of(table: VoxelTable, where: Mask) -> VoxelTable:
    """Return the voxels of a table for which `where` (n,) holds."""
    return table.rows(where)


def require_same_grid(*tables: VoxelTable | Events) -> None:
    """Raise DataError where tables differ in K or voxel size."""
    first, *rest = tables
    for other in rest:
        if (first.K, first.voxel_size) != (other.K, other.voxel_size):
            raise DataError(
                f"maps of {first.K} classes in voxels of {first.voxel_size:g} m and of {other.K} in"
                f" {other.voxel_size:g} m cannot be compared; fuse both with the same settings"
            )


def require_same_map(table: VoxelTable, events: Events) -> None:
    """Raise DataError where the events are not the log behind the table."""
    op = np.diff(events.bounds)
    if not (len(table) == len(events.ix) and np.array_equal(table.op, op)):
        raise DataError(
            f"events of {len(events.ix)} voxels and {len(events)} observations do not belong to a table of"
            f" {len(table)} and {int(table.op.sum(dtype=np.int64))}; take both from one backend"
        )


CHUNK = 1 << 14
"""Voxels that are compared at a time: they stay in the processor's cache."""

LABEL = "label"
"""The share of voxels with another dominant class; it alone is no disagreement, as a tie depends on the last bit."""

TOLERANCE = 1e-9
"""Largest difference allowed between float64 backends in a measure, or in a sum; of a sum above 1, relative to it."""

COUNTS = ("op", "pixels", "first_frame", "last_frame")
SUMS = ("evidence", "drift_sum", "self_sum", "frame_entropy_sum")
"""The columns of a voxel table besides the index: whole numbers, and sums over the frames."""


def compare(
    a: VoxelTable,
    b: VoxelTable,
    units: tuple[UnitName, UnitName],
    *,
    tolerance: float = TOLERANCE,
    voxel_share: float = 0.0,
) -> Agreement:
    """Compare two maps of the same frames, voxel by voxel, in every column of the voxel table and every measure.

    They agree where nothing differs by more than `tolerance` (sums above 1: relative to the sum), and where at most
    `voxel_share` of the voxels are in only one map. An SBD that is undefined in one map only counts as a difference of
    1, its range.

    Raises:
        DataError: If the maps differ in K or voxel size.
    """
    in_a, in_b = shared_rows(a, b)
    chunks = [
        _differences(a, b, in_a[start : start + CHUNK], in_b[start : start + CHUNK], tolerance)
        for start in range(0, max(1, len(in_a)), CHUNK)
    ]
    differences = {name: _deviation([(c[name].max, c[name].sum) for c in chunks], len(in_a)) for name in chunks[0]}
    only_in = (len(a) - len(in_a), len(b) - len(in_b))
    first = None
    if sum(only_in) > voxel_share * max(len(a), len(b)):
        first = next(_in_one_only(a, b, in_a, in_b))
    for name in differences:
        first = first or _joined([place for chunk in chunks if (place := chunk[name].first) is not None])
    return Agreement(
        scene=units[0].scene,
        model=units[0].model,
        backends=(units[0].backend, units[1].backend),
        voxels=(len(a), len(b)),
        only_in=only_in,
        differences=differences,
        agrees=first is None,
        first=first,
    )


def mismatches(got: VoxelTable, expected: VoxelTable, tolerance: float = TOLERANCE) -> Iterator[Mismatch]:
    """Yield where a map is not the expected one: voxels, then each column of the table, then each measure.

    Raises:
        DataError: If the maps differ in K or voxel size.
    """
    in_got, in_expected = shared_rows(got, expected)
    yield from _in_one_only(got, expected, in_got, in_expected)
    for column in _differences(got, expected, in_got, in_expected, tolerance).values():
        if column.first is not None:
            yield column.first


def together(parts: Sequence[Agreement]) -> Agreement:
    """Return the agreement on a map from that on each of its parts."""
    shared = [part.voxels[0] - part.only_in[0] for part in parts]
    return replace(
        parts[0],
        voxels=(sum(part.voxels[0] for part in parts), sum(part.voxels[1] for part in parts)),
        only_in=(sum(part.only_in[0] for part in parts), sum(part.only_in[1] for part in parts)),
        differences={
            name: _together([part.differences[name] for part in parts], shared) for name in parts[0].differences
        },
        agrees=all(part.agrees for part in parts),
        first=next((part.first for part in parts if part.first is not None), None),
    )


def _together(parts: Sequence[Deviation], voxels: Sequence[int]) -> Deviation:
    there = [(part, n) for part, n in zip(parts, voxels, strict=True) if n]
    return _deviation([(part.max, part.mean * n) for part, n in there], sum(voxels))


@dataclass(frozen=True, eq=False)
class _Rows:
    """Part of a map's rows, as measures read them."""

    op: Int32
    evidence: Float64
    drift_sum: Float64

    @classmethod
    def from_table(cls, table: VoxelTable, rows: Int64) -> _Rows:
        return cls(table.op[rows], table.evidence[rows], table.drift_sum[rows])


class _Difference(NamedTuple):
    """Largest difference of a quantity, its sum over the voxels (mean over classes), and the first that is too much."""

    max: float
    sum: float
    first: Mismatch | None


def _differences(a: VoxelTable, b: VoxelTable, in_a: Int64, in_b: Int64, tolerance: float) -> dict[str, _Difference]:
    """Return the differences of each quantity: columns, then measures, then the label."""
    rows_a, rows_b = _Rows.from_table(a, in_a), _Rows.from_table(b, in_b)

    def values(name: str) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        if name == "evidence":
            return rows_a.evidence, rows_b.evidence
        return getattr(a, name)[in_a], getattr(b, name)[in_b]

    def difference(name: str, x: npt.NDArray[Any], y: npt.NDArray[Any], most: Any = tolerance) -> _Difference:
        apart = np.abs(x.astype(np.float64) - y)
        undefined = np.isnan(apart)
        if undefined.any():
            apart[undefined] = np.isnan(x[undefined]) != np.isnan(y[undefined])
        largest, total = float(apart.max(initial=0.0)), float(apart.sum()) * len(x) / max(1, apart.size)
        if largest <= tolerance:
            return _Difference(largest, total, None)
        wrong = apart > most
        rows = np.flatnonzero(wrong if wrong.ndim == 1 else wrong.any(axis=1))
        if not len(rows):
            return _Difference(largest, total, None)
        where = tuple(np.argwhere(wrong)[0])
        column = name if len(where) == 1 else f"{name}_{where[1]}"
        first = Mismatch(_voxel(a, in_a[rows[0]]), column, x[where].item(), y[where].item(), len(rows))
        return _Difference(largest, total, first)

    differences = {name: difference(name, *values(name)) for name in COUNTS}
    for name in SUMS:
        x, y = values(name)
        differences[name] = difference(name, x, y, tolerance * np.maximum(1.0, np.abs(y)))
    for measure in measures():
        differences[measure.key] = difference(measure.key, measure.of(rows_a), measure.of(rows_b))
    other = dominant(rows_a) != dominant(rows_b)
    return differences | {LABEL: _Difference(float(other.max(initial=False)), float(other.sum()), None)}


def _in_one_only(got: VoxelTable, expected: VoxelTable, in_got: Int64, in_expected: Int64) -> Iterator[Mismatch]:
    """Yield the first voxel that is missing, and the first that should not be there."""
    for table, shared, is_expected in ((expected, in_expected, True), (got, in_got, False)):
        alone = np.setdiff1d(np.arange(len(table)), shared, assume_unique=True)
        if len(alone):
            op = (0, int(table.op[alone[0]]))
            yield Mismatch(_voxel(table, alone[0]), "op", *(op if is_expected else op[::-1]), len(alone))


def _voxel(table: VoxelTable, row: Any) -> tuple[int, int, int]:
    return int(table.ix[row]), int(table.iy[row]), int(table.iz[row])


def _joined(parts: Sequence[Mismatch]) -> Mismatch | None:
    return replace(parts[0], voxels=sum(part.voxels for part in parts)) if parts else None


def _deviation(chunks: Sequence[tuple[float, float]], voxels: int) -> Deviation:
    if not voxels:
        return Deviation(math.nan, math.nan)
    return Deviation(max(largest for largest, _ in chunks), sum(total for _, total in chunks) / voxels)
