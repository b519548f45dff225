"""The class of the map at each pixel of a frame, where its voxel meets the criteria of a `Belief`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.backends.shared.association import Observations, back_project, observe
from semstab.config import nearest
from semstab.core.prefetch import SizedCache
from semstab.core.types import Float64, Int64, Mask, UInt8, UInt16
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.data.measures import dominant
from semstab.data.tiles import AT_HAND, TileIndex, Tiles
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError
from semstab.exports.join import NONE, VoxelLookup
from semstab.metrics import CATEGORIES, categories
from semstab.metrics.agreement import rows_of
from semstab.statistics import psa
from semstab.statistics.acceptance import AcceptanceThresholds

UNSEEN, UNSTABLE = -1, -2
"""The marks of a pixel without a class: no depth or no voxel there; a voxel that fails the criteria."""

DECIMALS = 9
"""The decimals of evidence without a frame's own vote, so that no rounding error decides a tie."""


@dataclass(frozen=True)
class Belief:
    """The criteria that a voxel must meet.

    Attributes:
        min_op: Number of frames that must see a voxel.
        min_psa: Share of its pairs of frames that must agree; a voxel seen once has no pair.
        categories: Categories that a voxel may be in; empty for any.
        leave_one_out: True to leave the frame's own vote out; another frame must then see the voxel. Drift stays the
            drift of all votes: it depends on their order.
        thresholds: Thresholds whose evidence the label must have.

    Raises:
        ConfigError: For an unknown category, and values out of range.

    Examples:
        >>> belief = semstab.Belief(min_op=3, min_psa=0.8, categories=("stable",))
        >>> semstab.relabel("run:sim-steady", "fused", belief=belief).frames
        24
    """

    min_op: int = 1
    min_psa: float = 0.0
    categories: tuple[str, ...] = ()
    leave_one_out: bool = False
    thresholds: AcceptanceThresholds | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_psa <= 1:
            raise ConfigError(f"min_psa = {self.min_psa:g}: agreement lies between 0 and 1")
        for name in self.categories:
            if name not in CATEGORIES:
                raise ConfigError(f"no category '{name}'; {nearest(name, CATEGORIES)}")

    def trusts(self, table: VoxelTable) -> Mask:
        """Return a mask (n,) of the voxels that meet the criteria."""
        believed = table.op >= max(self.min_op, 1)
        if self.min_psa > 0:
            believed &= np.nan_to_num(psa(table), nan=-1.0) >= self.min_psa
        if self.categories:
            with np.errstate(invalid="ignore"):  # the belief of no vote
                believed &= np.isin(categories(table), [CATEGORIES.index(name) for name in self.categories])
        if self.thresholds is not None:
            believed &= self.thresholds.decide(table) >= 0
        return believed

    def settings(self) -> dict[str, object]:
        """Return the criteria for JSON."""
        criteria = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return criteria | {"thresholds": None if self.thresholds is None else self.thresholds.model_dump(by_alias=True)}


class FusedLabels:
    """A lookup of the classes of a map that a frame sees; the latest tiles stay in memory."""

    def __init__(self, tiles: Tiles[VoxelTable], belief: Belief, num_classes: int) -> None:
        self._tiles, self._belief, self._K = tiles, belief, num_classes
        self._lookups: SizedCache[TileIndex, VoxelLookup] = SizedCache(
            lambda tile: VoxelLookup(self._tiles[tile]), lambda lookup: len(lookup.table), AT_HAND
        )

    def labels_of(self, frame: Frame, pixel_stride: int = 1) -> Int64:
        """Return (H, W) rows 0..K-1 of the map's classes, UNSEEN or UNSTABLE, whatever the frame's own labels are.

        The frame is one of those that were fused, with every pixel_stride-th pixel of each axis.
        """
        everywhere = dataclasses.replace(frame, labels=np.zeros(frame.shape, np.uint8), scores=None)
        points = back_project(everywhere).T
        labels, fused = np.full(len(points), UNSEEN), np.full(frame.shape, UNSEEN)
        vote = (
            observe(frame.every(pixel_stride), self._tiles.voxel_size, self._K) if self._belief.leave_one_out else None
        )
        for tile, pixels in self._tiles.holding(points):
            labels[pixels] = self._labels(self._lookups[tile], points[pixels], vote)
        fused[everywhere.valid] = labels
        return fused

    def _labels(self, lookup: VoxelLookup, points: Float64, vote: Observations | None) -> Int64:
        """Return the classes (n,) of points in a tile."""
        voxel = lookup.rows(points)
        met = voxel != NONE
        rows, inverse = np.unique(voxel[met], return_inverse=True)
        voxels = rows_of(lookup.table, rows)
        if vote is not None:
            voxels = _without(vote, lookup, voxels, rows)
        label = np.where(self._belief.trusts(voxels), dominant(voxels), UNSTABLE)
        labels = np.full(len(points), UNSEEN)
        labels[met] = label[inverse]
        return labels


def _without(vote: Observations, lookup: VoxelLookup, voxels: VoxelTable, rows: Int64) -> VoxelTable:
    """Return the voxels of a tile that a frame sees, `rows` of it, without the frame's own vote."""
    centers = np.add(vote.index, 0.5, dtype=np.float64) * voxels.voxel_size
    seen_rows = lookup.rows(centers)
    met = seen_rows != NONE
    positions = np.searchsorted(rows, seen_rows[met])
    if voxels.weight is not None:
        raise ConfigError(
            "leave_one_out: no frame's vote can be taken away from evidence by another rule than the mean; do without,"
            " or take a map by the mean (--backend)"
        )
    evidence, op, self_sum = voxels.evidence[:], voxels.op.copy(), voxels.self_sum.copy()
    evidence[positions] = np.abs(np.round(evidence[positions] - vote.s_bar[met], DECIMALS))
    op[positions] -= 1
    self_sum[positions] -= (vote.s_bar[met] ** 2).sum(axis=1)
    return dataclasses.replace(voxels, evidence=Evidence.from_rows(evidence), op=op, self_sum=self_sum)


def labels_of(fused: Int64, ids: Sequence[int]) -> UInt8 | UInt16:
    """Return the label map of fused rows: the ids of the classes, or the ignore id."""
    position = np.where(fused < 0, len(ids), fused)
    if max(ids) < IGNORE_8BIT:
        return np.array([*ids, IGNORE_8BIT], np.uint8)[position]
    return np.array([*ids, IGNORE_16BIT], np.uint16)[position]
