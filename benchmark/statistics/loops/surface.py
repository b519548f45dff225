"""The surface at a pixel of a depth image: its inverse depth, slopes and area, and points in the world.

On a plane, inverse depth is linear in image coordinates. So the depth that a frame shows at a spot, between the centres
of its pixels, follows from a pixel and its slope, however steeply the surface is seen.
"""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial

STEEPEST = 32.0
"""Largest area that a pixel shows, in those that it would show if the surface faced it."""

AROUND, LEAST_AROUND = 2, 6.0
"""Pixels to each side through which a plane is laid where a spot is found, and the least number of them."""


@helper
def depth_at(depth, row, column):
    """Return the depth of a pixel, 0 outside of the image."""
    inside = (row >= 0) & (column >= 0) & (row < depth.shape[0]) & (column < depth.shape[1])
    return np.float64(depth[row, column]) if inside else 0.0


@helper
def depths_around(depth, row, column):
    """Return the depth of a pixel, and of those before and after it in its row and in its column; 0 outside."""
    if 0 < row < depth.shape[0] - 1 and 0 < column < depth.shape[1] - 1:
        in_row = np.float64(depth[row, column - 1]), np.float64(depth[row, column + 1])
        in_column = np.float64(depth[row - 1, column]), np.float64(depth[row + 1, column])
        return np.float64(depth[row, column]), *in_row, *in_column
    in_row = depth_at(depth, row, column - 1), depth_at(depth, row, column + 1)
    in_column = depth_at(depth, row - 1, column), depth_at(depth, row + 1, column)
    return depth_at(depth, row, column), *in_row, *in_column


@helper
def inverse(depth, row, column):
    """Return the inverse depth of a pixel; 0 without valid depth and outside of the image."""
    return inverse_of(depth_at(depth, row, column))


@helper
def inverse_of(depth):
    """Return inverse depth, 0 without valid depth; without branches, as `slope`, for vectors."""
    valid = (depth > 0.0) & (depth < np.inf)
    return (1.0 if valid else 0.0) / (depth if valid else 1.0)


@helper
def slope(before, here, after):
    """Return the slope of inverse depth by the minmod limiter: the smaller of both sides, 0 at an edge or a peak."""
    left, right = here - before, after - here
    smaller = left if abs(left) < abs(right) else right
    smaller = smaller if left * right > 0.0 else 0.0
    only = left if before > 0.0 else right
    only = only if ((before > 0.0) | (after > 0.0)) & (abs(only) < 0.5 * here) else 0.0
    return smaller if (before > 0.0) & (after > 0.0) else only


@helper
def slopes(depth, row, column, here, span=1):
    """Return the slopes of inverse depth along a row and along a column, from pixels `span` pixels away."""
    return (
        slope(inverse(depth, row, column - span), here, inverse(depth, row, column + span)) / span,
        slope(inverse(depth, row - span, column), here, inverse(depth, row + span, column)) / span,
    )


@serial
def second_differences(depth, stride, found):
    """Write second differences of inverse depth along rows, relative, at every stride-th pixel; return how many.

    On a plane they are noise alone, of variance 6 times a pixel's.
    """
    n = 0
    for row in range(stride // 2, depth.shape[0], stride):
        for column in range(stride // 2, depth.shape[1], stride):
            before, here, after = (
                inverse(depth, row, column - 1), inverse(depth, row, column), inverse(depth, row, column + 1)
            )  # fmt: skip
            if before > 0.0 and here > 0.0 and after > 0.0:
                found[n] = abs(before - 2.0 * here + after) / here
                n += 1
    return n


@helper
def plane_around(depth, row, column, here, allowed):
    """Return inverse depth at a pixel's centre, and its slopes, by a plane through the pixels around it.

    Pixels of another surface do not count: they differ by more than noise, `allowed` (relative), and slope explain. So
    a spot's own error is a fifth of a pixel's, and views from other sides meet it where it is.
    """
    along_x, along_y = slopes(depth, row, column, here, AROUND)
    steep = abs(along_x) + abs(along_y)
    n = sx = sy = sw = sxx = sxy = syy = sxw = syw = 0.0
    for b in range(-AROUND, AROUND + 1):
        for a in range(-AROUND, AROUND + 1):
            there = inverse(depth, row + b, column + a)
            if there == 0.0 or abs(there - here) > 2.0 * allowed * here + 2.0 * AROUND * steep:
                continue
            w = there - here
            n, sx, sy, sw = n + 1.0, sx + a, sy + b, sw + w
            sxx, sxy, syy, sxw, syw = sxx + a * a, sxy + a * b, syy + b * b, sxw + a * w, syw + b * w
    if n < LEAST_AROUND:
        return here, *slopes(depth, row, column, here)
    mx, my, mw = sx / n, sy / n, sw / n
    cxx, cxy, cyy, cxw, cyw = (
        sxx / n - mx * mx,
        sxy / n - mx * my,
        syy / n - my * my,
        sxw / n - mx * mw,
        syw / n - my * mw,
    )
    det = cxx * cyy - cxy * cxy
    if not det > 0.01:
        return here, 0.0, 0.0
    along_x, along_y = (cyy * cxw - cxy * cyw) / det, (cxx * cyw - cxy * cxw) / det
    return here + mw - along_x * mx - along_y * my, along_x, along_y


@helper
def normal_of(w, along_x, along_y, x, y, fx, fy):
    """Return n of the plane n . X = 1, 1/m, from its inverse depth at ray (x, y, 1), and slopes in a pixel.

    Inverse depth of the plane is n . (x, y, 1).
    """
    nx, ny = along_x * fx, along_y * fy
    return nx, ny, w - nx * x - ny * y


@helper
def area(here, along_x, along_y, x, y, fx, fy):
    """Return the area of the surface that a pixel at ray (x, y, 1) shows, m^2, from inverse depth and its slopes.

    It is z^3 |n| / (fx fy) of a plane n . X = 1, at most STEEPEST times that of a surface that faces the camera.
    """
    nx, ny, nz = normal_of(here, along_x, along_y, x, y, fx, fy)
    normal = np.sqrt(nx * nx + ny * ny + nz * nz)
    return min(normal, STEEPEST * here) / (here * here * here * fx * fy)


@serial
def mean_area(depth, camera, stride, span):
    """Return the mean area of the surface that a pixel shows, m^2, over every stride-th pixel of each axis.

    Slopes are those to pixels `span` pixels away.
    """
    fx, fy, cx, cy = camera
    total, count = 0.0, 0
    for row in range(stride // 2, depth.shape[0], stride):
        for column in range(stride // 2, depth.shape[1], stride):
            here = inverse(depth, row, column)
            if here > 0.0:
                along_x, along_y = slopes(depth, row, column, here, span)
                total += area(here, along_x, along_y, (column - cx) / fx, (row - cy) / fy, fx, fy)
                count += 1
    return total / max(count, 1)


@helper
def in_world(x, y, z, T):
    """Return a point of the sensor in the world."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@helper
def turned(x, y, z, T):
    """Return a direction of the sensor in the world."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@helper
def in_sensor(px, py, pz, T):
    """Return a point of the world in the axes of the sensor."""
    a, b, c = px - T[0, 3], py - T[1, 3], pz - T[2, 3]
    return (
        T[0, 0] * a + T[1, 0] * b + T[2, 0] * c,
        T[0, 1] * a + T[1, 1] * b + T[2, 1] * c,
        T[0, 2] * a + T[1, 2] * b + T[2, 2] * c,
    )
