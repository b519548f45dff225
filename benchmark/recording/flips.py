"""Flip forensics: which frames changed the dominant class of the voxels that drifted most."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.frames import Frame
from semstab.labels import LabelSpace
from semstab.metrics import sbd
from semstab.recording.entities import Clock, path
from semstab.recording.tracker import Tracker

SHOWN = 10
"""Voxels that are shown of a backbone on a scene."""

MAX_FLIPS = 2_000_000
"""Flips that are kept of a backbone on a scene; past them, those of the voxels that drifted least are dropped."""

FLIP = np.dtype([("row", np.int32), ("frame", np.int32), ("before", np.uint16), ("after", np.uint16), ("bits", "f4")])

COLORS = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (204, 121, 167), (213, 94, 0), (0, 114, 178),
    (255, 255, 255), (170, 255, 195), (220, 190, 255),
)  # fmt: skip


@dataclass(frozen=True)
class Suspect:
    """A voxel that drifted much.

    number  from 1, the one that drifted most first
    center  (3,) metres, world
    bits    its drift, summed over all frames
    flips   records of `FLIP`, in the order of the frames
    """

    number: int
    center: npt.NDArray[np.float64]
    first_frame: int
    first_class: int
    op: int
    sbd: float
    bits: float
    flips: npt.NDArray[np.void]


class FlipLog:
    """Keeps each change of a voxel's dominant class, and from which file the frame's labels came."""

    def __init__(self) -> None:
        self._parts: list[npt.NDArray[np.void]] = []
        self._count = 0
        self._frames: dict[int, tuple[float | None, str]] = {}  # timestamp, label file

    def update(self, tracker: Tracker, frame: Frame) -> None:
        """Keep the flips of the frame that the tracker followed last."""
        changes = tracker.map.changes
        at = np.flatnonzero(changes.before != changes.after)
        flips = np.zeros(len(at), dtype=FLIP)
        flips["row"], flips["frame"], flips["bits"] = changes.row[at], frame.index, changes.drift[at]
        flips["before"], flips["after"] = changes.before[at], changes.after[at]
        self._parts.append(flips)
        self._count += len(at)
        name = frame.files.get("labels") or frame.files.get("scores") or ""
        self._frames[frame.index] = frame.timestamp, PurePath(name).name
        if self._count > MAX_FLIPS:
            self._drop(tracker.total_drift)

    def suspects(self, tracker: Tracker) -> Iterator[Suspect]:
        """The voxels that drifted most, and what flipped them."""
        total = tracker.total_drift
        rows = np.argsort(-total, kind="stable")[:SHOWN]
        flips = np.concatenate([np.zeros(0, dtype=FLIP), *self._parts])
        for number, row in enumerate(rows[total[rows] > 0], start=1):
            table = tracker.map.table_of(np.array([row]))
            own = flips[flips["row"] == row]
            first = int(own["before"][0]) if len(own) else int(table.evidence[0].argmax())
            yield Suspect(
                number, table.centers[0], int(table.first_frame[0]), first, int(table.op[0]), float(sbd(table)[0]),
                float(total[row]), own,
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
        for suspect in suspects:
            lane = path(scene, "flips", backbone, f"voxel {suspect.number}")
            names = list(classes.classes)
            colors = [(*color, 255) for color in classes.colors]
            stream.log(lane, rr.StateConfiguration(values=names, labels=names, colors=colors), static=True)
            self._log_state(stream, lane, suspect.first_frame, classes.classes[suspect.first_class], clock)
            for flip in suspect.flips:
                self._log_state(stream, lane, int(flip["frame"]), classes.classes[flip["after"]], clock)
        report = rr.TextDocument(self._report(backbone, suspects, classes), media_type=rr.MediaType.MARKDOWN)
        stream.log(path(scene, "flips_report", backbone), report, static=True)
        if suspects:
            at = np.array([suspect.center - translation for suspect in suspects])
            labels = [f"{suspect.number}" for suspect in suspects]
            marks = [COLORS[k % len(COLORS)] for k in range(len(suspects))]
            radii = rr.Radius.ui_points([5.0] * len(suspects))
            points = rr.Points3D(at, labels=labels, colors=marks, radii=radii, show_labels=True)
            stream.log(path(scene, "flips_at", backbone), points, static=True)

    def _log_state(self, stream: rr.RecordingStream, lane: str, frame: int, name: str, clock: Clock) -> None:
        clock.set(stream, frame, self._frames.get(frame, (None, ""))[0])
        stream.log(lane, rr.StateChange(state=name))

    def _report(self, backbone: str, suspects: list[Suspect], classes: LabelSpace) -> str:
        """Markdown: for each suspect the frames that are to blame."""
        lines = [f"**{backbone}**: the voxels with the largest drift, and the frames that changed their dominant class"]
        lines += [""] if suspects else ["", "No voxel drifted."]
        for s in suspects:
            x, y, z = s.center
            lines.append(
                f"- **voxel {s.number}** at ({x:.2f}, {y:.2f}, {z:.2f}) m: OP {s.op}, drift {s.bits:.3f} bits in all,"
                f" SBD {s.sbd:.4f} bits; {classes.classes[s.first_class]} in frame {s.first_frame}"
            )
            for flip in s.flips:
                file = self._frames.get(int(flip["frame"]), (None, ""))[1]
                lines.append(
                    f"    - frame {flip['frame']}{f' ({file})' if file else ''}: {classes.classes[flip['before']]} →"
                    f" {classes.classes[flip['after']]}, {flip['bits']:.4f} bits"
                )
        return "\n".join(lines) + "\n"

    def _drop(self, total_drift: npt.NDArray[np.float32]) -> None:
        """Keep half as many: the flips of the voxels that drifted most."""
        flips = np.concatenate(self._parts)
        order = np.argsort(-total_drift[flips["row"]], kind="stable")[: MAX_FLIPS // 2]
        self._parts = [flips[np.sort(order)]]
        self._count = len(order)
