"""Compiled passes over places of a depth image, in which new spots are looked for."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import helper, serial
from semstab.statistics.loops.cells import (
    EDGE,
    PHASE,
    SPAN,
    add_spot,
    fraction,
    hash_cell,
    is_new,
    key_of,
    mixed,
    slot_of,
)
from semstab.statistics.loops.surface import (
    area,
    depths_around,
    in_world,
    inverse,
    inverse_of,
    normal_of,
    plane_around,
    slope,
    slopes,
    turned,
)

MOST_PLACES = 1 << 16
"""Most places that are looked at in a block of pixels: a pixel of damaged depth may show thousands of kilometres."""

AT_ONCE = 64
"""Places that are looked at in one go, of many blocks."""


@serial
def number_of(expected, chance):
    """Return how many places to look at if `expected` are expected, by a number from 0 to 1; at most MOST_PLACES."""
    return np.int64(min(np.floor(expected + chance), MOST_PLACES))


@helper
def draw_place(top, left, stride, number):
    """Draw a place in a block of pixels: its hash, which follows `number` in a chain, and its image coordinates."""
    number = mixed(np.uint32(number + np.uint32(0x9E3779B9)))
    return number, left + stride * fraction(np.uint32(number ^ np.uint32(0x27D4EB2F))), top + stride * fraction(number)


@helper
def places_of_block(depth, camera, row, column, stride, per_area, chance):
    """Return how many places to look at in a block of pixels, by the area that it shows at a pixel."""
    fx, fy, cx, cy = camera
    here = inverse(depth, row, column)
    if here == 0.0:
        return np.int64(0)
    along_x, along_y = slopes(depth, row, column, here, stride)
    block_area = area(here, along_x, along_y, (column - cx) / fx, (row - cy) / fy, fx, fy) * stride * stride
    return number_of(per_area * block_area, chance)


@helper
def look_at(depth, camera, T, spacing, share, low, u, v, depths, here, cell, keys, rows):
    """Find the inverse depth of the pixels of places, and the keys of the coarse cells that they show.

    Returns how many places show a cell within reach and in the sample, and writes which in `rows`. shown (5, n) and
    cell (3, n) are work space, for the depth of the pixels and of those next to them, and for indices of cells from the
    lowest ones on. The loops are apart since arithmetic alone becomes vector instructions.
    """
    fx, fy, cx, cy = camera
    edge = EDGE * spacing
    for i in range(len(u)):
        around = depths_around(depth, np.int64(v[i]), np.int64(u[i]))
        depths[0, i], depths[1, i], depths[2, i], depths[3, i], depths[4, i] = around
    for i in range(len(u)):
        w = inverse_of(depths[0, i])
        along_x = slope(inverse_of(depths[1, i]), w, inverse_of(depths[2, i]))
        along_y = slope(inverse_of(depths[3, i]), w, inverse_of(depths[4, i]))
        dx, dy = u[i] - np.floor(u[i]) - 0.5, v[i] - np.floor(v[i]) - 0.5
        here[i], depths[0, i] = w, max(w + along_x * dx + along_y * dy, 0.5 * w)
    for i in range(len(u)):
        z = 1.0 / (depths[0, i] if depths[0, i] > 0.0 else 1.0)
        px, py, pz = in_world((u[i] - 0.5 - cx) / fx * z, (v[i] - 0.5 - cy) / fy * z, z, T)
        cell[0, i], cell[1, i] = index_from(px / edge, low[0]), index_from(py / edge, low[1])
        cell[2, i] = index_from(pz / edge, low[2])
    n = 0
    for i in range(len(u)):
        a, b, c = cell[0, i], cell[1, i], cell[2, i]
        least, most = min(a, b, c), max(a, b, c)
        drawn = hash_cell(a + low[0], b + low[1], c + low[2]) < share
        keys[n], rows[n] = key_of(a, b, c), i
        n += (here[i] > 0.0) & (least >= 0) & (most < SPAN) & drawn
    return n


@helper
def index_from(coordinate, low):
    """Return the index, from the lowest one on, of the cell of a coordinate in edges of cells; see `look_at`."""
    return np.int32(min(max(np.floor(coordinate + PHASE) - low, -1.0), np.float64(SPAN)))


@helper
def add_spots(
    depth, camera, T, allowed, spacing, share, low, table, point, hashed, n, met, u, v, depths, here, cell, keys, rows
):
    """Look at places, and add spots to n others; return how many spots there are, and how many cells were met."""
    fx, fy, cx, cy = camera
    count = look_at(depth, camera, T, spacing, share, low, u, v, depths, here, cell, keys, rows)
    found = 0
    for k in range(count):  # most cells were met, and are in the first slot: no branch, so memory is asked ahead
        keys[found], rows[found] = keys[k], rows[k]
        found += table[slot_of(table, keys[k])] != keys[k]
    for k in range(found):
        if not is_new(table, keys[k], False):
            continue
        i = rows[k]
        row, column = np.int64(v[i]), np.int64(u[i])
        w, along_x, along_y = plane_around(depth, row, column, here[i], allowed)
        there = w + along_x * (u[i] - 0.5 - column) + along_y * (v[i] - 0.5 - row)
        there = there if there > 0.5 * here[i] else here[i]
        x, y, z = (u[i] - 0.5 - cx) / fx, (v[i] - 0.5 - cy) / fy, 1.0 / there
        normal = turned(*normal_of(there, along_x, along_y, x, y, fx, fy), T)
        n, met = add_spot(in_world(x * z, y * z, z, T), normal, spacing, share, low, table, point, hashed, n, met)
        if met == len(hashed):
            break
    return n, met


@serial
def new_in_image(depth, camera, T, allowed, spacing, share, low, stride, factor, density, seed, table, point, hashed):
    """Add spots where an image shows coarse cells that were not met before; return how many, and of how many cells.

    Places are looked at evenly over the surface, `density` in the square of the spacing: in all blocks of stride x
    stride pixels, in an order that jumps over the image by `factor`, as many as the area that a block shows asks for. A
    place lies anywhere in its pixel, so that the view that finds a spot meets it as any other view does.
    """
    surface = depth, camera, T, allowed, spacing, share, low, table, point, hashed
    u, v, here, depths = np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty((5, AT_ONCE))
    cell, keys, rows = np.empty((3, AT_ONCE), np.int32), np.empty(AT_ONCE, np.int64), np.empty(AT_ONCE, np.int64)
    columns = (depth.shape[1] + stride - 1) // stride
    total = (depth.shape[0] + stride - 1) // stride * columns
    at, per_area, count, n, met = np.int64(seed % total), density / (spacing * spacing), 0, 0, 0
    for _ in range(total):
        at += factor
        if at >= total:
            at -= total
        top, left = stride * (at // columns), stride * (at % columns)
        number = np.uint32(np.uint32(seed) ^ (np.uint32(at) * np.uint32(0x85EBCA6B)))
        number, u[count], v[count] = draw_place(top, left, stride, number)
        row, column = np.int64(v[count]), np.int64(u[count])
        chance = fraction(np.uint32(number ^ np.uint32(0x165667B1)))
        places = places_of_block(depth, camera, row, column, stride, per_area, chance)
        while places > 0:
            count, places = count + 1, places - 1
            if count == AT_ONCE:
                n, met = add_spots(*surface, n, met, u, v, depths, here, cell, keys, rows)
                count = 0
                if met == len(hashed):
                    return n, met
            if places > 0:
                number, u[count], v[count] = draw_place(top, left, stride, number)
    return add_spots(*surface, n, met, u[:count], v[:count], depths, here, cell, keys, rows)
