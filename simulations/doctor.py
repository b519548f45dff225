"""How often does `check` find a planted mistake in labels, time or intrinsics, and how often one that is not there?

    python simulations/simulate.py doctor [--scenes 20] [--seed 0] [--only TEXT] [--situations]

Each scene is a room of a size of its own with 12 boxes of 7 classes at random places, and a camera that walks about and
turns at random: 30 frames of 96 x 72 pixels with 0.5 % noise of depth. Labels are wrong in 5 % of the pixels and at
borders that wander by a pixel. Prints a table in Markdown: mistake, scenes in which it is found, scenes in which
something else is said. With --situations the table is of what begins at a frame, or is in some frames: scenes in which
`check` finds it, and a run, in which `check` names the right frames (+- 1), and in which it says something else.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cases
import cv2
import numpy as np

from semstab.check.inspection import Inspection
from semstab.check.labels import label_findings
from semstab.check.reprojection import clusters
from semstab.check.scene_check import CLUSTERS, POINTS, quick_sample
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets import Scene

W, H, FRAMES, CLASSES = 96, 72, 30, 7
CAMERA = Intrinsics(80.0, 80.0, (W - 1) / 2, (H - 1) / 2)
SPACE = LabelSpace("made", tuple(f"class {k}" for k in range(CLASSES)))
NOISE, WRONG = 0.005, 0.05

Frames = list[Frame]


class FramesInMemory(Scene):
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


@functools.lru_cache(maxsize=32)
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
    """Return a mistake that states other intrinsics: focal lengths times `factor`, cx plus `right` pixels."""
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
class Planted:
    """A planted mistake, and a part of the line that names it."""

    name: str
    plant: Callable[[Frames], Frames]
    said: str


MISTAKES = (
    Planted("labels of the next frame", labels_of(1), "are one frame early"),
    Planted("labels of the frame before", labels_of(-1), "are one frame late"),
    Planted("labels mirrored left to right", relabelled(lambda L: L[:, ::-1]), "are mirrored"),
    Planted("labels upside down", relabelled(lambda L: L[::-1]), "are upside down"),
    Planted("labels turned by 180 degrees", relabelled(lambda L: L[::-1, ::-1]), "are turned by 180"),
    Planted("labels transposed", relabelled(lambda L: cv2.resize(L.T, (W, H), interpolation=0)), "are transposed"),
    Planted("labels of the middle, enlarged twice", relabelled(lambda L: L[H // 4 : -H // 4, W // 4 : -W // 4]
            .repeat(2, axis=0).repeat(2, axis=1)), "are twice too large"),
    Planted("labels of one map in all frames", lambda fs: [replace(f, labels=fs[0].labels) for f in fs], "same map"),
    Planted("ids from 1, 6 of 7 classes used", relabelled(lambda L: L + 1), "never have the first id"),
    Planted("one class everywhere", relabelled(lambda L: L * 0), "have one class"),
    Planted("labels resized with interpolation", relabelled(resized), "thin bands of ids"),
    Planted("poses of the next frame", poses_of(1), "poses are one frame early"),
    Planted("poses of the frame before", poses_of(-1), "poses are one frame late"),
    Planted("focal length 20 % too small", camera(0.8), "focal length is"),
    Planted("focal length 10 % too small", camera(0.9), "focal length is"),
    Planted("focal length 10 % too large", camera(1.1), "focal length is"),
    Planted("cx 10 % of the width too large", camera(right=W / 10), "cx is"),
    Planted("poses jump by 0.3 m in the middle", jump, f"poses jump at frame {FRAMES // 2}:"),
    Planted("depth of one frame times 5", one(lambda f: replace(f, depth=f.depth * np.float32(5))),
            "frame 11 does not fit"),
    Planted("pose of one frame off by 0.4 m", one(lambda f: replace(f, T_wc=moved(f.T_wc, (0.3, 0.0, 0.3)))),
            "frame 11 does not fit"),
    Planted("labels of one frame upside down", one(lambda f: replace(f, labels=f.labels[::-1].copy())),
            "the map of frame 11 "),
    Planted("depth mirrored left to right", depth(lambda d: d[:, ::-1]), "depth images mirrored left to right"),
    Planted("depth upside down", depth(lambda d: d[::-1]), "depth images upside down"),
    Planted("depth turned by 180 degrees", depth(lambda d: d[::-1, ::-1]), "depth images turned by 180"),
    Planted("rotations transposed", rotation(lambda R: R.T), "transposed rotations"),
    Planted("quaternions w x y z read as x y z w", rotation(lambda R: reordered(R, (3, 0, 1, 2))), "w x y z that are"),
    Planted("quaternions x y z w read as w x y z", rotation(lambda R: reordered(R, (1, 2, 3, 0))), "x y z w that are"),
    Planted("cx and cy exchanged", lambda fs: [replace(f, intrinsics=SWAPPED) for f in fs], "cx and cy exchanged"),
    Planted("intrinsics divided by the size", lambda fs: [replace(f, intrinsics=SHARES) for f in fs], "as shares of"),
    Planted("none", lambda frames: frames, "nothing"),
)  # fmt: skip


# --- situations: what begins at a frame, or is in some of them --------------------------------------------------------

FROM = 13
LOST, ROW, SOME, PAIR = (3, 9, 14, 22, 27), tuple(range(12, 20)), (4, 5, 9), (20, 21)


def transform(degrees: Sequence[float], metres: Sequence[float]) -> np.ndarray:
    """Return (4, 4) of angles about x, y and z, and a translation."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    T[:3, 3] = metres
    return T


