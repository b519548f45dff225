"""The offset in time between poses and frames: shifts of the poses under which depth reprojects best."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Reading
from semstab.check.geometry import LEAST_PAIRS
from semstab.check.reprojection import Pair, Sample
from semstab.check.trials import clearly_falls, falls, fitted, middle
from semstab.check.verdict import GOOD, MIN_GAIN, SIMPLER, Verdict
from semstab.core.types import Float64
from semstab.datasets import Scene
from semstab.datasets.geometry.cameras import at_times
from semstab.errors import DataError

REACH = 2
"""Frames by which poses may be late or early."""

MOVES: tuple[Callable[[float], Iterable[float]], ...] = (
    lambda best: map(float, range(-REACH, REACH + 1)),
    lambda best: (best + part / 10 for part in range(-9, 10) if abs(best + part / 10) <= REACH),
)
"""Shifts that are tried, frames: whole ones, then tenths around the best."""

HALF, STRIKING = 0.5, 0.25
"""A shift that not all pairs of frames show is a remark if the error falls to the share HALF, and a fault if the error
falls to the share STRIKING."""

DIFFER, LEAST_MOVING = 0.3, 8
"""Change of an error, as a logarithm, from which on a pair tells two shifts apart, and the least such pairs."""

WHOLE = 0.75
"""Shift in frames from which it is a fault of the files, and the scene is unsound; a smaller shift is a remark."""


@dataclass(frozen=True)
class Lateness:
    """The shift under which depth reprojects best.

    Attributes:
        frames: Frames by which the poses are late; negative for early poses.
        seconds: Seconds by which the poses are late, or None if poses are not looked up by time stamps.
        error: Median relative depth error with the shift.
        present: Median relative depth error without the shift.
        sure: Whether enough pairs of frames show the shift; else it is a remark.
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
        """Return name and value of the setting that mends it, or None without such a setting."""
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
        return verdict.remarking(late.text(how))
    setting = late.setting(how)
    return verdict.refuted(late.text(how), () if setting is None else (f"{setting[0]}: {setting[1]}",))


def find_lateness(scene: Scene, sample: Sample, *, stamped: bool) -> Lateness | None:
    """Return the offset between poses and frames that explains the error of depth, or None without one.

    Between the poses of two frames the position is linear and the rotation spherically linear.

    Args:
        scene: The scene of the sample, whose poses are read; no image is.
        sample: Frames that are compared.
        stamped: Whether poses are looked up by time, so that any shift can be mended.
    """
    pairs, errors = _moved(scene, sample)
    if len(pairs) < LEAST_PAIRS or not (before := middle(present := errors(0.0))) > MIN_GAIN:
        return None
    best = fitted(0.0, MOVES, errors)
    if not stamped and middle(errors(float(round(best)))) <= SIMPLER * middle(errors(best)):
        best = float(round(best))
    error, moving = middle(errors(best)), falls(errors(best), present, DIFFER)
    won = moving.wins and moving.count >= LEAST_MOVING
    sure = clearly_falls(errors(best), present) or (won and error <= STRIKING * before)
    if abs(best) < 0.1 or not (sure or (won and error <= HALF * before)) or error > GOOD:
        return None
    return Lateness(round(best, 1), round(best, 1) * _period(scene) if stamped else None, error, before, sure)


def _period(scene: Scene) -> float:
    times = scene.timestamps
    return float(np.median(np.diff(times))) if times is not None and len(times) > 1 else math.nan


def _moved(scene: Scene, sample: Sample) -> tuple[list[Pair], Callable[[float], Float64]]:
    """Return the pairs of frames with poses within reach, and a function from a delay in frames to their errors."""
    poses_by_index, views = dict(_poses_around(scene, sample)), sample.views
    reach = {
        position
        for position, v in views.items()
        if all(v.index + k in poses_by_index for k in range(-REACH, REACH + 1))
    }
    pairs = [pair for pair in sample.pairs if {*pair} <= reach]
    used = {position: views[position] for pair in pairs for position in pair}
    indices, poses = np.array([*poses_by_index], dtype=np.float64), np.array([*poses_by_index.values()])

    @functools.cache
    def errors(shift: float) -> Float64:
        times = np.array([view.index + shift for view in used.values()])
        interpolated = at_times(indices, poses, times, 1.0, "interpolate")
        moved = {
            position: dataclasses.replace(view, T_wc=T)
            for (position, view), T in zip(used.items(), interpolated, strict=True)
        }
        return Sample(moved, pairs, sample.configured).by_pair()

    return pairs, errors


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
