"""Ray casting: depth, class, incidence and colour of each pixel, with trimesh's embree intersector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.core.types import Float32, Float64, Int64, Mask, UInt8
from semstab.data.frames import Intrinsics
from semstab.data.labels import IGNORE_8BIT
from semstab.datasets.city.hashing import hash_integers, uniform
from semstab.datasets.city.mesh import LOW_VEGETATION, TREE, TriangleSurface

CHUNK = 1 << 18
"""Rays cast at a time, which bounds the memory of a large image."""

SHADOW_OFFSET = 0.02
GRAIN = np.full((256, 2), 0.06)  # by class: share by which colour varies over 0.3 m and over 2.3 m
GRAIN[TREE] = 0.34, 0.14
GRAIN[LOW_VEGETATION] = 0.17, 0.13


@dataclass(frozen=True, eq=False)
class Light:
    """The light of a flight.

    Attributes:
        sun: (3,) unit vector towards the sun.
        ambient, sunlight: (3,) RGB of the light from all sides, and of the sun on a surface that faces it.
        sky: (3,) RGB of pixels without a surface.
    """

    sun: Float64
    ambient: Float64
    sunlight: Float64
    sky: Float64

    @classmethod
    def from_colors(
        cls, sun: tuple[float, ...], ambient: Sequence[float], sunlight: Sequence[float], sky: Any
    ) -> Light:
        """Make it of the direction towards the sun, of any length, and colours."""
        return cls(np.array(sun) / np.linalg.norm(sun), *(np.array(color) for color in (ambient, sunlight, sky)))


LIGHTS = {
    "noon": Light.from_colors((0.42, -0.38, 0.82), [0.52] * 3, [0.60] * 3, (0.62, 0.72, 0.85)),
    "morning": Light.from_colors((0.85, 0.30, 0.34), (0.40, 0.44, 0.52), (0.68, 0.60, 0.48), (0.70, 0.76, 0.85)),
    "evening": Light.from_colors((-0.90, -0.20, 0.26), (0.36, 0.36, 0.44), (0.78, 0.56, 0.34), (0.86, 0.70, 0.56)),
    "overcast": Light.from_colors((0.0, 0.0, 1.0), (0.62, 0.64, 0.67), [0.08] * 3, (0.74, 0.75, 0.77)),
}
"""The light by the name of an option: noon, sun low in the east or in the west, or clouds."""


@dataclass(frozen=True)
class Rendered:
    """The image that the camera sees, shared by all models of a scene.

    Attributes:
        depth: (H, W) float32, planar z in metres; 0 where a ray hits nothing.
        classes: (H, W) uint8 uavid8 ids; 255 where a ray hits nothing. `mesh.MOVERS` move, all others stand still.
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


class CityCaster:
    """Triangles to cast rays at: embree finds the triangle in float32, its plane gives the position in float64."""

    def __init__(self, surface: TriangleSurface) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        self.surface = surface
        corners = surface.vertices[surface.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals: Float64 = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        self.offsets: Float64 = (self.normals * corners[:, 0]).sum(axis=1)
        if len(surface.faces):
            mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False, validate=False)
            self._intersector: Any = RayMeshIntersector(mesh)
            self.first(np.zeros((1, 3)), np.ones((1, 3)))  # builds its tree: threads share it

    def first(self, origins: Float64, directions: Float64) -> Int64:
        """Return the triangle that each ray (n, 3) hits first, -1 for none."""
        if not len(self.normals):
            return np.full(len(directions), -1)
        return np.asarray(self._intersector.intersects_first(origins, directions)).astype(np.int64)

    def depth(self, face: Int64, origin: Float64, directions: Float64) -> Float64:
        """Return the parameter at which each ray from one origin meets the plane of its triangle; inf for none."""
        depth = np.full(len(face), np.inf)
        hit = np.flatnonzero(face >= 0)
        normal = self.normals[face[hit]]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.offsets[face[hit]] - normal @ origin) / np.einsum("ij,ij->i", normal, directions[hit])
        depth[hit] = np.where(np.isfinite(distance) & (distance > 0), distance, np.inf)
        return depth


