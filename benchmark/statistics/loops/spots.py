"""Compiled passes over spots of the surface: new ones in a frame's depth, and the pixels that answer for them.

On a plane, inverse depth is linear in image coordinates. So the depth that a frame shows at a spot, between the centres
of its pixels, follows from a pixel and its slope, however steeply the surface is seen.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from semstab.core.compiled import serial

BITS = 21
"""Bits of a coarse cell's index along each axis in its key."""

SPAN = 1 << BITS

ALONG_X, ALONG_Y, ALONG_Z = np.uint32(0xD1B54A33), np.uint32(0xABC98389), np.uint32(0x8CB92BA7)
"""Weights of a cell's indices in its hash: 2^32 / g^k of the root g of g^4 = g + 1, so that along no line and in no
plane the same sum comes again soon (Roberts 2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
EMPTY = np.int64(-1)

PHASE = 25 / 64
"""Part of its edge by which coarse cells are moved from the origin, near the golden section, so that floors and walls
of models do not lie in their faces; a multiple of the 64ths in which a log tells places, see `SpotObservations`."""

MOST_PLACES = 1 << 16
"""Most places that are looked at in a block of pixels: a pixel of damaged depth may show thousands of kilometres."""

AT_ONCE = 64
"""Places of a block that are looked at in one go."""

STEEPEST = 32.0
"""Largest area that a pixel shows, in those that it would show if the surface faced it."""

SLACK = 0.25
"""Share of the slope of inverse depth by which two pixels next to each other on one surface may differ from a plane."""

AROUND, LEAST_AROUND = 2, 6.0
"""Pixels to each side through which a plane is laid where a spot is found, and the least number of them."""

EDGE, JUMP = 4.0, 0.01
"""A slope of inverse depth to one side that is larger than that to the other side by this factor, and this share of the
inverse depth, is an edge."""


@serial
def mixed(number):
    """Return a hash of 32 bits, lowbias32 (Wellons 2018, Prospecting for Hash Functions)."""
    h = np.uint32(number)
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(h ^ (h >> np.uint32(16)))


@serial
def hash_cell(x, y, z):
    """Return the hash of a coarse cell, the same in each run."""
    weighted = np.uint32(np.uint32(x) * ALONG_X) + np.uint32(np.uint32(y) * ALONG_Y) + np.uint32(np.uint32(z) * ALONG_Z)
    return mixed(np.uint32(weighted))


@serial
def fraction(number):
    """Return a number from 0 to 1, without both, from a hash."""
    return (np.float64(mixed(number)) + 0.5) / 4294967296.0


@serial
def inverse(depth, row, column):
    """Return the inverse depth of a pixel; 0 without valid depth and outside of the image."""
    return inverse_of(depth_at(depth, row, column))


@serial
def depth_at(depth, row, column):
    """Return the depth of a pixel, 0 outside of the image."""
    inside = (row >= 0) & (column >= 0) & (row < depth.shape[0]) & (column < depth.shape[1])
    return np.float64(depth[row, column]) if inside else 0.0


@serial
def inverse_of(depth):
    """Return inverse depth, 0 without valid depth; without branches, as `slope`, for vectors."""
    valid = (depth > 0.0) & (depth < np.inf)
    return (1.0 if valid else 0.0) / (depth if valid else 1.0)


@serial
def slope(before, here, after):
    """Return the slope of inverse depth by the minmod limiter: the smaller of both sides, 0 at an edge or a peak."""
    left, right = here - before, after - here
    smaller = left if abs(left) < abs(right) else right
    smaller = smaller if left * right > 0.0 else 0.0
    only = left if before > 0.0 else right
    only = only if ((before > 0.0) | (after > 0.0)) & (abs(only) < 0.5 * here) else 0.0
    return smaller if (before > 0.0) & (after > 0.0) else only


@serial
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


@serial
def smoothed(depth, row, column, here, dx, dy, allowed):
    """Return inverse depth at (dx, dy) from a pixel's centre, by a plane through the pixels around it.

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
        along_x, along_y = slopes(depth, row, column, here)
        return here + along_x * dx + along_y * dy
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
        return here
    return here + mw + (cyy * cxw - cxy * cyw) / det * (dx - mx) + (cxx * cyw - cxy * cxw) / det * (dy - my)


# --- New spots --------------------------------------------------------------------------------------------------------


@serial
def is_new(table, key, added):
    """Return whether a table with open addressing lacks a key, which may then be added; its size is a power of 2."""
    mask = np.uint64(len(table) - 1)
    slot = (np.uint64(key) * GOLDEN >> np.uint64(20)) & mask
    while table[slot] != EMPTY:
        if table[slot] == key:
            return False
        slot = (slot + np.uint64(1)) & mask
    if added:
        table[slot] = key
    return True


