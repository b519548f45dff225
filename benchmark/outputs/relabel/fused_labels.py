"""The class that the map has where a frame looks: one a pixel, where the voxel can be believed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.backends.shared.association import Observations, back_project, observe
from semstab.config import nearest
from semstab.errors import ConfigError
from semstab.metrics import CATEGORIES, categories
from semstab.metrics.matching import rows_of
from semstab.model.evidence import Evidence
from semstab.model.frames import Frame
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.model.measures import dominant
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.tiles import AT_HAND, Place, Tiles
from semstab.outputs.export.lookup import NONE, VoxelLookup
from semstab.runtime.at_hand import AtHand
from semstab.statistics import psa
from semstab.statistics.judging.commit import Commit

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

UNSEEN, UNSTABLE = -1, -2
"""Instead of a class: no depth or no voxel there; a voxel that is not believed."""

DECIMALS = 9
"""Of evidence from which a vote was taken: what rounding left decides no tie."""


@dataclass(frozen=True)
class Belief:
    """Which voxels are believed.

    min_op         seen by so many frames
    min_psa        their pairs of frames agree so often; a voxel seen once has no pair
    categories     of these categories, of any where none is named
    leave_own_out  without the frame's own vote, and seen by another frame. Drift is that of all votes: it depends on
                   their order
    commit         whose label has the evidence that these thresholds ask for

    Raises ConfigError for a category that there is not, and values out of range.
    """

    min_op: int = 1
    min_psa: float = 0.0
    categories: tuple[str, ...] = ()
    leave_own_out: bool = False
    commit: Commit | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_psa <= 1:
            raise ConfigError(f"min_psa = {self.min_psa:g}: agreement lies between 0 and 1")
        for name in self.categories:
            if name not in CATEGORIES:
                raise ConfigError(f"no category '{name}'; {nearest(name, CATEGORIES)}")

    def of(self, table: VoxelTable) -> npt.NDArray[np.bool_]:
        """(n,) whether each voxel is."""
        believed = table.op >= max(self.min_op, 1)
        if self.min_psa > 0:
            believed &= np.nan_to_num(psa(table), nan=-1.0) >= self.min_psa
        if self.categories:
            with np.errstate(invalid="ignore"):  # the belief of no vote
                believed &= np.isin(categories(table), [CATEGORIES.index(name) for name in self.categories])
        if self.commit is not None:
            believed &= self.commit.decide(table) >= 0
        return believed

    def settings(self) -> dict[str, object]:
        """As JSON has it."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return own | {"commit": None if self.commit is None else self.commit.model_dump(by_alias=True)}


class FusedLabels:
    """A map, to be asked for the classes that a frame sees; of its tiles those are at hand that frames saw last."""

    def __init__(self, tiles: Tiles[VoxelTable], belief: Belief, num_classes: int) -> None:
        self._tiles, self._belief, self._K = tiles, belief, num_classes
        self._lookups: AtHand[Place, VoxelLookup] = AtHand(
            lambda place: VoxelLookup(self._tiles[place]), lambda lookup: len(lookup.table), AT_HAND
        )

    def of(self, frame: Frame, pixel_stride: int = 1) -> Int64:
        """(H, W) rows 0..K-1 of the map's classes, UNSEEN or UNSTABLE, whatever the frame's own labels are.

        The frame is one of those that were fused, with every pixel_stride-th pixel of each axis.
        """
        everywhere = dataclasses.replace(frame, labels=np.zeros(frame.shape, np.uint8), scores=None)
        points = back_project(everywhere).T
        found, fused = np.full(len(points), UNSEEN), np.full(frame.shape, UNSEEN)
        own = (
            observe(frame.every(pixel_stride), self._tiles.voxel_size, self._K) if self._belief.leave_own_out else None
        )
        for place, pixels in self._tiles.holding(points):
            found[pixels] = self._labels(self._lookups[place], points[pixels], own)
        fused[everywhere.valid] = found
        return fused

    def _labels(self, lookup: VoxelLookup, points: Float64, own: Observations | None) -> Int64:
        """(n,) what points see of a tile."""
        found = lookup.rows(points)
        met = found != NONE
        rows, inverse = np.unique(found[met], return_inverse=True)
        seen = rows_of(lookup.table, rows)
        if own is not None:
            seen = _without(own, lookup, seen, rows)
        label = np.where(self._belief.of(seen), dominant(seen), UNSTABLE)
        found[met], found[~met] = label[inverse], UNSEEN
        return found


def _without(own: Observations, lookup: VoxelLookup, seen: VoxelTable, rows: Int64) -> VoxelTable:
    """The voxels of a tile that a frame sees, those rows of it, without the frame's own vote."""
    centers = np.add(own.index, 0.5, dtype=np.float64) * seen.voxel_size
    found = lookup.rows(centers)
    here = found != NONE
    at = np.searchsorted(rows, found[here])
    evidence, op, self_sum = seen.evidence[:], seen.op.copy(), seen.self_sum.copy()
    evidence[at] = np.abs(np.round(evidence[at] - own.s_bar[here], DECIMALS))
    op[at] -= 1
    self_sum[at] -= (own.s_bar[here] ** 2).sum(axis=1)
    return dataclasses.replace(seen, evidence=Evidence.of(evidence), op=op, self_sum=self_sum)


def labels_of(fused: Int64, ids: Sequence[int]) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """The label map of fused rows: the ids of the classes, or the ignore id of its type."""
    at = np.where(fused < 0, len(ids), fused)
    if max(ids) < IGNORE_8BIT:
        return np.array([*ids, IGNORE_8BIT], np.uint8)[at]
    return np.array([*ids, IGNORE_16BIT], np.uint16)[at]
