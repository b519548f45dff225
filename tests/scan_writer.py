"""A drive through a street of boxes, seen by a LiDAR, and its files in SemanticKITTI's layout."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

IDS = np.array([10, 40, 50, 70])
"""Stored ids: car, road, building, vegetation."""

SCANS, ROWS, COLUMNS = 10, 24, 360
CALIBRATION = np.array([[0.01, -1.0, 0.0, -0.01], [0.0, 0.0, -1.0, -0.06], [1.0, 0.01, 0.0, -0.33]])
"""Tr: from the LiDAR to the camera, close to a turn of the axes; its rotation is made orthonormal below."""


def calibration():
    """Tr (4, 4)."""
    u, _, v = np.linalg.svd(CALIBRATION[:, :3])
    Tr = np.eye(4)
    Tr[:3, :3], Tr[:3, 3] = u @ v, CALIBRATION[:, 3]
    return Tr


@dataclass(frozen=True)
class Street:
    """Scans (N, 3) in the sensor's axes, stored ids (N,) of their points, and poses (4, 4) in the first LiDAR's."""

    scans: list
    ids: list
    poses: list

    @classmethod
    def made(cls, seed):
        rng = np.random.default_rng(seed)
        boxes = []
        for side in (-1, 1):
            for x in np.arange(-30, 60, 9.0):
                near, deep = rng.uniform(6, 9), rng.uniform(4, 8)
                low, high = sorted((side * near, side * (near + deep)))
                boxes.append(
                    ((x, low, -2), (x + rng.uniform(5, 8), high, rng.uniform(3, 8)), int(rng.choice([50, 70])))
                )
            for x in np.arange(-24, 50, 13.0):
                y = side * 4.0
                boxes.append(((x, y - 0.9, -2), (x + 4, y + 0.9, -0.5), 10))
        up, at = np.meshgrid(np.radians(np.linspace(8, -24, ROWS)), np.radians(np.arange(0, 360, 360 / COLUMNS)))
        rays = np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1).reshape(-1, 3)
        scans, ids, poses = [], [], []
        for k in range(SCANS):
            turn = 0.03 * k
            pose = np.eye(4)
            pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
            pose[:3, 3] = 1.2 * k, 0.1 * k, 0.0
            distance, label = _cast(pose[:3, 3], rays @ pose[:3, :3].T, boxes)
            hit = distance < 45
            scans.append((rays[hit] * (distance[hit] + rng.normal(0, 0.01, hit.sum()))[:, None]).astype(np.float32))
            ids.append(label[hit])
            poses.append(pose)
        return cls(scans, ids, poses)

    def with_ids(self, change):
        """The same with other ids: `change` takes those of a scan and its number."""
        return replace(self, ids=[change(own, k) for k, own in enumerate(self.ids)])


def _cast(origin, rays, boxes):
    """Distances (N,) along rays from an origin to the ground at z = -2 and to boxes, and the ids of what they meet."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = (-2.0 - origin[2]) / rays[:, 2]
        distance, label = np.where(ground > 0, ground, np.inf), np.full(len(rays), 40)
        for low, high, own in boxes:
            a, b = (np.array(low) - origin) / rays, (np.array(high) - origin) / rays
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (near < far) & (near > 0) & (near < distance)
            distance, label = np.where(hit, near, distance), np.where(hit, own, label)
    return distance, label


def write_semantickitti(folder, street):
    """Write velodyne/, labels/, poses.txt, calib.txt, times.txt, and predictions of three models."""
    rng, Tr = np.random.default_rng(1), calibration()
    models = {
        "labels": lambda ids, points, k: ids,
        "predictions/clean": lambda ids, points, k: ids,
        "predictions/flips": lambda ids, points, k: _flipped(ids, 0.25 if k % 3 == 1 else 0.0, rng),
        "predictions/far": lambda ids, points, k: _flipped(
            ids, np.clip((np.linalg.norm(points, axis=1) - 8) / 12, 0, 0.8), rng
        ),
    }
    (folder / "velodyne").mkdir(parents=True)
    for k, (points, ids) in enumerate(zip(street.scans, street.ids, strict=True)):
        rows = np.column_stack([points, np.zeros(len(points), np.float32)]).astype("<f4")
        rows.tofile(folder / f"velodyne/{k:06d}.bin")
        for name, change in models.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            stored = change(ids, points, k).astype("<u4") | (7 << 16)  # the upper half is an instance
            stored.tofile(folder / name / f"{k:06d}.label")
    poses = [(Tr @ pose @ np.linalg.inv(Tr))[:3].ravel() for pose in street.poses]
    np.savetxt(folder / "poses.txt", poses, fmt="%.9e")
    numbers = " ".join(f"{number:.12e}" for number in Tr[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: {' '.join(['0'] * 12)}\nTr: {numbers}\n")
    np.savetxt(folder / "times.txt", 0.1 * np.arange(len(poses)))


def _flipped(ids, share, rng):
    return np.where(rng.random(len(ids)) < share, rng.choice(IDS, len(ids)), ids)


__all__ = ["IDS", "Street", "calibration", "write_semantickitti"]
