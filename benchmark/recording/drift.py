"""The drift that each frame caused: its picture in the camera, and the top contributing frames of drifting voxels."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.backends import GrowingMap
from semstab.backends.numba_hash import NumbaHash
from semstab.core.types import Float32, Float64, Int32, Int64, Mask, UInt8
from semstab.model.frames import Frame, Intrinsics
from semstab.model.labels import GLOW, Color, LabelSpace, between
from semstab.model.measures import SBD_MAX, mean_drift
from semstab.recording.kernels import find_voxels
from semstab.recording.timeline import LINE_COLORS, Clock, path

# The picture: levels of drift, in colours that no class has, and their legend.

NO_VOXEL, FIRST_SEEN, NO_DRIFT = 0, 1, 2
LEVELS = 24
LEVEL_EDGES = SBD_MAX * (np.arange(LEVELS + 1) / LEVELS) ** 2
"""Bits at which one level of drift ends and the next begins: finer where drift is small; the last one is open."""

RAMPS: tuple[tuple[Color, ...], ...] = (
    GLOW,
    ((0, 100, 120), (0, 160, 190), (0, 220, 240), (130, 245, 255), (215, 255, 255)),
    ((120, 0, 110), (200, 0, 190), (255, 60, 220), (255, 150, 235), (255, 220, 250)),
    ((30, 100, 0), (70, 170, 0), (130, 235, 30), (190, 255, 110), (230, 255, 200)),
)
"""What drifts lights up like a glowing body; where a taxonomy of the user's has such a colour, in another hue."""

NEAR = 40.0
"""Distance in RGB from which on two colours are told apart."""

LEGEND = (-1.0, LEVELS + 3.0), (0.0, 2.8)
"""What is seen of the legend, across and down, in squares of a level."""


def ramp(classes: LabelSpace) -> Float64:
    """Colours (LEVELS, 3) of the levels: the first of RAMPS that no class's colour is near, else the farthest."""
    ramps = [between(colors, LEVELS) for colors in RAMPS]
    worn = np.array(classes.colors, dtype=np.float64)
    distance = [float(np.linalg.norm(r[:, None] - worn, axis=2).min()) for r in ramps]
    clear = [number for number, least in enumerate(distance) if least >= NEAR]
    return ramps[clear[0] if clear else int(np.argmax(distance))]


def levels_of(drift: Float32, seen: Mask) -> UInt8:
    """Picture of drift in bits (H, W), NaN where a voxel is seen for the first time; `seen` where there is a voxel."""
    level = np.searchsorted(LEVEL_EDGES[1:-1], drift, side="right") + NO_DRIFT + 1
    level[drift == 0] = NO_DRIFT
    level[np.isnan(drift)] = FIRST_SEEN
    level[~seen] = NO_VOXEL
    return level.astype(np.uint8)


def context(classes: LabelSpace) -> rr.AnnotationContext:
    """Names and colours of the levels; over the colour image only what drifts is seen, and dimly what is new."""
    names = [f"{low:.4f} to {high:.4f} bits" for low, high in itertools.pairwise(LEVEL_EDGES)]
    names[-1] = f"{LEVEL_EDGES[-2]:.4f} bits and more"
    glow = ramp(classes).astype(int)
    infos: list[tuple[int, str, tuple[int, ...]]] = [
        (NO_VOXEL, "no voxel", (0, 0, 0, 200)),
        (FIRST_SEEN, "first seen", (40, 60, 110, 170)),
        (NO_DRIFT, "no drift", (0, 0, 0, 150)),
    ]
    infos += [(NO_DRIFT + 1 + k, name, (*glow[k].tolist(), 255)) for k, name in enumerate(names)]
    return rr.AnnotationContext([rr.AnnotationInfo(*info) for info in infos])


def log_legend(stream: rr.RecordingStream, entity: str, classes: LabelSpace) -> None:
    """The levels side by side in their colours, and what they mean where that is round."""
    stream.log(entity, context(classes), static=True)
    shown = np.array([[FIRST_SEEN, NO_VOXEL, *range(NO_DRIFT + 1, NO_DRIFT + 1 + LEVELS)]], dtype=np.uint8)
    stream.log(f"{entity}/levels", rr.SegmentationImage(shown), static=True)
    ticks = [0.01, 0.05, 0.1, 0.2]
    at = [2 + LEVELS * (bits / SBD_MAX) ** 0.5 for bits in ticks]
    labels = ["first seen", *(f"{bits:g}" for bits in ticks), f"{SBD_MAX:.2f} bits"]
    points = np.array([(x, 1.2) for x in (0.5, *at, LEVELS + 1.0)])
    names = rr.Points2D(points, colors=(255, 255, 255), labels=labels, radii=0.0, show_labels=True)
    stream.log(f"{entity}/names", names, static=True)


# The map that is followed.


