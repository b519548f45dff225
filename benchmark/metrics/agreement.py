"""Agreement of the maps of two fusion implementations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.events import Events
from semstab.data.measures import dominant, measures
from semstab.data.results import Agreement, Deviation, Unit
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError

# The same voxels in several maps.


def voxel_keys(*indices: npt.NDArray[np.integer]) -> list[Int64]:
    """Return one int64 key per voxel of each index array (n, 3), ascending with (ix, iy, iz), the same for all arrays.

    Raises:
        DataError: If the voxels span more than 2^63 cells together.
    """
    filled = [index for index in indices if len(index)]
    if not filled:
        return [np.zeros(0, dtype=np.int64) for _ in indices]
    low = np.min([index.min(axis=0) for index in filled], axis=0).astype(np.int64)
    high = np.max([index.max(axis=0) for index in filled], axis=0).astype(np.int64)
    size = [int(n) for n in high - low + 1]
    if math.prod(size) >= 2**63:
        raise DataError(f"the maps span {' x '.join(map(str, size))} voxels; leave out far depth, or use larger voxels")
    keys = []
    for index in indices:
        x, y, z = (index.astype(np.int64) - low).T
        keys.append((x * size[1] + y) * size[2] + z)
    return keys


def shared_rows(*tables: VoxelTable) -> list[Int64]:
    """Return rows of the voxels that all tables hold, one array per table, in the same order of voxels.

    Raises:
        DataError: If the tables differ in K or voxel size.
    """
    require_same_grid(*tables)
    if same_voxels(*tables):
        return [np.arange(len(tables[0]))] * len(tables)
    keys = voxel_keys(*(table.index for table in tables))
    common = reduce(lambda a, b: np.intersect1d(a, b, assume_unique=True), keys)
    return [np.searchsorted(own, common).astype(np.int64) for own in keys]


def same_voxels(first: VoxelTable, *others: VoxelTable) -> bool:
    """Return whether all tables have the same voxels."""
    names = ("ix", "iy", "iz")
    return all(np.array_equal(getattr(first, name), getattr(other, name)) for other in others for name in names)


def observations(log: Events, rows: Int64) -> Events:
    """Return these rows of a log, ascending, with the voxels that they are of."""
    voxels, of = np.unique(log.voxel[rows], return_inverse=True)
    own: dict[str, Any] = {name: getattr(log, name)[voxels] for name in ("ix", "iy", "iz")}
    own |= {"frame": log.frame[rows], "evidence": log.evidence.take(rows), "pixels": log.pixels[rows]}
    return dataclasses.replace(log, **own, voxel=of)


def rows_of(table: VoxelTable, where: Mask) -> VoxelTable:
    """Return the voxels of a table for which `where` (n,) holds."""
    return table.rows(where)


def require_same_grid(*tables: VoxelTable | Events) -> None:
    """Raise DataError where tables differ in K or voxel size."""
    first, *others = tables
    for other in others:
        if (first.K, first.voxel_size) != (other.K, other.voxel_size):
            raise DataError(
                f"maps of {first.K} classes in voxels of {first.voxel_size:g} m and of {other.K} in"
                f" {other.voxel_size:g} m cannot be compared; fuse both alike"
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
"""Largest difference allowed between float64 backends in any quantity of any voxel."""


def compare(
    a: VoxelTable, b: VoxelTable, units: tuple[Unit, Unit], *, tolerance: float = TOLERANCE, voxel_share: float = 0.0
) -> Agreement:
    """Compare two maps of the same frames, voxel by voxel.

    They agree where no quantity differs by more than `tolerance`, and where at most `voxel_share` of the voxels are in
    only one map. An SBD that is undefined in one map only counts as a difference of 1, its range.

    Raises:
        DataError: If the maps differ in K or voxel size.
    """
    in_a, in_b = shared_rows(a, b)
    chunks = [
        _differences(_Rows.of(a, in_a[start : start + CHUNK]), _Rows.of(b, in_b[start : start + CHUNK]))
        for start in range(0, max(1, len(in_a)), CHUNK)
    ]
    differences = {name: _deviation([chunk[name] for chunk in chunks], len(in_a)) for name in chunks[0]}
    only_in = (len(a) - len(in_a), len(b) - len(in_b))
    same_voxels = sum(only_in) <= voxel_share * max(len(a), len(b))
    same_values = all(not d.max > tolerance for name, d in differences.items() if name != LABEL)
    return Agreement(
        scene=units[0].scene,
        model=units[0].model,
        backends=(units[0].backend, units[1].backend),
        voxels=(len(a), len(b)),
        only_in=only_in,
        differences=differences,
        agrees=same_voxels and same_values,
    )


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
    def of(cls, table: VoxelTable, rows: Int64) -> _Rows:
        return cls(table.op[rows], table.evidence[rows], table.drift_sum[rows])


def _differences(a: _Rows, b: _Rows) -> dict[str, tuple[float, float]]:
    """Return the largest difference of each quantity and the mean over the classes summed over the voxels."""
    of_measures = {measure.key: _difference(measure.of(a), measure.of(b)) for measure in measures()}
    other = dominant(a) != dominant(b)
    return {
        "op": _difference(a.op, b.op),
        **of_measures,
        "evidence": _difference(a.evidence, b.evidence),
        LABEL: (float(other.max(initial=False)), float(other.sum())),
    }


def _difference(x: npt.NDArray[Any], y: npt.NDArray[Any]) -> tuple[float, float]:
    difference = np.abs(x.astype(np.float64) - y)
    undefined = np.isnan(difference)
    if undefined.any():
        difference[undefined] = np.isnan(x[undefined]) != np.isnan(y[undefined])
    return float(difference.max(initial=0.0)), float(difference.sum()) * len(x) / max(1, difference.size)


def _deviation(chunks: Sequence[tuple[float, float]], voxels: int) -> Deviation:
    if not voxels:
        return Deviation(math.nan, math.nan)
    return Deviation(max(largest for largest, _ in chunks), sum(total for _, total in chunks) / voxels)
