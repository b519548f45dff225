"""Cubes of space over any set of voxels, and intervals for this map of any statistic of their sums."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Mask
from semstab.model.events import Events
from semstab.model.information import by_group
from semstab.model.statistics import Interval
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ratio_of
from semstab.statistics.sampling.cubes import cubes
from semstab.statistics.sampling.influence import MOST_CELLS, Scale, Statistic
from semstab.statistics.sampling.intervals import Asked, answers, asked_of_places
from semstab.statistics.sampling.where import Where


@dataclass(frozen=True, eq=False)
class Places:
    """The cubes of voxels, and sums over those in each.

    cell  (G, 3) int32 the cubes, sorted
    at    (n,) int32 which of them each voxel is in, -1 for those that are left out
    edge  metres, a power of 2
    voxels  (n,) how many voxels each stands for, None for one each
    """

    cell: Int32
    at: Int32
    edge: float
    voxels: Float64 | None = None

    @classmethod
    def of(cls, table: VoxelTable, edge: float | None = None, *, where: Mask | None = None) -> Places:
        """Of a table, without the voxels for which `where` (n,), OP >= 2 if not given, does not hold.

        There are at most MOST_CELLS cubes, unless their edge is given, in metres.
        """
        some = table.op >= 2 if where is None else where
        return cls(*cubes((table.ix, table.iy, table.iz), table.voxel_size, edge, some), table.copies)

    @classmethod
    def of_log(cls, events: Events, edge: float) -> Places:
        """The same of the voxels of a log."""
        again = np.diff(events.bounds) >= 2
        return cls(*cubes((events.ix, events.iy, events.iz), events.voxel_size, edge, again))

    def rows(self, rows: Any) -> Places:
        """The same cubes, for some of the voxels."""
        return replace(self, at=self.at[rows], voxels=None if self.voxels is None else self.voxels[rows])

    @property
    def count(self) -> int:
        """How many cubes there are."""
        return len(self.cell)

    def sums(self, columns: Float64) -> Float64:
        """(G, C) over the voxels of each cube of columns (n, C), of what is not NaN."""
        return by_group(self.at, columns.astype(np.float64, copy=False).T, self.count, self.voxels)[0]

    def means(self, values: Mapping[str, npt.NDArray[Any]]) -> dict[str, Float64]:
        """(G, 2) by name: over the voxels of each cube where values (n,) are defined their sum, and how many."""
        both = by_group(self.at, [*values.values()], self.count, self.voxels)
        return {name: np.stack(own, axis=1) for name, *own in zip(values, both[0].T, both[1].T, strict=True)}

    def sums_by_class(self, table: VoxelTable) -> tuple[Float64, Float64]:
        """(G, K) over the voxels of each cube, which are a table's, of their evidence, and of that / OP."""
        from semstab.statistics.loops.rows import add_classes

        by_look, by_place = (np.zeros((self.count, table.K)) for _ in range(2))
        add_classes(self.at, table.evidence.entries, table.op, table.voxels, by_look, by_place)
        return by_look, by_place

    def estimate(
        self,
        columns: Float64,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The statistic of the sums of the voxels' columns (n, C), the second of which counts, with its interval.

        Where no scale is given, what goes from 0 to 1 is a share.
        """
        return PlaceSums(self.cell, self.edge, {"": self.sums(columns)}).estimate("", statistic, bounds, scale)


@dataclass(frozen=True)
class Mean:
    """A statistic of sums (..., C) by name, the second of which counts: a mean, or any other.

    Where no scale is given, what goes from 0 to 1 is a share.
    """

    sums: str
    of: Statistic = ratio_of
    bounds: tuple[float, float] = (0.0, 1.0)
    scale: Scale | None = None

    @property
    def kind(self) -> Scale:
        """The scale of its interval."""
        return self.scale or ("share" if self.bounds == (0.0, 1.0) else "plain")


@dataclass(frozen=True, eq=False)
class PlaceSums:
    """Sums by name over the voxels of cubes; those of a map in parts follow from the parts'.

    cell  (G, 3) int32 the cubes, of an edge in metres, a power of 2
    sums  (G, C) of each name
    """

    cell: Int32
    edge: float
    sums: Mapping[str, Float64]

    def __getitem__(self, name: str) -> Float64:
        """Sums (C,) over all cubes."""
        total: Float64 = self.sums[name].sum(axis=0)
        return total

    def __or__(self, further: Mapping[str, Float64]) -> PlaceSums:
        return PlaceSums(self.cell, self.edge, {**self.sums, **further})

    def estimate(
        self,
        name: str,
        statistic: Statistic,
        bounds: tuple[float, float] = (0.0, 1.0),
        scale: Scale | None = None,
    ) -> Interval:
        """The statistic of sums (..., C), the second of which counts, with its interval; see `Mean`."""
        return self.estimates({name: Mean(name, statistic, bounds, scale)})[name]

    def estimates(self, means: Mapping[str, Mean]) -> dict[str, Interval]:
        """Several of them, together."""
        return dict(zip(means, answers(self.asked(means)), strict=True))

    def asked(self, means: Mapping[str, Mean]) -> Iterator[Asked]:
        """For `answers`."""
        return (self._asked(own) for own in means.values())

    def _asked(self, mean: Mean) -> Asked:
        return asked_of_places(self._where, self.sums[mean.sums], mean.of, mean.kind, mean.bounds)

    @functools.cached_property
    def _where(self) -> Where:
        return Where.of(self.cell, None, self.edge)

    @classmethod
    def merged(cls, parts: Sequence[PlaceSums]) -> PlaceSums:
        """Those of a map from its parts, by the cubes that the whole map has."""
        edge = max(part.edge for part in parts)
        cells = np.concatenate([part.cell // round(edge / part.edge) for part in parts])
        while len(np.unique(cells, axis=0)) > MOST_CELLS:
            cells, edge = cells // 2, 2 * edge
        joined = {name: np.concatenate([part.sums[name] for part in parts]) for name in parts[0].sums}
        return cls._summed(cells, edge, joined)

    @classmethod
    def added(cls, parts: Sequence[PlaceSums]) -> PlaceSums:
        """Those of a map from its parts, whose cubes are of one edge, and stay so however many there are."""
        cells = np.concatenate([part.cell for part in parts])
        joined = {name: np.concatenate([part.sums[name] for part in parts]) for name in parts[0].sums}
        return cls._summed(cells, parts[0].edge, joined)

    @classmethod
    def _summed(cls, cells: Int32, edge: float, rows: Mapping[str, Float64]) -> PlaceSums:
        distinct, of = np.unique(cells, axis=0, return_inverse=True)
        sums = {name: np.zeros((len(distinct), own.shape[1])) for name, own in rows.items()}
        for name, own in rows.items():
            np.add.at(sums[name], of.ravel(), own)
        return cls(distinct.astype(np.int32), edge, sums)
