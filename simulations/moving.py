"""Are the spots that moved found, and is nothing called moved that stayed?

    python simulations/simulate.py moving [--scenes 20] [--noise 0 0.003 0.01] [--only made still scans city]
        [--data FOLDER]

Made scenes: a camera goes along a street, 3 to 15 m high, 40 frames; there are walls, parked boxes and six boxes that
move: they drive all the time, drive and stop, or stand and start, at 0.05 to 2 of their own lengths a frame. Noise of
depth is 0 to 1 %. A model errs in 4 % of the places and frames, and in 40 % of the frames at what moves. A spot is on a
mover if the view that found it shows one there; recall is of the spots of movers that went by their own length at least
while the camera filmed, *told* of those of which it is known whether they moved. The first table has these scenes;
*share* is the mean and the largest error of the share of the disagreement that is at movers, and the number of scenes
in which it is above .1. The second one has the recall by speed, in lengths a frame, at the first noise. Then come the
same scenes without movers (still); the built-in city with its cars and people; the made streets with and without
movers, as a LiDAR sees them that drives there (scans); and sequences of the folder --data in which nothing moves
(../shared/data). With `--only streets` the folder --data has streets of SemanticKITTI, as scripts/streets.py prepares
them: what moves there has ids 252 to 259.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cases
import numpy as np

import semstab
from semstab.data.frames import Frame, Intrinsics
from semstab.datasets import Scene
from semstab.statistics import Sampler, SpotObservations
from semstab.statistics.moving import share_of_disagreement
from semstab.task import open_scenes

W, H, FOCAL, FRAMES, MOVERS = 320, 200, 220.0, 40, 6
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)
CLASSES = 4
"""Ground, building, parked and moving things."""

SPEEDS = (0.05, 0.2, 0.5, 1.0, 2.0)
NOISES = (0.0, 0.003, 0.01)
SCAN_NOISES = (0.0, 0.02, 0.05)
"""Standard deviations of the range of a LiDAR's points, metres."""

STATIC = (("livingroom", 4), ("hololens", 2), ("apc_shelf", 1), ("brighton", 1))
"""Real sequences without movers, and every n-th of their frames."""

SIZES = ((4.2, 1.8, 1.5), (0.6, 0.6, 1.75), (8.0, 2.5, 3.0))
"""Length, width and height of a car, a person and a truck, metres."""

WRONG, WRONG_MOVER = 0.04, 0.4
Way = Literal["drives", "stops", "starts"]


