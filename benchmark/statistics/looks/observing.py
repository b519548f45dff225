"""Compiled passes over entries in order of voxel and frame: what cells show, and what each look at a voxel says."""

from __future__ import annotations

import numpy as np

from semstab.runtime.compiled import serial


@serial
def settle(voxel, view, child, label, weight, cells, K, least, kept, shown):
    """Whether `least` frames or more saw each entry's cell, and the class with the largest sum of shares there.

    A frame's classes have shares of its pixels in the cell; the lowest class on ties. All arrays are (n,); `child` is
    the number of the cell in its voxel, which has so many `cells`.
    """
    seen, pixels, sums = np.zeros(cells, np.int64), np.zeros(cells), np.zeros((cells, K))
    most, best = np.zeros(cells), np.zeros(cells, np.int64)
    start = 0
    while start < len(voxel):
        end = start
        while end < len(voxel) and voxel[end] == voxel[start]:
            first = end
            while end < len(voxel) and voxel[end] == voxel[first] and view[end] == view[first]:
                seen[child[end]] += pixels[child[end]] == 0.0
                pixels[child[end]] += weight[end]
                end += 1
            for i in range(first, end):
                sums[child[i], label[i]] += weight[i] / pixels[child[i]]
            for i in range(first, end):
                pixels[child[i]] = 0.0
        for i in range(start, end):
            c, own = child[i], sums[child[i], label[i]]
            if own > most[c] or (own == most[c] and label[i] < best[c]):
                most[c], best[c] = own, label[i]
        for i in range(start, end):
            kept[i], shown[i] = seen[child[i]] >= least, best[child[i]]
        for i in range(start, end):
            c = child[i]
            seen[c], most[c], sums[c, label[i]] = 0, 0.0, 0.0
        start = end


@serial
def look(voxel, view, label, weight, kept, K, first, of, pixels, starts, classes, shares):
    """The looks at voxels: of each its voxel, its pixels, and the share of each class among them, classes ascending.

    Only of what is kept. `first` is an entry of each look, `of` counts voxels that have one; returns how many looks,
    and how many classes of them together, there are. All arrays are as long as the entries, `starts` longer by one.
    """
    sums, met = np.zeros(K), np.empty(K, np.int64)
    n = m = start = 0
    voxels = -1
    before = np.int64(-1)
    starts[0] = 0
    while start < len(voxel):
        end, many, total = start, 0, 0.0
        while end < len(voxel) and voxel[end] == voxel[start] and view[end] == view[start]:
            if kept[end]:
                if sums[label[end]] == 0.0:
                    met[many] = label[end]
                    many += 1
                sums[label[end]] += weight[end]
                total += weight[end]
            end += 1
        if many:
            voxels += voxel[start] != before
            before = voxel[start]
            first[n], of[n], pixels[n] = start, voxels, total
            met[:many].sort()
            for own in met[:many]:
                classes[m], shares[m], sums[own] = own, sums[own] / total, 0.0
                m += 1
            n += 1
            starts[n] = m
        start = end
    return n, m
