"""Search for a wrong ratio of fy to fx, and for an offset of the camera from its poses: both hide in depth noise.

How deep a point lies in another frame changes with the calibration, and with the place of the camera on the tracked
body. All parameters are fitted at once, by least squares over the points of all pairs of frames. A parameter counts if
a fit of this parameter alone gives the same value, so that it stands for nothing else.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from semstab.check.intrinsics import REFUSED
from semstab.check.reprojection import Pair, Sample, View
from semstab.check.verdict import Verdict
from semstab.core.types import Float64
from semstab.data.frames import Intrinsics

FX, FY, ARM, ALL = 0, 1, slice(5, 8), 11
"""The calibration: the logarithms of fx and fy, cx and cy in pixels, the logarithm of depth, metres to the right, down
and forward, and radians about the camera's axes."""

ROUNDS = 4
"""Number of times that the points are matched."""

SAME = 0.03
"""The relative error of depth up to which a point is taken for the same surface in the other frame."""

STEEPEST = 0.05
"""Change of the logarithm of depth from a pixel to the next one, beyond which lies an edge."""

LEAST_POINTS = 1000
"""Points that are matched, of all pairs."""

HUBER = 1.5
"""Standard deviations from which on a point counts less."""

CERTAIN = 6.0
"""Standard errors by which a part is off beyond doubt: pairs share frames, and noise is not all that there is."""

ALIKE = 0.5
"""Share of itself by which a parameter may differ between a fit of it alone and a fit of all parameters."""

LEAST_ASPECT = 0.03
"""The least difference of the changes of fx and fy that is named."""

LEAST_ARM, ARM_OF_DEPTH = 0.02, 0.005
"""The least lever arm that is named: metres, and as a share of the median depth."""


@dataclass(frozen=True, eq=False)
class MountingChange:
    """A change of the calibration (11,) that mends it, and its covariance (11, 11); 0 in what was not fitted."""

    values: Float64
    covariance: Float64

    def applied_to(self, view: View) -> View:
        """Return a view with the changed calibration, whose camera stands elsewhere on what was tracked."""
        from scipy.spatial.transform import Rotation

        fx, fy, cx, cy, scale = self.values[:5].tolist()
        K, mount = view.camera, np.eye(4)
        mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec(self.values[8:]).as_matrix(), self.values[ARM]
        camera = Intrinsics(K.fx * math.exp(fx), K.fy * math.exp(fy), K.cx + cx, K.cy + cy)
        depth = view.depth * np.float32(math.exp(scale))
        return dataclasses.replace(view, camera=camera, T_wc=view.T_wc @ mount, depth=depth)

    def certainty(self, row: Float64) -> float:
        """Return how many standard errors parts of the change are from 0, of rows (k, 11) that combine them."""
        with np.errstate(all="ignore"):
            value, spread = row @ self.values, row @ self.covariance @ row.T
            return math.sqrt(max(0.0, float(value @ np.linalg.pinv(spread) @ value)))


def with_mounting(verdict: Verdict, sample: Sample) -> Verdict:
    """Return the verdict with a note on a wrong ratio of fy to fx, or a forgotten lever arm, if beyond doubt."""
    if verdict.mend or verdict.state == "unclear":
        return verdict
    full_change = fitted_change(sample, np.eye(ALL))
    if full_change is None:
        return verdict
    findings = [finding for look in (_aspect, _arm) if (finding := look(sample, full_change)) is not None]
    if not findings:
        return verdict
    error, text = min((mended.fit().error, text) for text, mended in findings)
    return verdict.refuted(text) if error <= REFUSED * sample.fit().error else verdict.remarking(text)


