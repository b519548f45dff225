"""Ray casting: depth, class, incidence and colour of each pixel, with trimesh's embree intersector."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semstab.core.types import Float32, Float64, Int64, Mask, UInt8, UInt64
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_8BIT
from semstab.datasets.city.mesh import BUILDING, CLUTTER, LOW_VEGETATION, ROAD, TREE, Surface, uavid8
from semstab.datasets.city.options import CONFUSION, SimulatedModel

# Random numbers that are a function of integers: the same cell, view or frame always draws the same number.

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)


def splitmix64(x: UInt64) -> UInt64:
    """Return the output function of splitmix64 (Steele, Lea, Flood 2014) for states x, an array with an axis."""
    x = x + _GOLDEN
    x ^= x >> np.uint64(30)
    x *= _MIX1
    x ^= x >> np.uint64(27)
    x *= _MIX2
    x ^= x >> np.uint64(31)
    return x


def salt(*parts: str | int) -> int:
    """Return a 64-bit number that stands for names and numbers; the same in every process, unlike `hash`."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def hash_integers(seed: int, *coordinates: Int64) -> UInt64:
    """Hash integer coordinates, arrays of one shape, one after the other into 64 bits."""
    state = np.full(coordinates[0].shape, seed, dtype=np.uint64)
    for coordinate in coordinates:
        state = splitmix64(state ^ coordinate.astype(np.int64, copy=False).view(np.uint64))
    return state


def rehash(state: UInt64, seed: int) -> UInt64:
    """Return a second, independent hash of the numbers behind the hash `state`."""
    return splitmix64(state ^ np.uint64(seed))


def uniform(state: UInt64) -> Float64:
    """Return hashes as numbers in [0, 1), from their upper 53 bits."""
    numbers: Float64 = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers


CHUNK = 1 << 18
"""Rays cast at a time, which bounds the memory of a large image."""

SUN = np.array([0.42, -0.38, 0.82]) / np.linalg.norm([0.42, -0.38, 0.82])
AMBIENT, SUNLIGHT = 0.52, 0.60
SKY = np.array([0.62, 0.72, 0.85])
SHADOW_OFFSET = 0.02
GRAIN = np.zeros((256, 2))  # by class: share by which colour varies over 0.3 m and over 2.3 m
GRAIN[:] = 0.04, 0.04
GRAIN[TREE] = 0.34, 0.14
GRAIN[LOW_VEGETATION] = 0.17, 0.13
GRAIN[ROAD] = 0.06, 0.06
GRAIN[CLUTTER] = 0.08, 0.05
GRAIN[BUILDING] = 0.06, 0.04


@dataclass(frozen=True)
class Rendered:
    """The image that the camera sees, shared by all models of a scene.

    Attributes:
        depth: (H, W) float32, planar z in metres; 0 where a ray hits nothing.
        classes: (H, W) uint8 uavid8 ids; 255 where a ray hits nothing.
        incidence: (H, W) float32, cosine of the angle between ray and surface normal, 0..1.
        color: (H, W, 3) uint8 RGB.
    """

    depth: Float32
    classes: UInt8
    incidence: Float32
    color: UInt8

    @property
    def nbytes(self) -> int:
        """Bytes of all images together."""
        return self.depth.nbytes + self.classes.nbytes + self.incidence.nbytes + self.color.nbytes


