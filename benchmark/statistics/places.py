"""Find the worst places of a map: touching voxels on which frames disagree, and the views that see them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.records import Record
from semstab.data.voxel_keys import voxel_keys
from semstab.data.voxels import VoxelTable
from semstab.statistics.agreement import psa
from semstab.statistics.observations import SpotObservations

DISAGREES = 0.5
"""The largest share of the pairs of frames that agree on a voxel of a place."""

LEAST = 4
"""Least voxels of a place: a smaller one is where two surfaces meet in a voxel."""

MOST = 20
"""Most places, those with the most disagreement first."""

VOXELS = 1 << 19
"""Most voxels that are looked at, those on which frames agree least: memory does not grow with the map."""

NEIGHBOURS = 1.8
"""The largest distance of neighbours' centres, voxels: voxels across an edge or a corner are neighbours, too."""


@dataclass(frozen=True)
class PlaceView:
    """A frame that sees a place.

    Attributes:
        frame: Its index.
        label: The class that it gives most of the spots of the place; -1 if it gives no class.
        spots: Number of the spots that it sees.
    """

    frame: int
    label: int
    spots: int


@dataclass(frozen=True, eq=False)
class Place:
    """Touching voxels with the same two likeliest classes, on which frames disagree.

    Attributes:
        number: Number from 1 on, the most disagreement first.
        label, other: Rows of the likeliest class of the evidence of all its voxels, and of the next one.
        voxels: Number of voxels.
        agreement: Share of the pairs of frames that agree on a voxel, the mean over its voxels.
        share: Its share of the disagreement of the map, the sum of 1 - PSA over voxels.
        op: Median of the frames that saw a voxel.
        size: Metres from end to end.
        centre: (x, y, z) of the voxel that is closest to the mean of all, in the scene's coordinates, metres.
        points: (n, 3) centres of its voxels, metres.
        views: The frames that see a spot of it, in the order of their numbers; of frames that a camera took from one
            position the first.
    """

    number: int
    label: int
    other: int
    voxels: int
    agreement: float
    share: float
    op: float
    size: float
    centre: tuple[float, float, float]
    points: Float64
    views: tuple[PlaceView, ...]


def places_of(record: Record, most: int = MOST, table: VoxelTable | None = None) -> list[Place]:
    """Return the worst places of a unit whose voxels are stored, and read, unless they are given."""
    spots = record.observations_file
    observations = None if spots is None or not spots.exists() else SpotObservations.load(spots)
    return worst_places(record.tiles() if table is None else (table,), observations, most)


def worst_places(tables: Iterable[VoxelTable], spots: SpotObservations | None, most: int = MOST) -> list[Place]:
    """Return up to `most` of the worst places of a map in parts; without spots no views are known.

    The disagreement of a place is the sum of 1 - PSA over its voxels.
    """
    parts, total_loss = list[VoxelTable](), 0.0
    for part in tables:
        lost = 1 - np.nan_to_num(psa(part), nan=1.0)
        total_loss += float(lost.sum())
        parts.append(_least_agreed(part.rows(lost >= 1 - DISAGREES)))
        if sum(map(len, parts)) > 2 * VOXELS:
            parts = [_least_agreed(VoxelTable.joined(parts))]
    table = _least_agreed(VoxelTable.joined(parts))
    if not len(table):
        return []
    evidence, loss = table.evidence[:], 1 - psa(table)
    pair = np.sort(np.argsort(-evidence, axis=1, kind="stable")[:, :2], axis=1)
    place = connected(table.index, pair)
    total, count = np.bincount(place, loss), np.bincount(place)
    order = np.argsort(-total, kind="stable")
    order = order[count[order] >= LEAST][:most]
    number = np.full(len(total), -1)
    number[order] = np.arange(len(order))
    views = [()] * len(order) if spots is None else _views(table, number[place], len(order), spots)
    return [_place(k, number[place] == k, table, evidence, loss, total_loss, views[k]) for k in range(len(order))]


def _least_agreed(table: VoxelTable) -> VoxelTable:
    """Return the voxels on which frames agree least, at most VOXELS."""
    return table if len(table) <= VOXELS else table.rows(np.sort(np.argsort(psa(table), kind="stable")[:VOXELS]))


def connected(index: Int32, classes: npt.NDArray[np.integer[Any]]) -> Int64:
    """Return the set (n,) of touching voxels (n, 3) with the same classes (n, k) that each belongs to, from 0 on."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(index).query_pairs(NEIGHBOURS, output_type="ndarray")
    a, b = pairs[(classes[pairs[:, 0]] == classes[pairs[:, 1]]).all(axis=1)].T
    touching = coo_array((np.ones(len(a), np.bool_), (a, b)), shape=(len(index), len(index)))
    return np.asarray(connected_components(touching, directed=False)[1], np.int64)


def _place(
    number: int,
    inside: Mask,
    table: VoxelTable,
    evidence: Float64,
    loss: Float64,
    total_loss: float,
    views: tuple[PlaceView, ...],
) -> Place:
    """Return a place from the rows of its voxels, their losses (n,), and the loss of the whole map."""
    points, size = table.centers[inside], table.voxel_size
    x, y, z = points[np.linalg.norm(points - points.mean(axis=0), axis=1).argmin()].tolist()
    label, other = np.argsort(-evidence[inside].sum(axis=0), kind="stable")[:2].tolist()
    extent = float(np.linalg.norm(np.ptp(points, axis=0) + size))
    agreement, share, op = 1 - loss[inside].mean(), loss[inside].sum() / total_loss, np.median(table.op[inside])
    return Place(
        number + 1, label, other, len(points), float(agreement), float(share), float(op), extent, (x, y, z), points,
        views,
    )  # fmt: skip


def _views(table: VoxelTable, place: Int64, places: int, spots: SpotObservations) -> list[tuple[PlaceView, ...]]:
    """Return the views of each place, from the spots that lie in its voxels (n,), whose place is -1 for none."""
    cells, table_keys = voxel_keys(np.floor(spots.point / table.voxel_size).astype(np.int32), table.index)
    at = np.minimum(np.searchsorted(table_keys, cells), len(table_keys) - 1)
    of_spot = np.where(table_keys[at] == cells, place[at], -1)
    rows = np.flatnonzero(of_spot[spots.spot] >= 0)
    votes = np.zeros((places, len(spots.views), spots.K + 1), np.int64)
    np.add.at(votes, (of_spot[spots.spot[rows]], spots.view[rows], spots.label[rows]), 1)
    count = votes.sum(axis=2)
    labelled = votes[..., : spots.K].sum(axis=2) > 0
    label = np.where(labelled, votes[..., : spots.K].argmax(axis=2), -1)
    frame = spots.views.frame
    order = np.argsort(frame, kind="stable")
    return [
        tuple(PlaceView(int(frame[v]), int(label[k, v]), int(count[k, v])) for v in order if count[k, v])
        for k in range(places)
    ]
