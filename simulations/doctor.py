"""How often does `check` find a planted mistake in labels, time or intrinsics, and how often one that is not there?

    python simulations/doctor.py [--scenes 20] [--seed 0] [--only TEXT]

Each scene is a room of a size of its own with 12 boxes of 7 classes at random places, and a camera that walks about and
turns at random: 30 frames of 96 x 72 pixels with 0.5 % noise of depth. Labels are wrong in 5 % of the pixels and at
borders that wander by a pixel. Prints a table in Markdown: mistake, scenes in which it is found, scenes in which
something else is said.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semstab.check.reprojection import clusters
from semstab.check.scene_check import CLUSTERS, POINTS, Inspection, label_findings
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets import Scene

W, H, FRAMES, CLASSES = 96, 72, 30, 7
CAMERA = Intrinsics(80.0, 80.0, (W - 1) / 2, (H - 1) / 2)
SPACE = LabelSpace("made", tuple(f"class {k}" for k in range(CLASSES)))
NOISE, WRONG = 0.005, 0.05

Frames = list[Frame]


class Made(Scene):
    """Frames in memory."""

    models = ("net",)

    def __init__(self, frames: Frames) -> None:
        self.name, self.frames = "made", frames

    def __len__(self) -> int:
        return len(self.frames)

    def label_space(self, model: str) -> LabelSpace:
        return SPACE

    def digest(self, indices: list[int], model: str) -> str:
        return ""

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        return self.frames[index]

    def T_wc(self, index: int) -> np.ndarray:
        return self.frames[index].T_wc

    @property
    def settings(self) -> dict[str, object]:
        return {"pose_shift": None}


def walk(rng: np.random.Generator) -> np.ndarray:
    """Camera-to-world (n, 4, 4): steps of about 8 cm and 3 degrees, of which each is like the one before it."""
    from scipy.spatial.transform import Rotation

    steps = np.zeros((FRAMES, 6))
    for k in range(1, FRAMES):
        steps[k] = 0.6 * steps[k - 1] + rng.normal(0, 1, 6)
    way = np.cumsum(steps, axis=0)
    way -= way.mean(axis=0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("yxz", np.deg2rad(2.0) * way[:, 3:]).as_matrix()
    poses[:, :3, 3] = 0.05 * way[:, :3]
    return poses


def world(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (n, 2, 3), metres, y down, the first of which is the room; and their classes 0..5."""
    room = np.array([[-4.0, -2, -4], [4, 2, 5]]) * rng.uniform(0.8, 1.3)
    centres = rng.uniform((-3, -1.3, 1.8), (3, 1.8, 4.2), (12, 3))
    half = rng.uniform(0.15, 0.5, (12, 3))
    boxes = np.stack([centres - half, centres + half], axis=1)
    return np.concatenate([room[None], boxes]), np.concatenate([[0], rng.permutation(np.arange(12) % (CLASSES - 1))])


