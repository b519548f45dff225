"""Poses of a body instead of its camera: one fixed motion between them, with which depth agrees far better."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from semstab.check.geometry import GOOD, LEAST_PAIRS, MIN_GAIN, SIMPLER, Verdict
from semstab.check.intrinsics import SCALES, scaled_errors
from semstab.check.reprojection import Sample
from semstab.check.timing import clearly_lower, median_by_pair, middle
from semstab.core.types import Float64

ROUNDS = 8
STEP = 0.015
"""Gauss-Newton: its rounds, and the step of the derivative, a share of the median depth, or radians: over a pixel."""

OUTLIER = 0.1
"""Residuals of depth, relative, that are occlusions and do not count."""

LEAST_SHARE, LEAST_DEGREES = 0.003, 0.3
"""A mounting nearer to the camera than this share of the depth, and turned by less, is none."""

MOST_SHARE, MOST_DEGREES = 0.5, 15.0

DAMPING = 1e-6
"""What is added to the diagonal, relative to its mean: a motion that frames do not tell stays 0."""

REFUSED = 0.5
"""Data is unsound where the error falls to this part of it; else the finding is a remark."""


@dataclass(frozen=True)
class Mounting:
    """The camera in the axes of what the poses are of.

    Attributes:
        T: (4, 4) from the camera to the body, camera axes, metres.
        error: Median relative depth error with it; present without it.
    """

    T: Float64
    error: float
    present: float

    def text(self) -> str:
        """Return the finding, with the motion that mends it."""
        x, y, z = self.T[:3, 3]
        turn = self._degrees()
        turned = f" and is turned by {turn:.1f} degrees" if turn >= LEAST_DEGREES else ""
        rows = ", ".join(f"[{', '.join(f'{number:.4g}' for number in row)}]" for row in self.T[:3] + 0.0)
        return (
            "poses look as if they were of a body, not of the camera: depth reprojects with"
            f" {self.present:.2%} error, with {self.error:.2%} where the camera lies {x:.3f} m to the right, {y:.3f} m"
            f" down and {z:.3f} m ahead of them{turned}; multiply each pose from the right by that extrinsic, [{rows}]"
        )

    def _degrees(self) -> float:
        return math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(self.T[:3, :3])) - 1) / 2))))

    def is_one(self, depth: float) -> bool:
        """Return whether it is large enough to matter at that median depth, metres, and no wrong convention."""
        share, degrees = float(np.linalg.norm(self.T[:3, 3])) / depth, self._degrees()
        return (share >= LEAST_SHARE or degrees >= LEAST_DEGREES) and share <= MOST_SHARE and degrees <= MOST_DEGREES


def mounting_of(sample: Sample) -> Mounting | None:
    """Return the fixed motion between poses and camera that explains the error of depth; None where none does.

    All points of all pairs of frames are fitted at once by Gauss-Newton: the logarithm of the depth there over the
    distance from there, by six numbers, with weights of the absolute error.
    """
    if len(sample.pairs) < LEAST_PAIRS:
        return None
    present = median_by_pair(sample)
    if not MIN_GAIN < middle(present) <= OUTLIER:
        return None
    depth = float(np.median(np.concatenate([view.depth[view.v, view.u] for view in sample.views.values()])))
    numbers: Float64 = np.zeros(6)
    for _ in range(ROUNDS):
        numbers = numbers + _step(sample, numbers, depth)
        if not np.isfinite(numbers).all() or np.abs(numbers).max() > 1:
            return None
    errors = median_by_pair(_mounted(sample, numbers, depth))
    found = Mounting(_motion(numbers, depth), middle(errors), middle(present))
    if min(middle(scaled_errors(sample, factor)) for factor in SCALES.tolist()) <= SIMPLER * found.error:
        return None  # a depth that is a little too long or too short explains it as well
    return found if found.is_one(depth) and found.error <= GOOD and clearly_lower(errors, present) else None


def with_mounting(verdict: Verdict, sample: Sample, other: Verdict, error: float) -> Verdict:
    """Return the verdict with the mounting of the camera, or another one whose error is `error`, that fits as well."""
    if verdict.mend or (found := mounting_of(sample)) is None or SIMPLER * found.error > error:
        return other
    if found.error > REFUSED * found.present and verdict.state != "unsound":
        return dataclasses.replace(verdict, remarks=(*verdict.remarks, found.text()))
    return dataclasses.replace(verdict, state="unsound", text=found.text(), mend=(), undetermined=(), reason="")


def _motion(numbers: Float64, depth: float) -> Float64:
    """Return (4, 4) of a translation, in median depths, and a rotation vector."""
    from scipy.spatial.transform import Rotation

    T: Float64 = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(numbers[3:]).as_matrix()
    T[:3, 3] = depth * numbers[:3]
    return T


def _mounted(sample: Sample, numbers: Float64, depth: float) -> Sample:
    motion = _motion(numbers, depth)
    views = {at: dataclasses.replace(view, T_wc=view.T_wc @ motion) for at, view in sample.views.items()}
    return Sample(views, sample.pairs, sample.configured)


def _residuals(sample: Sample, numbers: Float64, depth: float) -> Float64:
    """Return (points,) logarithms of the depth there over the distance from there; NaN where a point is not seen."""
    mounted, one = _mounted(sample, numbers, depth), np.array([1.0])
    matches = [mounted.matched(pair, mounted.configured, one) for pair in mounted.pairs]
    with np.errstate(all="ignore"):
        logs = np.concatenate([
            np.where(np.isfinite(match.error[0]), np.log(match.depth[0] / match.z[0]), np.nan) for match in matches
        ])  # fmt: skip
    return np.where(np.abs(logs) < OUTLIER, logs, np.nan)


def _step(sample: Sample, numbers: Float64, depth: float) -> Float64:
    """Return the step of Gauss-Newton, with weights of the absolute error (iterated least squares)."""
    now = _residuals(sample, numbers, depth)
    there = [_residuals(sample, numbers + side * STEP * np.eye(6)[k], depth) for k in range(6) for side in (1, -1)]
    slopes = np.stack([(plus - minus) / (2 * STEP) for plus, minus in zip(there[::2], there[1::2], strict=True)])
    told = np.isfinite(now) & np.isfinite(slopes).all(axis=0) & (np.abs(slopes) < 1 / OUTLIER).all(axis=0)
    J, r = slopes[:, told], now[told]
    if r.size < 100 * len(J):
        return np.full(6, np.nan)
    weights = 1 / np.maximum(np.abs(r), max(1e-5, 0.5 * float(np.median(np.abs(r)))))
    A = (J * weights) @ J.T
    A += DAMPING * np.trace(A) / 6 * np.eye(6)
    return np.asarray(-np.linalg.solve(A, (J * weights) @ r))
