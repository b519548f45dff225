"""Comparison of the error of depth between frames with the error to expect from the camera's noise, by distance."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from semstab.check.coverage import by_distance, plane_residuals, said
from semstab.check.geometry import LEAST_PAIRS
from semstab.check.reprojection import Pair, Sample, View
from semstab.check.verdict import GOOD, Verdict

MEASURED = 1e-4
"""Noise of one frame, relative, from which on its depth is measured; below, it is rendered or of a surface."""

SENSOR, SURFACE = 0.005, 0.0015
"""Errors that depth of either kind has at least, from the place of a pixel and from what a sensor always gets wrong."""

BESIDE = 0.1
"""Footprints of a pixel by which the depth of the nearest pixel differs from the point's own: a point lies up to half a
pixel beside its middle, and most surfaces slant little."""

IMPRECISE = 3.0
"""Depth is imprecise from this ratio of its error to the error to expect."""

GROWS = 10.0
"""Poses drift from this ratio of the error of distant frames to the error of the nearest frames, without a good fit."""


def with_precision(verdict: Verdict, sample: Sample) -> Verdict:
    """Return the verdict; one that is sound becomes imprecise where depth agrees far worse than its noise explains."""
    if verdict.state != "sound" or not math.isfinite(verdict.error):
        return verdict
    text = _drift(sample) or _coarse(verdict, sample)
    return verdict if text is None else dataclasses.replace(verdict, state="imprecise", text=text)


def _coarse(verdict: Verdict, sample: Sample) -> str | None:
    expected, kind = expected_error(sample)
    if verdict.error <= IMPRECISE * expected:
        return None
    return (
        f"depth reprojects with {verdict.error:.2%} median error, {verdict.share:.0%} co-visible; {kind} has about"
        f" {expected:.2%}: poses, intrinsics or the scale of depth are imprecise"
    )


def expected_error(sample: Sample) -> tuple[float, str]:
    """Return the relative error that depth has with exact poses, and the kind of depth, in words."""
    noises = [noise for view in sample.views.values() if math.isfinite(noise := _noise(view))]
    noise = float(np.median(noises)) if noises else 0.0
    if not noises:  # no pixel has neighbours with depth, as where LiDAR points are projected
        least, kind = SENSOR, "depth as sparse as this"
    else:
        least, kind = (SENSOR, "depth as noisy as this") if noise >= MEASURED else (SURFACE, "depth as smooth as this")
    focal = float(np.median([view.camera.fx / view.stride for view in sample.views.values()]))
    return max(least, math.sqrt(2) * noise, BESIDE / focal), kind


def _noise(view: View) -> float:
    residuals = plane_residuals(view)
    return float(np.median(residuals) / np.median(view.depth[view.v, view.u])) if len(residuals) else math.nan


def _drift(sample: Sample) -> str | None:
    """Return the line on poses that fit nearby frames and not distant ones."""
    near: tuple[tuple[int, int], float] | None = None
    for (low, high), pairs in by_distance(sample.pairs):
        error = _error(sample, pairs)
        if near is not None and error > max(GOOD, GROWS * near[1]):
            return (
                f"poses drift: depth reprojects with {near[1]:.2%} error in frames {said(near[0])} apart, but with"
                f" {error:.1%} in those {low} to {high} apart"
            )
        if near is None and math.isfinite(error):
            near = (low, high), error
    return None


def _error(sample: Sample, pairs: list[Pair]) -> float:
    """Return the median error over pairs, or NaN if the frames see too little of each other."""
    if len(pairs) < LEAST_PAIRS:
        return math.nan
    fit = dataclasses.replace(sample, pairs=pairs).fit()
    return fit.error if fit.has_evidence else math.nan