def render(
    casters: tuple[CityCaster, ...], T: Float64, intrinsics: Intrinsics, shape: tuple[int, int], light: Light
) -> Rendered:
    """Render (H, W) pixels from the pose T (4, 4), relative to the town's origin."""
    depth, incidence = np.zeros((2, *shape), dtype=np.float32)
    classes = np.full(shape, IGNORE_8BIT, dtype=np.uint8)
    color = np.empty((*shape, 3), dtype=np.uint8)
    x = (np.arange(shape[1]) - intrinsics.cx) / intrinsics.fx
    for rows in row_chunks(shape):
        y = (np.arange(rows.start, rows.stop) - intrinsics.cy) / intrinsics.fy
        rays = y[:, None, None] * T[:3, 1] + x[None, :, None] * T[:3, 0] + T[:3, 2]  # their parameter is planar depth
        z, cosine, ids, rgb = _cast(casters, T[:3, 3], rays.reshape(-1, 3), light)
        depth[rows], incidence[rows] = z.reshape(-1, shape[1]), cosine.reshape(-1, shape[1])
        classes[rows], color[rows] = ids.reshape(-1, shape[1]), rgb.reshape(-1, shape[1], 3)
    return Rendered(depth, classes, incidence, color)


def row_chunks(shape: tuple[int, ...]) -> list[slice]:
    """Return slices of rows of at most CHUNK pixels."""
    step = max(1, CHUNK // shape[1])
    return [slice(top, min(top + step, shape[0])) for top in range(0, shape[0], step)]


def _cast(
    casters: tuple[CityCaster, ...], origin: Float64, directions: Float64, light: Light
) -> tuple[Float64, Float64, UInt8, UInt8]:
    """Return depth (0 where nothing is), incidence, class and colour for each ray (n, 3)."""
    n = len(directions)
    depth, normals, material = np.full(n, np.inf), -directions, np.tile(light.sky, (n, 1))
    classes = np.full(n, IGNORE_8BIT, dtype=np.uint8)
    for caster in casters:
        face = caster.first(np.broadcast_to(origin, directions.shape), directions)
        distance = caster.depth(face, origin, directions)
        nearer = np.flatnonzero(distance < depth)
        hit = face[nearer]
        depth[nearer], normals[nearer] = distance[nearer], caster.normals[hit]
        classes[nearer], material[nearer] = caster.surface.classes[hit], caster.surface.colors[hit]
    on_surface = np.isfinite(depth)
    depth[~on_surface] = 0.0
    towards = np.einsum("ij,ij->i", normals, directions)
    normals[towards > 0] *= -1
    incidence = np.minimum(1.0, np.abs(towards) / np.sqrt(np.einsum("ij,ij->i", directions, directions)))
    color = material * _brightness(casters, origin + directions * depth[:, None], normals, classes, light)
    color = np.clip(np.where(on_surface[:, None], color, light.sky) * 255, 0, 255)
    return depth, np.where(on_surface, incidence, 0.0), classes, color.astype(np.uint8)


def _brightness(
    casters: tuple[CityCaster, ...], points: Float64, normals: Float64, classes: UInt8, light: Light
) -> Float64:
    """Return (n, 3) Lambert's law under one sun with cast shadows, with grain that is tied to the position."""
    facing = np.maximum(normals @ light.sun, 0.0)
    lit = np.flatnonzero(facing > 0)
    start = points[lit] + SHADOW_OFFSET * (normals[lit] + light.sun)
    to_sun = np.broadcast_to(light.sun, start.shape)
    shadow: Mask = np.any([caster.first(start, to_sun) >= 0 for caster in casters], axis=0)
    facing[lit[shadow]] = 0.0
    fine, coarse = GRAIN[classes].T
    grain = 1 + fine * _noise(points, 0.3) + coarse * _noise(points, 2.3)
    brightness: Float64 = (light.ambient + light.sunlight * facing[:, None]) * grain[:, None]
    return brightness


def _noise(points: Float64, cell: float) -> Float64:
    """Return numbers in [-1, 1], one for each cubic cell of space."""
    x, y, z = np.floor(points / cell).astype(np.int64).T
    return 2 * uniform(hash_integers(17, x, y, z)) - 1
