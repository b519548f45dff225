"""Flicker of label sources that hold regions without classes, as Segment Anything's proposals do; none is fused."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from semstab.datasets import Scene
from semstab.engine.work.jobs import Job, Outcome, Request
from semstab.errors import DataError
from semstab.metrics import macro_mean, matched_region_flicker
from semstab.model.frames import Frame
from semstab.model.records import RegionFlicker, UnitContent
from semstab.pixels.exclusion import leave_out
from semstab.pixels.perturbation import perturb
from semstab.pixels.warp import correspond
from semstab.runtime.prefetch import prefetch
from semstab.task import frame_indices


def measure_regions(job: Job, scene: Scene, request: Request) -> Outcome:
    """The outcome of a unit of regions: the means over its pairs of sampled frames."""
    frames = _frames(job, scene, request)
    rows = [_compared(previous, current) for previous, current in itertools.pairwise(frames)]
    flicker, compensated, share = zip(*rows, strict=True) if rows else ((), (), ())
    found = RegionFlicker(job.scene, job.backbone, macro_mean(flicker), macro_mean(compensated), macro_mean(share))
    digest = scene.digest(frame_indices(scene, request.config, [job.backbone]), job.backbone)
    return Outcome(request.identity, UnitContent(digest, regions=found))


def _frames(job: Job, scene: Scene, request: Request) -> Iterator[Frame]:
    """The sampled frames with the regions' own ids."""
    config = request.config

    def decode(index: int) -> Frame:
        frame = scene.frame(index, job.backbone, color=False)
        if frame.labels is None:
            raise DataError(f"{frame.where('scores')}: regions are label maps of ids, not scores")
        frame = leave_out(frame, masks=config.exclude.masks)
        if config.perturbation is not None:
            frame = perturb(frame, config.perturbation, job.scene)
        return frame.every(config.pixel_stride)

    indices = frame_indices(scene, config, [job.backbone])
    with contextlib.closing(prefetch(decode, indices, threads=job.threads, size=lambda frame: frame.nbytes)) as fetched:
        for each in fetched:
            yield each.item


def _compared(previous: Frame, current: Frame) -> tuple[float, float, float]:
    """Flicker, compensated flicker (percent), and the co-visible share of two successive frames."""
    before, now = _labels(previous), _labels(current)
    flicker = math.nan
    if previous.shape == current.shape:
        flicker = matched_region_flicker(before, now, previous.valid & current.valid).flicker_percent
    seen = correspond(current, previous)
    both = current.valid & seen.bring(previous.valid, fill=False)
    compensated = matched_region_flicker(seen.bring(before), now, both).flicker_percent
    valid = np.count_nonzero(current.valid)
    return flicker, compensated, np.count_nonzero(both) / valid if valid else math.nan


def _labels(frame: Frame) -> Any:
    assert frame.labels is not None
    return frame.labels
