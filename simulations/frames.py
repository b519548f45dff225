"""How often does a frame stand out if no frame is bad, and are bad frames found?

    python simulations/simulate.py frames [--trials 100] [--seed 0]

Each trial makes a scene of its own: a floor of 2 to 12 classes, which a camera flies over on a random course, at a
random height and tilt, 12 to 40 times. Labels are wrong in blobs: at places that are hard for all frames, and at other
places in each frame, in 1 to 30 % of the pixels, and depth has noise of up to 1 %. Prints a table in Markdown: numbers
of trials, with frames of the same quality, and with frames whose quality differs: the log odds of an error have a
standard deviation of 0.2 or 0.6. Without bad frames, and with labels that are wrong in 15 % of the blocks of 24 x 24
pixels of every third frame (`simulations/planted.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import cases
import cv2
import numpy as np
from flights import field
from planted import in_blocks
from scipy.special import expit, logit
from scipy.stats import norm

from semstab.data.frames import Frame, Intrinsics
from semstab.statistics import Sampler
from semstab.statistics.frame_disagreement import lone_disagreement, outlying_frames

W, H, FOCAL = 320, 240, 260.0
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)
GRID, SIDE, PATCHES = 256, 40.0, 80
"""Cells along the edge of the floor, its metres, and how many patches of one class it has."""

THIRD = 3

CONDITIONS = (
    ("same quality", 0.0, False),
    ("same quality, every third bad", 0.0, True),
    ("log odds differ by 0.2", 0.2, False),
    ("log odds differ by 0.2, every third bad", 0.2, True),
    ("log odds differ by 0.6", 0.6, False),
    ("log odds differ by 0.6, every third bad", 0.6, True),
)
"""Name, the standard deviation of the log odds of an error between frames, and whether there are bad frames."""


@dataclass(frozen=True)
class MadeScene:
    """A scene, and how a model errs on it.

    Attributes:
        K: Classes.
        poses: (F, 4, 4) of the camera, metres.
        classes, confused: (GRID, GRID) class of a place, and the one that it is taken for.
        hard: (GRID, GRID) how hard a place is, of variance 1; `place` the part of the errors' variance that is its.
        wrong: (F,) share of the pixels of each frame that are wrong.
        blob: Pixels over which errors of a frame reach.
        noise: Of depth, relative.
    """

    K: int
    poses: np.ndarray
    classes: np.ndarray
    confused: np.ndarray
    hard: np.ndarray
    place: float
    wrong: np.ndarray
    blob: float
    noise: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, uneven: float) -> MadeScene:
        """Draw a scene; `uneven` is the standard deviation of the log odds of an error between frames."""
        K, F = int(rng.integers(2, 13)), int(rng.integers(12, 41))
        at = np.stack(np.meshgrid(np.arange(GRID), np.arange(GRID)), axis=-1).reshape(-1, 1, 2)
        patches = rng.uniform(0, GRID, (PATCHES, 2))
        nearest = np.square(at - patches).sum(axis=2).argmin(axis=1).reshape(GRID, GRID)
        first = rng.integers(0, K, PATCHES)
        other = (first + rng.integers(1, K, PATCHES)) % K
        wrong = expit(logit(np.exp(rng.uniform(np.log(0.01), np.log(0.3)))) + uneven * rng.standard_normal(F))
        hard = field(GRID, float(rng.uniform(2, 8)), rng)
        return cls(
            K, course(F, rng), first[nearest], other[nearest], hard, float(rng.uniform(0, 0.8)), wrong,
            float(rng.uniform(2, 12)), float(rng.uniform(0, 0.01)),
        )  # fmt: skip

    def frames(self, rng: np.random.Generator) -> Iterator[Frame]:
        """Yield the frames of a model on it."""
        u, v = np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        for index, (T_wc, wrong) in enumerate(zip(self.poses, self.wrong, strict=True)):
            world = rays @ T_wc[:3, :3].T
            depth = np.where(world[..., 2] < -1e-3, -T_wc[2, 3] / np.minimum(world[..., 2], -1e-3), 0.0)
            point = T_wc[:2, 3] + world[..., :2] * depth[..., None]
            row, column = np.moveaxis(np.floor(point * GRID / SIDE).astype(int) % GRID, -1, 0)
            blobs = cv2.GaussianBlur(rng.standard_normal((H, W)), (0, 0), self.blob)
            error = np.sqrt(self.place) * self.hard[row, column] + np.sqrt(1 - self.place) * blobs / blobs.std()
            labels = np.where(error > norm.isf(wrong), self.confused[row, column], self.classes[row, column])
            noisy = depth * (1 + self.noise * rng.standard_normal((H, W)))
            yield Frame(index, noisy.astype(np.float32), CAMERA, T_wc, labels=labels.astype(np.uint8))


def course(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses (F, 4, 4) of a camera that looks down on the floor z = 0, in turns."""
    height, tilt, step = rng.uniform(3, 6), rng.uniform(0, 0.6), rng.uniform(0.1, 0.8)
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, rng.uniform(0, 0.3), frames))
    position = np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for pose, (x, y), turn in zip(poses, position, heading, strict=True):
        c, s = np.cos(turn), np.sin(turn)
        forward = np.array([np.sin(tilt) * c, np.sin(tilt) * s, -np.cos(tilt)])
        right = np.array([s, -c, 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = x, y, height
    return poses


def planted_and_found(made: MadeScene, bad: bool, rng: np.random.Generator) -> tuple[set[int], set[int]]:
    """Return the frames that are bad, and those that are named."""
    first, sampler, planted = int(rng.integers(THIRD)), Sampler(made.K), set[int]()
    for frame in made.frames(rng):
        labels = frame.labels
        if bad and frame.index % THIRD == first:
            planted.add(frame.index)
            labels = in_blocks(labels, made.K, rng)
        sampler.add(dataclasses.replace(frame, labels=labels))
    spots = sampler.sample()
    found = outlying_frames(lone_disagreement(spots), len(spots.views))
    return planted, {outlier.frame for outlier in found.frames}


def main(trials: int = 100, seed: int = 0) -> None:
    cases.head(
        ["scenes", "trials", "any innocent frame named", "all bad frames and no other", "of the bad frames named"]
    )
    for name, uneven, bad in CONDITIONS:
        innocent = exact = found = planted = 0
        for trial in range(trials):
            rng = np.random.default_rng([seed, trial, bad])
            truth, blamed = planted_and_found(MadeScene.drawn(np.random.default_rng([seed, trial]), uneven), bad, rng)
            innocent, exact = innocent + bool(blamed - truth), exact + (blamed == truth)
            found, planted = found + len(blamed & truth), planted + len(truth)
        share = f"{found / planted:.3f}" if planted else "-"
        cases.row([name, str(trials), str(innocent), str(exact), share])
