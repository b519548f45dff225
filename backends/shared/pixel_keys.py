"""Compiled loops from the pixels of a row, or the points of a scan, to packed voxel keys."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.keys import HALF
from semstab.core.compiled import compiled, helper, serial
from semstab.core.types import Int64, Mask
from semstab.data.frames import Frame

FACE = 2.0**30
"""Index from which on rounding may move a point across a face by more than the margin of one millionth."""


@helper
def in_voxels(r0, r1, r2, t, x, y, z, size):
    """Return a coordinate of a point of the camera in the map, in voxels; the order of operations is the protocol's."""
    return (((r0 * x + r1 * y) + r2 * z) + t) / size


@helper
def exact_keys_of_row(depth, labels, ray_x, ray_y, T, size, ox, oy, oz, ignore, out):
    """Return packed keys of a row of pixels, -1 where a pixel does not count.

    Returns 1 where one is out of reach, else 0.

    One loop without branches, which the compiler turns into vector instructions.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    lost = 0
    for u in range(depth.shape[0]):
        d = np.float64(depth[u])
        ok = (d > 0.0) & (d < np.inf) & (labels[u] != ignore)
        d = d if ok else 0.0
        x = ray_x[u] * d
        y = ray_y * d
        a = np.floor(in_voxels(r00, r01, r02, t0, x, y, d, size)) - ox
        b = np.floor(in_voxels(r10, r11, r12, t1, x, y, d, size)) - oy
        c = np.floor(in_voxels(r20, r21, r22, t2, x, y, d, size)) - oz
        key = packed_near(a, b, c)
        lost |= 1 if ok & (key < 0) else 0
        out[u] = key if ok else -1
    return lost


@helper
def exact_keys_of_points(points, depth, labels, T, size, ox, oy, oz, ignore, out):
    """Return packed keys of points (n, 3) of a scan, as `exact_keys_of_row` of pixels; where depth is 0 there is none.

    Returns 1 where one is out of reach, else 0.
    """
    r00, r01, r02, t0 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, t1 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, t2 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    lost = 0
    for u in range(depth.shape[0]):
        ok = (depth[u] > 0.0) & (depth[u] < np.inf) & (labels[u] != ignore)
        x = np.float64(points[u, 0]) if ok else 0.0
        y = np.float64(points[u, 1]) if ok else 0.0
        z = np.float64(points[u, 2]) if ok else 0.0
        a = np.floor(in_voxels(r00, r01, r02, t0, x, y, z, size)) - ox
        b = np.floor(in_voxels(r10, r11, r12, t1, x, y, z, size)) - oy
        c = np.floor(in_voxels(r20, r21, r22, t2, x, y, z, size)) - oz
        key = packed_near(a, b, c)
        lost |= 1 if ok & (key < 0) else 0
        out[u] = key if ok else -1
    return lost


@helper
def packed_near(a, b, c):
    """Return the packed key of a voxel given as whole numbers from the origin, or -1 if it is out of reach."""
    low, high = -float(HALF), float(HALF - 1)
    near = (a >= low) & (a <= high) & (b >= low) & (b <= high) & (c >= low) & (c <= high)
    i = np.int64(np.int32(a if near else 0.0)) + HALF
    j = np.int64(np.int32(b if near else 0.0)) + HALF
    k = np.int64(np.int32(c if near else 0.0)) + HALF
    return ((i << 42) | (j << 21) | k) if near else np.int64(-1)


def drawn_of(frame: Frame, size: float, odd: Int64, one_in: int) -> Mask:
    """Return the valid pixels (H, W) that may fall into a voxel of the sample: all that do, and those close to a face.

    A filter for the numpy reference, which decides on the pixels that are left by itself.
    """
    pose, odds = tuple(map(tuple, frame.T_wc[:3].tolist())), tuple(odd.tolist())
    mask = np.empty(frame.shape, np.bool_)
    if frame.points is not None:
        drawn_points(frame.points, frame.valid, pose, size, odds, one_in, mask)
    else:
        drawn_pixels(frame.depth, frame.valid, *frame.rays, pose, size, odds, one_in, mask)
    return mask


@serial
def drawn_points(points, wanted, pose, size, odd, one_in, out):
    """Mark the wanted points (H, W), of (H, W, 3), that may fall into a voxel of the sample, see `drawn_of`."""
    for v in range(wanted.shape[0]):
        for u in range(wanted.shape[1]):
            x, y, z = np.float64(points[v, u, 0]), np.float64(points[v, u, 1]), np.float64(points[v, u, 2])
            out[v, u] = wanted[v, u] & _may_be_drawn(x, y, z, pose, size, odd, one_in)


@serial
def drawn_pixels(depth, wanted, ray_x, ray_y, pose, size, odd, one_in, out):
    """Mark the wanted pixels (H, W) that may fall into a voxel of the sample, see `drawn_of`."""
    for v in range(depth.shape[0]):
        drawn_row(depth[v], wanted[v], ray_x, ray_y[v], pose, size, odd, one_in, out[v])


@helper
def drawn_row(depth, wanted, ray_x, ray_y, pose, size, odd, one_in, out):
    """Mark pixels of a row; without a branch, for vectors."""
    for u in range(depth.shape[0]):
        d = np.float64(depth[u])
        out[u] = wanted[u] & _may_be_drawn(ray_x[u] * d, ray_y * d, d, pose, size, odd, one_in)


@helper
def _may_be_drawn(x, y, z, pose, size, odd, one_in):
    (r00, r01, r02, t0), (r10, r11, r12, t1), (r20, r21, r22, t2) = pose
    a = in_voxels(r00, r01, r02, t0, x, y, z, size)
    b = in_voxels(r10, r11, r12, t1, x, y, z, size)
    c = in_voxels(r20, r21, r22, t2, x, y, z, size)
    clear = _is_clear(a) & _is_clear(b) & _is_clear(c)
    i, j, k = np.floor(a), np.floor(b), np.floor(c)
    i, j, k = i if clear else 0.0, j if clear else 0.0, k if clear else 0.0
    mixed = np.int64(np.int32(i)) * odd[0] + np.int64(np.int32(j)) * odd[1] + np.int64(np.int32(k)) * odd[2]
    return (not clear) | (((mixed >> 40) & (one_in - 1)) == 0)


@helper
def _is_clear(q):
    """Return whether a coordinate in voxels is not close to a face, and near enough to tell."""
    part = q - np.floor(q)
    return (part > 1e-6) & (part < 1 - 1e-6) & (np.abs(q) < FACE)


def columns_of(within, origin):
    """Return the lowest and highest but one of the first two coordinates, as packed keys count, (4,).

    The result is (0,) for all voxels.
    """
    if within is None:
        return np.zeros(0, dtype=np.int64)
    (x0, y0), (x1, y1) = within.low, within.high
    edges = np.array([x0, x1, y0, y1]) - np.repeat(origin[:2], 2) + HALF
    return np.clip(edges, 0, 2 * HALF).astype(np.int64)


# Asking for memory before it is needed, in compiled loops.

AHEAD = 16
"""Rows whose memory is asked for before their turn comes."""


@intrinsic
def touch(_typing: Any, array: Any, _index: Any) -> Any:
    """Bring row i of an array (n,) into the cache; nothing waits for it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        pointer = cgutils.get_item_pointer(
            context, builder, signature.args[0], values, [arguments[1]], wraparound=False
        )
        ask_for(builder, pointer)
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def ask_for(builder: Any, pointer: Any) -> None:
    """Write code that asks for the memory at a pointer, to be written; there need be none."""
    number = ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
    prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
    to_write, keep, data = (ir.Constant(number, value) for value in (1, 3, 1))
    builder.call(prefetch, [builder.bitcast(pointer, cgutils.voidptr_t), to_write, keep, data])


# Doubles as the integers of the same bits, in compiled loops.


@compiled(helper=True, forceinline=True)
def bits_of(value):
    """Return the bits of a double as int64; the bits of non-negative numbers sort like the numbers."""
    return np.float64(value).view(np.int64)
