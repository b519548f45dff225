"""Frames drawn at random: boxes on a plane, walls round a camera, or slopes, cast by Open3D.

Nothing is tuned to a scene: what is drawn, in what size, from where and with which errors is up to a random generator.
Every other scene with boxes or slopes is seen obliquely.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import open3d as o3d
import open3d.core as o3c

import semstab

KINDS = ("boxes", "walls", "slopes")
SIZES = ((640, 480), (1280, 720), (1920, 1080), (2592, 1944), (3840, 2160))
CLASSES = (7, 21, 41, 150)
PIXELS_A_VOXEL = 5.0, 16.0
"""Edge of a voxel, in pixels at the median depth: 14 is 20 cm in a 4K image from 40 m. Open3D's own integration is slow
in smaller voxels, and would make a scene take minutes."""


OBLIQUE = 15.0, 35.0
"""Degrees below the horizon of an oblique view."""


@dataclasses.dataclass(frozen=True)
class SceneSettings:
    """Random settings of a scene, in metres and degrees. `far` is the largest depth, `step` the way between frames.

    Attributes:
        wrong: Share of the blocks of `patch` pixels that have the label of another class.
        salt: Share of single pixels with any label.
        pixels_a_voxel: Edge of a voxel, in pixels at the median depth.
    """

    kind: str
    width: int
    height: int
    K: int
    altitude: float
    pitch: float
    field_of_view: float
    far: float
    step: float
    wrong: float
    patch: int
    salt: float
    pixels_a_voxel: float
    seed: int


def drawn(seed: int, sizes: tuple[tuple[int, int], ...] = SIZES) -> SceneSettings:
    """The scene of that number."""
    rng = np.random.default_rng([seed, 1])
    kind = str(rng.choice(KINDS))
    width, height = sizes[rng.integers(len(sizes))]
    inside = kind == "walls"
    altitude = _log_uniform(rng, 1.0, 8.0) if inside else _log_uniform(rng, 2.0, 120.0)
    return SceneSettings(
        kind=kind,
        width=width,
        height=height,
        K=int(rng.choice(CLASSES)),
        altitude=altitude,
        pitch=float(rng.uniform(-5, 40) if inside else rng.uniform(*OBLIQUE) if seed % 2 else rng.uniform(20, 90)),
        field_of_view=float(rng.uniform(50, 90)),
        far=float(altitude * rng.uniform(3, 8)),
        step=float(altitude * rng.uniform(0.01, 0.06)),
        wrong=float(rng.uniform(0.0, 0.15)),
        patch=int(_log_uniform(rng, 8, 64)),
        salt=float(rng.uniform(0.0, 0.03)),
        pixels_a_voxel=_log_uniform(rng, *PIXELS_A_VOXEL),
        seed=seed,
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def views(scene: SceneSettings, frames: int) -> tuple[list[semstab.Frame], float, float]:
    """The frames of a scene, without any error; the size of its voxels, and its median depth, in metres."""
    caster, made = _caster(scene), []
    for index in range(frames):
        made.append(_view(scene, caster, index))
    depths = made[0].depth[made[0].depth > 0]
    middle = float(np.median(depths)) if len(depths) else 1.0
    return made, float(f"{scene.pixels_a_voxel * middle / made[0].intrinsics.fx:.2g}"), middle


def spoilt(scene: SceneSettings, frame: semstab.Frame, noise: float) -> semstab.Frame:
    """The frame with errors of its labels, and of its depth: `noise` is their standard deviation, a share of depth."""
    rng = np.random.default_rng([scene.seed, 2, frame.index])
    (height, width), labels = frame.shape, frame.labels
    wrong = rng.random((height // scene.patch + 1, width // scene.patch + 1)) < scene.wrong
    wrong = np.kron(wrong, np.ones((scene.patch, scene.patch), dtype=bool))[:height, :width]
    labels = np.where(wrong, (labels.astype(np.int64) + 1) % scene.K, labels)
    salt = rng.random(frame.shape) < scene.salt
    labels = np.where(salt, rng.integers(0, scene.K, frame.shape), labels).astype(np.uint8)
    depth = frame.depth * (1 + np.float32(noise) * rng.standard_normal(frame.shape, dtype=np.float32))
    return dataclasses.replace(frame, depth=np.maximum(depth, 0), labels=labels)


def _caster(scene: SceneSettings) -> Any:
    """The surfaces, round a camera at (0, 0, altitude) that looks along y; each mesh has a number of its own."""
    rng, caster, a = np.random.default_rng([scene.seed, 3]), o3d.t.geometry.RaycastingScene(), scene.altitude
    boxes = []
    if scene.kind == "slopes":
        n = 200
        at = np.linspace(-10 * a, 10 * a, n)
        x, y = np.meshgrid(at, at)
        tilt, wave, high = rng.uniform(-0.3, 0.3, 2), a * rng.uniform(1, 6, 2), a * rng.uniform(0.05, 0.3)
        z = tilt[0] * x + tilt[1] * y + high * (np.sin(x / wave[0]) * np.cos(y / wave[1]) - 1)
        corner = np.arange(n * n).reshape(n, n)
        p, q, r, s = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
        faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)])
        _add(caster, np.stack([x, y, np.minimum(z, 0.7 * a)], axis=-1).reshape(-1, 3), faces)
    elif scene.kind == "boxes":
        boxes.append(((-20 * a, -20 * a, -a), (20 * a, 20 * a, 0)))
        for _ in range(rng.integers(20, 200)):
            size = a * rng.uniform(0.05, 0.6, 3)
            low = np.array([*rng.uniform((-3 * a, -a), (3 * a, 6 * a)), 0.0])
            boxes.append((low, low + size))
    else:
        room = a * np.array([rng.uniform(1, 4), rng.uniform(3, 8), rng.uniform(1.3, 3)])
        low, high = np.array([-room[0], -a, 0.0]), np.array([room[0], room[1], room[2]])
        boxes.append((low, high))
        for _ in range(rng.integers(3, 30)):
            size = a * rng.uniform(0.1, 0.7, 3)
            at = np.array([*rng.uniform(low[:2], high[:2]), 0.0])
            if np.abs(at[:2] + size[:2] / 2).max() > a * 0.7:  # else the camera may be inside
                boxes.append((at, at + size))
    for begin, end in boxes:
        _add(caster, *_box(np.array(begin, dtype=float), np.array(end, dtype=float)))
    return caster


def _add(caster: Any, vertices: np.ndarray, faces: np.ndarray) -> None:
    caster.add_triangles(o3c.Tensor(vertices.astype(np.float32)), o3c.Tensor(faces.astype(np.uint32)))


def _box(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces."""
    mesh = o3d.geometry.TriangleMesh.create_box(*(high - low))
    return np.asarray(mesh.vertices) + low, np.asarray(mesh.triangles)


