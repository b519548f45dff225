"""Where do frames not agree about a place, and between which classes? What a mean over a map hides if they are few."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.model.evidence import row_chunks
from semstab.model.statistics import Flipping
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ratio_of
from semstab.statistics.sampling import Places

Float64 = npt.NDArray[np.float64]

ENOUGH = 4
"""Looks from which on places that flip can be told from places that err now and then."""


def flipping(table: VoxelTable, stable: Float64, places: Places) -> Flipping:
    """The share of the places with OP >= 2 that are not stable, by the probability (n,) of `steady`.

    places  the cubes of these voxels
    """
    rows = np.flatnonzero(~np.isnan(stable))
    unsteady = 1 - stable[rows]
    share = places.estimate(np.stack([unsteady, np.ones(len(rows))], axis=1), ratio_of)
    seen = float(np.mean(table.op[rows] >= ENOUGH)) if len(rows) else float("nan")
    together = _together(table, rows, unsteady)
    total = float(together.sum())
    if not total > 0:
        return Flipping(share, seen)
    a, b = np.unravel_index(together.argmax(), together.shape)
    names = table.classes or tuple(str(k) for k in range(table.K))
    return Flipping(share, seen, names[int(a)], names[int(b)], float(together[a, b]) / total)


def _together(table: VoxelTable, rows: npt.NDArray[np.int64], unsteady: Float64) -> Float64:
    """(K, K), above the diagonal: how often two looks at one place are of two classes, where it is not stable."""
    together = np.zeros((table.K, table.K))
    for some in row_chunks(len(rows), table.K):
        belief = table.evidence[rows[some]] / table.op[rows[some], None]
        together += (unsteady[some, None] * belief).T @ belief
    upper: Float64 = np.triu(together, 1)
    return upper
