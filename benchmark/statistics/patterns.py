"""What the same looks at other classes have in common is computed once: only the names of classes differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.model.concentration import Concentration
from semstab.model.evidence import Evidence
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import Judged
from semstab.statistics.observed import Observed
from semstab.statistics.order.fusion_rules import FLOOR

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

LEAST = 2 * FLOOR
"""Where a look gives a class less than this, a rule of fusion may take it for one that was never seen."""

MOST = 0.75
"""Patterns are looked for where there are at most so many for one voxel, else each voxel is looked at by itself."""


@dataclass(frozen=True, eq=False)
class Patterns:
    """The voxels of a map by their looks, where each class goes by its rank among those that a voxel ever saw.

    table, log  one voxel of each pattern, of which `copies` are all of them, with its observations
    of          (n,) which of these stands for each voxel; None where they are the same
    """

    table: VoxelTable
    log: Observed | None
    of: npt.NDArray[np.int32] | None = None

    @classmethod
    def found(cls, table: VoxelTable, log: Observed | None) -> Patterns:
        """Those of a table with its log; without one each voxel has its own."""
        if log is None:
            return cls(table, None)
        from semstab.statistics.loops.few_looks import ENUMERATED
        from semstab.statistics.loops.patterns import tell_patterns

        rows, of = np.empty(int(MOST * len(table)), np.int64), np.empty(len(table), np.int32)
        count = tell_patterns(
            table.op,
            (table.drift_sum, table.self_sum, table.frame_entropy_sum),
            table.evidence.entries,
            log.evidence.entries,
            log.starts,
            log.ends,
            table.K,
            ENUMERATED,  # above, orders hang on the place
            LEAST,
            rows,
            of,
        )
        if count < 0:
            return cls(table, log)
        rows = rows[:count]
        voxels = np.bincount(of, weights=table.voxels, minlength=count).astype(np.float64)
        return cls(replace(table.rows(rows), copies=voxels), log.rows(rows), of)

    def measured(self, table: VoxelTable) -> tuple[Patterns, VoxelTable]:
        """The same, and the table that they are of, with what measures are functions of: see `VoxelTable.measured`."""
        from semstab.statistics.loops.patterns import spread_labels

        own = self.table.measured()
        if self.of is None or table.evidence.known is not None:
            return replace(self, table=own), table if self.of is not None else own
        known, label = own.evidence.concentration, np.empty(len(table), np.uint16)
        spread_labels(own.evidence.entries, known.label, self.of, *table.evidence.entries[:2], label)
        largest, lead, bits, squares = (self.spread(v) for v in (known.largest, known.lead, known.bits, known.squares))
        evidence = replace(table.evidence, known=Concentration(largest, lead, bits, label, squares))
        return replace(self, table=own), replace(table, evidence=evidence)

    def spread(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values (n,) of all voxels from those (p,) of their patterns."""
        return values if self.of is None else values[self.of]


@dataclass(frozen=True, eq=False)
class Judging:
    """Beliefs (p, K) beside each class that may be the true one.

    label, largest  (p,) the dominant class, and the belief in it
    top     (p,) which of the classes with an entry it is, -1 where it is another
    errors  (m + p,) squared distance of a belief from certainty of each of these, and then of any other
    """

    label: npt.NDArray[np.uint16]
    largest: Float64
    top: Int64
    errors: Float64
    K: int

    @classmethod
    def of(cls, belief: Evidence) -> Judging:
        """Of beliefs as evidence, up to a factor."""
        from semstab.statistics.loops.patterns import errors_of

        found, rest = belief.concentration, np.zeros(0) if belief.unseen is None else belief.unseen
        top, errors = np.empty(len(belief), np.int64), np.empty(len(belief.label) + len(belief))
        errors_of(belief.entries, rest, found.label, belief.K, top, errors)
        return cls(found.label, found.largest, top, errors, belief.K)


@dataclass(frozen=True, eq=False)
class Alike:
    """Voxels (n,) with beliefs (p, K) that are those of their patterns, and their true classes.

    at      (n,) which of the beliefs each has
    begins  (n,) where its own classes begin in the labels of all
    truth   (n,) the true class, -1 where it is not known
    place   (n,) where that stands among the classes of its beliefs, see `place_of`
    voxels  (n,) how many each stands for
    """

    at: Int64
    begins: Int64
    labels: npt.NDArray[np.uint16]
    truth: Int64
    place: Int64
    voxels: Float64

    @classmethod
    def of(cls, belief: Evidence, at: Int64, table: VoxelTable, rows: Int64, truth: Int64) -> Alike:
        """Some rows (n,) of a table with true classes (n,)."""
        from semstab.statistics.loops.patterns import place_of

        starts, labels, _ = table.evidence.entries
        bounds, place = np.stack([starts[rows], starts[rows + 1]]), np.empty(len(rows), np.int64)
        place_of(at, bounds, labels, truth, belief.starts, place)
        return cls(at, bounds[0], labels, truth, place, table.voxels[rows])

    def judged(self, own: Judging) -> Judged:
        """These beliefs, or others about the same classes, beside the true classes."""
        top = own.top[self.at]
        predicted = self.labels[self.begins + top].astype(np.int64)
        if (top < 0).any():  # a class that was never seen: no other voxel has the pattern
            predicted = np.where(top < 0, own.label[self.at], predicted)
        return Judged(self.truth, predicted, own.largest[self.at], own.errors[self.place], self.voxels, own.K)