@serial
def cell_of(x, y, z, edge):
    """Return the coarse cell of a point; no face of a cell lies in a plane such as z = 0, where floors lie."""
    return (
        np.int64(np.floor(x / edge + PHASE)), np.int64(np.floor(y / edge + PHASE)),
        np.int64(np.floor(z / edge + PHASE)),
    )  # fmt: skip


@serial
def fill(point, edge, low, table):
    """Add the coarse cells of points (n, 3) to a table."""
    for i in range(len(point)):
        a, b, c = cell_of(point[i, 0], point[i, 1], point[i, 2], edge)
        is_new(table, ((a - low[0]) << (2 * BITS)) | ((b - low[1]) << BITS) | (c - low[2]), True)


@serial
def in_world(x, y, z, T):
    """Return a point of the sensor in the world."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@serial
def takes(i, j, k, low, table, added):
    """Return whether a coarse cell within reach has no spot, which may then be added."""
    a, b, c = i - low[0], j - low[1], k - low[2]
    if a < 0 or b < 0 or c < 0 or a >= SPAN or b >= SPAN or c >= SPAN:
        return False
    return is_new(table, (a << (2 * BITS)) | (b << BITS) | c, added)


@serial
def add_spot(px, py, pz, edge, share, low, table, point, hashed, n):
    """Add a point as spot n if its coarse cell is in the sample and has none; return how many spots there are."""
    i, j, k = cell_of(px, py, pz, edge)
    cell_hash = hash_cell(i, j, k)
    if cell_hash >= share or not takes(i, j, k, low, table, True):
        return n
    point[n, 0], point[n, 1], point[n, 2], hashed[n] = px, py, pz, cell_hash
    return n + 1


@serial
def in_sensor(px, py, pz, T):
    """Return a point of the world in the axes of the sensor."""
    a, b, c = px - T[0, 3], py - T[1, 3], pz - T[2, 3]
    return (
        T[0, 0] * a + T[1, 0] * b + T[2, 0] * c,
        T[0, 1] * a + T[1, 1] * b + T[2, 1] * c,
        T[0, 2] * a + T[1, 2] * b + T[2, 2] * c,
    )


@serial
def area(here, along_x, along_y, x, y, fx, fy):
    """Return the area of the surface that a pixel at ray (x, y, 1) shows, m^2, from inverse depth and its slopes.

    Inverse depth of a plane n . X = 1 is n . (x, y, 1). So n follows from the slopes, and the area is
    z^3 |n| / (fx fy), at most STEEPEST times that of a surface that faces the camera.
    """
    nx, ny = along_x * fx, along_y * fy
    nz = here - nx * x - ny * y
    normal = np.sqrt(nx * nx + ny * ny + nz * nz)
    return min(normal, STEEPEST * here) / (here * here * here * fx * fy)


@serial
def number_of(expected, chance):
    """Return how many places to look at if `expected` are expected, by a number from 0 to 1; at most MOST_PLACES."""
    return np.int64(min(np.floor(expected + chance), MOST_PLACES))


@serial
def draw_places(top, left, stride, number, numbers, u, v):
    """Draw places in a block of pixels, by a chain of hashes that goes on after `number`."""
    for i in range(len(u)):
        number = mixed(np.uint32(number + np.uint32(0x9E3779B9)))
        numbers[i] = number
        v[i] = top + stride * fraction(number)
        u[i] = left + stride * fraction(np.uint32(number ^ np.uint32(0x27D4EB2F)))


@serial
def look_at(depth, camera, T, edge, u, v, shown, here, cell, hashed):
    """Find the inverse depth of the pixels of places, and the coarse cells that they show, with their hashes.

    shown (5, n) is work space, for the depth of the pixels and of those next to them. The loops are apart since
    arithmetic alone becomes vector instructions.
    """
    fx, fy, cx, cy = camera
    H, W = depth.shape
    for i in range(len(u)):
        row, column = np.int64(v[i]), np.int64(u[i])
        if 0 < row < H - 1 and 0 < column < W - 1:
            shown[0, i], shown[1, i], shown[2, i] = depth[row, column], depth[row, column - 1], depth[row, column + 1]
            shown[3, i], shown[4, i] = depth[row - 1, column], depth[row + 1, column]
        else:
            shown[0, i] = depth_at(depth, row, column)
            shown[1, i], shown[2, i] = depth_at(depth, row, column - 1), depth_at(depth, row, column + 1)
            shown[3, i], shown[4, i] = depth_at(depth, row - 1, column), depth_at(depth, row + 1, column)
    for i in range(len(u)):
        w = inverse_of(shown[0, i])
        along_x = slope(inverse_of(shown[1, i]), w, inverse_of(shown[2, i]))
        along_y = slope(inverse_of(shown[3, i]), w, inverse_of(shown[4, i]))
        dx, dy = u[i] - np.floor(u[i]) - 0.5, v[i] - np.floor(v[i]) - 0.5
        here[i], shown[0, i] = w, max(w + along_x * dx + along_y * dy, 0.5 * w)
    for i in range(len(u)):
        z = 1.0 / (shown[0, i] if shown[0, i] > 0.0 else 1.0)
        px, py, pz = in_world((u[i] - 0.5 - cx) / fx * z, (v[i] - 0.5 - cy) / fy * z, z, T)
        cell[0, i], cell[1, i], cell[2, i] = cell_of(px, py, pz, edge)
    for i in range(len(u)):
        hashed[i] = hash_cell(cell[0, i], cell[1, i], cell[2, i])


@serial
def places_of_block(depth, camera, row, column, here, stride, per_area, chance):
    """Return how many places to look at in a block of pixels, by the area that it shows."""
    fx, fy, cx, cy = camera
    along_x, along_y = slopes(depth, row, column, here, stride)
    block_area = area(here, along_x, along_y, (column - cx) / fx, (row - cy) / fy, fx, fy) * stride * stride
    return number_of(per_area * block_area, chance)


@serial
def new_in_image(depth, camera, T, allowed, edge, share, low, stride, factor, density, seed, table, point, hashed):
    """Add spots where an image shows a coarse cell without one; return how many.

    Places are looked at evenly over the surface, `density` in the area of a coarse cell's face: in all blocks of stride
    x stride pixels, in an order that jumps over the image by `factor`, as many as the area that a block shows asks for.
    A place lies anywhere in its pixel, so that the view that finds a spot meets it as any other view does.
    """
    H, W = depth.shape
    fx, fy, cx, cy = camera
    u, v, here, shown = np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty((5, AT_ONCE))
    cell = np.empty((3, AT_ONCE), np.int64)
    cell_hash, numbers = np.empty(AT_ONCE, np.uint32), np.empty(AT_ONCE, np.uint32)
    columns = (W + stride - 1) // stride
    total, n = (H + stride - 1) // stride * columns, 0
    at = np.int64(seed % total)
    for _ in range(total):
        at += factor
        if at >= total:
            at -= total
        top, left = stride * (at // columns), stride * (at % columns)
        number = np.uint32(np.uint32(seed) ^ (np.uint32(at) * np.uint32(0x85EBCA6B)))
        places, done = np.int64(1), np.int64(0)
        while done < places:
            some: Any = min(places - done, AT_ONCE)
            draw_places(top, left, stride, number, numbers[:some], u[:some], v[:some])
            look_at(depth, camera, T, edge, u[:some], v[:some], shown, here, cell, cell_hash)
            number = numbers[some - 1]
            for i in range(some):
                if here[i] == 0.0:
                    continue
                row, column = np.int64(v[i]), np.int64(u[i])
                if done == 0:
                    chance = fraction(np.uint32(number ^ np.uint32(0x165667B1)))
                    per_area = density / (edge * edge)
                    places = places_of_block(depth, camera, row, column, here[i], stride, per_area, chance)
                    if places == 0:
                        break
                if cell_hash[i] >= share or not takes(cell[0, i], cell[1, i], cell[2, i], low, table, False):
                    continue
                x, y = u[i] - 0.5, v[i] - 0.5
                there = smoothed(depth, row, column, here[i], x - column, y - row, allowed)
                z = 1.0 / (there if there > 0.5 * here[i] else here[i])
                px, py, pz = in_world((x - cx) / fx * z, (y - cy) / fy * z, z, T)
                n = add_spot(px, py, pz, edge, share, low, table, point, hashed, n)
                if n == len(hashed):
                    return n
            done += some
    return n


# --- Answers of an image ----------------------------------------------------------------------------------------------


@serial
def outside(depth, row, column, here, dx, dy, w):
    """Return how far inverse depth w is from the range that a pixel's surface may have at (dx, dy) from its centre.

    The surface goes on with the slopes to the pixels before and after, of which one that belongs to another surface,
    behind an edge, does not count.
    """
    low = high = here
    for side in range(2):
        before = inverse(depth, row, column - 1) if side == 0 else inverse(depth, row - 1, column)
        after = inverse(depth, row, column + 1) if side == 0 else inverse(depth, row + 1, column)
        apart = dx if side == 0 else dy
        left = here - before if before > 0.0 else after - here
        right = after - here if after > 0.0 else left
        if before == 0.0 and after == 0.0:
            left = right = 0.0
        if abs(left) > EDGE * abs(right) + JUMP * here:
            left = right
        elif abs(right) > EDGE * abs(left) + JUMP * here:
            right = left
        if left * right < 0.0 and min(abs(left), abs(right)) > JUMP * here:
            left = right = 0.0
        low, high = low + min(left * apart, right * apart), high + max(left * apart, right * apart)
    return max(low - w, w - high, 0.0)


@serial
def project(point, depth, camera, T, noise, allowed, spot, pixel, x, y, error, room):
    """Find the spots that fall on a pixel with depth, in front of the camera; return how many.

    For each it writes its number, the pixel, its image coordinates, how much nearer than the spot the surface is by the
    pixel's slope, and `room`: how far the spot is from all that the slopes to the pixels around allow; both relative.
    The pixel is that which the spot falls into. If that shows only what lies behind the spot, it is one of the next
    pixels if one shows the spot's surface, as along a narrow surface (`allowed`, relative). Noise is what pixels of one
    surface differ by, relative: if it is not 0, planes through the pixels around tell the depth.
    """
    H, W = depth.shape
    fx, fy, cx, cy = camera
    n = 0
    for i in range(len(point)):
        right, down, z = in_sensor(point[i, 0], point[i, 1], point[i, 2], T)
        if not z > 1e-9:
            continue
        u, v = right / z * fx + cx, down / z * fy + cy
        if not (-0.5 <= u < W - 0.5 and -0.5 <= v < H - 0.5):
            continue
        column, row = np.int64(np.floor(u + 0.5)), np.int64(np.floor(v + 0.5))
        here = inverse(depth, row, column)
        error[n], room[n] = -1.0, 1.0
        if here > 0.0:
            error[n], room[n] = misfit(depth, row, column, here, u - column, v - row, z, noise)
        if room[n] > allowed and error[n] < 0.0:  # the spot is in front of all that its pixel shows
            for turn in range(3):
                a, b = towards(u - column, v - row, turn)
                there = inverse(depth, row + b, column + a)
                if there > 0.0:
                    _, room_there = misfit(depth, row + b, column + a, there, u - column - a, v - row - b, z, noise)
                    if room_there <= allowed:
                        column, row, here, room[n] = column + a, row + b, there, room_there
                        break
        if here == 0.0:
            continue
        spot[n], pixel[n], x[n], y[n] = i, row * W + column, u, v
        n += 1
    return n


@serial
def towards(dx, dy, turn):
    """Return the step to the next pixel towards (dx, dy): along the longer of them, the shorter, or both."""
    a, b = np.int64(1) if dx > 0.0 else np.int64(-1), np.int64(1) if dy > 0.0 else np.int64(-1)
    if turn == 2:
        return a, b
    return (a, np.int64(0)) if (turn == 0) == (abs(dx) > abs(dy)) else (np.int64(0), b)


@serial
def misfit(depth, row, column, here, dx, dy, z, noise):
    """Return how much nearer than depth z a pixel's surface is at (dx, dy) from its centre, and how far it is at least.

    Both are relative; see `project`.
    """
    if noise > 0.0:
        error = smoothed(depth, row, column, here, dx, dy, noise) * z - 1.0
        return error, abs(error)
    along_x, along_y = slopes(depth, row, column, here)
    error = (here + along_x * dx + along_y * dy) * z - 1.0
    return error, outside(depth, row, column, here, dx, dy, 1.0 / z) * z


@serial
def own_label(labels, unlabelled, row, column, K):
    """Return the label of a pixel: K for none, K + 1 for a pixel that is left out and does not answer."""
    label = np.int64(labels[row, column])
    if label < K:
        return label
    return np.int64(K) if unlabelled.shape[0] and unlabelled[row, column] else np.int64(K + 1)


@serial
def aside(side):
    """Return a step of one pixel to one of four sides."""
    sign = np.int64(1) if side & 2 else np.int64(-1)
    return (sign, np.int64(0)) if side & 1 else (np.int64(0), sign)


@serial
def first_side(seed, hashed):
    """Return the side at which the second answer for a spot is looked for first, 0 to 3: by frame and coarse cell."""
    return np.int64(mixed(np.uint32(np.uint32(seed) ^ hashed)) & np.uint32(3))


@serial
def two_labels(labels, unlabelled, row, column, step_x, step_y, K):
    """Return the labels of the next two pixels in a direction, K or more if one has none."""
    first = own_label(labels, unlabelled, row + step_y, column + step_x, K)
    last = own_label(labels, unlabelled, row + 2 * step_y, column + 2 * step_x, K)
    return (first, last) if max(first, last) < K else (np.int64(K), np.int64(K))


@serial
def shows(depth, row, column, here, along_x, along_y, dx, dy, allowed):
    """Return whether a pixel (dx, dy) away from another shows the surface that goes on there with these slopes."""
    there, expected = inverse(depth, row + dy, column + dx), here + along_x * dx + along_y * dy
    slack = 1.5 * allowed + SLACK * (abs(dx) + abs(dy)) * (abs(along_x) + abs(along_y)) / here
    return there > 0.0 and abs(there - expected) <= slack * here


@serial
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


# --- Entries in order of spot and view --------------------------------------------------------------------------------


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
