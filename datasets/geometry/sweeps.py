"""The motion of a sensor within a sweep, taken out of the points of a scan by their azimuth ('deskewing')."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from semstab.core.types import Float64

Sweep = Literal["ccw-0", "ccw-90", "ccw-180", "ccw-270", "cw-0", "cw-90", "cw-180", "cw-270"]
"""How a sweep turns, and the azimuth at which it begins: counter-clockwise from x to y, degrees from x."""

SWEEPS: tuple[Sweep, ...] = get_args(Sweep)


def motion_in_sweep(before: Float64 | None, now: Float64, after: Float64 | None) -> Float64:
    """Return (6,) the motion of a sensor in a sweep, in its own axes: a rotation vector in radians, then metres.

    It is that between the scans before and after, per scan; sweeps follow each other without a gap.

    Args:
        before: Pose (4, 4) sensor-to-world of the scan before; None, or NaN, without a pose.
        now: Pose of the scan itself.
        after: Pose of the scan after, as `before`.
    """
    from scipy.spatial.transform import Rotation

    poses = [pose for pose in (before, now, after) if pose is not None and np.isfinite(pose).all()]
    if len(poses) < 2:
        return np.zeros(6)
    step = np.linalg.inv(poses[0]) @ poses[-1]
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    return np.asarray(np.concatenate([turn, step[:3, 3]]) / (len(poses) - 1), np.float64)


def share_of_sweep(points: Float64, sweep: Sweep) -> Float64:
    """Return (N,) when points (N, 3) were measured, -1/2 at the sweep's beginning, 1/2 at its end."""
    turning, _, start = sweep.partition("-")
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - np.radians(float(start))
    share: Float64 = np.mod((azimuth if turning == "ccw" else -azimuth) / (2 * np.pi), 1.0) - 0.5
    return share


def carried(points: Float64, motion: Float64, share: Float64) -> Float64:
    """Return points (N, 3) of a moving sensor in the axes of its sweep's middle, by the share (N,) of its motion."""
    from scipy.spatial.transform import Rotation

    turned: Float64 = Rotation.from_rotvec(share[:, None] * motion[:3]).apply(points)
    return turned + share[:, None] * motion[3:]


def deskewed(points: Float64, motion: Float64, sweep: Sweep) -> Float64:
    """Return points (N, 3) as a sensor at rest, at the pose of the sweep's middle, would have seen them."""
    return carried(points, motion, share_of_sweep(points, sweep))
