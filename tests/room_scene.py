"""A furnished room with exact depth, seen by a camera that walks about, in memory or as a posed_folder; or mistaken."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from posed_writer import write_posed

from semstab import Frame, Intrinsics, LabelSpace
from semstab.datasets import Scene, open_dataset

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
CAMERA = Intrinsics(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
CLASSES = ("room", "table", "shelf", "crate", "box")
BOXES = np.array(
    [
        [[-3, -1.5, -3], [3, 1.5, 4]],  # the room, seen from within
        [[-1.0, 0.2, 1.5], [-0.2, 1.5, 2.2]],
        [[0.7, -0.6, 2.2], [1.6, 1.5, 2.9]],
        [[-2.6, 0.7, 2.6], [-1.6, 1.5, 3.6]],
        [[0.2, 1.0, 0.9], [0.6, 1.5, 1.3]],
    ]
)
"""Axis-aligned boxes, lowest and highest corner, metres; y is down."""

AXES = {
    "opencv": np.eye(4),
    "opengl": np.diag([1.0, -1, -1, 1]),
    "ned": np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
}
"""From camera axes of that name (ned: x forward, y right, z down) to OpenCV's (x right, y down, z forward)."""


def rigid(R, t) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def turn(yaw: float, pitch: float, roll: float = 0.0) -> np.ndarray:
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def walk(frames: int = 12) -> list[np.ndarray]:
    """Camera-to-world poses: about 15 cm and 4 degrees a frame, in every direction."""
    return [
        rigid(
            turn(0.035 * i - 0.2, 0.12 * np.sin(0.5 * i), 0.06 * np.cos(0.7 * i)),
            (0.1 * i - 0.5, 0.25 * np.sin(0.4 * i), 0.08 * i - 1),
        )
        for i in range(frames)
    ]


def rays(camera: Intrinsics = CAMERA, size=(HEIGHT, WIDTH)) -> np.ndarray:
    """(H, W, 3), z = 1."""
    v, u = np.indices(size)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(size)], axis=-1)


RAY_LENGTH = np.linalg.norm(rays(), axis=-1)


def render(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planar depth (H, W) and the number of the box that is seen."""
    return _render(T.tobytes())


@functools.lru_cache(maxsize=64)
def _render(pose: bytes) -> tuple[np.ndarray, np.ndarray]:
    T = np.frombuffer(pose).reshape(4, 4)
    return cast(rays() @ T[:3, :3].T, T[:3, 3])


def cast(direction: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) along rays (H, W, 3) and the number of the box that each meets."""
    with np.errstate(divide="ignore"):
        t = (BOXES[:, :, None, None, :] - origin) / direction  # (box, corner, H, W, 3)
    near, far = t.min(axis=1).max(axis=-1), t.max(axis=1).min(axis=-1)
    hits = np.where((near < far) & (near > 0), near, np.inf)
    hits[0] = far[0]
    return hits.min(axis=0), hits.argmin(axis=0)


class Room(Scene):
    """The scene in memory. What is told of poses, depth and camera may be mistaken; `noise` is relative, of depth."""

    name = "room"

    def __init__(
        self, poses=None, *, told_pose=lambda T: T, told_depth=lambda z: z, camera: Intrinsics = CAMERA,
        noise: float = 0.0, soft: bool = False,
    ) -> None:  # fmt: skip
        self.poses = walk() if poses is None else poses
        self.told_pose, self.told_depth, self.camera, self.noise, self.soft = told_pose, told_depth, camera, noise, soft
        self.models, self.ground_truth = ("net",), True
        self.read = []

    def __len__(self) -> int:
        return len(self.poses)

    def label_space(self, model) -> LabelSpace:
        return LabelSpace("room", CLASSES)

    def digest(self, indices, model) -> str:
        return ""

    def frame(self, index, model, *, color=True) -> Frame:
        self.read.append((index, model))
        rng = np.random.default_rng(index)
        z, truth = render(self.poses[index])
        z = z * (1 + self.noise * rng.standard_normal(z.shape))
        wrong = (rng.random(truth.shape) < 0.1) & (model != "gt")
        labels = np.where(wrong, (truth + 1) % len(CLASSES), truth).astype(np.uint8)
        scores = np.eye(len(CLASSES), dtype=np.float32)[labels] * 0.5 + 0.1 if self.soft else None
        return Frame(
            index=index, depth=self.told_depth(z).astype(np.float32), intrinsics=self.camera,
            T_wc=self.told_pose(self.poses[index]), labels=None if self.soft else labels, scores=scores,
        )  # fmt: skip


def write(folder: Path, room: Room | None = None, **settings) -> Path:
    """The scene as a posed_folder with float depth; `settings` are those of its scene.yaml."""
    room = room or Room()
    sources = {name: [room.frame(i, name) for i in range(len(room))] for name in ("net", "gt")}
    names = [f"{i:03d}" for i in range(len(room))]
    return write_posed(folder, names, sources, scale=None, **{"classes": list(CLASSES)} | settings)


def opened(folder: Path, **options):
    dataset = open_dataset("posed_folder", {"root": folder, **options})
    return dataset.scene(dataset.scenes[0])