class Tracker:
    """Follows a map voxel by voxel: a live one, which fuses each frame anyway, or else one of its own."""

    def __init__(self, voxel_size: float, num_classes: int, live: GrowingMap | None = None) -> None:
        self.map: GrowingMap = NumbaHash(voxel_size, num_classes) if live is None else live
        self._is_own = live is None

    def follow(self, frame: Frame) -> FrameDrift:
        """Return the drift that a frame caused, which live maps have fused by now."""
        if self._is_own:
            self.map.integrate(frame)
        changes = self.map.changes
        return FrameDrift(frame, changes.key.copy(), changes.drift, self.map.voxel_size, self.map.origin)


@dataclass(frozen=True, eq=False)
class FrameDrift:
    """The drift that a frame caused at each voxel that it saw, whatever becomes of the map.

    key    (n,) int64 packed voxel index, relative to the origin
    drift  (n,) float32 bits, NaN where the voxel was not seen before
    """

    frame: Frame
    key: Int64
    drift: Float32
    voxel_size: float
    origin: Int64

    def at(self, stride: int) -> tuple[Float32, Mask]:
        """Drift behind every stride-th pixel (H', W'), and where there is a voxel: where there is none, drift is 0."""
        found = self.voxels_at(stride)
        seen = found >= 0
        drift = np.zeros(found.shape, dtype=np.float32)
        drift[seen] = self.drift[found[seen]]
        return drift, seen

    def voxels_at(self, stride: int) -> Int32:
        """Which of the n voxels is behind every stride-th pixel (H', W'); -1 where a pixel does not count."""
        H, W = self.frame.shape
        camera, pick = self.frame.intrinsics, np.s_[::stride, ::stride]
        rays = (np.arange(W)[::stride] - camera.cx) / camera.fx, (np.arange(H)[::stride] - camera.cy) / camera.fy
        depth = np.where(self.frame.valid[pick], self.frame.depth[pick], np.float32(0))
        found = np.full(depth.shape, -1, dtype=np.int32)
        find_voxels(depth, *rays, np.array(self.frame.T_wc), self.voxel_size, self.origin, self.key, found)
        return found


# The voxels that drifted most, and the frames that contributed most to that.

SHOWN = 10
"""Voxels that are shown of a backbone on a scene."""

MAX_MOVES = 2_000_000
"""Moves that are remembered of a backbone on a scene; past them, those of the voxels that drifted least are dropped."""

MOVED_BITS = 0.05
"""Drift from which on a frame is listed, also where the dominant class stays: that of a drifting voxel."""

NUMBER = np.array([[0.04, 0.04], [0.04, 0.1]])
"""Share of an image's longer side that a number takes up left of its point and above, and right of it and below."""

MOVE = np.dtype([("row", np.int32), ("frame", np.int32), ("before", np.uint16), ("after", np.uint16), ("bits", "f4")])

COLORS = (*LINE_COLORS, (255, 255, 255), (170, 255, 195), (220, 190, 255))


@dataclass(frozen=True)
class DriftingVoxel:
    """A voxel that drifted much.

    number  from 1, the one that drifted most first
    center  (3,) metres, world
    bits    its drift, summed over all frames
    moves   records of `MOVE`, in the order of the frames
    """

    number: int
    center: Float64
    first_frame: int
    first_class: int
    op: int
    sbd: float
    bits: float
    moves: npt.NDArray[np.void]


@dataclass(frozen=True, eq=False)
class View:
    """A frame without its images: number and time, the camera that projects into it, and its label file."""

    timestamp: float | None
    intrinsics: Intrinsics
    T_wc: Float64
    shape: tuple[int, int]
    file: str = ""

    def project(self, points: Float64) -> tuple[Float64, Mask]:
        """Return where points (n, 3) are in the viewer's image (n, 2), and which have their number inside it."""
        R, t = self.T_wc[:3, :3], self.T_wc[:3, 3]
        x, y, z = self.intrinsics.matrix @ ((points - t) @ R).T
        before = z > 0
        pixels = np.stack([x, y], axis=1) / np.where(before, z, 1.0)[:, None] + 0.5  # its pixel centres are at halves
        size = np.array(self.shape[::-1], dtype=np.float64)
        first, last = NUMBER * size.max()
        return pixels, before & np.all((pixels >= first) & (pixels <= size - last), axis=1)


