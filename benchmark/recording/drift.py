"""Record the changes that each frame made to the map, and the frames that moved the voxels with the largest drift."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.core.types import Float64, Int64, Mask, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import GLOW, LabelSpace, between, fixed
from semstab.data.measures import SBD_MAX, mean_drift
from semstab.data.results import Changes
from semstab.data.voxels import VoxelTable
from semstab.recording.loops import AGREES, CONTRADICTS, FIRST_SEEN, NO_DRIFT, NO_VOXEL, draw_changes, key_of
from semstab.recording.timeline import Clock, path

# The pictures show levels of drift, in colours that no class has, and labels that contradict the map.

LEVELS = 24
LEVEL_EDGES = SBD_MAX * (np.arange(LEVELS + 1) / LEVELS) ** 2
"""The edges of the levels of drift, bits: finer where drift is small; the last level is open."""

PICTURES = {
    "contradictions": "contradictions (orange)",
    "drift": f"drift (red to white, {SBD_MAX:.2f} bits; blue: new)",
}
"""The pictures of a frame by entity, and the titles of their views. The first one is shown first: it marks labels that
are not the dominant class that their voxel had before the frame."""


OVER_COLOUR, AMONG_POINTS = (0, 0, 0, 150), (150, 150, 155, 255)
"""Colours of what has no finding: pixels darken the colour image under them, points are grey."""


def contexts(nothing: tuple[int, int, int, int] = OVER_COLOUR) -> dict[str, rr.AnnotationContext]:
    """Return names and colours of each picture; pixels or points without a finding have the colour of `nothing`."""
    names = [f"{low:.4f} to {high:.4f} bits" for low, high in itertools.pairwise(LEVEL_EDGES)]
    names[-1] = f"{LEVEL_EDGES[-2]:.4f} bits and more"
    none, glow = (NO_VOXEL, "no voxel", (0, 0, 0, 200)), between(GLOW, LEVELS).astype(int).tolist()
    infos = {
        "contradictions": [
            none,
            (AGREES, "as the map", nothing),
            (CONTRADICTS, "contradicts the map", (255, 120, 0, 255)),
        ],
        "drift": [
            none,
            (FIRST_SEEN, "first seen", (40, 60, 110, 170)),
            (NO_DRIFT, "no drift", nothing),
            *((NO_DRIFT + 1 + k, name, (*glow[k], 255)) for k, name in enumerate(names)),
        ],
    }
    return {name: rr.AnnotationContext(entries) for name, entries in infos.items()}


@dataclass(frozen=True, eq=False)
class FrameChanges:
    """The changes that a frame made to the n voxels that it saw.

    Attributes:
        frame: Its labels and depth.
        changes: Of its voxels.
        voxel_size: Edge of a voxel, metres.
    """

    frame: Frame
    changes: Changes
    voxel_size: float

    def pictures(self, stride: int = 1) -> dict[str, UInt8]:
        """Return each of PICTURES, of every stride-th pixel or point (H', W')."""
        frame = self.frame
        size = tuple(-(-side // stride) for side in frame.shape)
        values = {name: np.full(size, NO_VOXEL, np.uint8) for name in PICTURES}
        points = np.zeros((0, 0, 3), np.float32) if frame.points is None else frame.points
        draw_changes(
            fixed(frame.depth), fixed(points), fixed(frame.valid), fixed(frame.predicted), *frame.rays,
            fixed(frame.T_wc), self.voxel_size, stride, fixed(self.changes.index), fixed(self.changes.before),
            fixed(self.changes.drift), LEVEL_EDGES[1:-1], values["contradictions"], values["drift"],
        )  # fmt: skip
        return values


POINT_RADIUS = 1.5
"""Radius of a scan's point in the viewer, in its units of the screen."""


def log_points(stream: rr.RecordingStream, entity: str, frame: Frame, drift: FrameChanges | None) -> None:
    """Log a scan's valid points in the sensor's axes, by class, and by the drift that it caused in their voxels."""
    assert frame.points is not None
    values: dict[str, npt.NDArray[Any]] = {"labels": frame.predicted}
    if drift is not None:
        values |= drift.pictures()
    for name, of_name in values.items():
        points = rr.Points3D(
            frame.points[frame.valid], class_ids=of_name[frame.valid], radii=rr.Radius.ui_points(POINT_RADIUS)
        )
        stream.log(f"{entity}/{name}/points", points)


def packed(index: npt.NDArray[np.integer[Any]]) -> Int64:
    """Return one number (n,) for each voxel (n, 3), different for voxels within 2^20 of each other along each axis."""
    return np.asarray(key_of.py_func(*index.T.astype(np.int64)))


# The voxels that drifted most, and the frames that contributed most to their drift.

