"""Compiled passes over a frame's pixels: they select those of a sampled voxel, and group them by cell and class."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.pixel_keys import in_voxels
from semstab.core.compiled import serial
from semstab.statistics.loops import CELLS, DIGITS, SHIFTS, WITHIN

FIRST, SECOND, THIRD = SHIFTS
HIGH, MIDDLE, LOW = WITHIN

ALONG_X, ALONG_Y, ALONG_Z = np.uint32(0xD1B54A33), np.uint32(0xABC98389), np.uint32(0x8CB92BA7)
"""Weights of a voxel's indices in its hash: 2^32 / g^k of the root g of g^4 = g + 1, so that along no line and in no
plane the same sum comes again soon (Roberts 2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

HELD = 1024
"""Pixels whose cells are computed together: as many as stay in a core's nearest cache."""

GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@serial
def hash_row(at_x, at_y, at_z, hashed):
    """Hash blocks (n,) to uint32: by the weighted sum of their indices modulo 2^32, one hash for each sum.

    It is mixed as in lowbias32 (Wellons 2018, Prospecting for Hash Functions). Products of 32 bits are vector
    instructions on every processor, those of 64 are not.
    """
    for u in range(len(hashed)):
        x, y, z = np.uint32(at_x[u]), np.uint32(at_y[u]), np.uint32(at_z[u])
        h = np.uint32(np.uint32(x * ALONG_X) + np.uint32(y * ALONG_Y) + np.uint32(z * ALONG_Z))
        h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
        h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
        hashed[u] = h ^ (h >> np.uint32(16))


@serial
def draw(depth, points, valid, labels, ray_x, ray_y, T, size, share, origin, reach, cell, drawn, label):
    """Write key of the cell, hash and label of the pixels that show a sampled block; return the number of pixels.

    - `points`: (H, W, 3) of a scan, for which rays do not count; (0, 0, 3) of an image
    """
    n = held = 0
    H, W = depth.shape
    at, hashed, last = np.empty((3, W), np.int32), np.empty(W, np.uint32), np.uint32(share - 1)
    selected = np.empty(W, np.int32)
    x, y, z = np.empty(HELD + W), np.empty(HELD + W), np.empty(HELD + W)
    for v in range(H):
        if points.shape[0]:
            locate_points(points[v], T, size, at[0], at[1], at[2])
        else:
            locate_row(depth[v], ray_x, ray_y[v], T, size, at[0], at[1], at[2])
        hash_row(at[0], at[1], at[2], hashed)
        end = 0
        for u in range(W):  # without a branch: it could not be predicted where depth is noisy
            selected[end] = u
            end += hashed[u] <= last
        for u in selected[:end]:
            if points.shape[0]:
                x[held], y[held], z[held] = points[v, u, 0], points[v, u, 1], points[v, u, 2]
            else:
                d = np.float64(depth[v, u])
                x[held], y[held], z[held] = ray_x[u] * d, ray_y[v] * d, d
            drawn[n], label[n] = hashed[u], labels[v, u]
            n += valid[v, u]
            held += valid[v, u]
        if held >= HELD or v == H - 1:
            cells_of(x[:held], y[:held], z[:held], T, size, origin, reach, cell[n - held : n])
            held = 0
    return n


@serial
def locate_row(depth, ray_x, ray_y, T, size, at_x, at_y, at_z):
    """Find the block of each pixel of a row, any of invalid ones; without a branch, for vectors."""
    x0, x1, x2, x3 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    y0, y1, y2, y3 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    z0, z1, z2, z3 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for u in range(len(depth)):
        z = np.float64(depth[u])
        x, y = ray_x[u] * z, ray_y * z
        at_x[u] = np.int32(np.floor(in_voxels(x0, x1, x2, x3, x, y, z, size)))
        at_y[u] = np.int32(np.floor(in_voxels(y0, y1, y2, y3, x, y, z, size)))
        at_z[u] = np.int32(np.floor(in_voxels(z0, z1, z2, z3, x, y, z, size)))


@serial
def locate_points(points, T, size, at_x, at_y, at_z):
    """Find the block of each point (n, 3) of a scan, any of invalid ones, as `locate_row` finds those of pixels."""
    x0, x1, x2, x3 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    y0, y1, y2, y3 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    z0, z1, z2, z3 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for u in range(len(points)):
        x, y, z = np.float64(points[u, 0]), np.float64(points[u, 1]), np.float64(points[u, 2])
        at_x[u] = np.int32(np.floor(in_voxels(x0, x1, x2, x3, x, y, z, size)))
        at_y[u] = np.int32(np.floor(in_voxels(y0, y1, y2, y3, x, y, z, size)))
        at_z[u] = np.int32(np.floor(in_voxels(z0, z1, z2, z3, x, y, z, size)))


@serial
def cells_of(at_x, at_y, at_z, T, size, origin, reach, key):
    """Write keys (n,) of the cells of points of the camera, see `keys_of`; -1 out of reach."""
    x0, x1, x2, x3, low_x = T[0, 0], T[0, 1], T[0, 2], T[0, 3], float(origin[0] - reach)
    y0, y1, y2, y3, low_y = T[1, 0], T[1, 1], T[1, 2], T[1, 3], float(origin[1] - reach)
    z0, z1, z2, z3, low_z = T[2, 0], T[2, 1], T[2, 2], T[2, 3], float(origin[2] - reach)
    span = float(2 * reach)
    for n in range(len(key)):
        x, y, z = at_x[n], at_y[n], at_z[n]
        a = in_voxels(x0, x1, x2, x3, x, y, z, size)
        b = in_voxels(y0, y1, y2, y3, x, y, z, size)
        c = in_voxels(z0, z1, z2, z3, x, y, z, size)
        i, j, k = np.floor(a), np.floor(b), np.floor(c)
        child = (digit(a - i) << HIGH) | (digit(b - j) << MIDDLE) | (digit(c - k) << LOW)
        i, j, k = i - low_x, j - low_y, k - low_z
        near = (i >= 0.0) & (i < span) & (j >= 0.0) & (j < span) & (k >= 0.0) & (k < span)
        i, j, k = i if near else 0.0, j if near else 0.0, k if near else 0.0
        voxel = (np.int64(np.int32(i)) << FIRST) | (np.int64(np.int32(j)) << SECOND) | (np.int64(np.int32(k)) << THIRD)
        key[n] = voxel | child if near else np.int64(-1)


@serial
def digit(part):
    """Return the cell along a voxel's edge that a part of it, from 0 to 1, falls in."""
    cell = part * CELLS
    return np.int64(np.int32(cell if cell < CELLS else CELLS - 1.0))


@serial
def grouped(cell, label, drawn, pixels):
    """Move each pair of a cell and a label to the front, once, in order of appearance, and count its pixels (n,).

    Return the number of pairs. Those of one block lie side by side in the table, as they do in the image. A branch on
    whether a pixel's cell is new could not be predicted, so there is none.
    """
    bits = 7
    while len(cell) > 1 << bits:
        bits += 1
    table, mask, shift = np.full(2 << bits, -1, np.int32), (2 << bits) - 1, np.uint64(69 - bits)
    n = 0
    for i in range(len(cell)):
        own, its_label = cell[i], label[i]
        near = np.int64((np.uint64((own >> DIGITS) ^ (np.int64(its_label) << 48)) * GOLDEN) >> shift)
        slot = near << DIGITS | (own & ((1 << DIGITS) - 1))
        there = table[slot] if table[slot] >= 0 else i
        while (cell[there] != own) | (label[there] != its_label):
            slot = (slot + 1) & mask
            there = table[slot] if table[slot] >= 0 else i
        cell[n], label[n], drawn[n], pixels[n] = own, its_label, drawn[i], 0.0  # the next pair, if it is new
        new = table[slot] < 0
        number = n if new else there
        table[slot] = number
        n += new
        pixels[number] += 1.0
    return n


# The compiled pass over entries in order of cell and view.


@serial
def observe(number, view, label, weight, K, first, of, pixels, starts, classes, shares):
    """Write each observation: its cell, its pixels, and the share of each class among them, classes ascending.

    number, view (m,) are the cell and the view of each entry, in order. `first` is an entry of each observation, `of`
    counts cells; returns the number of observations, and the number of their classes together. All arrays are as long
    as the entries, `starts` is longer by one.
    """
    sums, met = np.zeros(K), np.empty(K, np.int64)
    n = m = start = 0
    cells = -1
    before = np.int64(-1)
    starts[0] = 0
    while start < len(number):
        end, many, total, cell = start, 0, 0.0, number[start]
        while end < len(number) and number[end] == cell and view[end] == view[start]:
            if sums[label[end]] == 0.0:
                met[many] = label[end]
                many += 1
            sums[label[end]] += weight[end]
            total += weight[end]
            end += 1
        cells += cell != before
        before = cell
        first[n], of[n], pixels[n] = start, cells, total
        if many > 1:
            met[:many].sort()
        for own in met[:many]:
            classes[m], shares[m], sums[own] = own, sums[own] / total, 0.0
            m += 1
        n += 1
        starts[n] = m
        start = end
    return n, m
