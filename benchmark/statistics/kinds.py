"""What is the same for many voxels of a map is computed once: few looks at labels differ in few ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int32, Int64
from semstab.model.events import Events
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import Truth
from semstab.statistics.observed import Observed
from semstab.statistics.patterns import Patterns
from semstab.statistics.sampling.places import Places

FEW = 2
"""One voxel of each kind is looked at where there are at most one kind for so many voxels, else all of them."""


@dataclass(frozen=True, eq=False)
class Known:
    """Voxels with what is known of them.

    log  of their observations, truth their true classes
    places  the cubes of those with OP >= 2
    """

    table: VoxelTable
    log: Observed | None
    truth: Truth | None
    places: Places

    @property
    def label(self) -> Int64 | None:
        """(n,) the true class, -1 where it is not known."""
        return None if self.truth is None else self.truth.label


@dataclass(frozen=True, eq=False)
class Kinds:
    """The voxels of a map, and one of each kind, whose `copies` are how many voxels and `pixels` those of all of them.

    All that is summed over voxels is the same for those of a kind.

    every, one  all of the voxels, and one of each kind
    patterns    of the looks at the latter
    of          (n,) which of the latter stands for each of the former; None where they are the same
    """

    every: Known
    one: Known
    patterns: Patterns
    of: Int32 | None = None

    @classmethod
    def found(cls, table: VoxelTable, events: Events | None = None, truth: Truth | None = None) -> Kinds:
        """Those of a table, of its log, and of its true classes."""
        from semstab.statistics.loops.few_looks import ENUMERATED
        from semstab.statistics.loops.kinds import tell_apart

        every = Known(table, None if events is None else Observed.of(events), truth, Places.of(table))
        most, of, none = len(table) // FEW, np.empty(len(table), np.int32), np.zeros(0, np.int64)
        rows, voxels, pixels = np.empty(most, np.int64), np.zeros(most), np.zeros(most, np.int64)
        count = tell_apart(
            table.op,
            (table.drift_sum, table.self_sum, table.frame_entropy_sum),
            every.places.at,
            none if truth is None else truth.label,
            table.evidence.entries,
            (table if events is None else events).evidence.entries,
            none if events is None else events.bounds,
            table.op if events is None else events.frame,
            int(table.op.max(initial=0)) if events is None else ENUMERATED,  # above, orders hang on the place
            table.pixels,
            rows,
            voxels,
            pixels,
            of,
        )
        if count < 0:
            return cls(every, every, Patterns.found(table, every.log))
        rows, voxels, pixels = rows[:count], voxels[:count], pixels[:count]  # what is not written takes no memory
        one = Known(
            replace(table.rows(rows), copies=voxels, pixels=pixels),
            None if every.log is None else every.log.rows(rows),
            None if truth is None else Truth(truth.known[rows], truth.label[rows]),
            replace(every.places, at=every.places.at[rows], voxels=voxels),
        )
        return cls(every, one, Patterns.found(one.table, one.log), of)

    def measured(self) -> Kinds:
        """The same with what measures of one of each kind are functions of: see `VoxelTable.measured`."""
        patterns, table = self.patterns.measured(self.one.table)
        return replace(self, one=replace(self.one, table=table), patterns=patterns)


def spread(maps: Mapping[str, npt.NDArray[Any]], of: Int32 | None) -> dict[str, npt.NDArray[Any]]:
    """Values (n,) by name of all voxels, from those (k,) of one of each kind, and which one stands for each of them."""
    return {name: values if of is None else values[of] for name, values in maps.items()}
