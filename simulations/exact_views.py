"""Cameras and scanners that fly over scenes of `exact_scenes.py`: for `exact.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from exact_scenes import Array, ExactScene, Ints, street, yard

from semstab.data.frames import Intrinsics


class Sensor(Protocol):
    """Where a direction lies in an image; integer (u, v) are the middles of pixels."""

    @property
    def width(self) -> int:
        """Columns."""
        ...

    @property
    def height(self) -> int:
        """Rows."""
        ...

    @property
    def reach(self) -> float:
        """Metres beyond which it sees nothing."""
        ...

    def rays(self, u: Array, v: Array) -> Array:
        """Return directions (n, 3) of image coordinates, in the sensor's axes."""
        ...

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return image coordinates of points (n, 3) in the sensor's axes; NaN for points behind a camera."""
        ...


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion; rays have z = 1, so that t along them is depth."""

    width: int
    height: int
    reach: float = np.inf

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics of a view 58 degrees wide."""
        f = 0.9 * self.width
        return Intrinsics(f, f, (self.width - 1) / 2, (self.height - 1) / 2)

    def rays(self, u: Array, v: Array) -> Array:
        """See `Sensor`."""
        K = self.intrinsics
        return np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(len(u))], axis=1)

    def project(self, points: Array) -> tuple[Array, Array]:
        """See `Sensor`."""
        K, z = self.intrinsics, np.where(points[:, 2] > 1e-6, points[:, 2], np.nan)
        return points[:, 0] / z * K.fx + K.cx, points[:, 1] / z * K.fy + K.cy


@dataclass(frozen=True)
class Spinning:
    """A scanner whose rings are the rows of an image, from the highest to the lowest, and azimuths its columns."""

    width: int = 1000
    height: int = 64
    reach: float = 80.0
    highest: float = np.radians(2.0)
    lowest: float = np.radians(-24.8)

    def rays(self, u: Array, v: Array) -> Array:
        """See `Sensor`; they have length 1."""
        azimuth = np.pi - 2 * np.pi * (u + 0.5) / self.width
        up = self.highest + (self.lowest - self.highest) * v / (self.height - 1)
        return np.stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)], axis=1)

    def project(self, points: Array) -> tuple[Array, Array]:
        """See `Sensor`."""
        x, y, z = points.T
        up = np.arctan2(z, np.hypot(x, y))
        u = (np.pi - np.arctan2(y, x)) / (2 * np.pi) * self.width - 0.5
        return u, (up - self.highest) / (self.lowest - self.highest) * (self.height - 1)


@dataclass(frozen=True)
class ImagePoints:
    """Surface points that one frame sees at image coordinates.

    Attributes:
        frame: Its number.
        u, v: (n,) image coordinates; integers are the middles of pixels.
        t: (n,) along the sensor's rays; of a camera it is depth; inf without a surface.
        point: (n, 3) metres.
        face, truth: (n,) face and true class; -1 without a surface.
        distance: (n,) from the sensor, metres.
        angle: (n,) between the ray and the surface's normal, degrees: 90 is a grazing view.
    """

    frame: int
    u: Array
    v: Array
    t: Array
    point: Array
    face: Ints
    truth: Ints
    distance: Array
    angle: Array


@dataclass(frozen=True)
class ExactFlight:
    """A sensor at poses (F, 4, 4) in a scene."""

    scene: ExactScene
    sensor: Sensor
    poses: Array

    def look(self, frame: int, u: Array, v: Array) -> ImagePoints:
        """Return what a frame sees at image coordinates."""
        R, centre = self.poses[frame, :3, :3], self.poses[frame, :3, 3]
        ways = self.sensor.rays(u, v) @ R.T
        t, face = self.scene.cast(centre, ways)
        far = t * np.linalg.norm(ways, axis=1) > self.sensor.reach
        return self._image_points(frame, u, v, ways, np.where(far, np.inf, t), np.where(far, -1, face))

    def meet(self, frame: int, points: Array, face: Ints) -> tuple[Ints, ImagePoints]:
        """Return which points (n, 3) of faces (n,) a frame sees, and what it sees there: nothing else is nearer."""
        R, centre = self.poses[frame, :3, :3], self.poses[frame, :3, 3]
        with np.errstate(invalid="ignore"):
            u, v = self.sensor.project((points - centre) @ R)
            inside = (u >= -0.5) & (v >= -0.5) & (u < self.sensor.width - 0.5) & (v < self.sensor.height - 0.5)
        facing = ((centre - points) * self.scene.normals[face]).sum(axis=1) > 0
        near = np.linalg.norm(points - centre, axis=1) <= self.sensor.reach
        some = np.flatnonzero(inside & facing & near)
        t, _ = self.scene.cast(centre, points[some] - centre)
        some = some[t >= 1 - 1e-6]
        ways = self.sensor.rays(u[some], v[some]) @ R.T
        t = np.linalg.norm(points[some] - centre, axis=1) / np.linalg.norm(ways, axis=1)
        return some, self._image_points(frame, u[some], v[some], ways, t, face[some])

    def _image_points(self, frame: int, u: Array, v: Array, ways: Array, t: Array, face: Ints) -> ImagePoints:
        along = np.where(face >= 0, t, 0.0)[:, None] * ways
        point, length = self.poses[frame, :3, 3] + along, np.linalg.norm(ways, axis=1)
        cosine = np.abs((ways * self.scene.normals[face]).sum(axis=1)) / length
        angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
        return ImagePoints(frame, u, v, t, point, face, self.scene.true_class(point, face), t * length, angle)

    @cached_property
    def images(self) -> list[ImagePoints]:
        """Surface points that each frame sees in the middles of its pixels, row by row."""
        v, u = np.mgrid[: self.sensor.height, : self.sensor.width].reshape(2, -1).astype(float)
        return [self.look(frame, u, v) for frame in range(len(self.poses))]


