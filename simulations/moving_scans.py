"""Moved spots of a LiDAR: scans of made streets, and the movers in streets of SemanticKITTI; a part of `moving`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cases
import numpy as np
from moving import CLASSES, HEADS, Counts, MadeStreet
from scipy.spatial import cKDTree

import semstab
from semstab.core.types import Float64, Int64, UInt8
from semstab.data.frames import Frame
from semstab.datasets import Scene
from semstab.statistics import Sampler
from semstab.task import open_scenes

RINGS, COLUMNS, UP, DOWN = 64, 720, 2.0, -24.8
"""Rays of a scan, and degrees above the horizon of the highest and the lowest."""

SIDE, HEIGHT, RANGE = -3.2, 1.8, 60.0
"""Where in the street the LiDAR drives, and how high it is and how far it sees, metres."""

MOVING, UNLABELLED = range(252, 260), (0, 1)
"""Stored ids of SemanticKITTI's moving things; and of points of which nobody said what they are: far cars are such."""

STAYS, MOVES, WENT, UNSAID = range(4)
"""The truth of a point: its thing stays, moves, or went by its own length; or nothing is said of it."""


def scans(street: MadeStreet, noise: float, rng: np.random.Generator) -> Iterator[tuple[Frame, Int64]]:
    """Yield scans of a street from the ground, with `noise` in metres, and the number of what each point is on."""
    up, at = np.meshgrid(np.radians(np.linspace(UP, DOWN, RINGS)), np.linspace(0, 2 * np.pi, COLUMNS, endpoint=False))
    rays = np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        inverse = 1 / rays.T
    for index, camera in enumerate(street.poses):
        pose = np.eye(4)
        pose[:3, 3] = camera[0, 3], SIDE + camera[1, 3], HEIGHT
        distance = np.where(rays[:, 2] < 0, -HEIGHT / np.minimum(rays[:, 2], -1e-9), np.inf)
        objects = np.zeros(len(rays), np.int64)
        for number, box in enumerate(street.boxes, 1):
            enter, leave = np.full(len(rays), -np.inf), np.full(len(rays), np.inf)
            for axis, (low, high) in enumerate(zip(*box.at(index), strict=True)):
                a, b = ((side - pose[axis, 3]) * inverse[axis] for side in (low, high))
                enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
            hit = (enter <= leave) & (enter > 0.1) & (enter < distance)
            distance, objects = np.where(hit, enter, distance), np.where(hit, number, objects)
        there = distance < RANGE
        points = rays[there] * (distance[there] + noise * rng.standard_normal(int(there.sum())))[:, None]
        labels = street.classes[objects[there]]
        yield Frame(index, points=points.astype(np.float32), labels=labels, T_wc=pose), objects[there]


def made(scenes: int, seed: int, noises: tuple[float, ...], movers: int) -> None:
    cases.head(["made scans", "noise", *HEADS])
    for noise in noises:
        counts = Counts()
        for scene in range(scenes):
            street = MadeStreet.drawn(np.random.default_rng([seed, scene]), movers=movers)
            votes, ids = Sampler(CLASSES), Sampler(len(street.boxes) + 1, moving=False)
            for frame, objects in scans(street, noise, np.random.default_rng([seed, scene, 2])):
                votes.add(frame)
                ids.add(dataclasses.replace(frame, labels=objects.astype(np.uint8)))
            on = first_answers(ids)
            moves, far = (
                np.array([False, *flags])[on] & (on >= 0)
                for flags in (
                    [box.speed != 0 for box in street.boxes],
                    [box.speed != 0 and box.goes_its_length for box in street.boxes],
                )
            )
            counts.add(votes.sample(), moves, far, on >= 0)
        name = str(scenes) if movers else f"{scenes}, nothing moves"
        cases.row([name, f"{noise:g} m", *counts.cells()])


def first_answers(sampler: Sampler) -> Int64:
    """Return the label (n,) that the first view gives each spot; -1 without one."""
    spots = sampler.sample()
    first = np.full(len(spots.point), -1)
    first[spots.spot[::-1]] = spots.label[::-1]
    return first