def posed(at: Sequence[int], pose: Callable[[Frames, Frame], np.ndarray]) -> Callable[[Frames], Frames]:
    """Return what gives some frames other poses."""
    return lambda frames: [replace(f, T_wc=pose(frames, f)) if f.index in at else f for f in frames]


def labelled(change: Callable[[Frames, Frame], np.ndarray], at: Sequence[int]) -> Callable[[Frames], Frames]:
    """Return what gives some frames other label maps."""
    return lambda frames: [
        replace(f, labels=np.ascontiguousarray(change(frames, f))) if f.index in at else f for f in frames
    ]


def with_fy(factor: float) -> Callable[[Frames], Frames]:
    """Return what states another fy."""
    K = Intrinsics(CAMERA.fx, CAMERA.fy * factor, CAMERA.cx, CAMERA.cy)
    return lambda frames: [replace(f, intrinsics=K) for f in frames]


@dataclass(frozen=True)
class Situation(Planted):
    """A situation, and how the line names its frames.

    Attributes:
        frames: Frames that are to be named; empty for all frames.
        where: A pattern with one group, the frames in a line, behind commas.
    """

    frames: tuple[int, ...] = ()
    where: str = r"frame (\d+)"

    def is_placed(self, lines: Sequence[str]) -> bool:
        """Return whether the lines name these frames, give or take one."""
        told = [re.search(self.where, line) for line in lines if self.said in line]
        frames_told = sorted(int(k) for match in told if match is not None for k in match[1].split(", "))
        return len(frames_told) == len(self.frames) and all(
            abs(a - b) <= 1 for a, b in zip(frames_told, self.frames, strict=True)
        )