class ContributionLog:
    """Remembers which frames moved a voxel's belief, above all its dominant class, and their label files."""

    def __init__(self) -> None:
        self.moves: list[npt.NDArray[np.void]] = []
        """Records of `MOVE`, in the order of the frames."""
        self._views: dict[int, View] = {}

    def update(self, tracker: Tracker, frame: Frame) -> None:
        """Remember the moves of the frame that the tracker followed last."""
        changes = tracker.map.changes
        at = np.flatnonzero((changes.before != changes.after) | (changes.drift >= MOVED_BITS))
        moves = np.zeros(len(at), dtype=MOVE)
        moves["row"], moves["frame"], moves["bits"] = changes.row[at], frame.index, changes.drift[at]
        moves["before"], moves["after"] = changes.before[at], changes.after[at]
        self.moves += [moves] if len(moves) else []
        file = PurePath(frame.files.get("labels") or frame.files.get("scores") or "")
        name = file.name if file.suffix else ""
        self._views[frame.index] = View(frame.timestamp, frame.intrinsics, np.array(frame.T_wc), frame.shape, name)
        if sum(map(len, self.moves)) > MAX_MOVES:  # half as many stay: those of the voxels that drifted most
            every = np.concatenate(self.moves)
            order = np.argsort(-tracker.map.column("drift_sum")[every["row"]], kind="stable")[: MAX_MOVES // 2]
            self.moves = [every[np.sort(order)]]

    def top_voxels(self, tracker: Tracker) -> Iterator[DriftingVoxel]:
        """Yield the voxels that drifted most, each with the frames that moved it."""
        fused, total = tracker.map, tracker.map.column("drift_sum")
        least = np.partition(total, -SHOWN)[-SHOWN] if len(total) > SHOWN else 0.0
        rows = np.flatnonzero((total >= least) & (total > 0))
        rows = rows[np.lexsort([*fused.index_of(rows).T[::-1], -total[rows]])][:SHOWN]
        first_frame, op = (fused.column(name, rows) for name in ("first_frame", "op"))
        centers = (fused.index_of(rows) + 0.5) * fused.voxel_size
        dominant, sbd = fused.evidence_of(rows).argmax(axis=1), mean_drift(total[rows], op)
        moves = np.concatenate([np.zeros(0, dtype=MOVE), *self.moves])
        for i, row in enumerate(rows):
            own = moves[moves["row"] == row]
            first = int(own["before"][0]) if len(own) else int(dominant[i])
            yield DriftingVoxel(
                i + 1, centers[i], int(first_frame[i]), first, int(op[i]), float(sbd[i]), float(total[row]), own
            )

    def log(
        self,
        stream: rr.RecordingStream,
        scene: str,
        backbone: str,
        voxels: list[DriftingVoxel],
        classes: LabelSpace,
        translation: npt.NDArray[np.floating[Any]],
        clock: Clock,
    ) -> None:
        """Log a lane with each voxel's dominant class, a line of text for each move, and where the voxels are."""
        names = list(classes.classes)
        lanes = rr.StateConfiguration(values=names, labels=names, colors=[(*color, 255) for color in classes.colors])
        for voxel in voxels:
            lane = path(scene, "flips", backbone, f"voxel_{voxel.number}")
            stream.log(lane, lanes, static=True)
            flips = voxel.moves[voxel.moves["before"] != voxel.moves["after"]]
            states = [(voxel.first_frame, voxel.first_class), *zip(flips["frame"], flips["after"], strict=True)]
            for frame, state in states:
                clock.set(stream, int(frame), self._views[int(frame)].timestamp)
                stream.log(lane, rr.StateChange(state=names[state]))
        report = rr.TextDocument(self._report(backbone, voxels, classes), media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "flips_report", backbone), report, static=True)
        if not voxels:
            return
        centers = np.array([voxel.center for voxel in voxels])
        labels, colors = (
            [f"{voxel.number}" for voxel in voxels],
            list(itertools.islice(itertools.cycle(COLORS), len(voxels))),
        )
        radii = rr.Radius.ui_points([5.0] * len(voxels))
        points = rr.Points3D(centers - translation, labels=labels, colors=colors, radii=radii, show_labels=True)
        stream.log(path(scene, "flips_at", backbone), points, static=True)
        for index, view in self._views.items():  # in the view of an image 3D points would stand beside it as well
            pixels, inside = view.project(centers)
            seen = np.flatnonzero(inside)
            clock.set(stream, index, view.timestamp)
            numbers = rr.Points2D(
                pixels[seen],
                labels=[labels[k] for k in seen],
                colors=[colors[k] for k in seen],
                radii=rr.Radius.ui_points([4.0] * len(seen)),
                show_labels=True,
            )
            stream.log(path(scene, "camera", backbone, "flips"), numbers)

    def _report(self, backbone: str, voxels: list[DriftingVoxel], classes: LabelSpace) -> str:
        """Markdown: the top contributing frames of each voxel."""
        lines = [f"**{backbone}**: the voxels with the largest drift, and the frames that moved them"]
        lines += [""] if voxels else ["", "No voxel drifted."]
        for voxel in voxels:
            x, y, z = voxel.center
            lines.append(
                f"- **voxel {voxel.number}** at ({x:.2f}, {y:.2f}, {z:.2f}) m: OP {voxel.op}, drift {voxel.bits:.3f}"
                f" bits in all, SBD {voxel.sbd:.4f} bits; {classes.classes[voxel.first_class]} in frame"
                f" {voxel.first_frame}"
            )
            for move in voxel.moves:
                file = self._views[int(move["frame"])].file
                before, after = (classes.classes[move[when]] for when in ("before", "after"))
                change = f"**{before} → {after}**" if before != after else f"stays {before}"
                where = f"frame {move['frame']}{f' ({file})' if file else ''}"
                lines.append(f"    - {where}: {change}, {move['bits']:.4f} bits")
        return "\n".join(lines) + "\n"
