"""Compiled loops from the pixels of a row, or the points of a scan, to packed voxel keys."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.keys import HALF
from semstab.core.compiled import serial
from semstab.core.types import Int64, Mask
from semstab.data.frames import Frame

FACE = 2.0**30
"""Index from which on rounding may move a point across a face by more than the margin of one millionth."""


@serial
def in_voxels(r0, r1, r2, t, x, y, z, size):
    """Return a coordinate of a point of the camera in the map, in voxels; the order of operations is the protocol's."""
    return (((r0 * x + r1 * y) + r2 * z) + t) / size


@serial
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


@serial
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


@serial
def packed_near(a, b, c):
    """Return the packed key of a voxel, whole numbers from the origin; -1 where it is out of reach."""
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
    pose = np.ascontiguousarray(frame.T_wc)
    if frame.points is not None:
        drawn: Mask = drawn_points(frame.points, frame.valid, pose, size, odd, one_in)
    else:
        K = frame.intrinsics
        drawn = drawn_pixels(frame.depth, frame.valid, (K.fx, K.fy, K.cx, K.cy), pose, size, odd, one_in)
    return drawn


@serial
def drawn_points(points, wanted, T, size, odd, one_in):
    """Return the wanted points (H, W), of (H, W, 3), that may fall into a voxel of the sample, see `drawn_of`."""
    out = np.zeros(wanted.shape, dtype=np.bool_)
    for v in range(wanted.shape[0]):
        for u in range(wanted.shape[1]):
            x, y, z = np.float64(points[v, u, 0]), np.float64(points[v, u, 1]), np.float64(points[v, u, 2])
            out[v, u] = wanted[v, u] and _may_be_drawn(x, y, z, T, size, odd, one_in)
    return out


@serial
def _may_be_drawn(x, y, z, T, size, odd, one_in):
    mixed, near = np.int64(0), False
    for axis in range(3):
        q = in_voxels(T[axis, 0], T[axis, 1], T[axis, 2], T[axis, 3], x, y, z, size)
        low = np.floor(q)
        near |= not (1e-6 < q - low < 1 - 1e-6 and abs(q) < FACE)
        mixed += np.int64(low) * odd[axis] if abs(q) < FACE else 0
    return near or ((mixed >> 40) & (one_in - 1)) == 0


@serial
def drawn_pixels(depth, wanted, camera, T, size, odd, one_in):
    """Return the wanted pixels (H, W) that may fall into a voxel of the sample, see `drawn_of`."""
    fx, fy, cx, cy = camera
    out = np.zeros(depth.shape, dtype=np.bool_)
    for v in range(depth.shape[0]):
        ray_y = (v - cy) / fy
        for u in range(depth.shape[1]):
            if not wanted[v, u]:
                continue
            d = np.float64(depth[v, u])
            out[v, u] = _may_be_drawn((u - cx) / fx * d, ray_y * d, d, T, size, odd, one_in)
    return out


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


@intrinsic
def bits_of(_typing: Any, _value: Any) -> Any:
    """Return the bits of a double, as int64; those of numbers from 0 on sort like the numbers."""
    return types.int64(types.float64), lambda _, builder, __, given: builder.bitcast(given[0], ir.IntType(64))