class Caster:
    """Triangles to cast rays at: embree finds the triangle in float32, its plane gives the position in float64."""

    def __init__(self, surface: Surface) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        self.surface = surface
        corners = surface.vertices[surface.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals: Float64 = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        self.offsets: Float64 = (self.normals * corners[:, 0]).sum(axis=1)
        if not len(surface.faces):
            return
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False, validate=False)
        self._intersector: Any = RayMeshIntersector(mesh)

    def first(self, origin: Float64, directions: Float64) -> tuple[Int64, Float64]:
        """Return the triangle that each ray (n, 3) of `directions` hits first (-1: none), and its parameter (inf)."""
        if not len(self.normals):
            return np.full(len(directions), -1), np.full(len(directions), np.inf)
        origins = np.broadcast_to(origin, directions.shape)
        face: Int64 = np.asarray(self._intersector.intersects_first(origins, directions)).astype(np.int64)
        normal = self.normals[face]
        along = np.einsum("ij,ij->i", normal, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            parameter = (self.offsets[face] - normal @ origin) / along
        missed = (face < 0) | ~np.isfinite(parameter) | (parameter <= 0)
        face[missed], parameter[missed] = -1, np.inf
        return face, parameter

    def blocks(self, points: Float64, direction: Float64) -> Mask:
        """Return whether a ray from each point (n, 3) along one direction hits anything."""
        if not len(self.normals):
            return np.zeros(len(points), dtype=bool)
        towards = np.broadcast_to(direction, points.shape)
        hit: Mask = np.asarray(self._intersector.intersects_first(points, towards)) >= 0
        return hit


def render(still: Caster, moving: Caster, T: Float64, intrinsics: Intrinsics, shape: tuple[int, int]) -> Rendered:
    """Render (H, W) pixels from the pose T (4, 4), relative to the town's origin."""
    H, W = shape
    depth, incidence = np.zeros((2, H * W), dtype=np.float32)
    classes = np.full(H * W, IGNORE_8BIT, dtype=np.uint8)
    color = np.empty((H * W, 3), dtype=np.uint8)
    for rows in _row_chunks(shape):
        part = slice(rows.start * W, rows.stop * W)
        directions = pixel_rays(intrinsics, T, rows, W)
        hit = _nearest((still, moving), T[:3, 3], directions)
        depth[part] = np.where(hit.classes == IGNORE_8BIT, 0.0, hit.depth)
        incidence[part], classes[part] = hit.incidence, hit.classes
        color[part] = _shade(hit, (still, moving))
    return Rendered(depth.reshape(shape), classes.reshape(shape), incidence.reshape(shape), color.reshape(H, W, 3))


def pixel_rays(intrinsics: Intrinsics, T: Float64, rows: slice, width: int) -> Float64:
    """Return the world directions (n, 3) of the rays of rows of pixels; the ray parameter is planar depth."""
    x = (np.arange(width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(rows.start, rows.stop) - intrinsics.cy) / intrinsics.fy
    rays = y[:, None, None] * T[:3, 1] + x[None, :, None] * T[:3, 0] + T[:3, 2]
    directions: Float64 = rays.reshape(-1, 3)
    return directions


@dataclass(frozen=True)
class _Hit:
    """Per ray: planar depth (inf for none), position, normal towards the camera, incidence, class, material colour."""

    depth: Float64
    points: Float64
    normals: Float64
    incidence: Float64
    classes: UInt8
    material: Float64


def _nearest(casters: tuple[Caster, Caster], origin: Float64, directions: Float64) -> _Hit:
    n = len(directions)
    depth, normals = np.full(n, np.inf), -directions
    classes, material = np.full(n, IGNORE_8BIT, dtype=np.uint8), np.tile(SKY, (n, 1))
    for caster in casters:
        face, parameter = caster.first(origin, directions)
        nearer = np.flatnonzero(parameter < depth)
        hit = face[nearer]
        depth[nearer], normals[nearer] = parameter[nearer], caster.normals[hit]
        classes[nearer], material[nearer] = caster.surface.classes[hit], caster.surface.colors[hit]
    towards = np.einsum("ij,ij->i", normals, directions)
    normals[towards > 0] *= -1
    incidence = np.abs(towards) / np.sqrt(np.einsum("ij,ij->i", directions, directions))
    points = origin + directions * np.where(np.isinf(depth), 0.0, depth)[:, None]
    return _Hit(depth, points, normals, np.where(np.isinf(depth), 0.0, np.minimum(incidence, 1.0)), classes, material)


def _shade(hit: _Hit, casters: tuple[Caster, Caster]) -> UInt8:
    """Return Lambert's law under one sun with cast shadows, with grain that is tied to the position."""
    light = np.maximum(hit.normals @ SUN, 0.0)
    lit = np.flatnonzero(light > 0)
    start = hit.points[lit] + SHADOW_OFFSET * (hit.normals[lit] + SUN)
    for caster in casters:
        light[lit] *= ~caster.blocks(start, SUN)
    brightness = AMBIENT + SUNLIGHT * light
    fine, coarse = GRAIN[hit.classes].T
    brightness *= 1 + fine * _noise(hit.points, 0.3) + coarse * _noise(hit.points, 2.3)
    shaded = np.where((hit.classes != IGNORE_8BIT)[:, None], hit.material * brightness[:, None], SKY)
    color: UInt8 = np.clip(shaded * 255, 0, 255).astype(np.uint8)
    return color


def _noise(points: Float64, cell: float) -> Float64:
    """Return numbers in [-1, 1], one for each cubic cell of space."""
    x, y, z = np.floor(points / cell).astype(np.int64).T
    return 2 * uniform(hash_integers(17, x, y, z)) - 1


# Simulated models: the true label map with errors tied to cells, views, frames and class borders.

Labels = UInt8
Scores = Float32


@dataclass(frozen=True)
class View:
    """One frame as a model is given it.

    Attributes:
        frame: Index, for which flicker and border errors are drawn.
        T_wc: (4, 4) camera-to-world; origin (3,), from where cells are counted.
    """

    frame: int
    rendered: Rendered
    intrinsics: Intrinsics
    T_wc: Float64
    origin: Float64

    def positions(self, rows: slice) -> Float64:
        """Return world coordinates (3, h, W) of rows of pixels, in the order of operations of the fusion backends."""
        d = self.rendered.depth[rows].astype(np.float64)
        k, T = self.intrinsics, self.T_wc
        v = np.arange(rows.start, rows.start + len(d))[:, None]
        x = ((np.arange(d.shape[1]) - k.cx) / k.fx) * d
        y = ((v - k.cy) / k.fy) * d
        return np.stack([((T[i, 0] * x + T[i, 1] * y) + T[i, 2] * d) + T[i, 3] for i in range(3)])


class Simulation:
    """A simulated model in one scene: predicts label maps, or soft scores where its softness is above 0."""

    def __init__(self, model: SimulatedModel, seed: int, name: str, scene: str) -> None:
        self.model = model
        self._salts = {kind: salt(seed, name, scene, kind) for kind in ("place", "view", "flicker", "border", "soft")}
        names, rows = uavid8().classes, CONFUSION | model.confusion
        weights = np.array([[rows[true].get(wrong, 0.0) for wrong in names] for true in names])
        self._weights: Float64 = weights / weights.sum(axis=1, keepdims=True)
        """(8, 8): for a true class in its row, the probability of each wrong class."""
        self._cumulative = np.cumsum(self._weights, axis=1)
        self._factors = np.array([model.difficulty.get(name, 1.0) for name in names] + [0.0])

    def labels(self, view: View) -> Labels:
        """Return predicted ids (H, W) uint8; 255 where there is nothing."""
        predicted = self._displaced_borders(view)
        for rows in _row_chunks(predicted.shape):
            predicted[rows] = self._with_errors(view, rows, predicted[rows])
        return predicted

    def scores(self, view: View) -> Scores:
        """Return soft scores (H, W, 8) float32 that sum to 1, the predicted class the largest.

        Scores are 0 where there is nothing.
        """
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
        spot = hash_integers(0, *cells)
        factor = self._factors[np.minimum(true, len(self._weights))]
        wrong = self._strike(predicted, true, rehash(spot, self._salts["place"]), model.place * factor)
        if model.view:
            seen_from, distance = self._seen_from(view, cells)
            # grows with the angle to the normal, 1 from 60 degrees, and with the distance
            slant = np.minimum(1.0, 2 * (1 - view.rendered.incidence[rows].astype(np.float64)))
            chance = model.view * slant * np.minimum(1.0, distance / model.view_distance) * factor
            drawn = hash_integers(self._salts["view"], spot.view(np.int64), *seen_from)
            wrong = self._strike(wrong, true, drawn, chance)
        if model.flicker:
            wrong = self._strike(wrong, true, self._of_frame(spot, view.frame, "flicker"), model.flicker * factor)
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
        spot = hash_integers(0, *self._cells(view, rows))
        rest = self.model.softness * uniform(self._of_frame(spot, view.frame, "soft"))[seen]
        best, other = predicted[seen], true[seen]
        spread = np.where((best == other)[:, None], self._weights[best], np.eye(len(self._weights))[other])
        spread *= rest[:, None]
        spread[np.arange(len(best)), best] = 1 - rest
        scores = np.zeros((*true.shape, len(self._weights)), dtype=np.float32)
        scores[seen] = spread
        return scores

    def _cells(self, view: View, rows: slice) -> tuple[Int64, Int64, Int64]:
        """Return the cell of each pixel, counted from that of the town's origin, so that errors move with the town."""
        size = self.model.cell
        first = np.rint(view.origin / size)
        x, y, z = ((np.floor(x / size) - first[k]).astype(np.int64) for k, x in enumerate(view.positions(rows)))
        return x, y, z

    def _seen_from(self, view: View, cells: tuple[Int64, Int64, Int64]) -> tuple[tuple[Int64, Int64, Int64], Float64]:
        """Return the camera's azimuth, elevation and distance from the cell's centre, quantised.

        The distance itself follows.
        """
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

    def _of_frame(self, spot: UInt64, frame: int, kind: str) -> UInt64:
        return rehash(rehash(spot, self._salts[kind]), frame)

    def _displaced_borders(self, view: View) -> Labels:
        """Return the true label map, read at pixels displaced by a smooth field of at most `border` pixels an axis."""
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
        """Return random numbers within +-border on a grid of border_scale pixels, interpolated to each pixel."""
        model, (H, W) = self.model, shape
        rows, columns = (int(np.ceil(n / model.border_scale)) + 1 for n in (H, W))
        v, u = (grid.astype(np.int64) for grid in np.indices((rows, columns)))
        drawn = hash_integers(self._salts["border"], v, u, np.full_like(v, axis), np.full_like(v, frame))
        nodes = (model.border * (2 * uniform(drawn) - 1)).astype(np.float32)
        size = (round(columns * model.border_scale), round(rows * model.border_scale))
        return np.asarray(cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)[:H, :W]


def _row_chunks(shape: tuple[int, ...]) -> list[slice]:
    """Return slices of rows of at most CHUNK pixels, which bounds the memory of a large image."""
    step = max(1, CHUNK // shape[1])
    return [slice(top, min(top + step, shape[0])) for top in range(0, shape[0], step)]
