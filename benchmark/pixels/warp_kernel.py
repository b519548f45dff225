"""The compiled loop behind `semstab.pixels.warp`: where each pixel of one view lies in another."""

from __future__ import annotations

import math
from typing import Any

from semstab.runtime.compiled import serial


@serial
def _seen_at(d: float, ray_x: float, ray_y: float, motion: Any, camera: Any) -> tuple[float, float, float]:
    """Column, row and depth in the other camera of the point at depth d along a ray; depth 0 where it is not seen."""
    fx, fy, cx, cy = camera
    if not 0.0 < d < math.inf:
        return 0.0, 0.0, 0.0
    x, y = ray_x * d, ray_y * d
    z = motion[2, 0] * x + motion[2, 1] * y + motion[2, 2] * d + motion[2, 3]
    if not z > 0.0:
        return 0.0, 0.0, 0.0
    to_x = motion[0, 0] * x + motion[0, 1] * y + motion[0, 2] * d + motion[0, 3]
    to_y = motion[1, 0] * x + motion[1, 1] * y + motion[1, 2] * d + motion[1, 3]
    return fx * (to_x / z) + cx, fy * (to_y / z) + cy, z


@serial
def look_up(depth: Any, rays: Any, motion: Any, other_depth: Any, camera: Any, tolerance: float, out: Any) -> None:
    """For each pixel of a view the flat index of the other view's pixel that sees the same surface, or -1.

    depth        (H, W) of the view, metres; 0, negative, NaN and inf are invalid
    rays         (u - cx) / fx of each column, then (v - cy) / fy of each row
    motion       (3, 4) from the view's camera axes to the other's
    other_depth  (H', W') of the other view, whose intrinsics are camera = (fx, fy, cx, cy)
    tolerance    of the occlusion test, relative to the distance from the other camera
    out          (H, W) int32, is filled
    """
    ray_x, ray_y = rays
    H, W = other_depth.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            out[v, u] = -1
            column, row, z = _seen_at(float(depth[v, u]), ray_x[u], ray_y[v], motion, camera)
            if not z > 0.0:
                continue
            at_u, at_v = math.floor(column + 0.5), math.floor(row + 0.5)  # integers are pixel centres
            if not (0 <= at_u < W and 0 <= at_v < H):
                continue
            if abs(float(other_depth[at_v, at_u]) - z) <= tolerance * z:
                out[v, u] = at_v * W + at_u


@serial
def blend(
    depth: Any, rays: Any, motion: Any, other_depth: Any, camera: Any, tolerance: float, values: Any, out: Any
) -> None:
    """For each pixel of a view the linear mean of those of the other view's four nearest pixels that see the same
    surface and hold something; arguments as of `look_up`, and

    values  (H', W', K) of the other view's pixels, 0 or more, all 0 where they hold nothing
    out     (H, W, K) zeros, is filled; 0 where there is nothing
    """
    ray_x, ray_y = rays
    H, W, K = values.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            column, row, z = _seen_at(float(depth[v, u]), ray_x[u], ray_y[v], motion, camera)
            if not (z > 0.0 and -0.5 <= column < W - 0.5 and -0.5 <= row < H - 0.5):
                continue
            left, top = math.floor(column), math.floor(row)
            total = 0.0
            for at_v in range(top, top + 2):
                for at_u in range(left, left + 2):
                    share = (1.0 - abs(column - at_u)) * (1.0 - abs(row - at_v))
                    inside = 0 <= at_v < H and 0 <= at_u < W
                    if not inside or share <= 0.0 or not abs(float(other_depth[at_v, at_u]) - z) <= tolerance * z:
                        continue
                    held = 0.0
                    for k in range(K):
                        held += values[at_v, at_u, k]
                        out[v, u, k] += share * values[at_v, at_u, k]
                    total += share * held
            if total > 0.0:
                for k in range(K):
                    out[v, u, k] /= total
