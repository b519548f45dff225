"""Compiled passes for maps at several voxel sizes: voxels in an order in which those of a larger one are together."""

from __future__ import annotations

import numpy as np

from semstab.backends.shared.keys import HALF
from semstab.backends.shared.pixel_keys import keys_of_row
from semstab.core.compiled import serial


@serial
def keys_of(depth, valid, ray_x, ray_y, T, size, origin, rays, margin, keys):
    """Packed keys (H, W) of a frame's pixels, -1 where one is not valid; whether one of them is out of reach."""
    lost = 0
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    for v in range(len(depth)):
        lost |= keys_of_row(
            depth[v], valid[v], ray_x, ray_y[v], T, size, ox, oy, oz, 0, rays, margin, keys[v]
        )  # fmt: skip
    return lost


@serial
def lowest(keys, low):
    """Lower low (3,) to the lowest index of each axis in packed keys (n,)."""
    mask = np.uint64(2 * HALF - 1)
    for i in range(len(keys)):
        key = np.uint64(keys[i])
        low[0] = min(low[0], key >> np.uint64(42))
        low[1] = min(low[1], (key >> np.uint64(21)) & mask)
        low[2] = min(low[2], key & mask)


@serial
def interleave(keys, low, code):
    """Codes (n,) of packed keys: of each axis, from `low` on, every third bit (Morton 1966).

    In their order the voxels of one twice, or four times, as large follow each other: it is the code without the last
    three bits, or six.
    """
    mask = np.uint64(2 * HALF - 1)
    for i in range(len(keys)):
        key = np.uint64(keys[i])
        x, y, z = (key >> np.uint64(42)) - low[0], ((key >> np.uint64(21)) & mask) - low[1], (key & mask) - low[2]
        code[i] = np.int64((spread(x) << np.uint64(2)) | (spread(y) << np.uint64(1)) | spread(z))


@serial
def spread(x):
    """A number of 21 bits with two zeros before each."""
    x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@serial
def look_at_voxel(code, shift, frame, many, start, pixels):
    """Count the pixels of each frame in the voxel that begins there; where it ends, and how many frames saw it."""
    end, T = start, 0
    while end < len(code) and (code[end] >> shift) == (code[start] >> shift):
        T += pixels[frame[end]] == 0.0
        pixels[frame[end]] += many[end]
        end += 1
    return end, T


@serial
def runs(code, order, frame, label, run_code, run_frame, run_label, many):
    """Pixels (n,) by their codes, ascending, those of one frame and label in a row once; returns how many that makes.

    order  (n,) which of the frames and labels (n,) each of the codes has
    many   of how many pixels each is
    """
    m = -1
    for k in range(len(code)):
        own, its_frame, its_label = code[k], frame[order[k]], label[order[k]]
        if m < 0 or own != run_code[m] or its_frame != run_frame[m] or its_label != run_label[m]:
            m += 1
            run_code[m], run_frame[m], run_label[m], many[m] = own, its_frame, its_label, 0
        many[m] += 1
    return m + 1


@serial
def sums_of_labels(code, frame, label, many, shift, frames, K):
    """What `alpha_sums` gives of the map whose voxels are the codes (n,), ascending, without their last bits."""
    sums, count, pixels, e = np.zeros(3 + K), np.zeros((frames, K)), np.zeros(frames), np.zeros(K)
    start = 0
    while start < len(code):
        end, T = look_at_voxel(code, shift, frame, many, start, pixels)
        for i in range(start, end):
            count[frame[i], label[i]] += many[i]
        own = 0.0
        for i in range(start, end):
            s = count[frame[i], label[i]] / pixels[frame[i]]  # 0 where its frame and label came before
            count[frame[i], label[i]] = 0.0
            own += s * s
            e[label[i]] += s
        both = 0.0
        for i in range(start, end):
            if T >= 2:
                sums[3 + label[i]] += e[label[i]]
            both += e[label[i]] ** 2
            e[label[i]] = pixels[frame[i]] = 0.0
        add_voxel(sums, T, both, own)
        start = end
    return sums


@serial
def sums_of_scores(code, shift, frame, many, pixel, scores, frames):
    """The same of scores, of which pixel (n,) names the row in scores (m, K)."""
    K = scores.shape[1]
    sums, s, pixels, e = np.zeros(3 + K), np.zeros((frames, K)), np.zeros(frames), np.zeros(K)
    start = 0
    while start < len(code):
        end, T = look_at_voxel(code, shift, frame, many, start, pixels)
        own = both = 0.0
        if T >= 2:
            for i in range(start, end):
                row, total = scores[pixel[i]], 0.0
                for k in range(K):
                    total += row[k]
                total *= pixels[frame[i]]
                for k in range(K):
                    s[frame[i], k] += row[k] / total
            for i in range(start, end):
                if pixels[frame[i]] == 0.0:
                    continue
                pixels[frame[i]] = 0.0
                for k in range(K):
                    own += s[frame[i], k] ** 2
                    e[k] += s[frame[i], k]
                    s[frame[i], k] = 0.0
            for k in range(K):
                both += e[k] ** 2
                sums[3 + k] += e[k]
                e[k] = 0.0
        for i in range(start, end):
            pixels[frame[i]] = 0.0
        add_voxel(sums, T, both, own)
        start = end
    return sums


@serial
def add_voxel(sums, T, both, own):
    """Add T PSA, T and the sum of ||s||^2 of a voxel that T frames saw, from ||e||^2 and that sum."""
    if T >= 2:
        sums[0] += min(max((both - own) / (T - 1), 0.0), float(T))
        sums[1] += T
        sums[2] += own
