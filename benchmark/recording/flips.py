"""Flip forensics: which frames moved the voxels that drifted most, and which of them changed the dominant class."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.backends import GrowingMap
from semstab.backends.numba_hash import NumbaHash
from semstab.core.rows import Rows
from semstab.core.types import Float32, Float64, Int32, Int64, Mask
from semstab.model.frames import Frame, Intrinsics
from semstab.model.labels import LabelSpace
from semstab.model.measures import mean_drift
from semstab.model.voxels import Extent
from semstab.recording.entities import Clock, path
from semstab.recording.kernels import find_voxels
from semstab.recording.series import LINE_COLORS

# What each frame of a backbone on a scene did to the voxels: followed for the recorder, whichever backends fuse it.


class Tracker:
    """Follows a map voxel by voxel: one of the run, which fuses each frame anyway, or else one of its own."""

    def __init__(
        self, voxel_size: float, num_classes: int, of_the_run: GrowingMap | None = None, within: Extent | None = None
    ) -> None:
        self.map: GrowingMap = (
            of_the_run if of_the_run is not None else NumbaHash(voxel_size, num_classes, within=within)
        )
        """The map that is followed."""
        self._is_own = of_the_run is None

    def follow(self, frame: Frame) -> None:
        """All units have fused the frame: from here on it is in the map that is followed, too."""
        if self._is_own:
            self.map.integrate(frame)

    def drift_of(self, frame: Frame) -> FrameDrift:
        """What that frame, which went into the map last, did to the voxels that it saw."""
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


SHOWN = 10
"""Voxels that are shown of a backbone on a scene."""

VIEW = 20
"""Numbers of `view_of`."""

MAX_MOVES = 2_000_000
"""Moves that are kept of a backbone on a scene; past them, those of the voxels that drifted least are dropped."""

MOVED_BITS = 0.05
"""Drift from which on a frame is to blame, also where the dominant class stays: that of a drifting voxel."""

NUMBER = np.array([[0.04, 0.04], [0.04, 0.1]])
"""Of an image's longer side, what a number takes up left of its point and above, and right of it and below."""

MOVE = np.dtype([("row", np.int32), ("frame", np.int32), ("before", np.uint16), ("after", np.uint16), ("bits", "f4")])

COLORS = (*LINE_COLORS, (255, 255, 255), (170, 255, 195), (220, 190, 255))


@dataclass(frozen=True)
class Suspect:
    """A voxel that drifted much.

    number  from 1, the one that drifted most first
    center  (3,) metres, world
    bits    its drift, summed over all frames
    moves   records of `MOVE`, in the order of the frames
    files   names of the files from which the labels of each came, where they have one
    """

    number: int
    center: Float64
    first_frame: int
    first_class: int
    op: int
    sbd: float
    bits: float
    moves: npt.NDArray[np.void]
    files: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Camera:
    """What projects a point of the world into a frame: K (3, 3), T_wc (4, 4), and the image's height and width."""

    K: Float64
    T_wc: Float64
    shape: tuple[int, int]

    @classmethod
    def of(cls, view: Sequence[float]) -> Camera:
        """The camera of a frame, from its `view_of`."""
        _, _, height, width, fx, fy, cx, cy, *pose = view
        T_wc = np.array([*pose[:12], 0, 0, 0, 1]).reshape(4, 4)
        return cls(Intrinsics(fx, fy, cx, cy).matrix, T_wc, (int(height), int(width)))

    def project(self, points: Float64) -> tuple[Float64, Mask]:
        """Of points (n, 3) where they are in the viewer's image (n, 2), and which of them with their number inside."""
        R, t = self.T_wc[:3, :3], self.T_wc[:3, 3]
        x, y, z = self.K @ ((points - t) @ R).T
        before = z > 0
        pixels = np.stack([x, y], axis=1) / np.where(before, z, 1.0)[:, None] + 0.5  # its pixel centres are at halves
        size = np.array(self.shape[::-1], dtype=np.float64)
        first, last = NUMBER * size.max()
        return pixels, before & np.all((pixels >= first) & (pixels <= size - last), axis=1)


def view_of(frame: Frame) -> list[float]:
    """Number, time stamp or NaN, height and width, fx, fy, cx, cy, and the upper rows of T_wc."""
    stamp, camera = math.nan if frame.timestamp is None else frame.timestamp, frame.intrinsics
    return [frame.index, stamp, *frame.shape, camera.fx, camera.fy, camera.cx, camera.cy, *frame.T_wc[:3].ravel()]


