"""Compiled passes over spots and sparse depth: points of a scan, or of a scan that is drawn into an image."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial
from semstab.statistics.loops.answers import aside, first_side, own_label, squared, two_labels
from semstab.statistics.loops.cells import add_spot, fraction, mixed
from semstab.statistics.loops.new_spots import number_of
from semstab.statistics.loops.surface import STEEPEST, area, in_sensor, in_world, normal_of, turned

ON_A_PLANE = 0.03
"""Sparse points lie on a plane if it leaves at most this over of their inverse depth, relative."""

NEXT, BESIDE = 2.25, 4.0
"""Squared distances, in pixels: of a point in the next pixel; and of the farthest point beside which a pixel of an
image answers, since what lies between points, such as a pole before a wall, is not known."""


@serial
def directions(points, unit, u, v, w):
    """Write azimuth and elevation, in `unit` radians, and inverse range of points (n, 3); 0 of invalid points."""
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        if not (0.0 < distance < np.inf):
            w[i] = 0.0
            continue
        u[i], v[i] = (np.arctan2(y, x) + np.pi) / unit, (np.arcsin(z / distance) + 0.5 * np.pi) / unit
        w[i] = 1.0 / distance


@serial
def drawn(u, v, w, grid):
    """Write into `grid` (rows, columns) the number of the point in each pixel, the nearest one; -1 without any."""
    grid[:] = -1
    rows, columns = grid.shape
    for i in range(len(w)):
        if w[i] > 0.0:
            row, column = min(np.int64(v[i] + 0.5), rows - 1), np.int64(u[i] + 0.5)
            column = column - columns if column >= columns else column
            there = grid[row, column]
            if there < 0 or w[i] > w[there]:
                grid[row, column] = i


@serial
def surface(grid, u, v, w, x, y, reach, around):
    """Return what points around (x, y) say of the surface there, by a plane through their inverse depth.

    reach is in pixels; around is True if the columns of the image close a circle. It returns the inverse depth, 0
    without a plane; the root mean square of what the plane leaves over, relative; the number of the nearest
    point, -1 without any; the squared distance to it in pixels; and the slopes of the plane in a pixel, relative.
    """
    rows, columns = grid.shape
    column, row = np.int64(np.floor(x + 0.5)), np.int64(np.floor(y + 0.5))
    nearest, least, reference = np.int64(-1), 1e18, 0.0
    n = sx = sy = sw = sxx = sxy = syy = sxw = syw = sww = 0.0
    for b in range(max(row - reach, 0), min(row + reach + 1, rows)):
        for a in range(column - reach, column + reach + 1):
            at = a % columns if around else a
            if at < 0 or at >= columns or grid[b, at] < 0:
                continue
            i = grid[b, at]
            dx, dy = u[i] - x, v[i] - y
            if around:
                dx = dx - columns * np.round(dx / columns)
            distance = dx * dx + dy * dy
            if distance < least:
                nearest, least = np.int64(i), distance
            reference = w[i] if n == 0.0 else reference
            dw = w[i] / reference - 1.0
            n += 1.0
            sx, sy, sw = sx + dx, sy + dy, sw + dw
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            sxw, syw, sww = sxw + dx * dw, syw + dy * dw, sww + dw * dw
    if n < 4.0:
        return 0.0, 0.0, nearest, least, 0.0, 0.0
    mx, my, mw = sx / n, sy / n, sw / n
    cxx, cxy, cyy = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
    cxw, cyw, cww = sxw / n - mx * mw, syw / n - my * mw, sww / n - mw * mw
    det = cxx * cyy - cxy * cxy
    if not det > 1e-3 * (cxx + cyy) ** 2:
        return 0.0, 0.0, nearest, least, 0.0, 0.0
    along_x, along_y = (cyy * cxw - cxy * cyw) / det, (cxx * cyw - cxy * cxw) / det
    residual = max(cww - along_x * cxw - along_y * cyw, 0.0)
    there = (1.0 + mw - along_x * mx - along_y * my) * reference
    scale = reference / there if there > 0.0 else 0.0
    return there, np.sqrt(residual), nearest, least, along_x * scale, along_y * scale


@helper
def shown_by(grid, u, v, w, at, camera, around, reach, allowed):
    """Return the area that a pixel at a point shows, m^2, and the plane through the points around it.

    The plane is an inverse depth, 0 if there is no plane, and two slopes, relative. Without a plane the surface is
    taken to face the sensor.
    """
    fx, fy, cx, cy = camera
    there, residual, _, _, along_x, along_y = surface(grid, u, v, w, u[at], v[at], reach, around)
    if there == 0.0 or residual > allowed:
        return 1.0 / (w[at] * w[at] * fx * fy), 0.0, 0.0, 0.0
    if around:
        narrow = max(np.cos(v[at] / fy - 0.5 * np.pi), 1e-3)
        normal = np.sqrt(1.0 + (along_x * fx / narrow) ** 2 + (along_y * fy) ** 2)
        pixel_area = min(normal, STEEPEST) * narrow / (w[at] * w[at] * fx * fy)
    else:
        x, y = (u[at] - cx) / fx, (v[at] - cy) / fy
        pixel_area = area(w[at], along_x * w[at], along_y * w[at], x, y, fx, fy)
    return pixel_area, there, along_x, along_y


@serial
def mean_area_of_points(grid, u, v, w, camera, around, reach, spacing, allowed, step):
    """Return the mean area of the surface for which a point stands, m^2, over every step-th point; 0 without any."""
    total, count = 0.0, 0
    for at in range(0, len(w), step):
        if w[at] > 0.0:
            pixel_area, _, _, _ = shown_by(grid, u, v, w, at, camera, around, reach, allowed)
            total += pixel_area * spacing * spacing
            count += 1
    return total / max(count, 1)


@serial
def new_in_points(
    grid, u, v, w, camera, around, reach, apart, allowed, T, spacing, share, low, factor, looked, density, seed, table,
    point, hashed,
):  # fmt: skip
    """Add spots where points show coarse cells that were not met before; return how many, and of how many cells.

    Places are looked at evenly over the surface, as in `new_in_image`, at `looked` points: on the plane through the
    points around a point, up to half of `apart` (pixels) away from it; at the point itself without a plane, where the
    surface is taken to face the sensor.
    """
    total, n, met, at = len(w), 0, 0, np.int64(seed % len(w))
    for _ in range(looked):
        at += factor
        if at >= total:
            at -= total
        if w[at] == 0.0:
            continue
        number = np.uint32(np.uint32(seed) ^ (np.uint32(at) * np.uint32(0x85EBCA6B)))
        pixel_area, there, along_x, along_y = shown_by(grid, u, v, w, at, camera, around, reach, allowed)
        expected = density * pixel_area * apart * apart / (spacing * spacing)
        for _ in range(number_of(expected, fraction(np.uint32(number ^ np.uint32(0x165667B1))))):
            number = mixed(np.uint32(number + np.uint32(0x9E3779B9)))
            x, y, here = u[at], v[at], w[at]
            if there > 0.0:
                dx = (fraction(number) - 0.5) * apart
                dy = (fraction(np.uint32(number ^ np.uint32(0x27D4EB2F))) - 0.5) * apart
                near = there * (1.0 + along_x * dx + along_y * dy)
                if near > 0.5 * here:
                    x, y, here = x + dx, y + dy, near
            p = in_world(*back(x, y, here, camera, around), T)
            normal = turned(*normal_at(x, y, here, along_x * there, along_y * there, camera, around), T)
            n, met = add_spot(p, normal, spacing, share, low, table, point, hashed, n, met)
            if met == len(hashed):
                return n, met
    return n, met


@helper
def normal_at(x, y, w, along_x, along_y, camera, around):
    """Return the normal of a surface at image coordinates, by its inverse depth, or range, and slopes in a pixel."""
    fx, fy, cx, cy = camera
    if not around:
        return normal_of(w, along_x, along_y, (x - cx) / fx, (y - cy) / fy, fx, fy)
    azimuth, elevation = x / fx - np.pi, y / fy - 0.5 * np.pi
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    east, up = along_x * fx / max(ce, 1e-3), along_y * fy
    return w * ce * ca - east * sa - up * se * ca, w * ce * sa + east * ca - up * se * sa, w * se + up * ce


@serial
def back(x, y, w, camera, around):
    """Return the point of the sensor at image coordinates and inverse depth, or inverse range of a scan."""
    fx, fy, cx, cy = camera
    if around:
        azimuth, elevation = x / fx - np.pi, y / fy - 0.5 * np.pi
        flat = np.cos(elevation) / w
        return flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) / w
    return (x - cx) / fx / w, (y - cy) / fy / w, 1.0 / w


@serial
def project_sparse(point, grid, u, v, w, camera, around, reach, T, spot, x, y, error, room, nearest):
    """Find the spots that points around show; return how many. As `project`, and `nearest` takes the nearest point.

    A plane through the points around tells the depth there; if they lie on no plane, as at an edge, the nearest point
    does, if it is the next pixel. In an image the nearest point is at most 2 pixels away. `room` is the slope of the
    plane in a pixel, relative.
    """
    rows, columns = grid.shape
    fx, fy, cx, cy = camera
    n = 0
    for i in range(len(point)):
        X, Y, Z = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
        distance = np.sqrt(X * X + Y * Y + Z * Z) if around else Z
        if not distance > 1e-9:
            continue
        if around:
            p, q = (np.arctan2(Y, X) + np.pi) * fx, (np.arcsin(Z / distance) + 0.5 * np.pi) * fy
        else:
            p, q = X / Z * fx + cx, Y / Z * fy + cy
            if not (-0.5 <= p < columns - 0.5 and -0.5 <= q < rows - 0.5):
                continue
        there, residual, at, least, along_x, along_y = surface(grid, u, v, w, p, q, reach, around)
        if not around and (at < 0 or least > BESIDE):
            continue
        if there == 0.0 or residual > ON_A_PLANE:
            if at < 0 or least > NEXT:
                continue
            there, along_x, along_y = w[at], 0.0, 0.0
        spot[n], x[n], y[n], error[n], nearest[n] = i, p, q, there * distance - 1.0, at
        room[n] = abs(along_x) + abs(along_y)
        n += 1
    return n


@serial
def answer_sparse(
    spot, x, y, error, allowed, labels, unlabelled, K, w, nearest, camera, hashed, seed, out, near, far, beyond, square
):
    """Write the answers of the pixels of an image with sparse depth and dense labels, as `answer` does."""
    H, W = labels.shape
    fx, fy, _, _ = camera
    n = 0
    for i in range(len(spot)):
        if abs(error[i]) > allowed:
            continue
        column, row, here = np.int64(np.floor(x[i] + 0.5)), np.int64(np.floor(y[i] + 0.5)), w[nearest[i]]
        label, dx, dy = own_label(labels, unlabelled, row, column, K), column - x[i], row - y[i]
        out[n], near[n], far[n], beyond[n] = spot[i], label, label, label
        square[n] = squared(dx, dy, here, fx, fy)
        if label < K:
            side = first_side(seed, hashed[spot[i]])
            for turn in range(4):
                step_x, step_y = aside((side + turn) & 3)
                if not (0 <= column + 2 * step_x < W and 0 <= row + 2 * step_y < H):
                    continue
                first, last = two_labels(labels, unlabelled, row, column, step_x, step_y, K)
                if first < K:
                    far[n], beyond[n] = first, last
                    square[n, 1] = squared(dx + step_x, dy + step_y, here, fx, fy)
                    break
        n += 1
    return n


@helper
def next_point(grid, u, v, w, at, goal_x, goal_y, reach, around, allowed, steep):
    """Return the point nearest to a goal in the image that shows the surface of point `at`, not `at`; -1 without any.

    It is looked for within half of `reach`.
    """
    rows, columns = grid.shape
    reach = (reach + 1) // 2
    other, least = np.int64(-1), 1e18
    column, row = np.int64(np.floor(goal_x + 0.5)), np.int64(np.floor(goal_y + 0.5))
    for b in range(max(row - reach, 0), min(row + reach + 1, rows)):
        for a in range(column - reach, column + reach + 1):
            c = a % columns if around else a
            if c < 0 or c >= columns or grid[b, c] < 0 or grid[b, c] == at:
                continue
            j = grid[b, c]
            dx, dy = u[j] - goal_x, v[j] - goal_y
            if around:
                dx = dx - columns * np.round(dx / columns)
            apart = abs(dx + goal_x - u[at]) + abs(dy + goal_y - v[at])
            if dx * dx + dy * dy < least and abs(w[j] / w[at] - 1.0) <= 1.5 * allowed + steep * apart:
                other, least = np.int64(j), dx * dx + dy * dy
    return other


@serial
def answer_points(
    spot, x, y, error, room, allowed, grid, u, v, w, labels, K, nearest, camera, around, reach, hashed, seed, out, near,
    far, beyond, square,
):  # fmt: skip
    """Write the answers of the nearest points, whose labels (n,) are given, as `answer` does.

    The second and the third label are those of points which lie further to one side, half of `reach` and all of it.
    """
    columns = grid.shape[1]
    fx, fy, _, _ = camera
    n = 0
    for i in range(len(spot)):
        if abs(error[i]) > allowed:
            continue
        at = nearest[i]
        step_x, step_y = aside(first_side(seed, hashed[spot[i]]))
        half = 0.5 * reach
        first = next_point(
            grid, u, v, w, at, u[at] + half * step_x, v[at] + half * step_y, reach, around, allowed, room[i]
        )
        last = next_point(
            grid, u, v, w, at, u[at] + reach * step_x, v[at] + reach * step_y, reach, around, allowed, room[i]
        )
        narrow = np.cos(y[i] / fy - 0.5 * np.pi) if around else 1.0
        out[n], near[n], far[n], beyond[n] = spot[i], labels[at], labels[at], labels[at]
        if first >= 0 and last >= 0 and max(labels[at], labels[first], labels[last]) < K:
            far[n], beyond[n] = labels[first], labels[last]
        else:
            first = at
        for k in range(2):
            j = first if k == 1 else at
            dx, dy = u[j] - x[i], v[j] - y[i]
            if around:
                dx = dx - columns * np.round(dx / columns)
            square[n, k] = squared(narrow * dx, dy, w[at], fx, fy)
        n += 1
    return n