def _aspect(sample: Sample, full_change: MountingChange) -> tuple[str, Sample] | None:
    """Return what is said of fx and fy where they do not belong together, and the sample with the one that does."""
    fx, fy = float(full_change.values[FX]), float(full_change.values[FY])
    difference = np.zeros((1, ALL))
    difference[0, [FX, FY]] = -1, 1
    if abs(fy - fx) < LEAST_ASPECT or full_change.certainty(difference) < CERTAIN:
        return None
    axis, other = (FY, FX) if abs(fy) >= abs(fx) else (FX, FY)
    alone = fitted_change(sample, np.eye(ALL)[[axis]])
    log_ratio = float(full_change.values[axis] - full_change.values[other])
    if alone is None or abs(float(alone.values[axis]) - log_ratio) > ALIKE * abs(log_ratio):
        return None
    names, K = ("fx", "fy"), next(iter(sample.views.values())).camera
    share, now = abs(math.expm1(-log_ratio)), (K.fx, K.fy)
    return (
        f"{names[axis]} is {share:.0%} too {'small' if log_ratio > 0 else 'large'} beside {names[other]}: depth fits"
        f" best under {names[axis]} = {now[axis] * math.exp(log_ratio):.4g} where {names[other]} ="
        f" {now[other]:.4g}; correct it, or scale each by its own side of the image"
    ), _changed(sample, alone)


def _arm(sample: Sample, full_change: MountingChange) -> tuple[str, Sample] | None:
    """Return what is said of a lever arm from the tracked body to the camera, and the sample with it."""
    rows = np.eye(ALL)[ARM]
    if full_change.certainty(rows) < CERTAIN:
        return None
    alone = fitted_change(sample, rows)
    if alone is None or alone.certainty(rows) < CERTAIN:
        return None
    arm = alone.values[ARM]
    length = float(np.linalg.norm(arm))
    deep = float(np.median([np.median(v.depth[v.v, v.u]) for v in sample.views.values() if len(v.u)]))
    if length < max(LEAST_ARM, ARM_OF_DEPTH * deep) or np.linalg.norm(full_change.values[ARM] - arm) > ALIKE * length:
        return None
    right, down, forward = arm.tolist()
    return (
        f"the camera stands {length:.2g} m from where the poses have it, in its own axes {right:+.3f} m to the right,"
        f" {down:+.3f} down, {forward:+.3f} forward: the poses are of another body, whose extrinsic to the camera is"
        f" forgotten or off; multiply T_wc from the right by the translation ({right:.3f}, {down:.3f}, {forward:.3f})"
    ), _changed(sample, alone)


def fitted_change(sample: Sample, free: Float64) -> MountingChange | None:
    """Return the change of the calibration in directions (k, 11) under which depth fits best; None of few points."""
    change, now = MountingChange(np.zeros(ALL), np.zeros((ALL, ALL))), sample
    for _ in range(ROUNDS):
        slopes = {position: _slopes(view) for position, view in now.views.items()}
        pairs = [_linear(now, pair, *slopes[pair[1]]) for pair in now.pairs]
        if sum(len(error) for error, _ in pairs) < LEAST_POINTS:
            return None
        step, covariance = _least_squares([(error, J @ free.T) for error, J in pairs])
        change = MountingChange(change.values + step @ free, free.T @ covariance @ free)
        if not (np.isfinite(change.values).all() and np.abs(change.values[[FX, FY, 4]]).max() < 1):
            return None
        now = _changed(sample, change)
    return change


def _changed(sample: Sample, change: MountingChange) -> Sample:
    return sample.with_views({position: change.applied_to(view) for position, view in sample.views.items()})


def _least_squares(pairs: list[tuple[Float64, Float64]]) -> tuple[Float64, Float64]:
    """Return the step (k,) that takes the errors (n,) of pairs away, by Jacobians (n, k), and its covariance (k, k).

    Errors of one pair are not independent of each other.
    """
    error, J = np.concatenate([e for e, _ in pairs]), np.concatenate([jacobian for _, jacobian in pairs])
    spread = max(1.4826 * float(np.median(np.abs(error))), 1e-9)
    weight = 1 / np.maximum(1, np.abs(error) / (HUBER * spread))
    inverse = np.linalg.pinv((J * weight[:, None]).T @ J, rcond=1e-12)
    step = -inverse @ ((J * weight[:, None]).T @ error)
    pull = J * (weight * (error + J @ step))[:, None]
    ends = np.cumsum([len(e) for e, _ in pairs])[:-1]
    sums = np.stack([part.sum(axis=0) for part in np.split(pull, ends)])
    return step, inverse @ (sums.T @ sums) @ inverse


