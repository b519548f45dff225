"""How much of a map's sums by frame and cube is stable, once the whole map tells how likely places with votes are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.measures import dominant, vss
from semstab.model.results import RECURRENT
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.ranks import added, distinct_rows, numbered
from semstab.statistics.sampling.cubes import cells_of
from semstab.statistics.sampling.influence import InfluenceSums
from semstab.statistics.sampling.layout import layout, width

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

AT_ONCE = 1 << 21
"""Observations that are looked at together."""

SEEN, MOST, WRONG = 4, 5, 6
"""Columns of the keys, after cube and frame."""


@dataclass(frozen=True, eq=False)
class StableLooks:
    """Looks at the places of a map with OP >= 3 and a true class, by what decides how likely these are stable.

    key     (k, 7) int32 cube, group of frames (-1 without a log), frames that saw the place, votes for its dominant
            class, whether this is wrong
    weight  (k,) how many places these are, each counting 1 / T for each of its T frames
    edge, step  of cubes and groups, as in `InfluenceSums`
    """

    key: npt.NDArray[np.int32]
    weight: Float64
    edge: float
    step: int

    @classmethod
    def of(cls, table: VoxelTable, events: Events | None, true_label: Int64, edge: float, step: int) -> StableLooks:
        """Those of a table with true classes (n,), -1 where they are not known."""
        counted = np.flatnonzero((true_label >= 0) & (table.op >= RECURRENT))
        some = table.rows(counted)
        cell, of = cells_of(some.index, table.voxel_size, edge)
        T, wrong = some.op.astype(np.int64), dominant(some) != true_label[counted]
        longest = int(T.max(initial=0)) + 1
        packed = ((of * longest + T) * longest + np.rint(vss(some) * T).astype(np.int64)) * 2 + wrong
        kinds, kind = numbered(packed)
        pairs, is_wrong = np.divmod(kinds, 2)
        ofs, votes = np.divmod(pairs, longest * longest)
        keys = np.column_stack([cell[ofs], np.full(len(kinds), -1), *np.divmod(votes, longest), is_wrong])
        if events is None:
            return cls(keys.astype(np.int32), np.bincount(kind, minlength=len(kinds)).astype(np.float64), edge, 0)
        groups = int(events.frame.max(initial=0)) // step + 1
        bounds = np.searchsorted(np.cumsum(T), np.arange(AT_ONCE, T.sum(), AT_ONCE))
        parts = []
        for rows in np.split(np.arange(len(T)), bounds):
            group = _frames_of(events, counted[rows], T[rows]) // step
            parts.append(added(np.repeat(kind[rows], T[rows]) * groups + group, np.repeat(1.0 / T[rows], T[rows])))
        key, weight = added(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        own = keys[key // groups]
        own[:, 3] = key % groups
        return cls(own.astype(np.int32), weight, edge, step)

    @classmethod
    def merged(cls, parts: Sequence[StableLooks], edge: float, step: int) -> StableLooks:
        """Those of a map from its parts, by coarser cubes and groups of frames."""
        keys = []
        for part in parts:
            key = part.key.copy()
            key[:, :3] //= round(edge / part.edge)
            known = step and part.step
            key[:, 3] = np.where(key[:, 3] >= 0, key[:, 3] // (step // part.step), -1) if known else -1
            keys.append(key)
        weight = np.concatenate([part.weight for part in parts])
        return cls(*_distinct(np.concatenate(keys), weight), edge, step)

    def added_to(self, sums: InfluenceSums, likely: Callable[[Int64, Int64], Float64]) -> InfluenceSums:
        """The sums of the same map with what is stable, by the probability (k,) of places with these votes."""
        own = layout(sums.K, truth=True)
        stable = self.weight * likely(self.key[:, SEEN].astype(np.int64), self.key[:, MOST].astype(np.int64))
        rows, of = distinct_rows(self.key[:, :4])
        columns = np.zeros((len(rows), width(sums.K, truth=True)))
        for name, values in (("stable", stable), ("stable_wrong", stable * self.key[:, WRONG])):
            columns[:, own[name].start] = np.bincount(of, weights=values, minlength=len(rows))
        return dataclasses.replace(
            sums,
            cell=np.concatenate([sums.cell, rows[:, :3]]).astype(np.int32),
            frame=np.concatenate([sums.frame, rows[:, 3]]).astype(np.int32),
            columns=np.concatenate([sums.columns, columns]),
        ).coarsened(sums.edge, sums.step)


def _frames_of(events: Events, voxels: Int64, T: Int64) -> Int64:
    """The frames that saw these voxels (n,), T each, one after the other."""
    of = np.repeat(np.arange(len(T)), T)
    frames: Int64 = events.frame[np.arange(len(of)) + (events.starts[voxels] - np.cumsum(T) + T)[of]].astype(np.int64)
    return frames


def _distinct(key: npt.NDArray[np.int32], weight: Float64) -> tuple[npt.NDArray[np.int32], Float64]:
    rows, of = distinct_rows(key)
    return rows.astype(np.int32), np.bincount(of, weights=weight, minlength=len(rows)).astype(np.float64)
