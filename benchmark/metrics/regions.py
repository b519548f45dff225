"""Regions without classes: how much of a segmentation changes between two frames, whatever its ids are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, DataError
from semstab.model.information import entropy_bits

Regions = npt.NDArray[np.integer[Any]]

UNASSIGNED = 0
"""The id of a pixel that belongs to no region."""

IOU_THRESHOLD = 0.25
"""Two regions can be one where their IoU is larger. Below 1/2, so that half of a region that is split stays it."""


@dataclass(frozen=True)
class RegionChange:
    """What happened between two frames.

    flicker_percent           of the pixels valid in both, those that left their region; NaN where there are none
    matched                   regions found again
    births, deaths            regions of the current frame that are new, of the previous one that are gone
    variation_of_information  between the two partitions, bits, the unassigned pixels being one part; NaN likewise
    """

    flicker_percent: float
    matched: int
    births: int
    deaths: int
    variation_of_information: float


def matched_region_flicker(
    previous: Regions,
    current: Regions,
    valid: npt.NDArray[np.bool_] | None = None,
    *,
    iou_threshold: float = IOU_THRESHOLD,
) -> RegionChange:
    """Flicker of region maps whose ids mean nothing across frames, such as Segment Anything's proposals.

    previous, current  (H, W) region ids, 0 for a pixel without a region
    valid              (H, W) pixels that count; all where not given

    Regions are matched one to one so that the sum of their IoUs over the valid pixels is largest (Hungarian method);
    pairs with an IoU of at most iou_threshold come apart again. flicker = 1 - (pixels in both regions of a pair +
    pixels unassigned in both) / valid pixels. To leave out camera motion, warp the previous map first
    (`semstab.pixels.warp.warp`) and count where that is defined.

    Raises DataError where the maps differ in size, ConfigError for a threshold that is not from 0 to below 1.
    """
    if not 0 <= iou_threshold < 1:
        raise ConfigError(f"iou_threshold = {iou_threshold:g}: use a share from 0 to below 1")
    if previous.shape != current.shape:
        sizes = " and ".join(f"{W}x{H}" for H, W in (previous.shape, current.shape))
        raise DataError(f"region maps differ in size ({sizes}); bring them to one")
    counted = slice(None) if valid is None else valid
    table = _Contingency.of(previous[counted].ravel(), current[counted].ravel())
    pairs = table.pairs(iou_threshold)
    stayed = table.both_unassigned + sum(int(table.shared[pair]) for pair in pairs)
    return RegionChange(
        flicker_percent=100 * (1 - stayed / table.pixels) if table.pixels else math.nan,
        matched=len(pairs),
        births=int(np.count_nonzero(table.current_ids)) - len(pairs),
        deaths=int(np.count_nonzero(table.previous_ids)) - len(pairs),
        variation_of_information=table.variation_of_information(),
    )


@dataclass(frozen=True, eq=False)
class _Contingency:
    """(P, Q) pixels that the p-th region of the previous and the q-th of the current map share, 0 being one of them."""

    previous_ids: Regions
    current_ids: Regions
    shared: npt.NDArray[np.int64]

    @classmethod
    def of(cls, previous: Regions, current: Regions) -> _Contingency:
        previous_ids, p = np.unique(previous, return_inverse=True)
        current_ids, q = np.unique(current, return_inverse=True)
        shape = (len(previous_ids), len(current_ids))
        shared = np.bincount(p * shape[1] + q, minlength=shape[0] * shape[1]).reshape(shape)
        return cls(previous_ids, current_ids, shared)

    @property
    def pixels(self) -> int:
        return int(self.shared.sum())

    @property
    def both_unassigned(self) -> int:
        p, q = self.previous_ids == UNASSIGNED, self.current_ids == UNASSIGNED
        return int(self.shared[np.ix_(p, q)].sum())

    def pairs(self, iou_threshold: float) -> list[tuple[int, int]]:
        """Rows and columns of the regions that are one."""
        from scipy.optimize import linear_sum_assignment

        rows, columns = np.flatnonzero(self.previous_ids), np.flatnonzero(self.current_ids)
        shared = self.shared[np.ix_(rows, columns)]
        either = self.shared.sum(axis=1)[rows, None] + self.shared.sum(axis=0)[None, columns] - shared
        iou = shared / np.maximum(either, 1)
        matched = zip(*linear_sum_assignment(iou, maximize=True), strict=True)
        return [(int(rows[i]), int(columns[j])) for i, j in matched if iou[i, j] > iou_threshold]

    def variation_of_information(self) -> float:
        """H(previous | current) + H(current | previous) = 2 H(both) - H(previous) - H(current); Meila 2007, JMVA 98."""
        if not self.pixels:
            return math.nan
        joint, before, after = (
            float(entropy_bits(part / self.pixels))
            for part in (self.shared.ravel(), self.shared.sum(axis=1), self.shared.sum(axis=0))
        )
        return max(0.0, 2 * joint - before - after)