def render(boxes: np.ndarray, classes: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planar depth (H, W) and classes."""
    v, u = np.indices((H, W))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((H, W))], axis=-1) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        t = (boxes[:, :, None, None, :] - T[:3, 3]) / rays
    near, far = t.min(axis=1).max(axis=-1), t.max(axis=1).min(axis=-1)
    hits = np.where((near < far) & (near > 0.1), near, np.inf)
    hits[0] = far[0]
    return hits.min(axis=0), classes[hits.argmin(axis=0)]


def predicted(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Labels as a network gives them: borders wander by a pixel or so, and some blocks are of another class."""
    shift = [cv2.GaussianBlur(rng.normal(0, 12, (H, W)), (0, 0), 4) for _ in range(2)]
    v, u = np.indices((H, W))
    moved = labels[(v + shift[0]).round().astype(int).clip(0, H - 1), (u + shift[1]).round().astype(int).clip(0, W - 1)]
    wrong = np.kron(rng.random((H // 4, W // 4)) < WRONG, np.ones((4, 4))).astype(bool)
    return np.where(wrong, rng.integers(0, CLASSES - 1), moved).astype(np.uint8)


def scene(seed: int) -> Frames:
    """A random scene without mistakes."""
    return list(_scene(seed))


@functools.lru_cache(maxsize=4)
def _scene(seed: int) -> tuple[Frame, ...]:
    """The same, made once: most of the time of a check."""
    rng = np.random.default_rng(seed)
    boxes, classes = world(rng)
    frames = []
    for k, T in enumerate(walk(rng)):
        depth, labels = render(boxes, classes, T)
        depth = (depth * (1 + rng.normal(0, NOISE, depth.shape))).astype(np.float32)
        frames.append(Frame(k, depth, CAMERA, T, labels=predicted(labels, rng)))
    return tuple(frames)


# --- mistakes --------------------------------------------------------------------------------------------------------


def relabelled(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    """Return a mistake that changes every label map."""
    return lambda frames: [replace(f, labels=np.ascontiguousarray(change(f.labels))) for f in frames]


def later(frames: Frames, by: int) -> Sequence[int]:
    return [min(max(k + by, 0), len(frames) - 1) for k in range(len(frames))]


def labels_of(by: int) -> Callable[[Frames], Frames]:
    return lambda frames: [replace(f, labels=frames[k].labels) for f, k in zip(frames, later(frames, by), strict=True)]


def poses_of(by: int) -> Callable[[Frames], Frames]:
    return lambda frames: [replace(f, T_wc=frames[k].T_wc) for f, k in zip(frames, later(frames, by), strict=True)]


def jump(frames: Frames) -> Frames:
    """Return the frames with the poses of the second half moved by 0.3 m, to the side and forward."""
    half = len(frames) // 2
    return [replace(f, T_wc=moved(f.T_wc, (0.2, 0.0, 0.2))) if f.index >= half else f for f in frames]


def moved(T: np.ndarray, by: Sequence[float]) -> np.ndarray:
    out = T.copy()
    out[:3, 3] += by
    return out


def one(change: Callable[[Frame], Frame]) -> Callable[[Frames], Frames]:
    """Return a mistake in one frame, the 12th."""
    return lambda frames: [change(f) if f.index == 11 else f for f in frames]


def camera(factor: float = 1.0, right: float = 0.0) -> Callable[[Frames], Frames]:
    """Return a mistake that states other intrinsics: focal lengths times a factor, cx so many pixels to the right."""
    K = Intrinsics(CAMERA.fx * factor, CAMERA.fy * factor, CAMERA.cx + right, CAMERA.cy)
    return lambda frames: [replace(f, intrinsics=K) for f in frames]


SWAPPED = Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cy, CAMERA.cx)
SHARES = Intrinsics(CAMERA.fx / W, CAMERA.fy / H, CAMERA.cx / W, CAMERA.cy / H)


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    """Return a mistake that changes every depth image."""
    return lambda frames: [replace(f, depth=np.ascontiguousarray(change(f.depth))) for f in frames]


def rotation(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    """Return a mistake that changes every rotation, and leaves the centres."""

    def changed(T: np.ndarray) -> np.ndarray:
        out = T.copy()
        out[:3, :3] = change(T[:3, :3])
        return out

    return lambda frames: [replace(f, T_wc=changed(f.T_wc)) for f in frames]


def reordered(R: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """Return the rotation whose quaternion, x y z w, has these numbers of the right one."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(Rotation.from_matrix(R).as_quat()[list(order)]).as_matrix())


def resized(labels: np.ndarray) -> np.ndarray:
    small = cv2.resize(labels, (W // 2, H // 2), interpolation=cv2.INTER_NEAREST)
    return cv2.resize(small, (W, H), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Mistake:
    """A planted mistake, and a part of the line that names it."""

    name: str
    plant: Callable[[Frames], Frames]
    said: str


MISTAKES = (
    Mistake("labels of the next frame", labels_of(1), "are one frame early"),
    Mistake("labels of the frame before", labels_of(-1), "are one frame late"),
    Mistake("labels mirrored left to right", relabelled(lambda L: L[:, ::-1]), "are mirrored"),
    Mistake("labels upside down", relabelled(lambda L: L[::-1]), "are upside down"),
    Mistake("labels turned by 180 degrees", relabelled(lambda L: L[::-1, ::-1]), "are turned by 180"),
    Mistake("labels transposed", relabelled(lambda L: cv2.resize(L.T, (W, H), interpolation=0)), "are transposed"),
    Mistake("labels of the middle, enlarged twice", relabelled(lambda L: L[H // 4 : -H // 4, W // 4 : -W // 4]
            .repeat(2, axis=0).repeat(2, axis=1)), "are twice too large"),
    Mistake("labels of one map in all frames", lambda fs: [replace(f, labels=fs[0].labels) for f in fs], "same map"),
    Mistake("ids from 1, 6 of 7 classes used", relabelled(lambda L: L + 1), "never have the first id"),
    Mistake("one class everywhere", relabelled(lambda L: L * 0), "have one class"),
    Mistake("labels resized with interpolation", relabelled(resized), "thin bands of ids"),
    Mistake("poses of the next frame", poses_of(1), "poses are one frame early"),
    Mistake("poses of the frame before", poses_of(-1), "poses are one frame late"),
    Mistake("focal length 20 % too small", camera(0.8), "focal length is"),
    Mistake("focal length 10 % too small", camera(0.9), "focal length is"),
    Mistake("focal length 10 % too large", camera(1.1), "focal length is"),
    Mistake("cx 10 % of the width too large", camera(right=W / 10), "cx is"),
    Mistake("poses jump by 0.3 m in the middle", jump, f"poses jump at frame {FRAMES // 2}:"),
    Mistake("depth of one frame times 5", one(lambda f: replace(f, depth=f.depth * np.float32(5))),
            "frame 11 does not fit"),
    Mistake("pose of one frame off by 0.4 m", one(lambda f: replace(f, T_wc=moved(f.T_wc, (0.3, 0.0, 0.3)))),
            "frame 11 does not fit"),
    Mistake("labels of one frame upside down", one(lambda f: replace(f, labels=f.labels[::-1].copy())),
            "the map of frame 11 "),
    Mistake("depth mirrored left to right", depth(lambda d: d[:, ::-1]), "depth images mirrored left to right"),
    Mistake("depth upside down", depth(lambda d: d[::-1]), "depth images upside down"),
    Mistake("depth turned by 180 degrees", depth(lambda d: d[::-1, ::-1]), "depth images turned by 180"),
    Mistake("rotations transposed", rotation(lambda R: R.T), "transposed rotations"),
    Mistake("quaternions w x y z read as x y z w", rotation(lambda R: reordered(R, (3, 0, 1, 2))), "w x y z that are"),
    Mistake("quaternions x y z w read as w x y z", rotation(lambda R: reordered(R, (1, 2, 3, 0))), "x y z w that are"),
    Mistake("cx and cy exchanged", lambda fs: [replace(f, intrinsics=SWAPPED) for f in fs], "cx and cy exchanged"),
    Mistake("intrinsics divided by the size", lambda fs: [replace(f, intrinsics=SHARES) for f in fs], "as shares of"),
    Mistake("none", lambda frames: frames, "nothing"),
)  # fmt: skip


def said(frames: Frames) -> Iterator[str]:
    """Yield the findings, as `check` says them."""
    made, indices = Made(frames), range(len(frames))
    inspection = Inspection(made, indices, "net", clusters(len(frames), CLUSTERS), POINTS)
    verdict = inspection.verdict({}, thorough=True)
    yield from verdict.remarks
    if verdict.state == "unsound":
        yield verdict.text
        return
    for found in label_findings(made, indices, ["net"], thorough=True):
        yield from (*found.wrong, *found.remarks)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.scenes)
    scenes = [scene(seed) for seed in seeds]
    print(f"| planted | found in {len(scenes)} | something else said |\n|---|---:|---:|")
    for mistake in MISTAKES:
        if arguments.only in mistake.name:
            lines = [[*said(mistake.plant(frames))] for frames in scenes]
            found = sum(any(mistake.said in line for line in each) for each in lines)
            other = sum(any(mistake.said not in line for line in each) for each in lines)
            print(f"| {mistake.name} | {found} | {other} |", flush=True)


if __name__ == "__main__":
    main()