# Streets of SemanticKITTI.


def streets(data: Path) -> None:
    """Print a row for each street that has movers, and sums, by scans and by images.

    Spots on things whose stored id moves are of movers; recall is of those that went by their own length. Spots at
    points without a label do not count.
    """
    of_scans = _opened("semantickitti", data)
    for name in ("semantickitti", "semantickitti_images"):
        cases.head([name, "frames", "told", *HEADS])
        total, told = Counts(), []
        for street, scene in _opened(name, data).items():
            counts, share = _of_street(scene, _instances(data / street, of_scans[street]))
            total = total + counts
            told.append(share)
            if counts.movers:
                cases.row([street, str(len(scene)), f"{100 * share:.0f} %", *counts.cells()])
        cases.row(["all", "", f"{100 * np.mean(told):.0f} %", *total.cells()])
        print()


def _opened(name: str, data: Path) -> dict[str, Scene]:
    return dict(open_scenes(semstab.load_config({"dataset": {"name": name, "options": {"root": str(data)}}})))


def _instances(folder: Path, scene: Scene) -> list[tuple[Float64, UInt8]]:
    """Return of each scan its points in the world (N, 3), and what is said of them (N,): STAYS, MOVES, ..."""
    world, said, things = [], [], []
    for index, file in enumerate(sorted((folder / "labels").glob("*.label"))):
        stored = np.fromfile(file, np.uint32)
        frame = scene.frame(index, "gt", color=False)
        assert frame.points is not None
        world.append(frame.points.reshape(-1, 3) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3])
        said.append(np.where(np.isin(stored & 0xFFFF, UNLABELLED), UNSAID, STAYS).astype(np.uint8))
        said[-1][np.isin(stored & 0xFFFF, MOVING)] = MOVES
        things.append(stored >> 16)
    far = set()
    for thing in np.unique(
        np.concatenate([instances[of == MOVES] for instances, of in zip(things, said, strict=True)])
    ):
        parts = [
            p[(instances == thing) & (of == MOVES), :2] for p, instances, of in zip(world, things, said, strict=True)
        ]
        middles = np.array([(part.min(axis=0) + part.max(axis=0)) / 2 for part in parts if len(part)])
        length = max(float(np.hypot(*np.ptp(part, axis=0))) for part in parts if len(part))
        if np.hypot(*np.ptp(middles, axis=0)) >= length:
            far.add(int(thing))
    for instances, of in zip(things, said, strict=True):
        of[(of == MOVES) & np.isin(instances, list(far))] = WENT
    return list(zip(world, said, strict=True))


def _of_street(scene: Scene, scans: list[tuple[Float64, UInt8]]) -> tuple[Counts, float]:
    """Return counts of the spots of a street, and the share of its spots of which it is told whether they moved."""
    sampler = Sampler(4)
    for index, (world, said) in enumerate(scans):
        frame = scene.frame(index, "gt", color=False)
        labels = said if frame.is_scan else _on_image(frame, world, said)
        sampler.add(dataclasses.replace(frame, labels=labels.reshape(frame.shape), mask=None))
    spots, first, counts = sampler.sample(), first_answers(sampler), Counts()
    counts.add(spots, (first == MOVES) | (first == WENT), first == WENT, (first >= 0) & (first != UNSAID))
    assert spots.votes is not None
    return counts, float(spots.votes.decided[first >= 0].mean())


def _on_image(frame: Frame, world: Float64, labels: np.ndarray) -> np.ndarray:
    """Return the labels of points in the pixels (H, W) that they fall on; 255 without depth."""
    row, column = np.nonzero(frame.depth > 0)
    z = frame.depth[row, column].astype(np.float64)
    x, y = frame.rays
    point = np.stack([x[column] * z, y[row] * z, z], axis=1) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]
    image = np.full(frame.shape, 255, np.uint8)
    image[row, column] = labels[cKDTree(world).query(point)[1]]
    return image
