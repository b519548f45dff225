"""Simulated backbones: the true label map with errors tied to places, views, frames and class borders."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semstab.core.types import Float32, Float64, Int64, UInt8, UInt64
from semstab.datasets.city.mesh import uavid8
from semstab.datasets.city.options import CONFUSION, SimulatedBackbone
from semstab.datasets.city.rendering import CHUNK, Rendered, hash_integers, rehash, salt, uniform
from semstab.model.frames import Intrinsics
from semstab.model.labels import IGNORE_8BIT

Labels = UInt8
Scores = Float32


@dataclass(frozen=True)
class View:
    """One frame as a backbone is given it.

    frame   index, what flicker and border errors are drawn for
    T_wc    (4, 4) camera-to-world; origin (3,), from where cells are counted
    """

    frame: int
    rendered: Rendered
    intrinsics: Intrinsics
    T_wc: Float64
    origin: Float64

    def positions(self, rows: slice) -> Float64:
        """World coordinates (3, h, W) of rows of pixels, in the order of operations of the fusion backends."""
        d = self.rendered.depth[rows].astype(np.float64)
        k, T = self.intrinsics, self.T_wc
        v = np.arange(rows.start, rows.start + len(d))[:, None]
        x = ((np.arange(d.shape[1]) - k.cx) / k.fx) * d
        y = ((v - k.cy) / k.fy) * d
        return np.stack([((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * d) + T[i, 3] for i in range(3)])


class Simulation:
    """A simulated backbone in one scene: predicts label maps, or soft scores where its softness is above 0."""

    def __init__(self, model: SimulatedBackbone, seed: int, name: str, scene: str) -> None:
        self.model = model
        self._salts = {kind: salt(seed, name, scene, kind) for kind in ("place", "view", "flicker", "border", "soft")}
        self._weights = confusion_matrix(model)
        self._cumulative = np.cumsum(self._weights, axis=1)
        self._factors = np.array([model.difficulty.get(name, 1.0) for name in uavid8().classes] + [0.0])

    def labels(self, view: View) -> Labels:
        """Predicted ids (H, W) uint8; 255 where there is nothing."""
        predicted = self._displaced_borders(view)
        for rows in _row_chunks(predicted.shape):
            predicted[rows] = self._with_errors(view, rows, predicted[rows])
        return predicted

    def scores(self, view: View) -> Scores:
        """Soft scores (H, W, 8) float32 that sum to 1, the predicted class the largest; 0 where there is nothing."""
        predicted = self.labels(view)
        scores = np.zeros((*predicted.shape, len(self._weights)), dtype=np.float32)
        for rows in _row_chunks(predicted.shape):
            scores[rows] = self._softened(view, rows, predicted[rows])
        return scores

    def _with_errors(self, view: View, rows: slice, predicted: Labels) -> Labels:
        model, true = self.model, view.rendered.classes[rows]
        if not (model.place or model.view or model.flicker):
            return predicted
        cells = self._cells(view, rows)
        place = hash_integers(0, *cells)
        factor = self._factors[np.minimum(true, len(self._weights))]
        wrong = self._strike(predicted, true, rehash(place, self._salts["place"]), model.place * factor)
        if model.view:
            seen_from, distance = self._seen_from(view, cells)
            chance = _view_chance(model, view.rendered.incidence[rows], distance) * factor
            drawn = hash_integers(self._salts["view"], place.view(np.int64), *seen_from)
            wrong = self._strike(wrong, true, drawn, chance)
        if model.flicker:
            wrong = self._strike(wrong, true, self._of_frame(place, view.frame, "flicker"), model.flicker * factor)
        return wrong

    def _strike(self, predicted: Labels, true: Labels, drawn: UInt64, chance: Float64) -> Labels:
        """Replace predictions by a wrong class for the true one, with a probability each, by drawn hashes."""
        struck = uniform(drawn) < chance
        u = uniform(rehash(drawn[struck], 1))
        wrong = (u[:, None] >= self._cumulative[true[struck]]).sum(axis=1)
        result = predicted.copy()
        result[struck] = wrong
        return result

    def _softened(self, view: View, rows: slice, predicted: Labels) -> Scores:
        true = view.rendered.classes[rows]
        seen = true != IGNORE_8BIT
        place = hash_integers(0, *self._cells(view, rows))
        rest = self.model.softness * uniform(self._of_frame(place, view.frame, "soft"))[seen]
        best, other = predicted[seen], true[seen]
        spread = np.where((best == other)[:, None], self._weights[best], np.eye(len(self._weights))[other])
        spread *= rest[:, None]
        spread[np.arange(len(best)), best] = 1 - rest
        scores = np.zeros((*true.shape, len(self._weights)), dtype=np.float32)
        scores[seen] = spread
        return scores

    def _cells(self, view: View, rows: slice) -> tuple[Int64, Int64, Int64]:
        """Cell of each pixel, counted from the cell of the town's origin, so that errors move with the town."""
        x, y, z = view.positions(rows)
        a, b, c = np.rint(view.origin / self.model.cell)
        size = self.model.cell
        return (
            (np.floor(x / size) - a).astype(np.int64),
            (np.floor(y / size) - b).astype(np.int64),
            (np.floor(z / size) - c).astype(np.int64),
        )

    def _seen_from(self, view: View, cells: tuple[Int64, Int64, Int64]) -> tuple[tuple[Int64, Int64, Int64], Float64]:
        """Quantised azimuth, elevation and distance of the camera as seen from the cell's centre; and that distance."""
        model = self.model
        first = np.rint(view.origin / model.cell)
        x, y, z = ((cell + (first[k] + 0.5)) * model.cell - view.T_wc[k, 3] for k, cell in enumerate(cells))
        across = np.hypot(x, y)
        distance = np.hypot(across, z)
        steps = (
            np.degrees(np.arctan2(y, x)) / model.view_angle,
            np.degrees(np.arctan2(z, across)) / model.view_angle,
            distance / model.view_step,
        )
        azimuth, elevation, far = (np.floor(step).astype(np.int64) for step in steps)
        return (azimuth, elevation, far), distance

    def _of_frame(self, place: UInt64, frame: int, kind: str) -> UInt64:
        return rehash(rehash(place, self._salts[kind]), frame)

    def _displaced_borders(self, view: View) -> Labels:
        """The true label map, read at pixels displaced by a smooth field of at most `border` pixels along each axis."""
        true = view.rendered.classes
        if not self.model.border:
            return true.copy()
        H, W = true.shape
        dv, du = (self._field(view.frame, axis, (H, W)) for axis in (0, 1))
        v = np.clip(np.rint(np.arange(H, dtype=np.float32)[:, None] + dv), 0, H - 1).astype(np.int32)
        u = np.clip(np.rint(np.arange(W, dtype=np.float32) + du), 0, W - 1).astype(np.int32)
        moved = true[v, u]
        nothing = (moved == IGNORE_8BIT) | (true == IGNORE_8BIT)
        return np.where(nothing, true, moved)

    def _field(self, frame: int, axis: int, shape: tuple[int, int]) -> Float32:
        """Random numbers within +-border on a grid of border_scale pixels, interpolated to each pixel."""
        model, (H, W) = self.model, shape
        rows, columns = (int(np.ceil(n / model.border_scale)) + 1 for n in (H, W))
        v, u = (grid.astype(np.int64) for grid in np.indices((rows, columns)))
        drawn = hash_integers(self._salts["border"], v, u, np.full_like(v, axis), np.full_like(v, frame))
        nodes = (model.border * (2 * uniform(drawn) - 1)).astype(np.float32)
        size = (round(columns * model.border_scale), round(rows * model.border_scale))
        return np.asarray(cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)[:H, :W]


def confusion_matrix(model: SimulatedBackbone) -> Float64:
    """(8, 8): for a true class in its row, the probability of each wrong class."""
    names = uavid8().classes
    rows = CONFUSION | model.confusion
    weights = np.array([[rows[true].get(wrong, 0.0) for wrong in names] for true in names])
    probabilities: Float64 = weights / weights.sum(axis=1, keepdims=True)
    return probabilities


def _view_chance(model: SimulatedBackbone, incidence: Float32, distance: Float64) -> Float64:
    """Probability of a view error: grows with the angle to the normal, 1 from 60 degrees, and with the distance."""
    slant = np.minimum(1.0, 2 * (1 - incidence.astype(np.float64)))
    chance: Float64 = model.view * slant * np.minimum(1.0, distance / model.view_distance)
    return chance


def _row_chunks(shape: tuple[int, ...]) -> list[slice]:
    """Slices of rows of at most CHUNK pixels: what bounds the memory of a large image."""
    step = max(1, CHUNK // shape[1])
    return [slice(top, min(top + step, shape[0])) for top in range(0, shape[0], step)]
