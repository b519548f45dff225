"""Focal length and principal point under which depth reprojects best, where the flight tells them."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Reading
from semstab.check.geometry import LEAST_PAIRS
from semstab.check.reprojection import Sample, View
from semstab.check.trials import clearly_falls, fitted, middle
from semstab.check.verdict import GOOD, MIN_GAIN, SIMPLER, Verdict
from semstab.core.types import Float64
from semstab.data.frames import Intrinsics

FACTORS = (0.5, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.25, 1.4, 2.0)
"""Focal lengths that are tried, relative to the configured one; then nearer ones around the best."""

SHIFTS = (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1)
"""Shifts of the principal point that are tried, in widths of the image."""

FINE = (-1.0, -0.5, 0.0, 0.5, 1.0)
FACTOR_NEAR, SHIFT_NEAR = 0.12, 0.04
"""Nearer ones: so far from the best at most, the focal length as a share of it, ..."""

SPREADS = (1 / 3, 1 / 9)
"""... and in each further round over so much of that."""

SCALES = np.power(10.0, np.arange(-10, 11) / 100)
"""Factors on depth, 0.8 to 1.26, that are no other intrinsics."""

LEAST_FACTOR, LEAST_SHIFT = 0.02, 0.01
"""A smaller change of the focal length, or of the principal point in widths of the image, is not named."""

REFUSED = 0.5
"""Data is unsound where the error falls to this part of it; else the finding is a remark."""


@dataclass(frozen=True)
class CameraChange:
    """A change of the intrinsics: a factor on the focal lengths, and a shift of the principal point in widths."""

    factor: float = 1.0
    right: float = 0.0
    down: float = 0.0

    def applied_to(self, view: View) -> View:
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

    camera: CameraChange
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
    fit = find_camera(sample)
    if fit is None or (verdict.mend and SIMPLER * fit.error > verdict.fits[1][1].error):
        return verdict
    if fit.error > REFUSED * fit.present and verdict.state != "unsound":
        return verdict.remarking(fit.text())
    return verdict.refuted(f"{fit.text()}; correct the intrinsics")


def _is_a_guess(verdict: Verdict, how: Reading) -> bool:
    """Return whether a verdict proposes nothing but a scale that was measured, or another size of an image."""
    name, _, value = verdict.mend[0].removeprefix("dataset.options.").partition(": ")
    if len(verdict.mend) > 1 or name not in ("depth_scale", "intrinsics_size"):
        return False
    return name == "intrinsics_size" or bool(re.fullmatch(r"[\d.e+-]+", value) and not how.is_usual(float(value)))


def find_camera(sample: Sample) -> CameraFit | None:
    """Return the intrinsics under which depth reprojects clearly better than as configured, or None without them.

    Focal length and principal point are fitted in turn.
    """
    errors = functools.cache(
        lambda camera: sample.with_views(
            {position: camera.applied_to(v) for position, v in sample.views.items()}
        ).by_pair()
    )
    if len(sample.pairs) < LEAST_PAIRS or not middle(present := errors(CameraChange())) > MIN_GAIN:
        return None
    best = _simplest(fitted(CameraChange(), _moves(), errors), errors)
    error = middle(errors(best))
    if best == CameraChange() or error > GOOD or not clearly_falls(errors(best), present):
        return None
    if min(middle(_scaled(sample, factor)) for factor in SCALES.tolist()) <= SIMPLER * error:
        return None  # a depth that is a little too long or too short explains it as well
    first = next(iter(sample.views.values()))
    return CameraFit(best, best.applied_to(first).camera, first.camera, error, middle(present))


def _moves() -> Iterator[Callable[[CameraChange], list[CameraChange]]]:
    """Yield which focal lengths, then shifts of the principal point, are tried next to the best camera so far."""
    fields = (("factor", FACTORS), ("right", SHIFTS), ("down", SHIFTS))
    for name, values in fields:
        yield functools.partial(_others, name, values, 0.0)
    for spread in SPREADS:
        for name, _ in fields:
            yield functools.partial(_others, name, FINE, spread)


def _others(name: str, values: Sequence[float], spread: float, best: CameraChange) -> list[CameraChange]:
    """Return cameras with these values of a field; with a spread, `values` are steps from the best camera's value."""
    now = getattr(best, name)
    reach = spread * (FACTOR_NEAR * now if name == "factor" else SHIFT_NEAR)
    return [dataclasses.replace(best, **{name: now + reach * value if spread else value}) for value in values]


def _simplest(best: CameraChange, errors: Callable[[CameraChange], Float64]) -> CameraChange:
    """Return the camera without the changes that hardly matter."""
    for name, least in (("factor", LEAST_FACTOR), ("right", LEAST_SHIFT), ("down", LEAST_SHIFT)):
        neutral = getattr(CameraChange(), name)
        without = dataclasses.replace(best, **{name: neutral})
        small = abs(getattr(best, name) - neutral) < least
        if small or middle(errors(without)) <= SIMPLER * middle(errors(best)):
            best = without
    return best


def _scaled(sample: Sample, factor: float) -> Float64:
    """Return (pairs,) median relative error of depth times `factor`."""
    longer = {
        position: dataclasses.replace(v, depth=v.depth * np.float32(factor)) for position, v in sample.views.items()
    }
    return sample.with_views(longer).by_pair()