class FlipLog:
    """Keeps what moved a voxel's belief, above all its dominant class, and from which file the frame's labels came.

    most  moves that are kept
    """

    def __init__(self, most: int | None = None) -> None:
        self.moves: list[npt.NDArray[np.void]] = []
        """Records of `MOVE`, in the order of the frames."""
        self._most = MAX_MOVES if most is None else most
        self._count = 0
        self._views = Rows(VIEW + 1)  # of the frames, and where the name of each one's file ends
        self._names = bytearray()

    def see(self, view: Sequence[float], name: str = "") -> None:
        """The next frame, by its `view_of`, and the name of its label file."""
        self._names += name.encode("utf-8", "surrogatepass")
        self._views.append([*view, len(self._names)])

    def update(self, tracker: Tracker, frame: Frame) -> None:
        """Keep what the frame that the tracker followed last has moved."""
        changes = tracker.map.changes
        at = np.flatnonzero((changes.before != changes.after) | (changes.drift >= MOVED_BITS))
        moves = np.zeros(len(at), dtype=MOVE)
        moves["row"], moves["frame"], moves["bits"] = changes.row[at], frame.index, changes.drift[at]
        moves["before"], moves["after"] = changes.before[at], changes.after[at]
        self.moves += [moves] if len(moves) else []
        self._count += len(at)
        name = frame.files.get("labels") or frame.files.get("scores") or ""
        file = PurePath(name)
        self.see(view_of(frame), file.name if file.suffix else "")
        if self._count > self._most:
            self._drop(tracker.map.column("drift_sum"))

    def suspects(self, tracker: Tracker) -> Iterator[Suspect]:
        """The voxels that drifted most, and what moved them."""
        total = tracker.map.column("drift_sum")
        most = np.partition(total, -SHOWN)[-SHOWN] if len(total) > SHOWN else 0.0
        rows = np.flatnonzero((total >= most) & (total > 0))
        fused = tracker.map
        rows = rows[np.lexsort([*fused.index_of(rows).T[::-1], -total[rows]])][:SHOWN]
        first_frame, op = (fused.column(name, rows) for name in ("first_frame", "op"))
        centers = (fused.index_of(rows) + 0.5) * fused.voxel_size
        dominant, sbd = fused.evidence_of(rows).argmax(axis=1), mean_drift(total[rows], op)
        moves = np.concatenate([np.zeros(0, dtype=MOVE), *self.moves])
        frames, ends = self._views.column(0), [0, *self._views.column(VIEW).astype(np.int64).tolist()]
        for i, row in enumerate(rows):
            own = moves[moves["row"] == row]
            first = int(own["before"][0]) if len(own) else int(dominant[i])
            files = [self._names[ends[k] : ends[k + 1]] for k in np.searchsorted(frames, own["frame"]).tolist()]
            yield Suspect(
                i + 1, centers[i], int(first_frame[i]), first, int(op[i]), float(sbd[i]), float(total[row]), own,
                tuple(file.decode("utf-8", "surrogatepass") for file in files),
            )  # fmt: skip

    def log(
        self,
        stream: rr.RecordingStream,
        scene: str,
        backbone: str,
        suspects: list[Suspect],
        classes: LabelSpace,
        translation: npt.NDArray[np.floating[Any]],
        clock: Clock,
    ) -> None:
        """A lane with each suspect's dominant class, a line of text for each flip, and where the suspects are."""
        frames, stamps = self._views.column(0), self._views.column(1)

        def log_state(lane: str, frame: int, name: str) -> None:
            clock.set(stream, frame, _known(stamps[np.searchsorted(frames, frame)]))
            stream.log(lane, rr.StateChange(state=name))

        for suspect in suspects:
            lane = path(scene, "flips", backbone, f"voxel_{suspect.number}")
            names = list(classes.classes)
            colors = [(*color, 255) for color in classes.colors]
            stream.log(lane, rr.StateConfiguration(values=names, labels=names, colors=colors), static=True)
            log_state(lane, suspect.first_frame, classes.classes[suspect.first_class])
            for flip in suspect.moves[suspect.moves["before"] != suspect.moves["after"]]:
                log_state(lane, int(flip["frame"]), classes.classes[flip["after"]])
        report = rr.TextDocument(self._report(backbone, suspects, classes), media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "flips_report", backbone), report, static=True)
        if suspects:
            at = np.array([suspect.center - translation for suspect in suspects])
            labels = [f"{suspect.number}" for suspect in suspects]
            marks = [COLORS[k % len(COLORS)] for k in range(len(suspects))]
            radii = rr.Radius.ui_points([5.0] * len(suspects))
            points = rr.Points3D(at, labels=labels, colors=marks, radii=radii, show_labels=True)
            stream.log(path(scene, "flips_at", backbone), points, static=True)
            self._log_numbers(stream, path(scene, "camera", backbone, "flips"), suspects, clock)

    def _log_numbers(self, stream: rr.RecordingStream, entity: str, suspects: list[Suspect], clock: Clock) -> None:
        """Where the suspects are in each frame; in the view of an image 3D points would stand beside it as well."""
        centers = np.array([suspect.center for suspect in suspects])
        for view in self._views:
            pixels, inside = Camera.of(view[:VIEW]).project(centers)
            seen = np.flatnonzero(inside)
            clock.set(stream, int(view[0]), _known(view[1]))
            numbers = rr.Points2D(
                pixels[seen],
                labels=[f"{suspects[k].number}" for k in seen],
                colors=[COLORS[k % len(COLORS)] for k in seen],
                radii=rr.Radius.ui_points([4.0] * len(seen)),
                show_labels=True,
            )
            stream.log(entity, numbers)

    def _report(self, backbone: str, suspects: list[Suspect], classes: LabelSpace) -> str:
        """Markdown: for each suspect the frames that are to blame."""
        lines = [f"**{backbone}**: the voxels with the largest drift, and the frames that moved them"]
        lines += [""] if suspects else ["", "No voxel drifted."]
        for s in suspects:
            x, y, z = s.center
            lines.append(
                f"- **voxel {s.number}** at ({x:.2f}, {y:.2f}, {z:.2f}) m: OP {s.op}, drift {s.bits:.3f} bits in all,"
                f" SBD {s.sbd:.4f} bits; {classes.classes[s.first_class]} in frame {s.first_frame}"
            )
            for move, file in zip(s.moves, s.files, strict=True):
                where = f"frame {move['frame']}{f' ({file})' if file else ''}"
                before, after = (classes.classes[move[when]] for when in ("before", "after"))
                what = f"**{before} → {after}**" if before != after else f"stays {before}"
                lines.append(f"    - {where}: {what}, {move['bits']:.4f} bits")
        return "\n".join(lines) + "\n"

    def _drop(self, total_drift: Float64) -> None:
        """Keep half as many: the moves of the voxels that drifted most."""
        moves = np.concatenate(self.moves)
        order = np.argsort(-total_drift[moves["row"]], kind="stable")[: self._most // 2]
        self.moves = [moves[np.sort(order)]]
        self._count = len(order)


def _known(stamp: float) -> float | None:
    return None if math.isnan(stamp) else float(stamp)


def to_arrays(suspects: Sequence[Suspect]) -> dict[str, npt.NDArray[Any]]:
    """What `of_arrays` makes them of again."""
    said = [(s.first_frame, s.first_class, s.op, s.sbd, s.bits, len(s.moves)) for s in suspects]
    return {
        "said": np.array(said, np.float64).reshape(-1, 6),
        "center": np.array([s.center for s in suspects], np.float64).reshape(-1, 3),
        "moves": np.concatenate([np.zeros(0, MOVE), *(s.moves for s in suspects)]),
        "files": np.frombuffer(json.dumps([s.files for s in suspects]).encode(), np.uint8),
    }


def of_arrays(arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[Suspect]:
    """In their order."""
    moves = np.split(arrays["moves"], np.cumsum(arrays["said"][:, 5]).astype(np.int64))
    files = json.loads(arrays["files"].tobytes())
    for i, (first_frame, first_class, op, sbd, bits, _) in enumerate(arrays["said"].tolist()):
        center, numbers = arrays["center"][i], (int(first_frame), int(first_class), int(op))
        yield Suspect(i + 1, center, *numbers, sbd, bits, moves[i], tuple(files[i]))


def worst_of(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Those of several parts of a map that drifted most, numbered anew, as the whole map would have them."""
    worst = sorted(suspects, key=lambda suspect: (-suspect.bits, *suspect.center.tolist()))[:SHOWN]
    return [replace(suspect, number=k) for k, suspect in enumerate(worst, start=1)]
