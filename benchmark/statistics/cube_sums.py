"""Sums over cubes of space that the sections of a description are functions of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.data.measures import sbd, vss
from semstab.data.statistics import Flipping
from semstab.data.voxels import VoxelTable
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import decompose, disagreement, kappa_of, psa
from semstab.statistics.cluster_sums import ClusterSums, Functional, mean_functional
from semstab.statistics.drift import flips
from semstab.statistics.intervals import estimate
from semstab.statistics.sample import MapSample

Columns = dict[str, npt.NDArray[Any]]


# --- Columns and means ------------------------------------------------------------------------------------------------


def row_columns(table: VoxelTable, null: Float64) -> Columns:
    """Return the columns (n,) that follow from the row of each voxel and its SBD in random order, `null` (n,)."""
    within, between = disagreement(table)
    parts = decompose(table)
    return {
        "psa": psa(table),
        "disagreement_within": within,
        "disagreement_between": between,
        "sbd_null": null,
        "sbd_excess": sbd(table) - null,
        "entropy_within": parts.within,
        "entropy_between": parts.between,
    }


MEANS: Mapping[str, Functional] = {
    **{name: mean_functional(name) for name in ("vss", "within", "between", "sbd", "null")},
    **{name: mean_functional(name) for name in ("entropy_within", "entropy_between")},
    "kappa": Functional(("kappa",), kappa_of, -1.0, 1.0, "agreement"),
}
"""Means over the voxels with OP >= 2 where values are defined, and kappa."""

OF_CLUSTERS = {"psa": "psa", "voxel_alpha": "voxel_alpha", "entropy": "entropy_op2", "excess": "sbd_excess"}
"""Numbers of the same voxels that verdicts, gates and comparisons print, too, with their names in `FUNCTIONALS`."""

OF_FLIPS = (mean_functional("flip_rate"), mean_functional("flip_null"), mean_functional("flip_excess", -1.0))
"""Means over the same voxels as the first of `MEANS`, so that those are identical without a log."""

OF_CHANGES = (mean_functional("frames_since", 0.0, math.inf),)
"""Means over fewer voxels."""


def location_sums(table: VoxelTable, columns: Columns, cubes: Cubes) -> ClusterSums:
    """Return the sums over cubes of the voxels with OP >= 2 that give `MEANS`."""
    sums = cubes.means(
        {
            "psa": columns["psa"],
            "vss": vss(table),
            "sbd": columns["sbd_excess"] + columns["sbd_null"],
            "null": columns["sbd_null"],
            "entropy_within": columns["entropy_within"],
            "entropy_between": columns["entropy_between"],
            **{name: columns[f"disagreement_{name}"] for name in ("within", "between")},
        }
    )
    (by_voxel,) = cubes.sums_by_class(table.evidence, lambda weight, voxel: weight / table.op[voxel])
    kappa = np.hstack([sums["psa"], by_voxel])  # as of `kappa_columns`
    return cubes.sums_by_name(sums | {"kappa": kappa})


# --- Locations that flip

ENOUGH = 4
"""Observations that separate locations that flip from locations that err now and then."""

UNIT = 2.0**-32
"""Unit of probabilities: sums of its multiples are exact, in whatever order a map's tiles are added."""


@dataclass(frozen=True, eq=False)
class FlippingSums:
    """Locations of a map that flip, as sums over its locations with OP >= 2.

    Attributes:
        share: Sums over cubes of the probability that a location is not consistent, and of their number.
        often: Number of locations seen ENOUGH times.
        together: (K, K), above the diagonal: how often two observations of one location are of two classes, where
            it is not consistent.
    """

    share: ClusterSums
    often: int
    together: Float64

    @classmethod
    def from_table(cls, table: VoxelTable, consistent: Float64, cubes: Cubes) -> FlippingSums:
        """Return the sums of a table by the stability posterior (n,), over the cubes of its voxels with OP >= 2."""
        inconsistent = np.round((1 - consistent) / UNIT) * UNIT
        share = cubes.sums_by_name(cubes.means({"inconsistent": inconsistent}))
        return cls(share, int(np.count_nonzero(table.op >= ENOUGH)), _together(table, inconsistent))

    def flipping(self, classes: Sequence[str] = ()) -> Flipping:
        """Return the share of the locations that are not consistent, and the two classes that most often meet there."""
        share = estimate(self.share, mean_functional("inconsistent"))
        locations = float(self.share["inconsistent"][:, 1].sum())
        share_seen_often = self.often / locations if locations else float("nan")
        total = float(self.together.sum())
        if not total > 0:
            return Flipping(share, share_seen_often)
        a, b = np.unravel_index(self.together.argmax(), self.together.shape)
        names = classes or tuple(str(k) for k in range(len(self.together)))
        return Flipping(share, share_seen_often, names[int(a)], names[int(b)], float(self.together[a, b]) / total)


def _together(table: VoxelTable, inconsistent: Float64) -> Float64:
    """Return (K, K) for voxels that are inconsistent with a probability (n,), NaN for those that do not count."""
    from semstab.statistics.loops.pairs import add_class_pairs

    pairs = np.zeros((table.K, table.K))
    add_class_pairs(table.evidence.entries, table.op, np.nan_to_num(inconsistent), pairs)
    return pairs


# --- Sums that need a log


def log_sums(sample: MapSample, cubes: Cubes) -> tuple[Columns, ClusterSums | None]:
    """Return the columns and sums that need a log; none without one."""
    if sample.events is None:
        return {}, None
    changes = flips(sample.events)
    means = {
        "flip_rate": changes.rate,
        "flip_null": changes.null,
        "flip_excess": changes.rate - changes.null,
        "frames_since": changes.since,
    }
    columns: Columns = {"flip_rate": changes.rate, "frames_since_flip": changes.since}
    return columns, cubes.sums_by_name(cubes.means(means))
