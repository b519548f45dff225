"""Do two fusion implementations leave the same map?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import shared_rows
from semstab.model.measures import dominant, measures
from semstab.model.results import Agreement, Deviation, Unit
from semstab.model.voxels import VoxelTable

Float64 = npt.NDArray[np.float64]

CHUNK = 1 << 14
"""Voxels that are compared at a time: they stay in the processor's cache."""

LABEL = "label"
"""The share of voxels with another dominant class; no disagreement by itself, for a tie hangs on the last bit."""

TOLERANCE = 1e-9
"""Largest difference allowed between float64 backends in any quantity of any voxel."""


def compare(
    a: VoxelTable, b: VoxelTable, units: tuple[Unit, Unit], *, tolerance: float = TOLERANCE, voxel_share: float = 0.0
) -> Agreement:
    """Compare two maps of the same frames, voxel by voxel.

    They agree where no quantity differs by more than `tolerance`, and where at most `voxel_share` of the voxels are in
    one map only. An SBD that is undefined in one map only counts as a difference of 1, its range.
    Raises DataError where the maps differ in K or voxel size.
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
        backbone=units[0].backbone,
        backends=(units[0].backend, units[1].backend),
        voxels=(len(a), len(b)),
        only_in=only_in,
        differences=differences,
        agrees=same_voxels and same_values,
    )


def together(parts: Sequence[Agreement]) -> Agreement:
    """The agreement on a map, from that on each of its parts."""
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
    """Some rows of a map, as measures read them."""

    op: npt.NDArray[np.int32]
    evidence: Float64
    drift_sum: Float64

    @classmethod
    def of(cls, table: VoxelTable, rows: npt.NDArray[np.int64]) -> _Rows:
        return cls(table.op[rows], table.evidence[rows], table.drift_sum[rows])


def _differences(a: _Rows, b: _Rows) -> dict[str, tuple[float, float]]:
    """The largest difference of each quantity and the mean over the classes summed over the voxels."""
    found = {measure.key: _difference(measure.of(a), measure.of(b)) for measure in measures()}
    other = dominant(a) != dominant(b)
    return {
        "op": _difference(a.op, b.op),
        **found,
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
