"""The compiled loop behind `semstab.pixels.warp`: the position of each pixel of one view in another."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from semstab.core.compiled import compiled, helper, parallel, serial


@helper
def _seen_at(d: float, ray_x: float, ray_y: float, motion: Any, camera: Any) -> tuple[float, float, float]:
    """Return the column, row and depth in the other camera of the point at depth d along a ray.

    The depth is 0 if the other camera does not see the point.
    """
    (fx, fy, cx, cy), (to_x, to_y, to_z) = camera, motion
    x, y = ray_x * d, ray_y * d
    z = to_z[0] * x + to_z[1] * y + to_z[2] * d + to_z[3]
    column = fx * ((to_x[0] * x + to_x[1] * y + to_x[2] * d + to_x[3]) / z) + cx
    row = fy * ((to_y[0] * x + to_y[1] * y + to_y[2] * d + to_y[3]) / z) + cy
    return column, row, z if (d > 0.0) & (d < math.inf) & (z > 0.0) else 0.0


@helper
def _look_up_row(
    depth: Any, ray_x: Any, ray_y: float, motion: Any, camera: Any, shape: Any, index: Any, z: Any
) -> None:
    """Find the flat index of the other view's pixel in which each point of a row falls, or -1, and its depth there.

    There is no branch, so that it runs on vectors.
    """
    H, W = float(shape[0]), float(shape[1])
    for u in range(len(depth)):
        column, row, z[u] = _seen_at(float(depth[u]), ray_x[u], ray_y, motion, camera)
        at_u, at_v = np.floor(column + 0.5), np.floor(row + 0.5)  # integers are pixel centres
        inside = (z[u] > 0.0) & (at_u >= 0.0) & (at_u < W) & (at_v >= 0.0) & (at_v < H)
        index[u] = np.int32(at_v * W + at_u if inside else -1.0)


@serial
def look_up(depth: Any, rays: Any, motion: Any, other_depth: Any, camera: Any, tolerance: float, out: Any) -> None:
    """Find for each pixel of a view the flat index of the other view's pixel that sees the same surface, or -1.

    Args:
        depth: (H, W) of the view, metres; 0, negative, NaN and inf are invalid.
        rays: (u - cx) / fx of each column, then (v - cy) / fy of each row.
        motion: Three rows of four numbers, from the view's camera axes to the other's.
        other_depth: (H', W') of the other view.
        camera: (fx, fy, cx, cy), the intrinsics of the other view.
        tolerance: Tolerance of the occlusion test, relative to the distance from the other camera.
        out: (H, W) int32, is filled.
    """
    other_flat, z = other_depth.reshape(-1), np.empty(depth.shape[1])
    for v in range(depth.shape[0]):
        row_index = out[v]
        _look_up_row(depth[v], rays[0], rays[1][v], motion, camera, other_depth.shape, row_index, z)
        for u in range(len(row_index)):
            row_index[u] = (
                row_index[u]
                if (row_index[u] >= 0) & (abs(float(other_flat[max(row_index[u], 0)]) - z[u]) <= tolerance * z[u])
                else -1
            )


@serial
def blend(
    depth: Any, rays: Any, motion: Any, other_depth: Any, camera: Any, tolerance: float, values: Any, out: Any
) -> None:
    """Blend the other view's four nearest pixels that see the same surface and hold something, by linear weights.

    See `look_up` for the other arguments.

    - `values`: (H', W', K) of the other view's pixels, 0 or more, all 0 for pixels that hold nothing
    - `out`: (H, W, K) zeros, is filled; stays 0 for pixels that see nothing
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


# The compiled loop that finds the largest scores of each pixel.

CHUNKS = 256


@compiled(fastmath={"reassoc", "contract"})
def _total(scores, start, K, shift, unit):
    """Return the sum of K scores by their bits.

    Moved up by `shift` they are those of a double, the score in that unit.
    """
    total = 0.0
    for c in range(K):
        total += np.int64(np.int64(scores[start + c]) << shift).view(np.float64)
    return total * unit


@parallel
def cut(scores, k, retained, shift, unit, infinite, shares):
    """Copy the k largest scores of each pixel into `retained` (n, K), which is 0; scores (n * K,) by their bits.

    Bits of numbers from 0 on sort like the numbers, and NaN is above all: it is retained, and the pixel stays unusable.

    - `shift`, `unit`: see `_total`; infinite: the bits of infinity
    - `shares`: (CHUNKS, 3), 0: pixels with a prediction, the sum of the shares of their scores that are left out, and
      the largest one
    """
    n, K = retained.shape
    for chunk in nb.prange(CHUNKS):
        largest = np.empty(k, dtype=np.int64)  # of the largest so far, in descending order
        for i in range(n * chunk // CHUNKS, n * (chunk + 1) // CHUNKS):
            count = 0
            for c in range(K):
                value = scores[i * K + c]
                if count == k and value <= scores[i * K + largest[k - 1]]:
                    continue
                slot = min(count, k - 1)
                while slot > 0 and scores[i * K + largest[slot - 1]] < value:
                    largest[slot] = largest[slot - 1]
                    slot -= 1
                largest[slot] = c
                count = min(count + 1, k)
            for j in range(count):
                retained[i, largest[j]] = scores[i * K + largest[j]]
            if 0 < scores[i * K + largest[0]] < infinite:
                retained_total = 0.0
                for j in range(count):
                    retained_total += _total(scores, i * K + largest[j], 1, shift, unit)
                share = max(0.0, 1.0 - retained_total / _total(scores, i * K, K, shift, unit))
                shares[chunk, 0] += 1.0
                shares[chunk, 1] += share
                shares[chunk, 2] = max(shares[chunk, 2], share)


# Compiled loops behind video consistency: the time for which each pixel has had its label.


@serial
def lengthen(labels: Any, before: Any, valid: Any, most: int, length: Any) -> None:
    """Count the frames, `most` at most, for which each pixel has counted and had its label; all arrays are (n,)."""
    for i in range(len(length)):
        unchanged = np.int32(length[i]) if labels[i] == before[i] else np.int32(0)
        length[i] = min(unchanged + np.int32(1), np.int32(most)) if valid[i] else np.int32(0)


@serial
def count_long(counted: Any, constant: Any, n: int) -> tuple[int, int]:
    """Return the pixels whose first length is n, and those among them whose second one is too."""
    pixels = constant_long = 0
    for i in range(len(counted)):
        long = counted[i] >= n
        pixels += long
        constant_long += long & (constant[i] >= n)
    return pixels, constant_long