SHOWN = 10
"""The most voxels that are shown of a model on a scene, at least APART voxels apart: one of each location."""

APART, CANDIDATES = 5, 20_000

MAX_MOVES = 2_000_000
"""The most moves that are stored of a model on a scene; of more, those of the voxels that moved least are dropped."""

MOVED_BITS = 0.05
"""A frame is listed from this drift on although the dominant class stays: a voxel with it is drifting, bits."""

NUMBER = np.array([[0.04, 0.04], [0.04, 0.1]])
"""The margins of a number, as shares of an image's longer side: left of its point and above, right of it and below."""

MOVE = np.dtype([("voxel", np.int64), ("frame", np.int32), ("before", np.uint16), ("after", np.uint16), ("bits", "f4")])

COLORS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178),
    (255, 255, 255), (170, 255, 195), (220, 190, 255),
)  # fmt: skip
"""The colours of numbered places, on the viewer's dark ground."""


class FrameView(NamedTuple):
    """A frame without its images: its time, the camera that projects into it, if it is an image, and its label file."""

    timestamp: float | None
    intrinsics: Intrinsics | None
    T_wc: Float64
    shape: tuple[int, int]
    file: str = ""

    def project(self, points: Float64) -> tuple[Float64, Mask]:
        """Return the pixels (n, 2) of points (n, 3) in the viewer's image, and a mask of those with a number inside."""
        assert self.intrinsics is not None
        x, y, z = self.intrinsics.matrix @ ((points - self.T_wc[:3, 3]) @ self.T_wc[:3, :3]).T
        pixels = np.stack([x, y], axis=1) / np.where(z > 0, z, 1.0)[:, None] + 0.5  # its pixel centres are at halves
        size = np.array(self.shape[::-1], dtype=np.float64)
        first, last = NUMBER * size.max()
        return pixels, (z > 0) & np.all((pixels >= first) & (pixels <= size - last), axis=1)


def top_voxels(table: VoxelTable) -> Int64:
    """Return the rows of the voxels that drifted most, one of each location, in the order of their drift."""
    total = table.drift_sum
    least = np.partition(total, -CANDIDATES)[-CANDIDATES] if len(total) > CANDIDATES else 0.0
    rows = np.flatnonzero((total >= least) & (total > 0))
    index = table.index[rows]
    chosen: list[int] = []
    for k in np.lexsort([*index.T[::-1], -total[rows]]):
        if np.all(np.abs(index[chosen] - index[k]).max(axis=1) >= APART):
            chosen.append(int(k))
        if len(chosen) == SHOWN:
            break
    return rows[chosen]


@dataclass(frozen=True, eq=False)
class Drifted:
    """A voxel that drifted much, and the frames that moved it.

    Attributes:
        number: From 1 on, in the order of the drift.
        center: (3,) world coordinates, metres.
        op, bits, sbd: Its observations, the drift of all together and their mean, bits.
        first_frame, first_class: The frame that saw it first, and its dominant class then.
        moves: Records of MOVE.
    """

    number: int
    center: Float64
    op: np.integer[Any]
    bits: np.floating[Any]
    sbd: np.floating[Any]
    first_frame: int
    first_class: int
    moves: npt.NDArray[np.void]


