"""Maps at the same number of observations: means as they would be if all had one distribution of OP."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.errors import ConfigError
from semstab.metrics.agreement import require_same_grid
from semstab.model.measures import Quantity, measures
from semstab.model.statistics import Estimate
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import PSA, psa
from semstab.statistics.blocks import BlockBootstrap, Blocks, Occupied, interval

Tables = Mapping[str, VoxelTable]

EDGES = (2, 3, 4, 5, 7, 10, 15, 20, 30, 50)
"""Upper edges of the strata of OP that comparisons are standardised by; OP = 1 is left out."""

LEAST_VOXELS, LEAST_OVERLAP = 50, 0.1
"""A stratum overlaps hardly where some map has fewer voxels in it, or a smaller part of what another map has."""


def voxelwise() -> dict[Quantity, Callable[[VoxelTable], Float64]]:
    """What is compared and has one value a voxel (n,), NaN where undefined."""
    return {PSA: psa, **{measure: measure.of for measure in measures()}}


@dataclass(frozen=True, eq=False)
class Observed:
    """How often maps saw their places, and where these are; what parts of the maps have adds up.

    counts    (M, S) voxels of each map in each stratum of OP
    occupied  of each map
    """

    counts: Int64
    occupied: tuple[Occupied, ...]

    @classmethod
    def of(cls, tables: Tables, edges: Sequence[int] = EDGES) -> Observed:
        """Of maps of one scene, or of their parts in one place."""
        own = [np.bincount(_stratum(table, edges), minlength=len(edges) + 2)[1:] for table in tables.values()]
        return cls(np.stack(own), tuple(Occupied.of(table.index) for table in tables.values()))

    @classmethod
    def merged(cls, parts: Sequence[Observed]) -> Observed:
        """Those of whole maps."""
        places = zip(*(part.occupied for part in parts), strict=True)
        counts = np.sum([part.counts for part in parts], axis=0)
        return cls(counts, tuple(Occupied.merged([each for each in own if len(each.cells)] or own) for own in places))

    def weights(self) -> Float64:
        """The common distribution of OP: shares (S,) of the strata among the voxels with OP >= 2 of all maps together.

        A stratum that is empty in some map has weight 0: there is nothing to compare it with.
        """
        pooled = np.where((self.counts > 0).all(axis=0), self.counts.sum(axis=0), 0)
        total = pooled.sum()
        return pooled / total if total else np.zeros(self.counts.shape[1])

    def thin(self, weights: Float64) -> float:
        """The part of the weights in strata of which some map has few voxels, or a small part of what another has."""
        few = (self.counts < LEAST_VOXELS).any(axis=0)
        few |= self.counts.min(axis=0) < LEAST_OVERLAP * self.counts.max(axis=0)
        return float(weights[few].sum())


def standardised(
    tables: Tables, measure: Quantity, *, edges: Sequence[int] = EDGES, seed: int = 0, weights: Float64 | None = None
) -> dict[str, Estimate]:
    """A measure's mean in each map, as it would be if all had the common distribution of OP (direct standardisation).

    sum_s w_s m_s with m_s the mean in stratum s; each map counts with all its voxels with OP >= 2.
    """
    require_same_grid(*tables.values())
    seen = Observed.of(tables, edges)
    estimates = {}
    for (name, table), occupied in zip(tables.items(), seen.occupied, strict=True):
        found = standardised_of(
            [stratum_sums(table, occupied.edge(), edges)],
            occupied.edge() * table.voxel_size,
            seen.weights() if weights is None else weights,
            seed=seed,
        )
        estimates[name] = found[measure.key]
    return estimates


def stratum_sums(table: VoxelTable, edge: int, edges: Sequence[int] = EDGES) -> Float64:
    """(B, 3 + Q S 2) over blocks of an edge in voxels: which block; by quantity and stratum the sum, and the count."""
    blocks, of = np.unique(table.index // edge, axis=0, return_inverse=True)
    stratum, S, B = _stratum(table, edges), len(edges) + 1, len(blocks)
    columns: list[npt.NDArray[np.number[Any]]] = [blocks]
    for formula in voxelwise().values():
        values = formula(table)
        again = np.flatnonzero((stratum > 0) & ~np.isnan(values))
        at = of.ravel()[again] * S + stratum[again] - 1
        columns += [np.bincount(at, weights=own, minlength=B * S).reshape(B, S) for own in (values[again], None)]
    return np.concatenate(columns, axis=1).astype(np.float64)


def standardised_of(parts: Sequence[Float64], size: float, weights: Float64, *, seed: int = 0) -> dict[str, Estimate]:
    """Each quantity's mean at these weights, by key, from `stratum_sums` of parts of a map in blocks of that size."""
    rows, S = np.concatenate(parts), len(weights)
    at, of = np.unique(rows[:, :3], axis=0, return_inverse=True)
    blocks = Blocks(of.ravel(), len(at), size)
    sums, resamples = blocks.sums(rows[:, 3:]), BlockBootstrap(blocks, seed=seed).weights

    def weighted(own: Float64) -> Float64:
        with np.errstate(invalid="ignore", divide="ignore"):
            means = own[..., :S] / own[..., S:]
            used = (weights > 0) & (own[..., S:].real > 0)
            total, of = np.where(used, weights * means, 0.0).sum(axis=-1), np.where(used, weights, 0.0).sum(axis=-1)
            value: Float64 = total / of
        return value

    return {
        quantity.key: interval(sums[:, 2 * S * q : 2 * S * (q + 1)], weighted, resamples, (0.0, 1.0))
        for q, quantity in enumerate(voxelwise())
    }


def _stratum(table: VoxelTable, edges: Sequence[int]) -> Int64:
    """(n,) 0 for OP = 1, else 1 to len(edges) + 1."""
    if list(edges) != sorted(set(edges)) or not edges or edges[0] < 2:
        raise ConfigError(f"edges = {list(edges)}: upper bounds of OP must ascend from 2 or more")
    return np.where(table.op >= 2, np.searchsorted(edges, table.op) + 1, 0)
