"""What the run folder tells of units that are finished: their series, their voxels, their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import rerun as rr

from semstab.model.records import voxels_of
from semstab.model.results import UnitSummary
from semstab.recording import series
from semstab.recording.entities import Clock
from semstab.recording.group import GroupLog
from semstab.recording.scenes import Scenes
from semstab.recording.voxel_maps import thinned_map
from semstab.task import Task


def log_finished(
    stream: rr.RecordingStream,
    task: Task,
    summaries: Sequence[UnitSummary],
    run: Path,
    scenes: Scenes,
    clock: Clock,
    *,
    track: bool,
) -> None:
    """Log units of a backbone on a scene; track: also where the camera was, of a map in tiles."""
    at = task.scene.T_wc(task.indices[0])[:3, 3]  # where the first frame was taken, as in a whole run
    group = GroupLog(task, summaries[0].table.voxel_size, scenes.origin(stream, task, at))
    _follow(stream, task, scenes, clock, log=track and voxels_of(run, summaries[0].unit).is_dir())
    for summary in summaries:
        unit = summary.unit
        factor, table = thinned_map(voxels_of(run, unit), group.origin)
        for values in series.send_rows(stream, unit, task, run / "frames" / f"{unit.slug}.csv", clock):
            group.span(values)
        clock.set(stream, task.indices[-1])
        group.log_map(stream, unit, table, scenes.plan.config.tolerance, factor)
        group.log_numbers(stream, summary)
    scenes.lay_out(stream, group, table)


def _follow(stream: rr.RecordingStream, task: Task, scenes: Scenes, clock: Clock, *, log: bool) -> None:
    """Know where the camera was in frames that are not logged here, and log the track where nobody else does."""
    times, camera = task.scene.timestamps, scenes.cameras[task.scene.name]
    for index in camera.follow(task.indices):
        if log:
            clock.set(stream, index, None if times is None else float(times[index]))
            camera.log_track(stream)