ALL, SECOND = range(FRAMES), range(FROM, FRAMES)
OTHERS = np.r_[3, 5, 4, 2, 0, 6, 1, np.arange(CLASSES, 256)].astype(np.uint8)
EXCHANGED = np.r_[1, 0, np.arange(2, 256)].astype(np.uint8)
ORDER = np.random.default_rng(1).permutation(FRAMES)
ELSEWHERE, TURN, SHIFT = (
    transform((20, 70, 10), (20, -3, 8)),
    transform((0, 2, 0), (0, 0, 0)),
    moved(np.eye(4), (0.1, 0, 0.1)),
)
IN_POSE, IN_FRAMES = r"pose[^(]*\(([\d, ]+)\)", r"frames \(([\d, ]+)\)"
SITUATIONS = (
    Situation("identity as pose in 5 frames, spread", posed(LOST, lambda fs, f: np.eye(4)),
              "5 frames have the identity", LOST, IN_POSE),
    Situation("identity as pose in 8 frames in a row", posed(ROW, lambda fs, f: np.eye(4)),
              "8 frames have the identity", ROW, IN_POSE),
    Situation("identity as pose in 1 frame", posed((17,), lambda fs, f: np.eye(4)), "has the identity as", (17,)),
    Situation("last known pose in 8 frames in a row", posed(ROW, lambda fs, f: fs[ROW[0] - 1].T_wc),
              "8 frames have the pose of a frame before", ROW, IN_POSE),
    Situation("poses in another frame of reference from a frame on", posed(SECOND, lambda fs, f: ELSEWHERE @ f.T_wc),
              "poses jump", (FROM,)),
    Situation("poses turned by 2 degrees from a frame on", posed(SECOND, lambda fs, f: TURN @ f.T_wc),
              "poses jump", (FROM,)),
    Situation("poses moved by 0.14 m from a frame on", posed(SECOND, lambda fs, f: SHIFT @ f.T_wc),
              "poses jump", (FROM,)),
    Situation("fy 5 % too large", with_fy(1.05), "fy"),
    Situation("extrinsic of 5 cm forgotten", posed(ALL, lambda fs, f: f.T_wc @ moved(np.eye(4), (0, -0.05, 0))),
              "extrinsic"),
    Situation("ids permuted from a frame on", labelled(lambda fs, f: OTHERS[f.labels], SECOND),
              "have other ids from frame", (FROM,)),
    Situation("two classes exchanged from a frame on", labelled(lambda fs, f: EXCHANGED[f.labels], SECOND),
              "have other ids from frame", (FROM,)),
    Situation("ids that roll with the frame", labelled(lambda fs, f: (f.labels + f.index) % CLASSES, ALL),
              "have other ids from frame to frame"),
    Situation("labels mirrored from a frame on", labelled(lambda fs, f: f.labels[:, ::-1], SECOND),
              "are mirrored left to right from", (FROM,)),
    Situation("labels upside down from a frame on", labelled(lambda fs, f: f.labels[::-1], SECOND),
              "are upside down from", (FROM,)),
    Situation("labels one frame late from a frame on", labelled(lambda fs, f: fs[f.index - 1].labels, SECOND),
              "are late from", (FROM,)),
    Situation("labels two frames late from a frame on", labelled(lambda fs, f: fs[f.index - 2].labels, SECOND),
              "are late from", (FROM,)),
    Situation("labels two frames late", labels_of(-2), "are two frames late"),
    Situation("labels three frames late", labels_of(-3), "are three frames late"),
    Situation("labels in reversed order", labelled(lambda fs, f: fs[-1 - f.index].labels, ALL), "in reversed order"),
    Situation("labels shuffled", labelled(lambda fs, f: fs[ORDER[f.index]].labels, ALL), "are in another order than"),
    Situation("maps without labels in 2 frames", labelled(lambda fs, f: f.labels * 0 + 255, PAIR),
              "have no label at all in 2", PAIR, r"frames: ([\d, ]+);"),
    Situation("maps of one class in 3 frames", labelled(lambda fs, f: f.labels * 0, SOME), "have one class", SOME,
              IN_FRAMES),
    Situation("maps upside down in 2 frames side by side", labelled(lambda fs, f: f.labels[::-1], PAIR), "the map of",
              PAIR),
)  # fmt: skip


def said(frames: Frames, *, run: bool = False) -> Iterator[str]:
    """Yield the findings, as `check` says them, or a run."""
    made, indices = FramesInMemory(frames), range(len(frames))
    if run:
        verdict, _, chained = quick_sample(made, indices, {}, "net")
    else:
        inspection = Inspection(made, indices, "net", clusters(len(frames), CLUSTERS), POINTS)
        verdict = inspection.verdict({}, thorough=True)
        chained = {} if inspection.chained is None else {"net": inspection.chained}
    yield from verdict.remarks
    if verdict.state == "unsound":
        yield verdict.text
        return
    for found in label_findings(made, indices, ["net"], {}, chained, thorough=not run):
        yield from (*found.wrong, *found.remarks)


def print_situations(seeds: Sequence[int], only: str) -> None:
    """Print the table of situations."""
    print(f"| situation | `check` finds it in {len(seeds)} | a run | right frames | something else said |")
    print("|---|---:|---:|---:|---:|")
    for situation in SITUATIONS:
        if only not in situation.name:
            continue
        scenes = [situation.plant(scene(seed)) for seed in seeds]
        lines = [[*said(frames)] for frames in scenes]
        runs = [[*said(frames, run=True)] for frames in scenes]
        found, in_run = (
            [any(situation.said in line for line in of_scene) for of_scene in told] for told in (lines, runs)
        )
        placed = sum(situation.is_placed(of_scene) for of_scene in lines) if situation.frames else "-"
        other = sum(any(situation.said not in line for line in of_scene) for of_scene in lines)
        print(f"| {situation.name} | {sum(found)} | {sum(in_run)} | {placed} | {other} |", flush=True)


def main(scenes: int = 20, seed: int = 0, only: str = "", situations: bool = False) -> None:
    seeds = range(seed, seed + scenes)
    if situations:
        print_situations(seeds, only)
        return
    rooms = [scene(seed) for seed in seeds]
    cases.head(["planted", f"found in {scenes}", "something else said"])
    for mistake in MISTAKES:
        if only in mistake.name:
            lines = [[*said(mistake.plant(frames))] for frames in rooms]
            found = sum(any(mistake.said in line for line in of_scene) for of_scene in lines)
            other = sum(any(mistake.said not in line for line in of_scene) for of_scene in lines)
            cases.row([mistake.name, str(found), str(other)])
