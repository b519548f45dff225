"""How often does `check` find a planted mistake in scans of a LiDAR, and how often one that is not there?

    python simulations/simulate.py doctor-scans [--drives 20] [--seed 0] [--only TEXT]

Each drive is a LiDAR on a car in a made street: 30 scans of 32 rings and 360 columns with 2 cm of noise, at 0.3 to
1.2 m a scan, on a way that bends by up to 20 degrees to either side. The car rolls and pitches by half a degree. Rays
that meet nothing within 60 m have no point. Labels of 4 % of the places are wrong. Prints a table in Markdown: mistake,
drives in which `check` names it, drives in which only something else is said, drives in which nothing is said. The row
without a mistake has twice as many drives.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cases
import numpy as np
from doctor import FramesInMemory, poses_of
from moving import CLASSES, MadeStreet
from scipy.spatial.transform import Rotation

from semstab.check.reprojection import clusters
from semstab.check.scan_sample import ScanSample
from semstab.check.scan_verdict import verdict_of_scans
from semstab.check.scene_check import SCAN_CLUSTERS
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets.geometry.sweeps import motion_in_sweep, share_of_sweep

SCANS, RINGS, COLUMNS = 30, 32, 360
UP, DOWN, RANGE, NOISE = 10.0, -25.0, 60.0, 0.02
"""Degrees above the horizon of the highest and the lowest ring, and metres."""

HEIGHT, WRONG = 1.8, 0.04
FROM = 15
"""The scan from which on something is wrong."""

SWEEP = "ccw-180"
SPACE = LabelSpace("made", ("ground", "building", "parked", "moving"))

Scans = list[Frame]


class Drive(FramesInMemory):
    """Scans in memory."""

    of_scans = True

    def label_space(self, model: str) -> LabelSpace:
        return SPACE

    @property
    def settings(self) -> dict[str, object]:
        return {"pose_convention": "camera_to_world", "coordinates": "sensor", "deskew": None}


# --- drives ----------------------------------------------------------------------------------------------------------


def way(rng: np.random.Generator) -> np.ndarray:
    """Return poses (n, 4, 4) of a LiDAR that looks along x, z up, on a way that bends to both sides."""
    times, step = np.arange(SCANS), rng.uniform(0.3, 1.2)
    yaw = np.deg2rad(rng.uniform(5, 20)) * np.sin(2 * np.pi * (times / rng.uniform(20, 40) + rng.random()))
    tilt = np.deg2rad(0.5) * np.sin(2 * np.pi * (times[:, None] / rng.uniform(6, 12, 2) + rng.random(2)))
    poses = np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    along, aside = (np.cumsum(step * turned(yaw)) - step * turned(yaw)[0] for turned in (np.cos, np.sin))
    poses[:, :3, 3] = np.column_stack([along, -3.2 + aside, HEIGHT + 0.03 * np.sin(times)])
    return poses


def rays() -> np.ndarray:
    """Return the directions (N, 3) of a scan, ring by ring."""
    up, at = np.meshgrid(
        np.radians(np.linspace(UP, DOWN, RINGS)), np.linspace(0, 2 * np.pi, COLUMNS, endpoint=False), indexing="ij"
    )
    return np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1).reshape(-1, 3)


def cast(street: MadeStreet, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (N,) of what rays (N, 3) meet, inf without anything, and its number: 0 for the ground."""
    with np.errstate(divide="ignore"):
        inverse = 1 / directions
        distance = np.where(directions[:, 2] < 0, -origins[:, 2] * inverse[:, 2], np.inf)
    objects = np.zeros(len(directions), np.int64)
    for number, box in enumerate(street.boxes, 1):
        sides = (np.stack(box.at(0))[:, None] - origins) * inverse
        enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        hit = (enter <= leave) & (enter > 0.1) & (enter < distance)
        distance, objects = np.where(hit, enter, distance), np.where(hit, number, objects)
    return distance, objects


def drive(seed: int, *, swept: bool = False) -> Scans:
    """Return the scans of a random drive; `swept` scans have the motion in their sweeps in them."""
    return list(_drive(seed, swept))


