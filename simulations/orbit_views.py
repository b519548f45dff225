"""Flights pixel by pixel: a plane with patches and boxes, seen by a camera that orbits, with errors of eight kinds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.stats import norm

from semstab.data.frames import Frame, Intrinsics

K = 6
TOP, WALL = 4, 5
"""Classes of boxes; the others are of patches on the ground."""

SIZE, HEIGHT, RADIUS = 40.0, 20.0, 18.0
"""Half the edge of the plane, the camera's height and the radius of its orbit, metres."""

KINDS = ("none", "pixel", "block", "persistent", "view", "class", "boundary", "burst", "lasting")

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OrbitViews:
    """Labels (F, H, W) of a scene, which pixels see it, points (F, H, W, 3) in metres, and poses (F, 4, 4)."""

    labels: npt.NDArray[np.int64]
    there: npt.NDArray[np.bool_]
    points: Array
    poses: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.labels.shape[1], self.labels.shape[2]

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.9 * self.labels.shape[2]


def scene(
    rng: np.random.Generator, frames: int = 30, height: int = 60, width: int = 80, turns: float = 1.0
) -> OrbitViews:
    """Return the views of a new scene from an orbit."""
    sites, of = rng.uniform(-SIZE, SIZE, (40, 2)), rng.integers(0, TOP, 40)
    low = rng.uniform(-0.6 * SIZE, 0.6 * SIZE, (10, 2))
    boxes = low, low + rng.uniform(3, 8, low.shape), rng.uniform(2, 7, len(low))
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - width / 2) / (0.9 * width), (v - height / 2) / (0.9 * width), np.ones(u.shape)], axis=-1)
    poses, casts = [], []
    for k in range(frames):
        centre = np.array(
            [*(RADIUS + rng.normal()) * _circle(2 * np.pi * turns * k / frames), HEIGHT + 0.5 * rng.normal()]
        )
        poses.append(_looking(centre, np.array([*rng.normal(0, 3, 2), 0.0])))
        casts.append(_cast(poses[-1], rays, sites, of, boxes))
    labels, there, points = (np.stack(arrays) for arrays in zip(*casts, strict=True))
    return OrbitViews(labels, there, points, np.stack(poses))


def _circle(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def _looking(centre: Array, at: Array) -> Array:
    z = (at - centre) / np.linalg.norm(at - centre)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, centre], axis=1)
    return pose


def _cast(
    pose: Array, rays: Array, sites: Array, of: npt.NDArray[np.int64], boxes: tuple[Array, Array, Array]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_], Array]:
    """Labels (H, W), whether the scene is there, and points (H, W, 3) of a picture."""
    d, o = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(d[..., 2] < 0, -o[2] / d[..., 2], np.inf)
        box = np.full(t.shape, -1)
        for low, high, tall in zip(*boxes, strict=True):
            one, other = (np.append(low, 0.0) - o) / d, (np.append(high, tall) - o) / d
            enters, leaves = np.minimum(one, other), np.maximum(one, other).min(axis=-1)
            near = enters.max(axis=-1)
            hit = (near < leaves) & (near > 0) & (near < t)
            t, box = np.where(hit, near, t), np.where(hit, np.where(enters.argmax(axis=-1) == 2, TOP, WALL), box)
    points = o + d * np.where(np.isfinite(t), t, 0.0)[..., None]
    ground = of[((points[..., None, :2] - sites) ** 2).sum(axis=-1).argmin(axis=-1)]
    there = np.isfinite(t) & (np.abs(points[..., :2]) < SIZE).all(axis=-1)
    return np.where(box >= 0, box, ground), there, points


def field(points: Array, rng: np.random.Generator, scale: float) -> Array:
    """A smooth random field with mean 0 and variance 1 whose correlation falls over `scale` metres."""
    waves, phase = rng.normal(0, 1 / scale, (24, 3)), rng.uniform(0, 2 * np.pi, 24)
    return np.cos(points @ waves.T + phase).sum(axis=-1) / np.sqrt(12)


def predicted(views: OrbitViews, kind: str, rate: float, model: int, flight: int) -> npt.NDArray[np.int64]:
    """Return the labels (F, H, W) of a model on a flight.

    Args:
        views: What the camera sees.
        kind: One of KINDS.
        rate: Share of wrong pixels, or of what errs.
        model: Seed of the errors that a model repeats on every flight.
        flight: Seed of the errors that are new on each flight.
    """
    of_model, new = np.random.default_rng([model, 1]), np.random.default_rng([model, flight, 2])
    wrong = _WRONG[kind](views, rate, of_model, new)
    if isinstance(wrong, tuple):
        bad, instead = wrong
        return np.where(bad, instead, views.labels)
    return np.where(wrong, (views.labels + 1) % K, views.labels)


