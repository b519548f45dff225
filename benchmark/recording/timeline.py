"""Record time series; with entity paths, the clock of the timelines, and the background thread."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rerun as rr

from semstab.core.background import Background
from semstab.core.palette import model_color
from semstab.data.results import UnitName
from semstab.engine.series import COLUMNS, FrameColumn, read_cells
from semstab.engine.units import Plan
from semstab.errors import DataError, summarize_error
from semstab.task import Task

FIRST_DATE, LAST_DATE = 1e8, 9e9
"""Seconds: timestamps from the first on count from 1970 and are shown as dates, smaller ones as durations. Beyond the
last one, 64 bits do not hold their nanoseconds: frames are then shown by their number alone."""


def path(*parts: str) -> str:
    """Return the path of an entity, with its parts escaped."""
    return "/" + rr.new_entity_path(list(parts)).lstrip("/")


class Clock:
    """The time of a stream: the frame's number, and its timestamp if it has one."""

    def __init__(self) -> None:
        self._dated: bool | None = None  # a timeline has one type: the first timestamp decides

    def set(self, stream: rr.RecordingStream, frame: int, timestamp: float | None = None) -> None:
        """Set the time of all later logs to that frame."""
        stream.reset_time()
        stream.set_time("frame", sequence=frame)
        if timestamp is not None and self.shows(timestamp):
            if self._dated:
                stream.set_time("time", timestamp=timestamp)
            else:
                stream.set_time("time", duration=timestamp)

    def shows(self, timestamp: float | None) -> bool:
        """Return whether a frame has its timestamp on a timeline, too."""
        if timestamp is None or not abs(timestamp) <= LAST_DATE:
            return False
        if self._dated is None:
            self._dated = timestamp >= FIRST_DATE
        return True

    def columns(self, frames: Sequence[int], timestamps: Sequence[float | None]) -> list[rr.TimeColumn]:
        """Return the times of several frames, all of which have a timestamp that is shown, or none."""
        times = [rr.TimeColumn("frame", sequence=frames)]
        if self.shows(timestamps[0]):
            stamps = [stamp for stamp in timestamps if stamp is not None]  # a list: rerun rounds an array otherwise
            times.append(
                rr.TimeColumn("time", timestamp=stamps) if self._dated else rr.TimeColumn("time", duration=stamps)
            )
        return times


MOST_PENDING = 4
"""The most jobs that may wait; they hold their frames in memory."""


class FrameJobs:
    """A thread that runs jobs one after the other, each at the time of its frame."""

    def __init__(self, stream: rr.RecordingStream, clock: Clock) -> None:
        self._stream = stream
        self._clock = clock
        self._jobs = Background("semstab-recording", MOST_PENDING)

    def begin(self, job: Callable[[], None]) -> None:
        """Submit the first job, which logs what holds at all times."""
        self._jobs.submit(job)

    def submit(self, frame: int, timestamp: float | None, job: Callable[[], None]) -> None:
        """Submit a job, and wait while too many are pending; an error of an earlier job is raised here."""

        def at_its_time() -> None:
            self._clock.set(self._stream, frame, timestamp)  # a stream has a time for each thread
            job()

        self._jobs.submit(at_its_time)

    def drain(self) -> None:
        """Wait until all jobs are done; an error of a job is raised here."""
        self._jobs.drain()

    def close(self) -> None:
        """Finish the pending jobs, and end the thread."""
        self._jobs.close()


# Time series are columns of RUN/frames/*.csv, and one that follows from two of them.

UPDATED = FrameColumn("updated_voxels", "Updated voxels")
"""voxels - new_voxels."""

SERIES = {column.key: column for column in (*COLUMNS, UPDATED) if column.plot}
"""The time series by name."""

OF_VIDEOS = {name: column for name, column in SERIES.items() if column.plot and column.of_model}
OF_VIDEOS |= {"lone_percent": FrameColumn("lone_percent", "Alone (%)", of_model=True)}
"""The time series of videos, which have no map; how often a frame stands alone follows from all frames."""


