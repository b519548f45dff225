"""Points of one scan against the surfaces of another: whether two scans lie on each other.

The nearest point would not tell: the rings of a scanner lie metres apart on the ground and move with the sensor, so
that the scans of a straight drive meet best, point by point, where their poses stand still.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.core.types import Float64, Mask

NEIGHBOURS = 30
"""Points of the other scan that may make a surface, ..."""

FLAT = 0.05
"""... where the least of their extents is, squared, at most this part of the middle one, ..."""

WIDE = 0.02
"""... and the middle one at least this part of the largest: the points of one ring make none."""

REACH = 2.0
"""A point is near to others up to this multiple of their largest extent, a standard deviation."""

LEAST_RANGE = 0.1
"""Metres; a point may be at the sensor itself."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of one scan, and the surface of another that is nearest to each.

    Attributes:
        points: (n, 3) in the axes of their own sensor.
        turn, shift: (3, 3), (3,) from these axes to those of the other sensor.
        middle, normal: (n, 3) of the surfaces, in the axes of the other.
        flat: (n,) whether the points there make a surface.
        nearest: (n,) metres to the nearest of them.
        reach: (n,) metres up to which a point is near to them.
    """

    points: Float64
    turn: Float64
    shift: Float64
    middle: Float64
    normal: Float64
    flat: Mask
    nearest: Float64
    reach: Float64

    @classmethod
    def nearest_to(cls, points: Float64, others: Float64, tree: Any, turn: Float64, shift: Float64) -> Surfaces:
        """Find the surface nearest to each of the points (n, 3), of others (m, 3), which are in the tree."""
        distance, rows = tree.query(points @ turn.T + shift, k=min(NEIGHBOURS, len(others)))
        distance, rows = distance.reshape(len(points), -1), rows.reshape(len(points), -1)
        around = others[rows]
        middle = around.mean(axis=1)
        from_middle = around - middle[:, None]
        squares = np.einsum("nki,nkj->nij", from_middle, from_middle) / around.shape[1]
        extents, axes = np.linalg.eigh(squares)
        flat = (extents[:, 0] <= FLAT * extents[:, 1]) & (extents[:, 1] >= WIDE * extents[:, 2])
        reach = REACH * np.sqrt(np.maximum(extents[:, 2], 0))
        return cls(points, turn, shift, middle, axes[:, :, 0], flat, distance[:, 0], reach)

    @property
    def near(self) -> Mask:
        """(n,) whether each point is near to points of the other scan."""
        return self.nearest <= self.reach

    @property
    def met(self) -> Mask:
        """(n,) whether each is near to a surface."""
        return self.flat & self.near

    @property
    def distance(self) -> Float64:
        """(n,) metres from each point to the plane of the surface."""
        carried = self.points @ self.turn.T + self.shift
        return np.asarray(np.abs(((carried - self.middle) * self.normal).sum(axis=1)), np.float64)

    @property
    def error(self) -> Float64:
        """(n,) the distance to the surface as a share of the range; for a point that is not near, to the nearest point.

        NaN for a point near to points that make no surface.
        """
        to_surface = np.where(self.flat, self.distance, np.nan)
        away = np.where(self.near, to_surface, self.nearest)
        return np.asarray(away / np.maximum(np.linalg.norm(self.points, axis=1), LEAST_RANGE), np.float64)