class DriftLog:
    """A log of the frames that moved the beliefs of a map, and of where they were taken."""

    def __init__(self, voxel_size: float) -> None:
        self._voxel_size = voxel_size
        self._moves: list[npt.NDArray[np.void]] = []  # records of MOVE, in the order of the frames
        self._views: dict[int, FrameView] = {}

    def follow(self, frame: Frame, changes: Changes) -> FrameChanges:
        """Store the moves of a frame that the map has fused; return its changes, for pictures."""
        rows = np.flatnonzero((changes.before != changes.after) | (changes.drift >= MOVED_BITS))
        moves = np.zeros(len(rows), dtype=MOVE)
        moves["voxel"], moves["frame"], moves["bits"] = packed(changes.index[rows]), frame.index, changes.drift[rows]
        moves["before"], moves["after"] = changes.before[rows], changes.after[rows]
        self._moves += [moves] if len(moves) else []
        file = PurePath(frame.files.get("labels") or frame.files.get("scores") or "")
        name = file.name if file.suffix else ""
        self._views[frame.index] = FrameView(frame.timestamp, frame.intrinsics, np.array(frame.T_wc), frame.shape, name)
        if sum(map(len, self._moves)) > MAX_MOVES:  # keep half of them: the moves of the voxels that were moved most
            all_moves = np.concatenate(self._moves)
            _, voxel = np.unique(all_moves["voxel"], return_inverse=True)
            order = np.argsort(-np.bincount(voxel, all_moves["bits"])[voxel], kind="stable")[: MAX_MOVES // 2]
            self._moves = [all_moves[np.sort(order)]]
        return FrameChanges(frame, changes, self._voxel_size)

    def log(
        self,
        stream: rr.RecordingStream,
        scene: str,
        model: str,
        classes: LabelSpace,
        table: VoxelTable,
        translation: npt.NDArray[np.floating[Any]],
        clock: Clock,
    ) -> None:
        """Log a lane with the dominant class of each top voxel of a map, its moves in words, and its position."""
        if not self._views:
            return
        drifted = self._drifted(table)
        for voxel in drifted:
            self._log_lane(stream, path(scene, "flips", model, f"voxel_{voxel.number}"), voxel, classes, clock)
        report = "\n".join(self._report(model, drifted, classes.classes)) + "\n"
        text = rr.TextDocument(report, media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "flips_report", model), text, static=True)
        if drifted:
            centers = np.array([voxel.center for voxel in drifted])
            numbers = [f"{voxel.number}" for voxel in drifted]
            points = rr.Points3D(
                centers - translation, labels=numbers, colors=COLORS[: len(drifted)], radii=rr.Radius.ui_points(5.0),
                show_labels=True,
            )  # fmt: skip
            stream.log(path(scene, "flips_at", model), points, static=True)
            self._log_in_images(stream, path(scene, "camera", model, "flips"), centers, clock)

    def _drifted(self, table: VoxelTable) -> list[Drifted]:
        """Return the top voxels of a map, with the frames that moved them."""
        top = top_voxels(table)
        bits, op = table.drift_sum[top], table.op[top]
        voxels, centers, first_frame = packed(table.index[top]), table.centers[top], table.first_frame[top]
        class_now, sbd = np.asarray(table.evidence.take(top)).argmax(axis=1), mean_drift(bits, op)
        all_moves, drifted = np.concatenate([np.zeros(0, dtype=MOVE), *self._moves]), []
        for i, voxel in enumerate(voxels):
            moves = all_moves[all_moves["voxel"] == voxel]
            first = int(moves["before"][0]) if len(moves) else int(class_now[i])
            drifted.append(Drifted(i + 1, centers[i], op[i], bits[i], sbd[i], int(first_frame[i]), first, moves))
        return drifted

    def _log_lane(
        self, stream: rr.RecordingStream, lane: str, voxel: Drifted, classes: LabelSpace, clock: Clock
    ) -> None:
        """Log the dominant class of a voxel from frame to frame."""
        names, colors = classes.classes, [(*color, 255) for color in classes.colors]
        stream.log(lane, rr.StateConfiguration(values=names, labels=names, colors=colors), static=True)
        changes = [(frame, after) for _, frame, before, after, _ in voxel.moves.tolist() if before != after]
        for frame, label in [(voxel.first_frame, voxel.first_class), *changes]:
            clock.set(stream, frame, self._views[frame].timestamp)
            stream.log(lane, rr.StateChange(state=names[label]))

    def _report(self, model: str, drifted: Sequence[Drifted], names: Sequence[str]) -> Iterator[str]:
        """Yield lines of Markdown on voxels and the frames that moved them."""
        yield f"**{model}**: the voxels with the largest drift, and the frames that moved them"
        yield ""
        if not drifted:
            yield "No voxel drifted."
        for voxel in drifted:
            x, y, z = voxel.center
            yield (
                f"- **voxel {voxel.number}** at ({x:.2f}, {y:.2f}, {z:.2f}) m: OP {voxel.op}, drift {voxel.bits:.3f}"
                f" bits in all, SBD {voxel.sbd:.4f} bits; {names[voxel.first_class]} in frame {voxel.first_frame}"
            )
            for _, frame, before, after, moved in voxel.moves.tolist():
                file = self._views[frame].file
                change = f"**{names[before]} → {names[after]}**" if before != after else f"stays {names[before]}"
                yield f"    - frame {frame}{f' ({file})' if file else ''}: {change}, {moved:.4f} bits"

    def _log_in_images(self, stream: rr.RecordingStream, entity: str, centers: Float64, clock: Clock) -> None:
        """Log the numbers of voxels at their pixels: the view of an image would also draw 3D points outside of it."""
        numbers, colors = [f"{i + 1}" for i in range(len(centers))], COLORS[: len(centers)]
        for index, view in self._views.items():
            if view.intrinsics is None:
                continue
            pixels, inside = view.project(centers)
            clock.set(stream, index, view.timestamp)
            points = rr.Points2D(
                pixels[inside],
                labels=list(itertools.compress(numbers, inside)),
                colors=list(itertools.compress(colors, inside)),
                radii=rr.Radius.ui_points(4.0),
                show_labels=True,
            )
            stream.log(entity, points)
