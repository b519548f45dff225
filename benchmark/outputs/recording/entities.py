"""Where things are in a recording: entity paths, and the clock of its timelines."""

from __future__ import annotations

import rerun as rr

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