def entity(name: str, unit: UnitName) -> str:
    """Return the entity of a series."""
    backend = () if name in OF_VIDEOS else (unit.backend,)
    return path(unit.scene, "series", name, unit.model, *backend)


def columns(unit: UnitName, task: Task) -> list[str]:
    """Return the names of the unit's series."""
    if not task.scene.posed:
        return [*OF_VIDEOS]
    return [name for name in SERIES if name not in OF_VIDEOS or unit.backend == task.backends[0]]


SECONDS = 0.3
"""Rows of time series that come within that time are sent together: a call for each number would take longer."""


class SeriesLog:
    """Rows of time series, which are sent as columns.

    Args:
        stream: Where to.
        clock: Its clock.
    """

    def __init__(self, stream: rr.RecordingStream, clock: Clock) -> None:
        self._stream, self._clock, self._sent = stream, clock, time.monotonic()
        self._values: defaultdict[tuple[str, bool], list[tuple[int, float | None, float]]] = defaultdict(list)

    def add(self, unit: UnitName, task: Task, frame: int, timestamp: float | None, cells: Mapping[str, Any]) -> None:
        """Take the defined values of a row of the CSV; send them with those before if it is time."""
        row, dated = {**cells}, self._clock.shows(timestamp)
        if task.scene.posed:
            row["updated_voxels"] = float(cells["voxels"]) - float(cells["new_voxels"])
        for name in columns(unit, task):
            if row.get(name) not in (None, ""):
                self._values[entity(name, unit), dated].append((frame, timestamp, float(row[name])))
        if time.monotonic() - self._sent >= SECONDS:
            self.send()

    def send(self) -> None:
        """Send the rows that wait."""
        for (name, _), rows in self._values.items():
            frames, timestamps, values = zip(*rows, strict=True)
            self._stream.send_columns(name, self._clock.columns(frames, timestamps), rr.Scalars.columns(scalars=values))
        self._values.clear()
        self._sent = time.monotonic()


def read_rows(file: Path) -> list[tuple[int, float | None, dict[str, str]]]:
    """Return frame, timestamp and cells of each row of a time series.

    Raises:
        DataError: If it is damaged.
    """
    cells = read_cells(file)
    try:
        return [(int(row["frame"]), float(row["timestamp"]) if row["timestamp"] else None, row) for row in cells]
    except (LookupError, TypeError, ValueError) as error:
        raise _damaged(file, error) from error


def log_file(
    stream: rr.RecordingStream, unit: UnitName, task: Task, file: Path, clock: Clock, only: Sequence[str] = ()
) -> None:
    """Log a unit's time series from its CSV, all of them or `only` some.

    Raises:
        DataError: If it is damaged.
    """
    series = SeriesLog(stream, clock)
    try:
        for frame, timestamp, cells in read_rows(file):
            series.add(unit, task, frame, timestamp, {name: cells[name] for name in only} if only else cells)
        series.send()
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise _damaged(file, error) from error


def _damaged(file: Path, error: Exception) -> DataError:
    return DataError(f"{file}: not a time series of a run ({summarize_error(error)}); delete the run folder's units/")


def log_styles(stream: rr.RecordingStream, plan: Plan) -> None:
    """Log names, colours and widths of all lines."""
    models = list(dict.fromkeys(task.model for task in plan.tasks))
    for task in plan.tasks:
        for unit in task.units:
            color = model_color(models.index(unit.model))
            # The lines of backends that agree coincide; the viewer draws them by name, so each line is thinner.
            width = 2.0 + 2.5 * sum(backend > unit.backend for backend in task.backends)
            for name in columns(unit, task):
                label = unit.model if name in OF_VIDEOS else f"{unit.model}, {unit.backend}"
                line = rr.SeriesLines(colors=color, names=label, widths=width)
                stream.log(entity(name, unit), line, static=True)
