"""Compiled passes over spots of the surface: the pixels of an image that answer for them, and the answers in order."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial
from semstab.statistics.loops.cells import mixed
from semstab.statistics.loops.surface import depths_around, in_sensor, inverse, inverse_of, plane_around, slope, slopes

SLACK = 0.25
"""Share of the slope of inverse depth by which two pixels next to each other on one surface may differ from a plane."""

EDGE, JUMP = 4.0, 0.01
"""A slope of inverse depth to one side that is larger than that to the other side by this factor, and this share of the
inverse depth, is an edge."""


@helper
def steps(before, here, after):
    """Return by how much inverse depth may change from a pixel to those before and after it; without branches.

    A pixel of another surface, behind an edge, does not count.
    """
    left = here - before if before > 0.0 else after - here
    right = after - here if after > 0.0 else left
    nothing = (before == 0.0) & (after == 0.0)
    left_jumps, right_jumps = abs(left) > EDGE * abs(right) + JUMP * here, abs(right) > EDGE * abs(left) + JUMP * here
    left, right = right if left_jumps else left, left if right_jumps and not left_jumps else right
    nothing |= (left * right < 0.0) & (min(abs(left), abs(right)) > JUMP * here)
    return 0.0 if nothing else left, 0.0 if nothing else right


@helper
def outside(here, left, right, up, down, dx, dy, w):
    """Return how far inverse depth w is from the range that a pixel's surface may have at (dx, dy) from its centre.

    The surface goes on with the slopes to the pixels to the left and right, and above and below.
    """
    before_x, after_x = steps(left, here, right)
    before_y, after_y = steps(up, here, down)
    low = here + min(before_x * dx, after_x * dx) + min(before_y * dy, after_y * dy)
    high = here + max(before_x * dx, after_x * dx) + max(before_y * dy, after_y * dy)
    return max(low - w, w - high, 0.0)


@helper
def misfit(around, dx, dy, z):
    """Return how much nearer than depth z a pixel's surface is at (dx, dy) from its centre, and how far it is at least.

    Both are relative; `around` has the depth of the pixel, and of those around it. See `project`.
    """
    here, left, right = inverse_of(around[0]), inverse_of(around[1]), inverse_of(around[2])
    up, down = inverse_of(around[3]), inverse_of(around[4])
    error = (here + slope(left, here, right) * dx + slope(up, here, down) * dy) * z - 1.0
    return error, outside(here, left, right, up, down, dx, dy, 1.0 / z) * z


@helper
def misfit_on_plane(depth, row, column, dx, dy, z, noise):
    """Return the same two numbers by a plane through the pixels around."""
    w, along_x, along_y = plane_around(depth, row, column, inverse(depth, row, column), noise)
    error = (w + along_x * dx + along_y * dy) * z - 1.0
    return error, abs(error)


@helper
def in_view(point, camera, T, shape, spot, x, y, z):
    """Find the spots that fall on a pixel, in front of the camera, their image coordinates and depth; return how many.

    The loops are apart since arithmetic alone becomes vector instructions.
    """
    fx, fy, cx, cy = camera
    H, W = shape
    for i in range(len(point)):
        right, down, forward = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
        x[i], y[i], z[i] = right / forward * fx + cx, down / forward * fy + cy, forward
    n = 0
    for i in range(len(point)):
        u, v, forward = x[i], y[i], z[i]
        spot[n], x[n], y[n], z[n] = i, u, v, forward
        n += (forward > 1e-9) & (u >= -0.5) & (u < W - 0.5) & (v >= -0.5) & (v < H - 0.5)
    return n


@serial
def project(point, depth, camera, T, noise, allowed, spot, pixel, x, y, error, room):
    """Find the spots that fall on a pixel with depth, in front of the camera; return how many.

    For each it writes its number, the pixel, its image coordinates, how much nearer than the spot the surface is by the
    pixel's slope, and `room`: how far the spot is from all that the slopes to the pixels around allow; both relative.
    The pixel is that which the spot falls into. If that shows only what lies behind the spot, it is one of the next
    pixels if one shows the spot's surface, as along a narrow surface (`allowed`, relative). Noise is what pixels of one
    surface differ by, relative: if it is not 0, planes through the pixels around tell the depth.
    """
    W, z = depth.shape[1], np.empty(len(point))
    n = in_view(point, camera, T, depth.shape, spot, x, y, z)
    depths = np.empty((5, n))
    for i in range(n):
        column, row = np.int64(np.floor(x[i] + 0.5)), np.int64(np.floor(y[i] + 0.5))
        pixel[i] = row * W + column
        depths[0, i], depths[1, i], depths[2, i], depths[3, i], depths[4, i] = depths_around(depth, row, column)
    for i in range(n):
        around = depths[0, i], depths[1, i], depths[2, i], depths[3, i], depths[4, i]
        dx, dy = x[i] - np.floor(x[i] + 0.5), y[i] - np.floor(y[i] + 0.5)
        error[i], room[i] = misfit(around, dx, dy, z[i])
    found = 0
    for i in range(n):
        row, column = pixel[i] // W, pixel[i] % W
        here = inverse_of(depths[0, i])
        if here == 0.0:
            error[i], room[i] = -1.0, 1.0
        elif noise > 0.0:
            error[i], room[i] = misfit_on_plane(depth, row, column, x[i] - column, y[i] - row, z[i], noise)
        if room[i] > allowed and error[i] < 0.0:  # the spot is in front of all that its pixel shows
            row, column, room_there = fitting_pixel(depth, row, column, x[i], y[i], z[i], noise, allowed)
            if room_there <= allowed:
                pixel[i], here, room[i] = row * W + column, inverse(depth, row, column), room_there
        spot[found], pixel[found], x[found], y[found] = spot[i], pixel[i], x[i], y[i]
        error[found], room[found] = error[i], room[i]
        found += here > 0.0
    return found


@helper
def fitting_pixel(depth, row, column, x, y, z, noise, allowed):
    """Return the first of the next pixels towards (x, y) that shows the surface of a spot, and its `room`.

    If none does, that is 1.
    """
    for turn in range(3):
        a, b = towards(x - column, y - row, turn)
        if inverse(depth, row + b, column + a) > 0.0:
            dx, dy = x - column - a, y - row - b
            if noise > 0.0:
                _, room = misfit_on_plane(depth, row + b, column + a, dx, dy, z, noise)
            else:
                _, room = misfit(depths_around(depth, row + b, column + a), dx, dy, z)
            if room <= allowed:
                return row + b, column + a, room
    return row, column, 1.0


@helper
def towards(dx, dy, turn):
    """Return the step to the next pixel towards (dx, dy): along the longer of them, the shorter, or both."""
    a, b = np.int64(1) if dx > 0.0 else np.int64(-1), np.int64(1) if dy > 0.0 else np.int64(-1)
    if turn == 2:
        return a, b
    return (a, np.int64(0)) if (turn == 0) == (abs(dx) > abs(dy)) else (np.int64(0), b)


@helper
def own_label(labels, unlabelled, row, column, K):
    """Return the label of a pixel: K for none, K + 1 for a pixel that is left out and does not answer."""
    label = np.int64(labels[row, column])
    if label < K:
        return label
    return np.int64(K) if unlabelled.shape[0] and unlabelled[row, column] else np.int64(K + 1)


@helper
def aside(side):
    """Return a step of one pixel to one of four sides."""
    sign = np.int64(1) if side & 2 else np.int64(-1)
    return (sign, np.int64(0)) if side & 1 else (np.int64(0), sign)


@helper
def first_side(seed, hashed):
    """Return the side at which the second answer for a spot is looked for first, 0 to 3: by frame and coarse cell."""
    return np.int64(mixed(np.uint32(np.uint32(seed) ^ hashed)) & np.uint32(3))


@helper
def two_labels(labels, unlabelled, row, column, step_x, step_y, K):
    """Return the labels of the next two pixels in a direction, K or more if one has none."""
    first = own_label(labels, unlabelled, row + step_y, column + step_x, K)
    last = own_label(labels, unlabelled, row + 2 * step_y, column + 2 * step_x, K)
    return (first, last) if max(first, last) < K else (np.int64(K), np.int64(K))


@helper
def shows(depth, row, column, here, along_x, along_y, dx, dy, allowed):
    """Return whether a pixel (dx, dy) away from another shows the surface that goes on there with these slopes."""
    there, expected = inverse(depth, row + dy, column + dx), here + along_x * dx + along_y * dy
    slack = 1.5 * allowed + SLACK * (abs(dx) + abs(dy)) * (abs(along_x) + abs(along_y)) / here
    return there > 0.0 and abs(there - expected) <= slack * here


@helper
def squared(dx, dy, here, fx, fy):
    """Return the squared distance, metres^2 across the ray, of a point (dx, dy) pixels away at an inverse depth."""
    return ((dx / fx) ** 2 + (dy / fy) ** 2) / (here * here)


@serial
def answer(
    spot, pixel, x, y, room, allowed, depth, labels, unlabelled, K, camera, hashed, seed, out, near, far, beyond, square
):
    """Write the answers of the pixels that show a spot: its number, three labels, and two squared distances, metres^2.

    A pixel shows a spot if both are at the same depth, but for `allowed` (relative). The first label is that of the
    pixel which `project` found; the second and the third one those of the next two pixels to one side, if they
    show the same surface. The distances are those of the first two pixels' centres from the spot, across the ray.
    unlabelled (H, W) marks pixels to which the model gave no label; (0, 0) without such pixels. Returns the number of
    answers.
    """
    fx, fy, _, _ = camera
    n = 0
    for i in range(len(spot)):
        if room[i] > allowed:
            continue
        row, column = pixel[i] // depth.shape[1], pixel[i] % depth.shape[1]
        label, here = own_label(labels, unlabelled, row, column, K), inverse(depth, row, column)
        out[n], near[n], far[n], beyond[n] = spot[i], label, label, label
        dx, dy = column - x[i], row - y[i]
        square[n] = squared(dx, dy, here, fx, fy)
        if label < K:
            along_x, along_y = slopes(depth, row, column, here)
            side = first_side(seed, hashed[spot[i]])
            for turn in range(4):
                step_x, step_y = aside((side + turn) & 3)
                surface = row, column, here, along_x, along_y
                if not shows(depth, *surface, step_x, step_y, allowed):
                    continue
                if not shows(depth, *surface, 2 * step_x, 2 * step_y, allowed):
                    continue
                first, last = two_labels(labels, unlabelled, row, column, step_x, step_y, K)
                if first < K:
                    far[n], beyond[n] = first, last
                    square[n, 1] = squared(dx + step_x, dy + step_y, here, fx, fy)
                    break
        n += 1
    return n


@serial
def observe(number, view, label, K, first, of, starts, classes, shares):
    """Write each observation: its spot, and the share of each class among its answers, classes ascending.

    number, view (m,) are the spot and the view of each answer, in order: a camera that stands still answers more than
    once in a view. `first` is an answer of each observation, `of` counts spots; returns the number of observations, and
    the number of their classes together. All arrays are as long as the answers, `starts` is longer by one.
    """
    sums, met = np.zeros(K), np.empty(K, np.int64)
    n = m = start = 0
    spots = -1
    before = np.int64(-1)
    starts[0] = 0
    while start < len(number):
        end, many, spot = start, 0, number[start]
        while end < len(number) and number[end] == spot and view[end] == view[start]:
            if sums[label[end]] == 0.0:
                met[many] = label[end]
                many += 1
            sums[label[end]] += 1.0
            end += 1
        spots += spot != before
        before = spot
        first[n], of[n] = start, spots
        if many > 1:
            met[:many].sort()
        for k in met[:many]:
            classes[m], shares[m], sums[k] = k, sums[k] / (end - start), 0.0
            m += 1
        n += 1
        starts[n] = m
        start = end
    return n, m
