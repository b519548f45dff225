"""The offset in time between poses and frames: shifts of the poses under which depth reprojects best."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Reading
from semstab.check.geometry import BETTER, GOOD, LEAST_PAIRS, MIN_GAIN, PAIR_POINTS, SIMPLER, WON_PAIRS, Verdict
from semstab.check.reprojection import Sample, median_of_seen
from semstab.core.types import Float64
from semstab.datasets import Scene
from semstab.errors import DataError

REACH = 2
"""Frames by which poses may be late or early."""

COARSE = np.arange(-REACH, REACH + 1) * 1.0
FINE = np.arange(-9, 10) / 10
"""Shifts that are tried, frames: whole ones, then tenths around the best."""

CLEAR = 4.0
"""Standard errors by which the logarithm of the error must fall, in the mean over pairs of frames."""

HALF, STRIKING = 0.5, 0.25
"""A shift that not all pairs of frames show is remarked where the error falls to the first part, and a fault where it
falls to the second one."""

DIFFER, LEAST_MOVING = 0.3, 8
"""Change of an error, as a logarithm, from which on a pair tells two shifts apart, and the least such pairs."""

WHOLE = 0.75
"""A shift of so many frames is a fault of the files, which makes a scene unsound; a smaller one is remarked."""


@dataclass(frozen=True)
class Lateness:
    """The shift under which depth reprojects best.

    Attributes:
        frames: Frames by which the poses are late; negative where they are early.
        seconds: The same in seconds, None where the frames have no time stamps that poses are looked up by.
        error: Median relative depth error under it.
        present: The same without it.
        sure: Whether enough pairs of frames show it; else it is remarked.
    """

    frames: float
    seconds: float | None
    error: float
    present: float
    sure: bool = True

    @property
    def whole(self) -> bool:
        """Return whether the poses are off by about a frame or more."""
        return abs(self.frames) >= WHOLE

    def text(self, how: Reading) -> str:
        """Return the finding with the setting that mends it."""
        side = "late" if self.frames > 0 else "early"
        by = f"{abs(self.frames):.1f} frames"
        if self.seconds is not None:
            by = f"{abs(self.seconds):.3f} s ({by})"
        elif self.frames == round(self.frames):
            by = "one frame" if abs(self.frames) == 1 else f"{abs(self.frames):.0f} frames"
        return (
            f"poses are {by} {side}: depth reprojects with {self.present:.2%} error, with {self.error:.2%} where the"
            f" poses are moved by that; {self._mend(how)}"
        )

    def _mend(self, how: Reading) -> str:
        if (setting := self.setting(how)) is None:
            return "no setting mends a part of a frame here: interpolate the poses at the times of the images"
        name, value = setting
        return f"set {how.change(name, value)}"

    def setting(self, how: Reading) -> tuple[str, str] | None:
        """Return name and value of the setting that mends it; None where there is none."""
        if self.seconds is not None:
            return "time_offset", f"{how.said.get('time_offset', 0.0) + self.seconds:.4g}"
        if self.frames == round(self.frames) and "pose_shift" in how.names:
            return "pose_shift", f"{(how.said.get('pose_shift') or 0) + round(self.frames)}"
        return None


def with_lateness(verdict: Verdict, scene: Scene, sample: Sample, how: Reading) -> Verdict:
    """Return the verdict, with an offset between poses and frames if one explains the error."""
    if verdict.mend or (late := find_lateness(scene, sample, stamped="time_offset" in how.names)) is None:
        return verdict
    if not (late.whole and late.sure):
        return dataclasses.replace(verdict, remarks=(*verdict.remarks, late.text(how)))
    setting = late.setting(how)
    mend = () if setting is None else (f"{setting[0]}: {setting[1]}",)
    return dataclasses.replace(verdict, state="unsound", text=late.text(how), mend=mend, undetermined=(), reason="")


def find_lateness(scene: Scene, sample: Sample, *, stamped: bool) -> Lateness | None:
    """Return the offset between poses and frames that explains the error of depth; None where none does.

    Between the poses of two frames the position is linear and the rotation spherically linear.

    Args:
        scene: The scene of the sample, whose poses are read; no image is.
        sample: Frames that are compared.
        stamped: Whether poses are looked up by time, so that any shift can be mended.
    """
    moved = PoseShift(scene, sample)
    if len(moved.pairs) < LEAST_PAIRS:
        return None
    present = moved.errors(0.0)
    if not middle(present) > MIN_GAIN:
        return None
    tried = {shift: moved.errors(shift) for shift in COARSE.tolist()}
    near = min(tried, key=lambda shift: mean_log(tried[shift]))
    tried |= {near + part: moved.errors(near + part) for part in FINE.tolist() if abs(near + part) <= REACH}
    best = min(tried, key=lambda shift: mean_log(tried[shift]))
    if not stamped and middle(tried[float(round(best))]) <= SIMPLER * middle(tried[best]):
        best = float(round(best))
    error, before = middle(tried[best]), middle(present)
    won = _won(tried[best], present)
    sure = clearly_lower(tried[best], present) or (won and error <= STRIKING * before)
    if abs(best) < 0.1 or not (sure or (won and error <= HALF * before)) or error > GOOD:
        return None
    return Lateness(round(best, 1), round(best, 1) * _period(scene) if stamped else None, error, before, sure)


def _won(errors: Float64, present: Float64) -> bool:
    """Return whether errors (pairs,) are lower than the present ones in most pairs in which they differ at all.

    They do not where the camera stands still.
    """
    told = np.isfinite(errors) & np.isfinite(present)
    told[told] = np.abs(np.log(np.maximum(errors[told], 1e-9) / np.maximum(present[told], 1e-9))) > DIFFER
    return bool(told.sum() >= LEAST_MOVING and np.mean(errors[told] < present[told]) >= WON_PAIRS)


def median_by_pair(sample: Sample) -> Float64:
    """Return (pairs,) median relative error of depth as configured; NaN where few points are seen again."""
    errors = sample.errors(sample.configured, np.array([1.0]))
    return np.array([median_of_seen(e)[0] if np.isfinite(e).sum() >= PAIR_POINTS else math.nan for e in errors])


def clearly_lower(errors: Float64, present: Float64) -> bool:
    """Return whether errors (pairs,) are lower than the present ones: in the mean, by its standard error, in most."""
    told = np.isfinite(errors) & np.isfinite(present)
    if told.sum() < LEAST_PAIRS or middle(errors) > min(BETTER * middle(present), middle(present) - MIN_GAIN):
        return False
    gains = np.log(np.maximum(present[told], 1e-9)) - np.log(np.maximum(errors[told], 1e-9))
    standard_error = gains.std(ddof=1) / math.sqrt(len(gains))
    return bool(gains.mean() > CLEAR * standard_error and np.mean(gains > 0) >= WON_PAIRS)


def mean_log(errors: Float64) -> float:
    """Return the mean logarithm of errors (pairs,) that are known; inf where none is."""
    told = errors[np.isfinite(errors)]
    return float(np.log(np.maximum(told, 1e-9)).mean()) if len(told) else math.inf


def middle(errors: Float64) -> float:
    """Return the median of errors (pairs,) that are known; inf where none is."""
    return float(np.nanmedian(errors)) if np.isfinite(errors).any() else math.inf


def _period(scene: Scene) -> float:
    times = scene.timestamps
    return float(np.median(np.diff(times))) if times is not None and len(times) > 1 else math.nan


class PoseShift:
    """The frames of a sample with the poses of other times.

    Attributes:
        pairs: The pairs of frames that have poses within reach.
    """

    def __init__(self, scene: Scene, sample: Sample) -> None:
        self._sample = sample
        self._poses = dict(_poses_around(scene, sample))
        self.pairs = [(a, b) for a, b in sample.pairs if self._reaches(a) and self._reaches(b)]

    def _reaches(self, position: int) -> bool:
        index = self._sample.views[position].index
        return all(index + k in self._poses for k in range(-REACH, REACH + 1))

    def errors(self, shift: float) -> Float64:
        """Return (pairs,) median relative error of depth with the poses `shift` frames later; NaN where few see."""
        used = {position for pair in self.pairs for position in pair}
        views = {
            position: dataclasses.replace(view, T_wc=self._between(view.index + shift))
            for position, view in self._sample.views.items()
            if position in used
        }
        return median_by_pair(Sample(views, self.pairs, self._sample.configured))

    def _between(self, at: float) -> Float64:
        from scipy.spatial.transform import Rotation, Slerp

        before = math.floor(at + 1e-9)
        part, first = at - before, self._poses[before]
        if part < 1e-6:
            return first
        second, T = self._poses[before + 1], np.eye(4)
        rotations = Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]]))
        T[:3, :3] = Slerp([0, 1], rotations)([part]).as_matrix()[0]
        T[:3, 3] = (1 - part) * first[:3, 3] + part * second[:3, 3]
        return T


def _poses_around(scene: Scene, sample: Sample) -> Iterator[tuple[int, Float64]]:
    """Yield index and pose (4, 4) of the sample's frames and their neighbours, where they are known.

    A scene that reads a whole frame for its pose yields none.
    """
    if type(scene).T_wc is Scene.T_wc:
        return
    indices = {view.index + k for view in sample.views.values() for k in range(-REACH, REACH + 1)}
    for index in sorted(indices):
        if 0 <= index < len(scene) and not scene.missing(index) and scene.tracked(index):
            with contextlib.suppress(DataError):
                yield index, scene.T_wc(index)
