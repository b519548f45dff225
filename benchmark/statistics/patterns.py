"""What the same looks at other classes have in common is computed once: only the names of classes differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64
from semstab.model.evidence import Evidence
from semstab.model.information import BLOCK, Concentration
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import BINS
from semstab.statistics.observed import Observed
from semstab.statistics.order.fusion_rules import FLOOR

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
    of: Int32 | None = None

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


def judged_alike(beliefs: Sequence[Evidence], at: Int32, table: VoxelTable, rows: Int64, truth: Int64) -> Float64:
    """(R, C) `judged_sums` of some rows (n,) of a table with true classes (n,), where these are known.

    Each of R beliefs (p, K) is that of patterns, all by the same classes; `at` (n,) is which of these voxels have.
    """
    from semstab.statistics.loops.patterns import add_alike, errors_of

    K, size = table.K, (len(beliefs), len(beliefs[0]))
    top, errors = np.empty(size, np.int64), np.empty((size[0], len(beliefs[0].label) + size[1]))
    found = [belief.concentration for belief in beliefs]
    for r, belief in enumerate(beliefs):
        rest = np.zeros(0) if belief.unseen is None else belief.unseen
        errors_of(belief.entries, rest, found[r].label, K, top[r], errors[r])
    about = (top, np.stack([own.label for own in found]), np.stack([own.largest for own in found]), errors)
    total, voxels = np.zeros((size[0], 3 + 3 * BINS + 3 * K)), np.zeros(0) if table.copies is None else table.copies
    for first in range(0, len(rows), BLOCK):
        some, sums = slice(first, first + BLOCK), np.zeros_like(total)
        own = (at[some], rows[some], truth[some], voxels)
        add_alike(*own, *table.evidence.entries[:2], beliefs[0].starts, *about, BINS, sums)
        total += sums
    return total
