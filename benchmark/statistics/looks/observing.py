"""Compiled passes over entries in order of voxel and frame: what cells show, and what each look at a voxel says."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial
from semstab.statistics.looks.keys import DIGITS, SHIFTS, SPAN

FIRST, SECOND, THIRD = SHIFTS


@serial
def voxel_of(key):
    """The three voxel indices of a key, from where keys begin."""
    return key >> FIRST, (key >> SECOND) & (SPAN - 1), (key >> THIRD) & (SPAN - 1)


@serial
def extent(key, low, high):
    """Set low and high (3,) to the least and largest voxel index of each axis in keys (n,), 0 where there are none."""
    low[:], high[:] = SPAN - 1 if len(key) else 0, 0
    for i in range(len(key)):
        x, y, z = voxel_of(key[i])
        low[0], low[1], low[2] = min(low[0], x), min(low[1], y), min(low[2], z)
        high[0], high[1], high[2] = max(high[0], x), max(high[1], y), max(high[2], z)


@serial
def places(key, view, low, size, views, place):
    """A number (n,) for the voxel and frame of each entry, ascending with x, y, z and frame, of voxels in a box."""
    for i in range(len(key)):
        x, y, z = voxel_of(key[i])
        voxel = ((x - low[0]) * size[1] + (y - low[1])) * size[2] + (z - low[2])
        place[i] = voxel * views + view[i]


@serial
def gather(order, key, view, label, weight, own_key, own_view, own_label, own_weight):
    """Entries (n,) in that order, into columns of their own."""
    for i in range(len(order)):
        k = order[i]
        own_key[i], own_view[i], own_label[i], own_weight[i] = key[k], view[k], label[k], weight[k]


@serial
def settle(key, view, label, weight, cells, K, least, kept, shown):
    """Whether `least` frames or more saw each entry's cell, and the class with the largest sum of shares there.

    A frame's classes have shares of its pixels in the cell; the lowest class on ties. All arrays are (n,); a voxel has
    so many `cells`.
    """
    seen, pixels, sums = np.zeros(cells, np.int64), np.zeros(cells), np.zeros((cells, K))
    most, best, which = np.zeros(cells), np.zeros(cells, np.uint16), (1 << DIGITS) - 1
    start = 0
    while start < len(key):
        end, voxel = start, key[start] >> DIGITS
        while end < len(key) and key[end] >> DIGITS == voxel:
            first = end
            while end < len(key) and key[end] >> DIGITS == voxel and view[end] == view[first]:
                c = key[end] & which
                seen[c] += pixels[c] == 0.0
                pixels[c] += weight[end]
                end += 1
            for i in range(first, end):
                c = key[i] & which
                sums[c, label[i]] += weight[i] / pixels[c]
            for i in range(first, end):
                pixels[key[i] & which] = 0.0
        for i in range(start, end):
            c = key[i] & which
            own = sums[c, label[i]]
            if own > most[c] or (own == most[c] and label[i] < best[c]):
                most[c], best[c] = own, label[i]
        for i in range(start, end):
            c = key[i] & which
            kept[i], shown[i] = seen[c] >= least, best[c]
        for i in range(start, end):
            c = key[i] & which
            seen[c], most[c], sums[c, label[i]] = 0, 0.0, 0.0
        start = end


@serial
def look(key, view, label, weight, kept, K, first, of, pixels, starts, classes, shares):
    """The looks at voxels: of each its voxel, its pixels, and the share of each class among them, classes ascending.

    Only of what is kept. `first` is an entry of each look, `of` counts voxels that have one; returns how many looks,
    and how many classes of them together, there are. All arrays are as long as the entries, `starts` longer by one.
    """
    sums, met = np.zeros(K), np.empty(K, np.int64)
    n = m = start = 0
    voxels = -1
    before = np.int64(-1)
    starts[0] = 0
    while start < len(key):
        end, many, total, voxel = start, 0, 0.0, key[start] >> DIGITS
        while end < len(key) and key[end] >> DIGITS == voxel and view[end] == view[start]:
            if kept[end]:
                if sums[label[end]] == 0.0:
                    met[many] = label[end]
                    many += 1
                sums[label[end]] += weight[end]
                total += weight[end]
            end += 1
        if many:
            voxels += voxel != before
            before = voxel
            first[n], of[n], pixels[n] = start, voxels, total
            if many > 1:
                met[:many].sort()
            for own in met[:many]:
                classes[m], shares[m], sums[own] = own, sums[own] / total, 0.0
                m += 1
            n += 1
            starts[n] = m
        start = end
    return n, m