def _slopes(view: View) -> tuple[Float64, Float64]:
    """Return how the logarithm of depth (H, W) changes from a pixel to the next, along u and v; NaN at edges."""
    with np.errstate(all="ignore"):
        log = np.log(np.where((view.depth > 0) & (view.depth < np.inf), view.depth, np.nan).astype(np.float64))
    along_u, along_v = np.full(log.shape, np.nan), np.full(log.shape, np.nan)
    along_u[:, 1:-1], along_v[1:-1] = (log[:, 2:] - log[:, :-2]) / 2, (log[2:] - log[:-2]) / 2
    return along_u, along_v


def _linear(sample: Sample, pair: Pair, along_u: Float64, along_v: Float64) -> tuple[Float64, Float64]:
    """Return errors (n,) of points that both frames of a pair see, and how they change (n, 11) with the calibration.

    An error is the logarithm of the depth that is met, at the very place of the point, over that of the point.
    """
    a, b = (sample.views[position] for position in pair)
    met = sample.matched(pair, sample.configured, np.array([1.0]))
    valid = met.error[0] <= SAME
    column, row = np.where(valid, met.u[0], 0), np.where(valid, met.v[0], 0)
    with np.errstate(invalid="ignore"):
        valid &= (np.abs(along_u[row, column]) < STEEPEST) & (np.abs(along_v[row, column]) < STEEPEST)
    column, row = column[valid], row[valid]
    to_u, to_v = along_u[row, column], along_v[row, column]
    camera_a, camera_b = a.camera.every(a.stride), b.camera.every(b.stride)
    depth = a.depth[a.v, a.u][valid].astype(np.float64)
    first = np.stack(
        [(a.u[valid] - camera_a.cx) / camera_a.fx * depth, (a.v[valid] - camera_a.cy) / camera_a.fy * depth, depth]
    )
    motion = np.linalg.inv(b.T_wc) @ a.T_wc
    R = motion[:3, :3]
    x, y, z = second = R @ first + motion[:3, 3:]
    off = to_u * (camera_b.fx * x / z + camera_b.cx - column) + to_v * (camera_b.fy * y / z + camera_b.cy - row)
    error = np.log(b.depth[row, column].astype(np.float64)) + off - np.log(z)

    def moved(by: Float64) -> Float64:
        """Return how the error changes where points (3, n) of the second camera move."""
        du, dv = camera_b.fx * (by[0] - x * by[2] / z) / z, camera_b.fy * (by[1] - y * by[2] / z) / z
        change: Float64 = to_u * du + to_v * dv - by[2] / z
        return change

    ones, zero = np.ones_like(depth), np.zeros_like(depth)
    axes = np.eye(3)
    columns = [
        moved(R @ np.stack([-first[0], zero, zero])) + to_u * camera_b.fx * x / z,
        moved(R @ np.stack([zero, -first[1], zero])) + to_v * camera_b.fy * y / z,
        moved(R @ np.stack([-depth / camera_a.fx, zero, zero])) / a.stride + to_u / b.stride,
        moved(R @ np.stack([zero, -depth / camera_a.fy, zero])) / a.stride + to_v / b.stride,
        moved(R @ first) + 1,
        *(moved(np.outer((R - axes)[:, k], ones)) for k in range(3)),
        *(moved(R @ np.cross(axes[k], first.T).T - np.cross(axes[k], second.T).T) for k in range(3)),
    ]
    return error, np.stack(columns, axis=1)
