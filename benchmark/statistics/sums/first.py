"""The first look at a part of a map: all sums that need nothing but it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import from_arrays, to_arrays
from semstab.core.types import Float64
from semstab.metrics.summary import STRATA
from semstab.model.voxels import VoxelTable
from semstab.statistics.blocks import Occupied
from semstab.statistics.correctness import Judged, judged_strata, judged_where
from semstab.statistics.kinds import Kinds
from semstab.statistics.map_sums import Maps, MapSums
from semstab.statistics.observed import Log
from semstab.statistics.order.drift import Flips, changes, flips_of, untested_drift
from semstab.statistics.patterns import Patterns
from semstab.statistics.sampling import PlaceSums
from semstab.statistics.sampling.collect import FrameGroups
from semstab.statistics.steady import Votes
from semstab.statistics.sums.by_log import LogSums, log_maps
from semstab.statistics.sums.by_rule import sums_by_rule
from semstab.statistics.sums.stable_looks import StableLooks
from semstab.statistics.verdict import repeated


@dataclass(frozen=True, eq=False)
class TruthSums:
    """What needs ground truth.

    right        over the cubes of the voxels with OP >= 2: how many are right, of those with a true class
    strata       `stratum_sums`
    reliability  `judged_sums` of the voxels with OP >= 2 and a true class
    stable       what the whole map makes sums of what is stable of
    """

    right: PlaceSums
    strata: Float64
    reliability: Float64
    stable: StableLooks

    @classmethod
    def of(cls, kinds: Kinds, edges: Sequence[int], groups: FrameGroups | None) -> TruthSums:
        """Of a map with true classes, whose log has these groups of frames."""
        table, truth, places = kinds.one.table, kinds.one.truth, kinds.one.places
        assert truth is not None
        judged = Judged.of(table.evidence, truth.label, table.voxels)
        right = {"right": np.where(truth.known, judged.right, np.nan)}
        return cls(
            PlaceSums(places.cell, places.edge, places.means(right)),
            judged_strata(judged, table.op, truth.known, edges),
            judged_where(judged, truth.known & (table.op >= 2)),
            StableLooks.of(kinds, groups),
        )

    @classmethod
    def merged(cls, parts: Sequence[TruthSums], sums: MapSums) -> TruthSums:
        """Those of a map whose other sums these are, from its parts."""
        return cls(
            PlaceSums.merged([part.right for part in parts]),
            np.sum([part.strata for part in parts], axis=0),
            np.sum([part.reliability for part in parts], axis=0),
            StableLooks.merged([part.stable for part in parts], sums.influence.edge, sums.influence.step),
        )


@dataclass(frozen=True, eq=False)
class FirstSums:
    """Those of a map; log, truth and limited (where a ceiling saw voxels twice) where that is known."""

    own: MapSums
    votes: Votes
    log: LogSums | None = None
    truth: TruthSums | None = None
    limited: Occupied | None = None

    @classmethod
    def merged(cls, parts: Sequence[FirstSums], seed: int = 0) -> FirstSums:
        """Those of a map from its parts."""
        own = MapSums.merged([part.own for part in parts])
        logs, truths, limits = ([getattr(part, name) for part in parts] for name in ("log", "truth", "limited"))
        return cls(
            own,
            Votes.merged([part.votes for part in parts]),
            None if logs[0] is None else LogSums.merged(logs, seed),
            None if truths[0] is None else TruthSums.merged(truths, own),
            None if limits[0] is None else Occupied.merged(limits),
        )

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All of it by name, as `read` takes it."""
        return {**self.own.arrays(), **to_arrays(replace(self, own=None), "first")}  # type: ignore[arg-type]

    @classmethod
    def read(cls, arrays: Mapping[str, npt.NDArray[Any]], classes: tuple[str, ...]) -> FirstSums:
        """From its arrays, among others, and the names of the classes."""
        return cls(MapSums.read(arrays, classes), *vars(from_arrays(_Further, arrays, "first")).values())


@dataclass(frozen=True, eq=False)
class _Further:
    """What `FirstSums` are beside their own."""

    votes: Votes
    log: LogSums | None
    truth: TruthSums | None
    limited: Occupied | None


def first_look(
    kinds: Kinds, limit: VoxelTable | None = None, *, edges: Sequence[int] = STRATA, seed: int = 0
) -> tuple[FirstSums, Maps, Float64 | None]:
    """The sums of a map, what is known of one voxel of each kind, and with a log its SBD in random order (n,).

    See `analyse` for what it takes.
    """
    kinds = kinds.measured()
    table, seen = kinds.one.table, kinds.one.log
    patterns = kinds.patterns
    groups = None if kinds.every.log is None else FrameGroups.of_log(kinds.every.log)
    rules = None if seen is None else sums_by_rule(kinds)  # before all that is kept: what follows has its memory
    truth = None if kinds.one.truth is None else TruthSums.of(kinds, edges, groups)
    drift = None if patterns.log is None else untested_drift(patterns.table, patterns.log, seed=seed)
    null = None if drift is None else patterns.spread(drift.null)
    own = MapSums.of(kinds, edges, null=null, groups=groups)
    log, more = None, {} if kinds.one.label is None else {"true_label": kinds.one.label}
    if seen is not None and drift is not None and rules is not None:
        changed = _flips_of(patterns, seen)
        log = LogSums.of(kinds, rules, drift, changed, seed)
        more = log_maps(patterns, drift, changed) | more
    found = FirstSums(
        own,
        Votes.of(table),
        log,
        truth,
        None if limit is None else Occupied.of(kinds.every.table.index[repeated(kinds.every.table, limit)[0]]),
    )
    return found, more, null


def _flips_of(patterns: Patterns, seen: Log) -> Flips:
    """Of all voxels (n,), whose log is `seen`."""
    assert patterns.log is not None
    return flips_of(seen, *(patterns.spread(values) for values in changes(patterns.log)))
