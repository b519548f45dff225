"""Focal length and principal point under which depth reprojects best, where the flight tells them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Reading
from semstab.check.geometry import GOOD, LEAST_PAIRS, MIN_GAIN, SIMPLER, Verdict
from semstab.check.reprojection import Sample, View
from semstab.check.timing import clearly_lower, mean_log, median_by_pair, middle
from semstab.core.types import Float64
from semstab.data.frames import Intrinsics

FACTORS = (0.5, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.4, 2.0)
"""Focal lengths that are tried, relative to the configured one; then nearer ones around the best."""

SHIFTS = (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1)
"""Shifts of the principal point that are tried, in widths of the image."""

FINE = np.linspace(-1, 1, 5)

SCALES = np.power(10.0, np.arange(-10, 11) / 100)
"""Factors on depth, 0.8 to 1.26, that are no other intrinsics."""

ROUNDS = 3
"""Focal length and principal point are fitted in turn so often, each time over a third of the range."""

LEAST_FACTOR, LEAST_SHIFT = 0.02, 0.01
"""A smaller change of the focal length, or of the principal point in widths of the image, is not named."""

REFUSED = 0.5
"""Data is unsound where the error falls to this part of it; else the finding is a remark."""


@dataclass(frozen=True)
class Camera:
    """A change of the intrinsics: a factor on the focal lengths, and a shift of the principal point in widths."""

    factor: float = 1.0
    right: float = 0.0
    down: float = 0.0

    def of(self, view: View) -> View:
        """Return a view with the changed intrinsics."""
        K, width = view.camera, view.size[0]
        cx, cy = K.cx + self.right * width, K.cy + self.down * width
        changed = Intrinsics(K.fx * self.factor, K.fy * self.factor, cx, cy)
        return dataclasses.replace(view, camera=changed)


@dataclass(frozen=True)
class CameraFit:
    """The intrinsics under which depth reprojects best.

    Attributes:
        camera: The change of the configured ones; K of the first frame after it.
        error: Median relative depth error under it; present without it.
    """

    camera: Camera
    K: Intrinsics
    before: Intrinsics
    error: float
    present: float

    def text(self) -> str:
        """Return the finding, with the intrinsics that mend it."""
        what = []
        if (factor := self.camera.factor) != 1:
            share = abs(1 / factor - 1)
            what.append(f"the focal length is {share:.0%} too {'small' if factor > 1 else 'large'}")
        if moved := [
            f"{side} is {abs(pixels):.0f} pixels too {'small' if pixels > 0 else 'large'}"
            for side, pixels in (("cx", self.K.cx - self.before.cx), ("cy", self.K.cy - self.before.cy))
            if abs(pixels) >= 1
        ]:
            what.append(" and ".join(moved))
        K = self.K
        return (
            f"{', '.join(what)}: depth reprojects with {self.present:.2%} error, with {self.error:.2%} under fx ="
            f" {K.fx:.4g}, fy = {K.fy:.4g}, cx = {K.cx:.4g}, cy = {K.cy:.4g}"
        )


def with_intrinsics(verdict: Verdict, sample: Sample, how: Reading) -> Verdict:
    """Return the verdict, with the intrinsics that explain the error where some do.

    They replace a proposal that is a guess, where they fit clearly better: a depth scale that datasets do not use, or
    another size of the intrinsics' image.
    """
    if verdict.mend and not _is_a_guess(verdict, how):
        return verdict
    fit = fitted(sample)
    if fit is None or (verdict.mend and SIMPLER * fit.error > verdict.fits[1][1].error):
        return verdict
    if fit.error > REFUSED * fit.present and verdict.state != "unsound":
        return dataclasses.replace(verdict, remarks=(*verdict.remarks, fit.text()))
    return dataclasses.replace(
        verdict, state="unsound", text=f"{fit.text()}; correct the intrinsics", mend=(), undetermined=(), reason=""
    )


def _is_a_guess(verdict: Verdict, how: Reading) -> bool:
    """Return whether a verdict proposes nothing but a scale that was measured, or another size of an image."""
    name, _, value = verdict.mend[0].removeprefix("dataset.options.").partition(": ")
    if len(verdict.mend) > 1 or name not in ("depth_scale", "intrinsics_size"):
        return False
    return name == "intrinsics_size" or bool(re.fullmatch(r"[\d.e+-]+", value) and not how.is_usual(float(value)))


def fitted(sample: Sample) -> CameraFit | None:
    """Return the intrinsics under which depth reprojects clearly better than as configured; None where none do.

    Focal length and principal point are fitted in turn to the mean logarithm of the median errors of pairs of frames.
    """
    if len(sample.pairs) < LEAST_PAIRS:
        return None
    present = _errors(sample, Camera())
    if not middle(present) > MIN_GAIN:
        return None
    best = _simplest(sample, _fit(sample))
    errors = _errors(sample, best)
    if best == Camera() or middle(errors) > GOOD or not clearly_lower(errors, present):
        return None
    if min(middle(_scaled(sample, factor)) for factor in SCALES.tolist()) <= SIMPLER * middle(errors):
        return None  # a depth that is a little too long or too short explains it as well
    first = next(iter(sample.views.values()))
    return CameraFit(best, best.of(first).camera, first.camera, middle(errors), middle(present))


def _fit(sample: Sample) -> Camera:
    best, spread = Camera(), 1.0
    for _ in range(ROUNDS):
        for tried in (_focal_lengths, _to_the_right, _down):
            best = min((best, *tried(best, spread)), key=lambda camera: mean_log(_errors(sample, camera)))
        spread /= 3
    return best


def _focal_lengths(best: Camera, spread: float) -> list[Camera]:
    """Return cameras of other focal lengths: in the whole range, or around the best in a part of it."""
    values = FACTORS if spread == 1 else [best.factor * (1 + 0.12 * spread * part) for part in FINE.tolist()]
    return [dataclasses.replace(best, factor=value) for value in values]


def _to_the_right(best: Camera, spread: float) -> list[Camera]:
    return [dataclasses.replace(best, right=value) for value in _shifts(best.right, spread)]


def _down(best: Camera, spread: float) -> list[Camera]:
    return [dataclasses.replace(best, down=value) for value in _shifts(best.down, spread)]


def _shifts(best: float, spread: float) -> Sequence[float]:
    return SHIFTS if spread == 1 else [best + 0.04 * spread * part for part in FINE.tolist()]


def _simplest(sample: Sample, best: Camera) -> Camera:
    """Return the camera without the changes that hardly matter."""
    simpler = best
    for neutral, small in (
        ({"factor": 1.0}, abs(best.factor - 1) < LEAST_FACTOR),
        ({"right": 0.0}, abs(best.right) < LEAST_SHIFT),
        ({"down": 0.0}, abs(best.down) < LEAST_SHIFT),
    ):
        without = Camera(**{**dataclasses.asdict(simpler), **neutral})
        if small or middle(_errors(sample, without)) <= SIMPLER * middle(_errors(sample, simpler)):
            simpler = without
    return simpler


def _scaled(sample: Sample, factor: float) -> Float64:
    """Return (pairs,) median relative error of depth that is so many times as long."""
    views = {
        position: dataclasses.replace(view, depth=view.depth * np.float32(factor))
        for position, view in sample.views.items()
    }
    return median_by_pair(Sample(views, sample.pairs, sample.configured))


def _errors(sample: Sample, camera: Camera) -> Float64:
    """Return (pairs,) median relative error of depth under changed intrinsics; NaN where few points are seen."""
    views = {position: camera.of(view) for position, view in sample.views.items()}
    return median_by_pair(Sample(views, sample.pairs, sample.configured))
