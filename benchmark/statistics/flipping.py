"""Where do frames not agree about a place, and between which classes? What a mean over a map hides if they are few."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.model.statistics import Flipping, Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.sampling import Places, PlaceSums
from semstab.statistics.sampling.intervals import Asked
from semstab.statistics.sampling.places import Mean

ENOUGH = 4
"""Observations from which on places that flip can be told from places that err now and then."""

UNIT = 2.0**-32
"""Of probabilities: sums of multiples of it are exact, in whatever order a map's tiles are added."""


@dataclass(frozen=True, eq=False)
class FlippingSums:
    """What is known of the places of a map that flip, as sums over its places with OP >= 2.

    share     over the cubes: how likely places are not stable, and how many there are
    often     how many were seen ENOUGH times
    together  (K, K), above the diagonal: how often two looks at one place are of two classes, where it is not stable
    """

    share: PlaceSums
    often: int
    together: Float64

    @classmethod
    def of(cls, table: VoxelTable, stable: Float64, places: Places) -> FlippingSums:
        """Of a table, by the probability (n,) of `steady`, over the cubes of its voxels with OP >= 2."""
        unsteady = np.round((1 - stable) / UNIT) * UNIT
        share = PlaceSums(places.cell, places.edge, places.means({"": unsteady}))
        return cls(share, int(table.voxels.sum(where=table.op >= ENOUGH)), _together(table, table.voxels * unsteady))

    @classmethod
    def merged(cls, parts: Sequence[FlippingSums]) -> FlippingSums:
        """Those of a map from its parts."""
        share = PlaceSums.added([part.share for part in parts])
        return cls(share, sum(part.often for part in parts), np.sum([part.together for part in parts], axis=0))

    def asked(self) -> Iterator[Asked]:
        """For `answers`: the share of the places that are not stable."""
        return self.share.asked({"": Mean("")})

    def flipping(self, share: Interval, classes: Sequence[str] = ()) -> Flipping:
        """That share, as it was answered, and the two classes that stand together most often there."""
        places = self.share[""][1]
        seen = float(self.often / places) if places else float("nan")
        total = float(self.together.sum())
        if not total > 0:
            return Flipping(share, seen)
        a, b = np.unravel_index(self.together.argmax(), self.together.shape)
        names = classes or tuple(str(k) for k in range(len(self.together)))
        return Flipping(share, seen, names[int(a)], names[int(b)], float(self.together[a, b]) / total)


def _together(table: VoxelTable, unsteady: Float64) -> Float64:
    """(K, K) of voxels that are unsteady with that probability (n,), NaN for those that do not count."""
    from semstab.statistics.loops.rows import add_pairs

    pairs = np.zeros((table.K, table.K))
    add_pairs(table.evidence.entries, table.op, unsteady, pairs)
    return pairs
