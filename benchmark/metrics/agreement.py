"""Do two fusion implementations leave the same map?"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import shared_rows
from semstab.model.evidence import row_chunks
from semstab.model.measures import measures
from semstab.model.results import Agreement, Deviation, Unit
from semstab.model.voxels import VoxelTable

Int64 = npt.NDArray[np.int64]

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
    quantities: dict[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]] = {
        "op": (a.op, b.op),
        **{measure.key: (measure.of(a), measure.of(b)) for measure in measures()},
    }
    differences = {name: _difference(x[in_a], y[in_b]) for name, (x, y) in quantities.items()}
    differences["evidence"] = _evidence_difference(a, b, in_a, in_b)
    only_in = (len(a) - len(in_a), len(b) - len(in_b))
    same_voxels = sum(only_in) <= voxel_share * max(len(a), len(b))
    same_values = all(not d.max > tolerance for d in differences.values())
    return Agreement(
        scene=units[0].scene,
        backbone=units[0].backbone,
        backends=(units[0].backend, units[1].backend),
        voxels=(len(a), len(b)),
        only_in=only_in,
        differences=differences,
        agrees=same_voxels and same_values,
    )


def _evidence_difference(a: VoxelTable, b: VoxelTable, in_a: Int64, in_b: Int64) -> Deviation:
    """Likewise of the evidence for each class, without all of it dense."""
    parts = [
        (_difference(a.evidence[in_a[some]], b.evidence[in_b[some]]), in_a[some].size)
        for some in row_chunks(len(in_a), a.K)
    ]
    return Deviation(max(part.max for part, _ in parts), sum(part.mean * n for part, n in parts) / max(len(in_a), 1))


def _difference(x: npt.NDArray[Any], y: npt.NDArray[Any]) -> Deviation:
    x, y = x.astype(np.float64), y.astype(np.float64)
    difference = np.where(np.isnan(x) & np.isnan(y), 0.0, np.abs(x - y))
    difference = np.where(np.isnan(difference), 1.0, difference)
    if not difference.size:
        return Deviation(math.nan, math.nan)
    return Deviation(float(difference.max()), float(difference.mean()))
