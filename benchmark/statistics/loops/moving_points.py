"""Compiled passes that tell by a LiDAR's points whether views see spots, have them hidden, or see through them.

A view's points are kept as an image of directions: each pixel has the code of its nearest point, 0 without any.
"""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial
from semstab.statistics.loops.moving import HIDDEN, SEEN, SIDES, THROUGH, UNKNOWN, code_of
from semstab.statistics.loops.surface import in_sensor

RIGHT, DOWN, LEFT, UP = 0, 1, 2, 3
"""Sides of a spot to which points lie."""


@serial
def nearest_in_pixels(u, v, w, stride, top, near):
    """Write the code of the nearest of the points, by image coordinates and inverse depth, in pixels of `stride`.

    `top` is the number of the first row.
    """
    near[:] = 0
    rows, columns = near.shape
    for i in range(len(w)):
        row, column = np.int64(np.floor((v[i] + 0.5) / stride)) - top, np.int64(np.floor((u[i] + 0.5) / stride))
        if not w[i] > 0.0 or row < 0 or row >= rows or column < 0:
            continue
        column = column - columns if column >= columns else column
        if column >= columns:
            continue
        code = code_of(1.0 / w[i])
        if near[row, column] == 0 or code < near[row, column]:
            near[row, column] = code


@serial
def place_of(point, i, T, camera, around, stride, top, shape):
    """Return the column and the row in which a view shows a point, not rounded, and its depth; 0 if it is outside.

    `around` is True if columns close a circle, as in a scan, whose depth is the distance.
    """
    fx, fy, cx, cy = camera
    rows, columns = shape
    right, down, z = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
    depth = np.sqrt(right * right + down * down + z * z) if around else z
    if not depth > 1e-9:
        return 0.0, 0.0, 0.0
    if around:
        u, v = (np.arctan2(down, right) + np.pi) * fx, (np.arcsin(z / depth) + 0.5 * np.pi) * fy
    else:
        u, v = right / z * fx + cx, down / z * fy + cy
    x, y = (u + 0.5) / stride - 0.5, (v + 0.5) / stride - 0.5 - top
    if not (-0.5 <= y < rows - 0.5 and (around or -0.5 <= x < columns - 0.5)):
        return 0.0, 0.0, 0.0
    return x, y, depth


@serial
def side_of(dx, dy):
    """Return the side to which an offset in the image goes."""
    if abs(dx) > abs(dy):
        return RIGHT if dx > 0.0 else LEFT
    return DOWN if dy > 0.0 else UP


@serial
def vote_by_points(point, T, camera, around, stride, top, near, reach, clear, limit, span, votes):
    """Write the vote of a view on each point (n, 3), by its own points within `reach` pixels of the place in the image.

    They are at the depth of the point, but for `limit` codes, or nearer, or farther. A view sees through the point if
    it has farther ones to each of the four sides, and all others are `clear` times as far away in the image, at least.
    It sees the point if one is at its depth, or if they are on both sides of it and at most `span` codes apart. It has
    the point hidden if all of them are nearer.
    """
    rows, columns = near.shape
    most, farther = np.int64(np.ceil(reach + 0.5)), np.empty(4)
    for i in range(len(point)):
        votes[i] = UNKNOWN
        x, y, depth = place_of(point, i, T, camera, around, stride, top, near.shape)
        if depth == 0.0:
            continue
        column, row, here = np.int64(np.floor(x + 0.5)), np.int64(np.floor(y + 0.5)), code_of(depth)
        nearest, farthest, same = np.int64(0xFFFF), np.int64(0), False
        farther[:], other = np.inf, np.inf  # squared distances of the closest ones in the image
        for b in range(row - most, row + most + 1):
            for a in range(column - most, column + most + 1):
                if b < 0 or b >= rows or (not around and (a < 0 or a >= columns)):
                    continue
                code, away = np.int64(near[b, a % columns]), (a - x) ** 2 + (b - y) ** 2
                if code == 0 or away > reach * reach:
                    continue
                nearest, farthest = min(nearest, code), max(farthest, code)
                if code > here + limit:
                    side = side_of(a - x, b - y)
                    farther[side] = min(farther[side], away)
                else:
                    same |= code >= here - limit
                    other = min(other, away)
        if farthest == 0:
            continue
        part = np.uint8(4 * (SIDES * (SIDES * row // rows) + SIDES * (column % columns) // columns))
        around_it = farther.max()
        if around_it < np.inf and other > clear * clear * around_it:
            votes[i] = THROUGH + part
        elif same or (nearest <= here <= farthest and farthest - nearest <= span):
            votes[i] = SEEN + part
        elif farthest < here - limit:
            votes[i] = HIDDEN + part