def _looking(centre: Array, forward: Array) -> Array:
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0, 0, 1.0] if abs(z[2]) < 0.99 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, centre], axis=1)
    return pose


def orbit(frames: int, rng: np.random.Generator) -> Array:
    """Return poses of a camera that circles the middle, 45 degrees down; fewer than 10 frames are a part of that."""
    poses = []
    for angle in 2 * np.pi * np.arange(frames) / max(frames, 10):
        centre = np.array([18 * np.cos(angle), 18 * np.sin(angle), 18.0]) + rng.normal(0, 0.5, 3)
        poses.append(_looking(centre, np.append(rng.normal(0, 1, 2), 0.0) - centre))
    return np.stack(poses)


def strips(frames: int, rng: np.random.Generator) -> Array:
    """Return poses of a camera that looks straight down from 18 m, in parallel lines, there and back."""
    lines = max(1, round(np.sqrt(frames / 1.5)))
    of_line = -(-frames // lines)
    poses = []
    for k in range(frames):
        line, step = divmod(k, of_line)
        x = (step - (of_line - 1) / 2) * 4.5 * (1 if line % 2 == 0 else -1)
        centre = np.array([x, (line - (lines - 1) / 2) * 8.0, 18.0]) + rng.normal(0, 0.3, 3)
        poses.append(_looking(centre, np.append(rng.normal(0, 0.02, 2), -1.0)))
    return np.stack(poses)


def oblique(frames: int, rng: np.random.Generator) -> Array:
    """Return poses of a camera 1.6 m high that walks about the solids and looks inwards, up to 10 degrees down."""
    poses = []
    for angle in 2 * np.pi * np.arange(frames) / max(frames, 20):
        heading, down = angle + np.pi + rng.uniform(-0.4, 0.4), np.radians(rng.uniform(0, 10))
        centre = np.array([*(16 + rng.normal(0, 0.5)) * np.array([np.cos(angle), np.sin(angle)]), 1.6])
        poses.append(_looking(centre, np.array([np.cos(heading), np.sin(heading), -np.tan(down)])))
    return np.stack(poses)


def along(frames: int, rng: np.random.Generator) -> Array:
    """Return poses of a camera 1.6 m high that drives along a street, a metre a frame."""
    poses = []
    for k in range(frames):
        centre = np.array([k, 0.3 * rng.normal() - 1.2, 1.6])
        poses.append(_looking(centre, np.array([1.0, 0.03 * rng.normal(), 0.01 * rng.normal() - 0.03])))
    return np.stack(poses)


def scanning(frames: int, rng: np.random.Generator) -> Array:
    """Return poses of a scanner 1.73 m high that drives along a street, a metre a frame; x forward, z up."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for k, turn in enumerate(0.03 * rng.normal(size=frames)):
        poses[k, :2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        poses[k, :3, 3] = k, 0.3 * rng.normal() - 1.2, 1.73
    return poses


PATHS: dict[
    str, tuple[Callable[[int, np.random.Generator], ExactScene], Callable[[int, np.random.Generator], Array]]
] = {
    "orbit": (yard, orbit),
    "strips": (yard, strips),
    "oblique": (yard, oblique),
    "street": (street, along),
    "sparse": (street, along),
    "scan": (street, scanning),
}
"""The scene and the path of each."""


def flight(path: str, frames: int, K: int, size: tuple[int, int], rng: np.random.Generator) -> ExactFlight:
    """Return a new scene, and a flight over it; size: (height, width) of a camera's images."""
    scene, course = PATHS[path]
    sensor: Sensor = Spinning() if path == "scan" else Pinhole(size[1], size[0])
    return ExactFlight(scene(K, rng), sensor, course(frames, rng))
