"""What a stretch of frames sees, found by a job."""

from __future__ import annotations

from semstab.datasets import Scene
from semstab.engine.tiling.sights import seen_by
from semstab.engine.work.finish import written
from semstab.engine.work.jobs import Job, Outcome, Request
from semstab.task import tasks_of


def look(job: Job, scene: Scene, request: Request) -> Outcome:
    """Write what the frames see; raises what `seen_by` raises."""
    assert request.looking is not None
    (task,) = tasks_of(scene, request.config)
    to, config = request.looking, request.config
    seen = seen_by(task, config.voxel_size, config.pixel_stride, to.origin, to.cell, job.threads)
    _, files = written(job, {to.file: seen.save})
    return Outcome(request.identity, files=files)