@dataclass(frozen=True)
class Box:
    """A box on the ground: its first corner and its size, metres; how it moves along the street, metres a frame."""

    corner: np.ndarray
    size: tuple[float, float, float]
    speed: float = 0.0
    way: Way = "drives"
    turn: int = 0

    def travelled(self, frame: int) -> float:
        """Metres from its place in the first frame."""
        if self.way == "stops":
            return self.speed * min(frame, self.turn)
        return self.speed * max(frame - (self.turn if self.way == "starts" else 0), 0)

    def at(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Its lowest and its highest corner."""
        low = self.corner + np.array([self.travelled(frame), 0.0, 0.0])
        return low, low + self.size

    @property
    def goes_its_length(self) -> bool:
        return abs(self.travelled(FRAMES - 1)) >= self.size[0]


@dataclass(frozen=True)
class MadeStreet:
    """Objects of a street, and the views of them."""

    boxes: list[Box]
    poses: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, movers: int = MOVERS) -> MadeStreet:
        """A street along x, with walls, parked boxes and movers in lanes of their own."""
        walls = [
            Box(np.array([x, y, 0.0]), (14.0, 8.0, rng.uniform(4, 9)))
            for x in range(-20, 80, 18)
            for y in (-20.0, 14.0)
        ]
        parked = [
            Box(np.array([rng.uniform(0, 50), y, 0.0]), SIZES[k % 2]) for k, y in enumerate((-12.0, -10.5, 11.0, 12.5))
        ]
        going = []
        for k in range(movers):
            size, speed = SIZES[k % 3], float(rng.choice(SPEEDS)) * float(rng.choice([-1, 1]))
            way: Way = ("drives", "stops", "starts")[int(rng.integers(3))]
            metres, turn = speed * size[0], int(rng.integers(FRAMES // 4, 3 * FRAMES // 4))
            start = rng.uniform(5, 35) - metres * (FRAMES / 2 if way == "drives" else turn if way == "stops" else 0)
            going.append(Box(np.array([start, -8.0 + 3.0 * k, 0.0]), size, metres, way, turn))
        height, tilt, step = rng.uniform(3, 15), rng.uniform(0.35, 0.9), rng.uniform(0.1, 0.5)
        forward = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
        right = np.array([0.0, -1.0, 0.0])
        poses = np.tile(np.eye(4), (FRAMES, 1, 1))
        poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses[:, :3, 3] = np.stack(
            [-10 + step * np.arange(FRAMES), rng.normal(0, 0.3, FRAMES), np.full(FRAMES, height)], 1
        )
        return cls([*walls, *parked, *going], poses)

    def frames(self, noise: float, rng: np.random.Generator) -> Iterator[tuple[Frame, np.ndarray]]:
        """Yield frames with true classes, and the number of what each pixel shows: 0 of the ground, then the boxes."""
        u, v = np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        for index, T_wc in enumerate(self.poses):
            world, centre = rays @ T_wc[:3, :3].T, T_wc[:3, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = np.where(world[..., 2] < -1e-3, -centre[2] / world[..., 2], np.inf)
                objects = np.zeros((H, W), np.int64)
                for number, box in enumerate(self.boxes, 1):
                    low, high = box.at(index)
                    if (part := _part(low, high, T_wc)) is None:
                        continue
                    faces = (np.stack([low, high]) - centre)[:, None, None] / world[part]
                    enter, leave = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
                    hit = (enter <= leave) & (enter > 0.1) & (enter < depth[part])
                    depth[part], objects[part] = np.where(hit, enter, depth[part]), np.where(hit, number, objects[part])
            depth = np.where(depth < 60, depth * (1 + noise * rng.standard_normal((H, W))), 0)
            yield Frame(index, depth.astype(np.float32), CAMERA, T_wc, labels=self.classes[objects]), objects

    @property
    def classes(self) -> np.ndarray:
        """The class of the ground, and of each box."""
        of_boxes = [3 if box.speed else 1 if box.size[0] == 14.0 else 2 for box in self.boxes]
        return np.array([0, *of_boxes], np.uint8)

    def asked(self, noise: float, rng: np.random.Generator) -> tuple[SpotObservations, np.ndarray]:
        """Return the answers of the model, and the number of what each spot is on; -1 for a spot without answers."""
        model, ids = Sampler(CLASSES), Sampler(len(self.boxes) + 1, moving=False)
        for frame, objects in self.frames(noise, rng):
            assert frame.labels is not None
            place = np.kron(rng.random((H // 8, W // 8)), np.ones((8, 8)))
            wrong = np.where(frame.labels == 3, rng.random() < WRONG_MOVER, place < WRONG)
            labels = np.where(wrong, (frame.labels + 2) % CLASSES, frame.labels).astype(np.uint8)
            model.add(dataclasses.replace(frame, labels=labels))
            ids.add(dataclasses.replace(frame, labels=objects.astype(np.uint8)))
        spots, of_ids = model.sample(), ids.sample()
        first = np.full(len(spots.point), -1)
        first[of_ids.spot[::-1]] = of_ids.label[::-1]
        return spots, first


def _part(low: np.ndarray, high: np.ndarray, T_wc: np.ndarray) -> tuple[slice, slice] | None:
    """Return the rows and columns in which a box may be seen; all of them if it is next to the camera."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(8, 3)
    x, y, z = ((corners - T_wc[:3, 3]) @ T_wc[:3, :3]).T
    if z.max() <= 0:
        return None
    if z.min() <= 0.1:
        return slice(0, H), slice(0, W)
    u, v = x / z * FOCAL + CAMERA.cx, y / z * FOCAL + CAMERA.cy
    rows = slice(max(0, int(v.min())), min(H, int(v.max()) + 2))
    columns = slice(max(0, int(u.min())), min(W, int(u.max()) + 2))
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


@dataclass
class Counts:
    """Spots: called moved, of these on movers; on movers, known and called moved; static and known, called moved."""

    called: int = 0
    right: int = 0
    movers: int = 0
    known: int = 0
    found: int = 0
    static: int = 0
    wrong: int = 0
    errors: list[float] = dataclasses.field(default_factory=list)

    def add(self, spots: SpotObservations, mover: np.ndarray, far: np.ndarray, counted: np.ndarray) -> None:
        """Add spots (n,): on a mover, on one that went by its length, with answers."""
        assert spots.votes is not None
        moved, told = spots.votes.moved & counted, spots.votes.decided & counted
        self.called, self.right = self.called + int(moved.sum()), self.right + int((moved & mover).sum())
        self.movers, self.known = self.movers + int(far.sum()), self.known + int((far & told).sum())
        self.found += int((far & moved).sum())
        self.static, self.wrong = self.static + int((told & ~mover).sum()), self.wrong + int((moved & ~mover).sum())

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, field.name) + getattr(other, field.name) for field in dataclasses.fields(self)))

    def cells(self) -> list[str]:
        def part(a: int, b: int) -> str:
            return f"{a / b:.3f}" if b else "-"

        static = f"{100 * self.wrong / self.static:.3f} %" if self.static else "-"
        return [
            str(self.movers),
            part(self.right, self.called),
            part(self.found, self.movers),
            part(self.found, self.known),
            static,
        ]


HEADS = ["spots on movers", "precision", "recall", "of told", "static called moved"]


