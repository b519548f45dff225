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
from semstab.statistics.ranks import distinct_rows, numbered, ranked
from semstab.statistics.sampling.collect import frame_groups
from semstab.statistics.sampling.cubes import cells_of
from semstab.statistics.sampling.influence import InfluenceSums
from semstab.statistics.sampling.layout import layout, width

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

AT_ONCE = 1 << 21
"""Sums that are made together."""

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
        groups, group = frame_groups(events.frame, step)
        key, weight = _by_frame(events, counted, kind, group, len(groups))
        own = keys[key // max(len(groups), 1)]
        own[:, 3] = groups[key % max(len(groups), 1)]
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


def _by_frame(events: Events, voxels: Int64, kind: Int64, group: Int64, groups: int) -> tuple[Int64, Float64]:
    """What kinds (n,) of voxels which groups (m,) of frames saw: kind * groups + group, and how many places these are.

    A place counts 1 / T for each of its T frames.
    """
    from semstab.statistics.sampling.loops import add_kinds

    starts, ends, order = events.starts[voxels], events.bounds[1:][voxels], ranked(kind)
    step, kinds, found = max(1, AT_ONCE // max(groups, 1)), int(kind.max(initial=-1)) + 1, [(kind[:0], np.zeros(0))]
    for first in range(0, kinds, step):
        low, high = np.searchsorted(kind, [first, first + step], sorter=order)
        total = np.zeros(min(step, kinds - first) * groups)
        add_kinds(order[low:high], kind, first, starts, ends, group, groups, total)
        key = np.flatnonzero(total)
        found.append((key + first * groups, total[key]))
    keys, weights = zip(*found, strict=True)
    return np.concatenate(keys), np.concatenate(weights)


def _distinct(key: npt.NDArray[np.int32], weight: Float64) -> tuple[npt.NDArray[np.int32], Float64]:
    rows, of = distinct_rows(key)
    return rows.astype(np.int32), np.bincount(of, weights=weight, minlength=len(rows)).astype(np.float64)
