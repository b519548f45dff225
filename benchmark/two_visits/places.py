"""Places where neighbouring spots changed between two visits: their surface, or their class."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semstab.core.types import Int64, Mask
from semstab.data.georeference import Georeference
from semstab.statistics.visits import GONE, NEW, VisitedSpots

REACH = 2.0
"""Edges of coarse cells up to which spots with the same change are neighbours."""

LEAST = 5
"""Least number of spots of a place."""

MOST = 50
"""Most places."""


@dataclass(frozen=True)
class ChangedPlace:
    """Neighbouring spots with the same change.

    Attributes:
        number: From 1, the largest first.
        change: 'gone', 'new' or 'relabelled'.
        before, after: The class in the first and in the second visit; '' where the surface is not there.
        spots: How many.
        centre: Their mean, metres.
        size: From end to end, metres.
    """

    number: int
    change: str
    before: str
    after: str
    spots: int
    centre: tuple[float, float, float]
    size: float


def changed_places(visited: VisitedSpots, georeference: Georeference | None) -> tuple[ChangedPlace, ...]:
    """Return the places, the most spots first, in the coordinates of the exports."""
    spots, (before, after) = visited.spots, visited.dominant
    names = (*(spots.classes or tuple(str(k) for k in range(spots.K))), "")
    places = []
    for change, rows, pair in (
        ("gone", visited.change == GONE, (before, np.full_like(after, -1))),
        ("new", visited.change == NEW, (np.full_like(before, -1), after)),
        ("relabelled", visited.relabelled, (before, after)),
    ):
        for at in _together(visited, rows, pair):
            point = spots.point[at]
            size = float(np.linalg.norm(np.ptp(point, axis=0)))
            centre = point.mean(axis=0, keepdims=True)
            x, y, z = (centre if georeference is None else georeference.projected(centre))[0].tolist()
            places.append((change, names[pair[0][at[0]]], names[pair[1][at[0]]], len(at), (x, y, z), size))
    places.sort(key=lambda place: -place[3])
    return tuple(ChangedPlace(number, *place) for number, place in enumerate(places[:MOST], 1))


def _together(visited: VisitedSpots, where: Mask, pair: tuple[Int64, Int64]) -> list[Int64]:
    """Return the spots of each place: neighbours with the same pair of classes."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(where)
    if not len(rows):
        return []
    pairs = cKDTree(visited.spots.point[rows]).query_pairs(REACH * visited.spots.spacing, output_type="ndarray")
    kinds = np.stack([label[rows] for label in pair], axis=1)
    pairs = pairs[(kinds[pairs[:, 0]] == kinds[pairs[:, 1]]).all(axis=1)]
    links = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    _, group = connected_components(links, directed=False)
    order = np.argsort(group, kind="stable")
    groups = np.split(rows[order], np.cumsum(np.bincount(group))[:-1])
    return [members for members in groups if len(members) >= LEAST]