def _view(scene: SceneSettings, caster: Any, index: int) -> semstab.Frame:
    """A frame, its labels by surface and by place."""
    f = scene.width / (2 * np.tan(np.radians(scene.field_of_view / 2)))
    camera = semstab.Intrinsics(f, f, scene.width / 2, scene.height / 2)
    pitch = np.radians(scene.pitch)
    R = np.array([[1, 0, 0], [0, -np.sin(pitch), np.cos(pitch)], [0, -np.cos(pitch), -np.sin(pitch)]])
    start = np.array([0.2 * scene.step * index, scene.step * index, scene.altitude])
    v, u = np.mgrid[: scene.height, : scene.width].astype(np.float32)
    x, y = (u - camera.cx) / f, (v - camera.cy) / f
    rays = np.empty((scene.height, scene.width, 6), dtype=np.float32)
    for axis in range(3):
        rays[..., axis] = start[axis]
        rays[..., 3 + axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2]
    hits = caster.cast_rays(o3c.Tensor(rays))
    depth, mesh = hits["t_hit"].numpy(), hits["geometry_ids"].numpy()
    depth = np.where(np.isfinite(depth) & (depth < scene.far), depth, 0).astype(np.float32)
    place = (rays[..., :3] + rays[..., 3:] * depth[..., None]).sum(axis=-1) / (0.3 * scene.altitude)
    label = (np.where(depth > 0, mesh, 0).astype(np.int64) * 5 + 3 * np.floor(place).astype(np.int64)) % scene.K
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = R, start
    return semstab.Frame(index=index, depth=depth, labels=label.astype(np.uint8), intrinsics=camera, T_wc=T_wc)
