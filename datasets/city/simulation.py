"""Simulated models: the true label map with errors tied to cells, views, frames and class borders."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semstab.core.types import Float32, Float64, Int64, UInt8, UInt64
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_8BIT
from semstab.datasets.city.hashing import hash_integers, rehash, salt, uniform
from semstab.datasets.city.mesh import uavid8
from semstab.datasets.city.options import CONFUSION, SimulatedModel
from semstab.datasets.city.rendering import Rendered, row_chunks

VIEW_ANGLE, VIEW_STEP, VIEW_DISTANCE = 15.0, 12.0, 60.0
"""Steps of direction (degrees) and distance (metres) for which view errors are drawn; where they stop growing."""

BORDER_SCALE = 12
"""Pixels over which the displacement of borders varies."""


@dataclass(frozen=True)
class CityView:
    """One frame as a model is given it.

    Attributes:
        frame: Index, for which flicker and border errors are drawn.
        T: (4, 4) camera to town: the pose, relative to the origin, so that errors move with the town.
    """

    frame: int
    rendered: Rendered
    intrinsics: Intrinsics
    T: Float64

    def positions(self, rows: slice) -> Float64:
        """Return coordinates (3, h, W) in the town of rows of pixels, with the fusion backends' order of operations."""
        d = self.rendered.depth[rows].astype(np.float64)
        k, T = self.intrinsics, self.T
        v = np.arange(rows.start, rows.start + len(d))[:, None]
        x = ((np.arange(d.shape[1]) - k.cx) / k.fx) * d
        y = ((v - k.cy) / k.fy) * d
        return np.stack([((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * d) + T[i, 3] for i in range(3)])


class Simulation:
    """A simulated model in one scene: predicts label maps, or soft scores if its softness is above 0."""

    def __init__(self, model: SimulatedModel, seed: int, name: str, scene: str) -> None:
        self.model = model
        self._salts = {kind: salt(seed, name, scene, kind) for kind in ("place", "view", "flicker", "border", "soft")}
        names = uavid8().classes
        self._weights: Float64 = np.array([[CONFUSION[true].get(wrong, 0.0) for wrong in names] for true in names])
        """(8, 8): for a true class in its row, the probability of each wrong class."""
        self._factors = np.array([model.difficulty.get(name, 1.0) for name in names] + [0.0])

    def labels(self, view: CityView) -> UInt8:
        """Return predicted ids (H, W); 255 for pixels without a surface."""
        predicted = self._displaced_borders(view)
        for rows in row_chunks(predicted.shape):
            self._put_errors(view, rows, predicted[rows])
        return predicted

    def scores(self, view: CityView) -> Float32:
        """Return soft scores (H, W, 8) that sum to 1, the predicted class the largest; 0 without a surface."""
        predicted = self.labels(view)
        scores = np.zeros((*predicted.shape, len(self._weights)), dtype=np.float32)
        for rows in row_chunks(predicted.shape):
            true = view.rendered.classes[rows]
            labelled = true != IGNORE_8BIT
            rest = self.model.softness * uniform(self._of_frame(self._spots(view, rows)[0], view, "soft"))[labelled]
            best, other = predicted[rows][labelled], true[labelled]
            spread = np.where((best == other)[:, None], self._weights[best], np.eye(len(self._weights))[other])
            spread *= rest[:, None]
            spread[np.arange(len(best)), best] = 1 - rest
            scores[rows][labelled] = spread
        return scores

    def _put_errors(self, view: CityView, rows: slice, predicted: UInt8) -> None:
        """Put errors of place, view and frame into rows of predictions."""
        model, true = self.model, view.rendered.classes[rows]
        spot, cells = self._spots(view, rows)
        factor = self._factors[np.minimum(true, len(self._weights))]
        self._strike(predicted, true, rehash(spot, self._salts["place"]), model.place * factor)
        if model.view:
            seen_from, distance = _seen_from(view.T, cells, model.cell)
            # grows with the angle to the normal, 1 from 60 degrees, and with the distance
            slant = np.minimum(1.0, 2 * (1 - view.rendered.incidence[rows].astype(np.float64)))
            chance = model.view * slant * np.minimum(1.0, distance / VIEW_DISTANCE) * factor
            self._strike(predicted, true, hash_integers(self._salts["view"], spot.view(np.int64), *seen_from), chance)
        self._strike(predicted, true, self._of_frame(spot, view, "flicker"), model.flicker * factor)

    def _strike(self, predicted: UInt8, true: UInt8, hashes: UInt64, chance: Float64) -> None:
        """Replace predictions by a wrong class for the true one, with a probability each, by hashes."""
        struck = uniform(hashes) < chance
        u = uniform(rehash(hashes[struck], 1))
        predicted[struck] = (u[:, None] >= np.cumsum(self._weights, axis=1)[true[struck]]).sum(axis=1)

    def _spots(self, view: CityView, rows: slice) -> tuple[UInt64, Int64]:
        """Return a hash of each pixel's cell, and the cell (3, h, W)."""
        cells = np.floor(view.positions(rows) / self.model.cell).astype(np.int64)
        return hash_integers(0, *cells), cells

    def _of_frame(self, spot: UInt64, view: CityView, kind: str) -> UInt64:
        return rehash(rehash(spot, self._salts[kind]), view.frame)

    def _displaced_borders(self, view: CityView) -> UInt8:
        """Return the true label map, read at pixels displaced by a smooth field of at most `border` pixels an axis."""
        true = view.rendered.classes
        if not self.model.border:
            return true.copy()
        H, W = true.shape
        dv, du = (self._field(view.frame, axis, H, W) for axis in (0, 1))
        v = np.clip(np.rint(np.arange(H, dtype=np.float32)[:, None] + dv), 0, H - 1).astype(np.int32)
        u = np.clip(np.rint(np.arange(W, dtype=np.float32) + du), 0, W - 1).astype(np.int32)
        moved = true[v, u]
        nothing = (moved == IGNORE_8BIT) | (true == IGNORE_8BIT)
        return np.where(nothing, true, moved)

    def _field(self, frame: int, axis: int, H: int, W: int) -> Float32:
        """Return random numbers within +-border on a grid of BORDER_SCALE pixels, interpolated to each pixel."""
        v, u = np.indices((H // BORDER_SCALE + 2, W // BORDER_SCALE + 2))
        hashes = hash_integers(self._salts["border"], v, u, np.full_like(v, axis), np.full_like(v, frame))
        nodes = (self.model.border * (2 * uniform(hashes) - 1)).astype(np.float32)
        size = (nodes.shape[1] * BORDER_SCALE, nodes.shape[0] * BORDER_SCALE)
        return np.asarray(cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)[:H, :W]


def _seen_from(T: Float64, cells: Int64, size: float) -> tuple[Int64, Float64]:
    """Return the camera's azimuth, elevation and distance from each cell's centre in steps (3, h, W); the distance."""
    x, y, z = (cells + 0.5) * size - T[:3, 3, None, None]
    across = np.hypot(x, y)
    distance = np.hypot(across, z)
    angles = np.degrees([np.arctan2(y, x), np.arctan2(z, across)]) / VIEW_ANGLE
    return np.floor([*angles, distance / VIEW_STEP]).astype(np.int64), distance
