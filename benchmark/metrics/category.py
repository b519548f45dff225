"""What kind of place a voxel is: low persistence, drifting, uncertain or stable (paper, Qualitative Analysis)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.model.measures import bits, sbd
from semstab.model.results import RECURRENT
from semstab.model.voxels import VoxelTable

LOW_PERSISTENCE, DRIFTING, UNCERTAIN, STABLE = range(4)

CATEGORIES = ("low persistence", "drifting", "uncertain", "stable")
"""Names by id, in the order in which they are decided."""

CATEGORY_COLORS = ((153, 153, 153), (240, 228, 66), (213, 94, 0), (0, 114, 178))
"""RGB by id: grey, and yellow, vermillion and blue of the colour-blind safe palette by Okabe and Ito (2008)."""


@dataclass(frozen=True)
class CategoryThresholds:
    """Where one category ends and the next begins.

    min_op          fewer observations are low persistence; the paper calls a voxel recurrent from OP = 3 on
    drifting_bits   SBD from which on the belief is still on the move. The paper's backbones have 0.041 and 0.019 bits
                    on average over recurrent voxels. One dissent among three labels has 0.095 bits or more; one among
                    four 0.046 if it comes last, 0.113 if it comes second
    uncertain_bits  entropy of the belief from which on it is ambiguous. In bits, because the normalised entropy of the
                    same split falls with K: a vote of 3 to 1 between two classes has 0.811 bits, one of 4 to 1 0.722

    Raises ConfigError where one of them is out of range.
    """

    min_op: int = RECURRENT
    drifting_bits: float = 0.05
    uncertain_bits: float = 0.8

    def __post_init__(self) -> None:
        if self.min_op < 1:
            raise ConfigError(f"min_op = {self.min_op}: use 1 or more")
        for name in ("drifting_bits", "uncertain_bits"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name} = {value:g}: it must be positive, in bits")


def categories(table: VoxelTable, thresholds: CategoryThresholds | None = None) -> npt.NDArray[np.uint8]:
    """Category of each voxel (n,), an index into CATEGORIES; the first of these that applies.

    low persistence  OP < min_op: too few observations to tell
    drifting         SBD >= drifting_bits: observations still move the belief
    uncertain        entropy >= uncertain_bits: the belief has settled on no clear answer
    stable           a clear answer, and little movement

    Drifting comes first because nearly all drifting voxels are ambiguous as well, but not the other way round: with
    more observations a voxel that stays ambiguous goes from drifting to uncertain.
    """
    return categorise(table.op, sbd(table), bits(table), thresholds)


def categorise(
    op: npt.NDArray[np.int32],
    sbd: npt.NDArray[np.float64],
    bits: npt.NDArray[np.float64],
    thresholds: CategoryThresholds | None = None,
) -> npt.NDArray[np.uint8]:
    """Category (n,) by OP, SBD in bits and entropy in bits, (n,) each; see `categories`."""
    limits = thresholds or CategoryThresholds()
    category = np.full(len(op), STABLE, dtype=np.uint8)
    category[bits >= limits.uncertain_bits] = UNCERTAIN
    category[sbd >= limits.drifting_bits] = DRIFTING
    category[op < limits.min_op] = LOW_PERSISTENCE
    return category


def category_shares(table: VoxelTable, thresholds: CategoryThresholds | None = None) -> dict[str, float]:
    """Share of the voxels in each category, 0 to 1, by name; NaN where the map is empty."""
    counts = np.bincount(categories(table, thresholds), minlength=len(CATEGORIES))
    return {name: float(n / len(table)) if len(table) else math.nan for name, n in zip(CATEGORIES, counts, strict=True)}