def made(scenes: int, seed: int, noises: tuple[float, ...], movers: int) -> None:
    cases.head(["made scenes", "noise", *HEADS, "share"])
    by_speed: dict[tuple[str, float], list[int]] = {}
    for noise in noises:
        counts = Counts()
        for scene in range(scenes):
            street = MadeStreet.drawn(np.random.default_rng([seed, scene]), movers=movers)
            spots, on = street.asked(noise, np.random.default_rng([seed, scene, 1]))
            assert spots.votes is not None
            boxes = [None, *street.boxes]
            mover = np.array([box is not None and box.speed != 0 for box in boxes])[on] & (on >= 0)
            far = np.array([box is not None and box.speed != 0 and box.goes_its_length for box in boxes])[on] & (
                on >= 0
            )
            counts.add(spots, mover, far, on >= 0)
            if movers:
                told = share_of_disagreement(spots, spots.votes.moved, spots.votes.static)
                error = told - share_of_disagreement(spots, mover, ~mover)
                counts.errors.append(abs(error))
            for number, box in enumerate(street.boxes, 1):
                if box.speed and noise == noises[0]:
                    of_object = on == number
                    sums = by_speed.setdefault((box.way, round(abs(box.speed) / box.size[0], 3)), [0, 0, 0])
                    for k, some in enumerate(
                        (of_object, of_object & spots.votes.decided, of_object & spots.votes.moved)
                    ):
                        sums[k] += int(some.sum())
        off = np.array(counts.errors)
        share = f"{off.mean():.3f}, {off.max():.2f}, {np.count_nonzero(off > 0.1)}" if movers else "-"
        cases.row([str(scenes) + ("" if movers else ", nothing moves"), f"{100 * noise:g} %", *counts.cells(), share])
    if not movers:
        return
    print()
    cases.head(["way", "lengths a frame", "spots", "told", "moved", "of told"])
    for (way, speed), (all_, told, moved) in sorted(by_speed.items()):
        cases.row(
            [way, f"{speed:g}", str(all_), str(told), f"{moved / max(all_, 1):.3f}", f"{moved / max(told, 1):.3f}"]
        )


def city() -> None:
    cases.head(["city", "frames", *HEADS])
    for frames in (20, 60, 120):
        config = semstab.load_config({"dataset": {"name": "city", "options": {"frames": frames}}})
        for name, scene in open_scenes(config).items():
            space, sampler = scene.label_space("gt"), Sampler(len(scene.label_space("gt")))
            rows = np.full(256, 255)
            rows[list(space.ids)] = np.arange(len(space))
            for index in range(len(scene)):
                frame = scene.frame(index, "gt", color=False)
                sampler.add(dataclasses.replace(frame, labels=rows[frame.labels].astype(np.uint8)))
            spots = sampler.sample()
            first = np.full(len(spots.point), -1)
            first[spots.spot[::-1]] = spots.label[::-1]
            mover = np.isin(first, [space.classes.index(mover_class) for mover_class in ("moving car", "human")])
            counts = Counts()
            counts.add(spots, mover, mover, first >= 0)
            cases.row([name, str(frames), *counts.cells()])


def unlabelled(scene: Scene, step: int) -> Iterator[Frame]:
    for index in range(0, len(scene), step):
        frame = scene.geometry(index)
        yield dataclasses.replace(frame, labels=np.full(frame.shape, index % 2, np.uint8))


def real(data: Path) -> None:
    cases.head(["static", "frames", "spots", "told", "moved", "moved by chance", "farther by", "misplaced"])
    for name, step in STATIC:
        config = semstab.load_config({"dataset": {"name": "posed_folder", "options": {"root": str(data / name)}}})
        (scene,) = open_scenes(config).values()
        sampler = Sampler(2)
        for frame in unlabelled(scene, step):
            sampler.add(frame)
        spots = sampler.sample()
        votes, answered = spots.votes, np.unique(spots.spot)
        assert votes is not None
        is_told, moved = votes.decided[answered], votes.moved[answered]
        share = f"{100 * moved.sum() / max(is_told.sum(), 1):.3f} %"
        chance, gap = f"{100 * votes.false_share:.4f} %", f"{100 * votes.gap:.1f} %"
        told = f"{100 * is_told.mean():.0f} %"
        cases.row(
            [name, str(spots.frames), f"{len(answered):,}", told, share, chance, gap, str(int(votes.misplaced.sum()))]
        )


def main(
    scenes: int = 20,
    seed: int = 0,
    data: str = "",
    only: tuple[str, ...] = ("made", "still", "city"),
    noise: tuple[float, ...] = NOISES,
) -> None:
    import moving_scans  # which takes streets from here

    for name, movers in (("made", MOVERS), ("still", 0)):
        if name in only:
            made(scenes, seed, noise, movers)
            print()
    if "scans" in only:
        for movers in (MOVERS, 0):
            moving_scans.made(scenes, seed, SCAN_NOISES, movers)
            print()
    if "city" in only:
        city()
        print()
    if data:
        (moving_scans.streets if "streets" in only else real)(Path(data))
