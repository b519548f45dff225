"""A drive through a street of boxes, seen by a LiDAR, in SemanticKITTI's layout, with predictions of three models."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scan_writers import Scan, predict_semantickitti, rigid, write_semantickitti

IDS = np.array([10, 40, 50, 70])
"""Stored ids: car, road, building, vegetation."""

DRIVES = 252
"""The stored id of a car that drives."""

SCANS, ROWS, COLUMNS = 10, 24, 240

TO_CAMERA = rigid((90.5, -89.6, 0.3), (-0.01, -0.06, -0.33))
"""Tr, nearly as KITTI's: a camera that looks where the LiDAR's x points."""


@dataclass(frozen=True)
class Street:
    """Scans (N, 3) in the sensor's axes, stored ids (N,) of their points, and poses (4, 4) in the first LiDAR's."""

    scans: list
    ids: list
    poses: list

    @classmethod
    def made(cls, seed, rows=ROWS, turn=0.03, sideways=0.1, oncoming=0.0):
        """A drive that turns by so many radians a scan, and moves by so many metres to the left.

        If `oncoming` is not 0 a car, of the id DRIVES, comes towards it by so many metres a scan.
        """
        scans, ids, poses = _driven(seed, rows, turn, sideways, oncoming)
        return cls([*scans], [*ids], [pose.copy() for pose in poses])

    def __iter__(self):
        return zip(self.scans, self.ids, self.poses, strict=True)

    @property
    def stored_ids(self):
        """The stored ids that there are, ascending, those of IDS among them."""
        return np.unique(np.concatenate([IDS, *self.ids]))

    def with_ids(self, change):
        """The same with other ids: `change` takes those of a scan and its number."""
        return replace(self, ids=[change(of_scan, k) for k, of_scan in enumerate(self.ids)])


@functools.lru_cache(maxsize=8)
def _driven(seed, rows, turn, sideways, oncoming):
    """Scans, ids and poses of a drive, made once."""
    rng = np.random.default_rng(seed)
    boxes = []
    for side in (-1, 1):
        for x in np.arange(-30, 60, 9.0):
            near, deep = rng.uniform(6, 9), rng.uniform(4, 8)
            low, high = sorted((side * near, side * (near + deep)))
            boxes.append(((x, low, -2), (x + rng.uniform(5, 8), high, rng.uniform(3, 8)), int(rng.choice([50, 70]))))
        for x in np.arange(-24, 50, 13.0):
            y = side * 4.0
            boxes.append(((x, y - 0.9, -2), (x + 4, y + 0.9, -0.5), 10))
    up, at = np.meshgrid(np.radians(np.linspace(8, -24, rows)), np.radians(np.arange(0, 360, 360 / COLUMNS)))
    rays = np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1).reshape(-1, 3)
    scans, ids, poses = [], [], []
    for k in range(SCANS):
        cos, sin = np.cos(turn * k), np.sin(turn * k)
        pose = np.eye(4)
        pose[:2, :2] = [[cos, -sin], [sin, cos]]
        pose[:3, 3] = 1.2 * k, sideways * k, 0.0
        x = 22.0 - oncoming * k
        going = [((x, 1.2, -2), (x + 4, 3.0, -0.4), DRIVES)] if oncoming else []
        distance, label = _cast(pose[:3, 3], rays @ pose[:3, :3].T, boxes + going)
        hit = distance < 45
        scans.append((rays[hit] * (distance[hit] + rng.normal(0, 0.01, hit.sum()))[:, None]).astype(np.float32))
        ids.append(label[hit])
        poses.append(pose)
    return scans, ids, poses


def _cast(origin, rays, boxes):
    """Distances (N,) along rays from an origin to the ground at z = -2 and to boxes, and the ids of what they meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (-2.0 - origin[2]) / rays[:, 2]
        distance, label = np.where(ground > 0, ground, np.inf), np.full(len(rays), 40)
        for low, high, number in boxes:
            a, b = (np.array(low) - origin) / rays, (np.array(high) - origin) / rays
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (near < far) & (near > 0) & (near < distance)
            distance, label = np.where(hit, near, distance), np.where(hit, number, label)
    return distance, label


def write_street(folder, street):
    """Write it with its true labels, and predictions of three models: right, flipped in each third scan, worse far."""
    rng = np.random.default_rng(1)
    classes = [Scan(points, np.searchsorted(street.stored_ids, ids), T) for points, ids, T in street]
    names = write_semantickitti(folder, classes, street.stored_ids, TO_CAMERA)
    for k, (name, scan) in enumerate(zip(names, classes, strict=True)):
        far = np.clip((np.linalg.norm(scan.points, axis=1) - 12) / 70, 0, 0.8)
        for model, share in (("clean", 0.0), ("flips", 0.25 if k % 3 == 1 else 0.0), ("far", far)):
            wrong = rng.random(len(scan.walls)) < share
            predicted = np.where(wrong, rng.integers(0, len(IDS), len(scan.walls)), scan.walls)
            predict_semantickitti(folder, name, predicted, model, street.stored_ids)
