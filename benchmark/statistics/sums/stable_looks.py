"""How much of a map's sums by frame and cube is stable, once the whole map tells how likely places with votes are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int32, Int64
from semstab.model.results import RECURRENT
from semstab.statistics.kinds import Kinds
from semstab.statistics.observed import Log
from semstab.statistics.ranks import distinct_rows, numbered
from semstab.statistics.sampling.collect import FrameGroups
from semstab.statistics.sampling.influence import InfluenceSums
from semstab.statistics.sampling.layout import layout, width

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

    key: Int32
    weight: Float64
    edge: float
    step: int

    @classmethod
    def of(cls, kinds: Kinds, groups: FrameGroups | None) -> StableLooks:
        """Those of a map with true classes."""
        one = kinds.one
        assert one.truth is not None
        counted = np.flatnonzero(one.truth.known & (one.table.op >= RECURRENT))
        evidence, edge = one.table.evidence.concentration, one.places.edge
        cell, of = one.places.cell, one.places.at[counted].astype(np.int64)
        T, wrong = one.table.op[counted].astype(np.int64), evidence.label[counted] != one.truth.label[counted]
        longest = int(T.max(initial=0)) + 1
        packed = ((of * longest + T) * longest + np.rint(evidence.largest[counted] * T).astype(np.int64)) * 2 + wrong
        votings, voting = numbered(packed)
        pairs, is_wrong = np.divmod(votings, 2)
        ofs, votes = np.divmod(pairs, longest * longest)
        keys = np.column_stack([cell[ofs], np.full(len(votings), -1), *np.divmod(votes, longest), is_wrong])
        if one.log is None or groups is None:
            count = np.bincount(voting, weights=one.table.voxels[counted], minlength=len(votings))
            return cls(keys.astype(np.int32), count.astype(np.float64), edge, 0)
        kind = np.full(len(one.table), -1, np.int32)
        kind[counted] = voting
        key, weight = _by_frame(one.log, kind, one.table.copies, len(votings), groups)
        many = max(len(groups.groups), 1)
        own = keys[key // many]
        own[:, 3] = groups.groups[key % many]
        return cls(own.astype(np.int32), weight, edge, groups.step)

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


def _by_frame(log: Log, kind: Int32, copies: Float64 | None, kinds: int, groups: FrameGroups) -> tuple[Int64, Float64]:
    """What kinds (n,) of voxels, -1 is none, which groups of frames saw: kind * groups + group, and how many.

    A row stands for `copies` (n,) of voxels, for one where these are not given, of which each counts
    1 / T for each of its T frames.
    """
    from semstab.statistics.sampling.loops import add_kinds

    count, found = len(groups.groups), [(np.zeros(0, np.int64), np.zeros(0))]
    voxels = np.zeros(0) if copies is None else copies
    step = max(1, AT_ONCE // max(count, 1))
    for first in range(0, kinds, step):
        total = np.zeros(min(step, kinds - first) * count)
        add_kinds(kind, voxels, first, (log.starts, log.ends), groups.of, count, total)
        key = np.flatnonzero(total)
        found.append((key + first * count, total[key]))
    keys, weights = zip(*found, strict=True)
    return np.concatenate(keys), np.concatenate(weights)


def _distinct(key: Int32, weight: Float64) -> tuple[Int32, Float64]:
    rows, of = distinct_rows(key)
    return rows.astype(np.int32), np.bincount(of, weights=weight, minlength=len(rows)).astype(np.float64)