@functools.lru_cache(maxsize=64)
def _drive(seed: int, swept: bool) -> tuple[Frame, ...]:
    rng = np.random.default_rng(seed)
    street, poses, directions = MadeStreet.drawn(rng, movers=0), way(rng), rays()
    shares = share_of_sweep(directions, SWEEP) if swept else np.zeros(len(directions))
    scans = []
    for k, pose in enumerate(poses):
        around = (poses[j] if 0 <= j < SCANS else None for j in (k - 1, k + 1))
        motion = motion_in_sweep(next(around), pose, next(around))
        turns = Rotation.from_rotvec(shares[:, None] * motion[:3])
        origins = (shares[:, None] * motion[3:]) @ pose[:3, :3].T + pose[:3, 3]
        distance, objects = cast(street, origins, turns.apply(directions) @ pose[:3, :3].T)
        there = distance < RANGE
        ranged = np.where(there, distance + NOISE * rng.standard_normal(len(directions)), 0)
        wrong = np.repeat(rng.random(len(directions) // 8) < WRONG, 8)
        labels = np.where(wrong, rng.integers(0, CLASSES, len(directions)), street.classes[objects])
        points = (directions * ranged[:, None]).astype(np.float32)
        scans.append(Frame(k, points=points, labels=np.where(there, labels, 255).astype(np.uint8), T_wc=pose))
    return tuple(scans)


# --- mistakes --------------------------------------------------------------------------------------------------------

TR = np.eye(4)
TR[:3] = [[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]
"""From the LiDAR to a camera, which looks along x."""

MOUNTED = np.eye(4)
MOUNTED[:3, :3], MOUNTED[:3, 3] = Rotation.from_euler("xyz", (1, 2, -90), degrees=True).as_matrix(), (0.9, 0, 0)
"""The pose of the LiDAR on the vehicle."""

Plant = Callable[[Scans], Scans]


def posed(change: Callable[[np.ndarray], np.ndarray], begin: int = 0) -> Plant:
    """Return the mistake that changes each pose (4, 4) from a scan on."""
    return lambda scans: [replace(s, T_wc=change(s.T_wc)) if s.index >= begin else s for s in scans]


def pointed(matrix: Sequence[Sequence[float]]) -> Plant:
    """Return the mistake that changes the axes of points by a matrix (3, 3)."""
    change = np.array(matrix, np.float32)
    return lambda scans: [Frame(s.index, points=s.points @ change.T, labels=s.labels, T_wc=s.T_wc) for s in scans]


def labelled(change: Callable[[Scans, Frame], np.ndarray]) -> Plant:
    return lambda scans: [replace(s, labels=np.ascontiguousarray(change(scans, s))) for s in scans]


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda T: T * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])


def transform(degrees: Sequence[float], metres: Sequence[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), metres
    return T


TURN, JUMP = transform((0, 0, 2), (0, 0, 0)), transform((0, 0, 0), (0.3, 0.3, 0))


@dataclass(frozen=True)
class ScanMistake:
    """A mistake, how to plant it, and parts of a line of `check` that name it."""

    name: str
    plant: Plant
    said: tuple[str, ...]
    swept: bool = False


MISTAKES = (
    ScanMistake("inverse poses", posed(np.linalg.inv), ("with inverse poses",)),
    ScanMistake("poses of the camera", posed(lambda T: TR @ T @ np.linalg.inv(TR)), ("with poses of a camera",)),
    ScanMistake("poses without the sensor's mounting", posed(lambda T: T @ np.linalg.inv(MOUNTED)),
            ("with poses of another body",)),
    ScanMistake("positions in millimetres", posed(scaled(1000)), ("with poses in millimetres",)),
    ScanMistake("positions in kilometres", posed(scaled(0.001)), ("with poses in kilometres",)),
    ScanMistake("points in millimetres", pointed(1000 * np.eye(3)), ("with points in millimetres",)),
    ScanMistake("points with y mirrored", pointed(np.diag((1, -1, 1))), ("with y mirrored",)),
    ScanMistake("points with z mirrored", pointed(np.diag((1, 1, -1))), ("z mirrored", "z of the points was mirrored")),
    ScanMistake("points with x and y exchanged", pointed(np.eye(3)[[1, 0, 2]]), ("with x and y exchanged",)),
    ScanMistake("points of a sensor whose z is down", pointed(np.diag((1, -1, -1))), ("with z down",)),
    ScanMistake("poses of the scan before", poses_of(-1), ("poses are one scan late",)),
    ScanMistake("poses of the next scan", poses_of(1), ("poses are one scan early",)),
    ScanMistake("labels of the scan before", labelled(lambda scans, s: scans[max(s.index - 1, 0)].labels),
            ("are one scan late",)),
    ScanMistake("labels of the points in reversed order", labelled(lambda scans, s: s.labels[..., ::-1]),
            ("in reversed order",)),
    ScanMistake("poses turned by 2 degrees from a scan on", posed(lambda T: TURN @ T, FROM),
            (f"poses jump at scan {FROM}:",)),
    ScanMistake("poses moved by 0.42 m from a scan on", posed(lambda T: JUMP @ T, FROM),
            (f"poses jump at scan {FROM}:",)),
    ScanMistake("pose of one scan off by 0.42 m",
            lambda scans: [replace(s, T_wc=JUMP @ s.T_wc) if s.index == FROM else s for s in scans],
            (f"scan {FROM} does not fit",)),
    ScanMistake("motion in the sweep not removed", lambda scans: scans, ("not deskewed",), swept=True),
    ScanMistake("none", lambda scans: scans, ("nothing",)),
)  # fmt: skip


def said(scans: Scans) -> list[str]:
    """Return what `check` says is wrong, or looks wrong."""
    made, indices = Drive(scans), range(len(scans))
    sample = ScanSample(made, indices, "net", clusters(len(scans), SCAN_CLUSTERS))
    verdict, findings = verdict_of_scans(sample, indices, ["net"])
    wrong = [line for found in findings for line in found.wrong]
    return [*([verdict.text] if verdict.state != "sound" else []), *verdict.remarks, *wrong]


def main(drives: int = 20, seed: int = 0, only: str = "") -> None:
    cases.head(["planted", "drives", "named", "something else", "nothing"])
    for mistake in MISTAKES:
        if only not in mistake.name:
            continue
        seeds = range(seed, seed + (drives if mistake.name != "none" else 2 * drives))
        lines = [said(mistake.plant(drive(seed, swept=mistake.swept))) for seed in seeds]
        found = [any(part in line for part in mistake.said for line in of_drive) for of_drive in lines]
        other = sum(bool(of_drive) and not is_named for of_drive, is_named in zip(lines, found, strict=True))
        cases.row([mistake.name, *map(str, (len(seeds), sum(found), other, len(seeds) - sum(found) - other))])