Wrong = npt.NDArray[np.bool_] | tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]


def _blocks(views: OrbitViews, new: np.random.Generator, rate: float) -> npt.NDArray[np.bool_]:
    F, (H, W) = len(views.labels), views.shape
    drawn = new.random((F, -(-H // 8), -(-W // 8))) < rate
    return drawn.repeat(8, axis=1).repeat(8, axis=2)[:, :H, :W]


def _pixel(views: OrbitViews, rate: float, _: np.random.Generator, new: np.random.Generator) -> Wrong:
    shape = views.labels.shape
    return new.random(shape) < rate, (views.labels + new.integers(1, K, shape)) % K


def _persistent(views: OrbitViews, rate: float, of_model: np.random.Generator, _: np.random.Generator) -> Wrong:
    return field(views.points, of_model, 3.0) > norm.isf(rate)


def _view(views: OrbitViews, rate: float, of_model: np.random.Generator, new: np.random.Generator) -> Wrong:
    """Each location is hard from directions of its own, which neighbours have in common."""
    azimuth = np.arctan2(views.poses[:, 1, 3], views.poses[:, 0, 3])[:, None, None]
    away = np.cos(np.pi * field(views.points, of_model, 6.0) - azimuth + 0.2 * new.normal(size=azimuth.shape))
    return away > np.cos(np.pi * rate)


def _class(views: OrbitViews, rate: float, _: np.random.Generator, new: np.random.Generator) -> Wrong:
    confused = np.isin(views.labels, (0, 2, TOP)) & _blocks(views, new, min(3 * rate, 1.0))
    return confused, np.full(views.labels.shape, 1)


def _boundary(views: OrbitViews, rate: float, _: np.random.Generator, new: np.random.Generator) -> Wrong:
    width = 1 + 2 * max(1, round(10 * rate))
    near = [ndimage.maximum_filter(image, width) != ndimage.minimum_filter(image, width) for image in views.labels]
    shift = new.integers(-(width // 2), width // 2 + 1, (len(views.labels), 2))
    moved = [np.roll(image, tuple(by), (0, 1)) for image, by in zip(views.labels, shift, strict=True)]
    return np.stack(near), np.stack(moved)


def _burst(views: OrbitViews, rate: float, _: np.random.Generator, new: np.random.Generator) -> Wrong:
    of_frame = np.where(new.random(len(views.labels)) < 0.12, min(3 * rate, 1.0), 0.3 * rate)
    return new.random(views.labels.shape) < of_frame[:, None, None]


def _lasting(views: OrbitViews, rate: float, _: np.random.Generator, new: np.random.Generator) -> Wrong:
    """Errors of a place last: a field over space whose autocorrelation from frame to frame is 0.85."""
    keep, result = 0.85, []
    waves, phase = new.normal(0, 0.5, (24, 3)), new.uniform(0, 2 * np.pi, 24)
    amplitude = new.normal(size=(24, 2))
    for points in views.points:
        angle = points @ waves.T + phase
        now = np.cos(angle) @ amplitude[:, 0] + np.sin(angle) @ amplitude[:, 1]
        result.append(now / np.sqrt(24) > norm.isf(rate))
        amplitude = keep * amplitude + np.sqrt(1 - keep**2) * new.normal(size=amplitude.shape)
    return np.stack(result)


_WRONG: dict[str, Callable[[OrbitViews, float, np.random.Generator, np.random.Generator], Wrong]] = {
    "none": lambda views, *_: np.zeros(views.labels.shape, np.bool_),
    "pixel": _pixel,
    "block": lambda views, rate, _, new: _blocks(views, new, rate),
    "persistent": _persistent,
    "view": _view,
    "class": _class,
    "boundary": _boundary,
    "burst": _burst,
    "lasting": _lasting,
}


def frames(views: OrbitViews, labels: npt.NDArray[np.int64], stride: int = 1) -> Iterator[Frame]:
    """Yield the frames of a flight, of which every stride-th pixel of each axis is kept."""
    (H, W), f = views.shape, views.focal
    for k, (pose, label, there) in enumerate(zip(views.poses, labels, views.there, strict=True)):
        depth = ((views.points[k] - pose[:3, 3]) @ pose[:3, 2]).astype(np.float32)
        visible = np.where(there, label, 255).astype(np.uint8)
        camera = Intrinsics(f, f, W / 2, H / 2)
        yield Frame(k, np.where(there, depth, np.float32(0)), camera, pose, labels=visible).every(stride)
