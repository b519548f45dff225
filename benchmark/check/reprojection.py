"""Depth of one view, reprojected into another under a convention: how well it agrees, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.check.conventions import Convention
from semstab.check.views import Float64, Int64, Pair, View


@dataclass(frozen=True, eq=False)
class Sample:
    """The views of a check, which pairs of them are compared, and how their files are read."""

    views: dict[int, View]
    pairs: Sequence[Pair]
    configured: Convention

    def errors(self, convention: Convention, factors: Float64) -> list[Float64]:
        """For each pair, (F, N) relative error of the first view's sample in the second one; inf where not seen."""
        return [self.matched(pair, convention, factors).error for pair in self.pairs]

    def matched(self, pair: Pair, convention: Convention, factors: Float64) -> Matches:
        """Look the sample of the pair's first view up in the second one, for each factor on depth."""
        a, b = self.views[pair[0]], self.views[pair[1]]
        R, t = motion(a.pose(convention, self.configured), b.pose(convention, self.configured))
        K_a, K_b = a.kept_camera(convention), b.kept_camera(convention)
        depth = a.planar(a.u, a.v, convention, self.configured)
        points = np.stack([(a.u - K_a.cx) / K_a.fx * depth, (a.v - K_a.cy) / K_a.fy * depth, depth])
        # depth times f and t as it is, or depth as it is and t over f: the same but for the unit
        x, y, z = (turned + t_i / factors[:, None] for turned, t_i in zip(R @ points, t, strict=True))
        with np.errstate(all="ignore"):
            u, v = np.floor(K_b.fx * (x / z) + K_b.cx + 0.5), np.floor(K_b.fy * (y / z) + K_b.cy + 0.5)
            H, W = b.depth.shape
            inside = (z > 0) & (u >= 0) & (v >= 0) & (u < W) & (v < H)
            u, v = (np.where(inside, at, 0).astype(np.int64) for at in (u, v))
            seen = b.planar(u, v, convention, self.configured)
            error = np.where(inside & (seen > 0) & (seen < np.inf), np.abs(seen / z - 1), np.inf)
        return Matches(u, v, z, seen, inside, error)

    def motions(self, convention: Convention) -> list[tuple[Float64, Float64]]:
        """For each pair, the rotation and translation from the first camera to the second."""
        poses = {at: view.pose(convention, self.configured) for at, view in self.views.items()}
        return [motion(poses[a], poses[b]) for a, b in self.pairs]


@dataclass(frozen=True, eq=False)
class Matches:
    """Where a sample of N points lies in another view, for F factors on depth; all (F, N).

    u, v    the nearest kept pixel there
    z       distance from there along the optical axis, over the factor
    depth   planar depth of that pixel, over the factor
    inside  whether the point lies in that image, before the camera
    error   |depth / z - 1|, inf where the point is not seen: not inside, or no depth there
    """

    u: Int64
    v: Int64
    z: Float64
    depth: Float64
    inside: npt.NDArray[np.bool_]
    error: Float64


def motion(pose: Float64, other: Float64) -> tuple[Float64, Float64]:
    """(3, 3), (3,) from a camera's axes to the other's; exact for large coordinates, which cancel first."""
    back = np.linalg.inv(other[:3, :3])
    return back @ pose[:3, :3], back @ (pose[:3, 3] - other[:3, 3])


def median_of_seen(errors: npt.NDArray[Any]) -> Float64:
    """Median along the last axis of those that are finite (the lower one of two); NaN where there is none."""
    ordered = np.sort(errors, axis=-1)
    seen = np.isfinite(ordered).sum(axis=-1)
    middle = np.take_along_axis(ordered, np.maximum(seen - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    median: Float64 = np.where(seen > 0, middle, np.nan)
    return median
