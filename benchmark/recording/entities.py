"""Where things are in a recording: entity paths, and the clock of its timelines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.core.types import Float64
from semstab.model.labels import Color, LabelSpace

FIRST_DATE, LAST_DATE = 1e8, 9e9
"""Seconds; timestamps from the first on count from 1970 and are shown as dates, smaller ones as durations. Beyond the
last one they are no seconds, and more nanoseconds than 64 bits hold: frames are shown by their number alone."""


def path(*parts: str) -> str:
    """An entity's path; what a part may not hold is escaped."""
    return "/" + rr.new_entity_path(list(parts))


class Clock:
    """Sets a stream's time: the frame's number, and its timestamp where there is one."""

    def __init__(self) -> None:
        self._dated: bool | None = None  # a timeline has one type: the first timestamp decides

    def set(self, stream: rr.RecordingStream, frame: int, timestamp: float | None = None) -> None:
        """What is logged from now on belongs to that frame."""
        stream.reset_time()
        stream.set_time("frame", sequence=frame)
        if timestamp is None or not abs(timestamp) <= LAST_DATE:
            return
        if self._dated is None:
            self._dated = timestamp >= FIRST_DATE
        if self._dated:
            stream.set_time("time", timestamp=timestamp)
        else:
            stream.set_time("time", duration=timestamp)

    def columns(self, frames: list[int], timestamps: list[float | None]) -> list[rr.TimeColumn]:
        """The times of a whole series; without timestamps where one is missing."""
        columns = [rr.TimeColumn("frame", sequence=frames)]
        known = [stamp for stamp in timestamps if stamp is not None and abs(stamp) <= LAST_DATE]
        if not known or len(known) < len(frames):
            return columns
        if self._dated is None:
            self._dated = known[0] >= FIRST_DATE
        stamps = rr.TimeColumn("time", timestamp=known) if self._dated else rr.TimeColumn("time", duration=known)
        return [*columns, stamps]


# The classes of a scene's maps and their colours, laid out like words on lines.

WIDTH, LINE = 780.0, 24.0
"""Of the legend and of one of its lines, in points of a window of 1500."""

LETTER, DOT, GAP = 7.0, 20.0, 34.0
"""Width of a letter, of a dot, and of what is around a name and between it and the next."""

LABEL = -13.5
"""The viewer draws a label below its point: from the middle of the label to its point."""

LINES = 2
"""Of the legend that is always seen; what it leaves out is in a tab."""

Entry = tuple[str, Color]


class Legend:
    """Names and colours of a scene's classes: those of its maps, and in a tab all that a frame may show."""

    def __init__(self, spaces: Iterable[LabelSpace]) -> None:
        self._voxels: dict[Entry, int] = {
            entry: 0 for space in spaces for entry in zip(space.classes, space.colors, strict=True)
        }

    def see(self, classes: LabelSpace, label: npt.NDArray[np.integer]) -> None:
        """A finished map has voxels of these dominant classes."""
        voxels = np.bincount(label, minlength=len(classes)).tolist()
        for entry, n in zip(zip(classes.classes, classes.colors, strict=True), voxels, strict=True):
            self._voxels[entry] += n

    @property
    def entries(self) -> list[Entry]:
        """All, those with the most voxels first."""
        return sorted(self._voxels, key=lambda entry: -self._voxels[entry])

    @property
    def used(self) -> list[Entry]:
        """Those that the maps show; all, while no map is finished."""
        return [entry for entry in self.entries if self._voxels[entry]] or self.entries

    @property
    def shown(self) -> int:
        """How many of these the legend that is always seen has room for."""
        names = [name for name, _ in self.used]
        if _lines(names) <= LINES:
            return len(names)
        return max((n for n in range(len(names)) if _lines([*names[:n], _rest(len(names) - n)]) <= LINES), default=0)

    @property
    def is_whole(self) -> bool:
        """Whether it has all classes."""
        return self.shown == len(self.entries)

    def size(self, *, whole: bool) -> tuple[float, float]:
        """Width and height of the legend that is always seen, or of that of all classes."""
        lines = _lines([name for name, _ in (self.entries if whole else self.used)])
        return WIDTH, LINE * (lines if whole else min(lines, LINES))

    def log(self, stream: rr.RecordingStream, entity: str, all_classes: str) -> None:
        """Both legends, each below an entity of its own."""
        used, shown = self.used, self.shown
        _log(stream, all_classes, self.entries)
        _log(stream, entity, used[:shown], _rest(len(used) - shown) if shown < len(used) else "")


def _rest(classes: int) -> str:
    return f"and {classes} more: tab All classes"


def _log(stream: rr.RecordingStream, entity: str, entries: Sequence[Entry], rest: str = "") -> None:
    """Dots in the classes' colours, and their names in white: a label has its point's colour, which may be dark."""
    names = [*(name for name, _ in entries), *([rest] if rest else [])]
    at = _places(names)
    middle = DOT + LETTER / 2 * np.array([len(name) for name in names])
    beside = at + np.stack([middle, np.full(len(at), LABEL)], axis=1)
    dots = rr.Points2D(at[: len(entries)], colors=[color for _, color in entries], radii=rr.Radius.ui_points(5.0))
    words = rr.Points2D(beside, colors=(255, 255, 255), labels=names, radii=0.0, show_labels=True)
    stream.log(entity, dots, static=True)
    stream.log(f"{entity}/names", words, static=True)


def _lines(names: Sequence[str]) -> int:
    return round(float(_places(names)[:, 1].max()) / LINE + 0.5)


def _places(names: Sequence[str]) -> Float64:
    """(n, 2) where the dots are; a name is right of its dot."""
    left, line = 0.0, 0
    at = []
    for name in names:
        width = DOT + LETTER * len(name) + GAP
        if left + width > WIDTH and left > 0:
            left, line = 0.0, line + 1
        at.append((left + DOT / 2, (line + 0.5) * LINE))
        left += width
    return np.array(at)
