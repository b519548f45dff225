"""Observations from the soft scores of a frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from semstab.backends.shared.keys import PARTITIONS, mix, partition_of
from semstab.backends.shared.pixel_keys import exact_keys_of_points, exact_keys_of_row
from semstab.backends.shared.tile_loops import runs_of
from semstab.core.compiled import helper, parallel

# Sums over the scores of pixels, eight classes at a time, for compiled loops.
#
# Scores are flat arrays of float32 or float64, or of half-precision numbers by their bits (uint16), since compiled code
# knows no such type. They are added up in float64, in an order that depends on the number of classes only. A pixel's
# last classes are read together with the numbers that follow them: behind the last pixel there must be `LANES` numbers
# of whatever value.

LANES = 8

NUMBERS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType(), types.uint16: ir.HalfType()}

INT, INT32, DOUBLE = ir.IntType(64), ir.IntType(32), ir.DoubleType()
DOUBLES, INTS = ir.VectorType(DOUBLE, LANES), ir.VectorType(INT, LANES)
ZEROS = ir.Constant(DOUBLES, [0.0] * LANES)


@intrinsic
def scale_eight(_typing: Any, scores: Any, _at: Any, _K: Any, keys: Any, scale: Any, _u: Any) -> Any:
    """Invert the sum of each of eight pixels' scores, from scores[at] on.

    Arguments: scores, at, K, keys, scale, u.
    Leaves the result in scale[u : u + 8]; a key in keys[u : u + 8], int64, becomes -1 if the sum is not a positive
    number.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, offset, K, _, _, u = arguments
        pixels = [builder.add(offset, builder.mul(K, INT(pixel))) for pixel in range(LANES)]
        total = _folded(builder, _sums(context, builder, signature.args[0], array, pixels, K))
        key, scales = (
            builder.bitcast(builder.gep(_data(context, builder, signature, arguments, i), [u]), kind.as_pointer())
            for i, kind in ((3, INTS), (4, DOUBLES))
        )
        sound = builder.and_(
            builder.fcmp_ordered(">", total, ZEROS),
            builder.fcmp_ordered("<", total, ir.Constant(DOUBLES, [float("inf")] * LANES)),
        )
        chosen = builder.select(sound, builder.load(key, align=8), ir.Constant(INTS, [-1] * LANES))
        builder.store(chosen, key, align=8)
        builder.store(builder.fdiv(ir.Constant(DOUBLES, [1.0] * LANES), total), scales, align=8)
        return context.get_dummy_value()

    number = types.intp
    return types.void(scores, number, number, keys, scale, number), generate


@intrinsic
def add_two(
    _typing: Any, scores: Any, _at: Any, _K: Any, scale: Any, _u: Any, _end: Any, sums: Any, _to: Any, _fresh: Any
) -> Any:
    """Add u's scores and the next pixel's to their voxel.

    Arguments: scores, at, K, scale, u, end, sums, to, fresh.
    sums[to : to + K] += scale[u] * scores[at + u * K : at + (u + 1) * K], or = if `fresh`, and the same for u + 1 if
    u + 1 is below `end`. Pixel u + 1 is read in any case, without a branch, and must exist.

    `sums` is float64, and has room for a multiple of `LANES` values at `to`: values beyond K get 0 added.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, offset, K, _, u, end, _, to, fresh = arguments
        pixels = [u, builder.add(u, INT(1))]
        offsets = [builder.add(offset, builder.mul(K, pixel)) for pixel in pixels]
        counted = [builder.icmp_signed("<", pixel, end) for pixel in pixels]
        scales = _data(context, builder, signature, arguments, 3)
        factors = [
            spread(builder, builder.select(counts, builder.load(builder.gep(scales, [pixel])), DOUBLE(0.0)), DOUBLES)
            for pixel, counts in zip(pixels, counted, strict=True)
        ]
        row = builder.gep(_data(context, builder, signature, arguments, 6), [to])

        def add(values: list[Any], k: Any) -> None:
            pointer = builder.bitcast(builder.gep(row, [k]), DOUBLES.as_pointer())
            total = builder.select(fresh, ZEROS, builder.load(pointer, align=8))
            for value, factor, counts in zip(values, factors, counted, strict=True):
                scaled = builder.fmul(builder.select(counts, value, ZEROS), factor, flags=["contract"])
                total = builder.fadd(total, scaled, flags=["contract"])
            builder.store(total, pointer, align=8)

        _by_eights(context, builder, signature.args[0], array, offsets, K, add)
        return context.get_dummy_value()

    number = types.intp
    return types.void(scores, number, number, scale, number, number, sums, number, types.boolean), generate


def _data(context: Any, builder: Any, signature: Any, arguments: Any, i: int) -> Any:
    return context.make_array(signature.args[i])(context, builder, arguments[i]).data


def _sums(context: Any, builder: Any, kind: Any, array: Any, offsets: list[Any], K: Any) -> list[Any]:
    """Return for each offset the vector of sums of every eighth of the K numbers from there on."""
    totals = [cgutils.alloca_once_value(builder, ZEROS) for _ in offsets]
    for total in totals:
        builder.store(ZEROS, total)

    def add(values: list[Any], _: Any) -> None:
        for total, value in zip(totals, values, strict=True):
            builder.store(builder.fadd(builder.load(total), value), total)

    _by_eights(context, builder, kind, array, offsets, K, add)
    return [builder.load(total) for total in totals]


def _folded(builder: Any, vectors: list[Any]) -> Any:
    """Return the sums of the lanes of eight vectors, as one vector.

    The lanes of each are halved three times, in pairs.
    """
    lanes = LANES
    while len(vectors) > 1:
        half = lanes // 2
        first = [i for i in range(2 * LANES) if i % lanes < half]
        low, high = (ir.Constant(ir.VectorType(INT32, LANES), [i + by for i in first]) for by in (0, half))
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [
            builder.fadd(builder.shuffle_vector(a, b, low), builder.shuffle_vector(a, b, high)) for a, b in pairs
        ]
        lanes = half
    return vectors[0]


def _by_eights(
    context: Any, builder: Any, kind: Any, array: Any, offsets: list[Any], K: Any,
    do: Callable[[list[Any], Any], None],
) -> None:  # fmt: skip
    """Write code that does something with each eight of the K numbers from each offset, the rest filled up by 0.

    - `do`: is given a vector of doubles for each offset, and the index of its first one among the K
    """
    number, vector = NUMBERS[kind.dtype], ir.VectorType(NUMBERS[kind.dtype], LANES)
    data = builder.bitcast(context.make_array(kind)(context, builder, array).data, number.as_pointer())
    starts = [builder.gep(data, [offset]) for offset in offsets]
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    full_lanes = builder.and_(K, INT(-LANES))
    rest = builder.sub(K, full_lanes)

    def eight(start: Any, k: Any) -> Any:
        return builder.load(builder.bitcast(builder.gep(start, [k]), vector.as_pointer()), align=size)

    def widened(values: Any) -> Any:
        return values if vector == DOUBLES else builder.fpext(values, DOUBLES)

    with cgutils.for_range_slice(builder, INT(0), full_lanes, INT(LANES), intp=INT) as (k, _):
        do([widened(eight(start, k)) for start in starts], k)
    with builder.if_then(builder.icmp_signed(">", rest, INT(0))):
        lanes = ir.Constant(INTS, list(range(LANES)))
        inside = builder.icmp_signed("<", lanes, spread(builder, rest, INTS))
        nothing = ir.Constant(vector, [0.0] * LANES)
        do([widened(builder.select(inside, eight(start, full_lanes), nothing)) for start in starts], full_lanes)


def spread(builder: Any, value: Any, vector: Any) -> Any:
    """Return a vector of equal values."""
    lane = builder.insert_element(ir.Constant(vector, ir.Undefined), value, INT32(0))
    return builder.shuffle_vector(lane, lane, ir.Constant(ir.VectorType(INT32, vector.count), [0] * vector.count))


# Compiled loops from the scores of a frame to the sums of its voxels, by tiles of the image.
#
# The image is cut into bands of `ROWS` rows, and each band into tiles so narrow that the sums of their voxels stay in a
# core's cache. Scores are read from memory once, in the order of their addresses; the scores of eight invalid pixels
# in a row are not read. A voxel's pixels are added up band by band, in an order that depends on the image only: the
# same numbers for any number of threads.

ROWS, COLUMNS = 16, 512
"""Pixels of a tile; its rows are those of a band."""

TABLE_BITS = 13
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
SHIFT = np.uint64(64 - TABLE_BITS)


@parallel
def sum_scores(
    depth, points, labels, scores, ending, K, ray_x, ray_y, T, size, origin, room, row_keys,
    tables, table_rows, stretches, scales, key, count, sums, entries, lost, spread,
):  # fmt: skip
    """Sum the scores of each voxel's pixels, each scaled to sum 1, band by band; some voxels come twice.

    If a band has more than `room` of them, its number in `entries` is -1, and its rest is left undone.

    - `points`: (H, W, 3) of a scan, for which rays do not count; (0, 0, 3) of an image
    - `labels`: (W,) 0 wherever there is depth: scores have no ignore id
    - `scores`: (H * W * K,), see `vectors`
    - `ending`: the last scores of at least a tile's row, and room for as many: where reading goes beyond the image
    - `key`: (bands * room,) packed voxels, their pixels in `count`, and their sums (bands * room * stride,) in `sums`
    - `lost`: (bands,) whether a pixel with depth is out of reach
    - `spread`: (bands, PARTITIONS) of the voxels by partition
    """
    H, W = depth.shape
    stride = -(-K // LANES) * LANES
    ox, oy, oz = float(origin[0]), float(origin[1]), float(origin[2])
    elsewhere = scores.shape[0] + (COLUMNS + LANES) * K - ending.shape[0]
    for band in nb.prange(entries.shape[0]):
        thread = nb.get_thread_id()
        keys, table = row_keys[thread], tables[thread]
        first, last = band * ROWS, min(H, (band + 1) * ROWS)
        for v in range(first, last):
            key_row = keys[v - first]
            if points.shape[0]:
                lost[band] |= exact_keys_of_points(points[v], depth[v], labels, T, size, ox, oy, oz, 1, key_row)
            else:
                lost[band] |= exact_keys_of_row(depth[v], labels, ray_x, ray_y[v], T, size, ox, oy, oz, 1, key_row)
        table[:] = -1
        own_key, own_count = key[band * room : (band + 1) * room], count[band * room : (band + 1) * room]
        own_sums = sums[band * room * stride : (band + 1) * room * stride]
        n = np.int64(0)
        for start in range(0, W, COLUMNS):
            stop = min(W, start + COLUMNS)
            words = stretches[thread, 0, : -(-(stop - start) // LANES) * LANES + LANES]
            for v in range(first, last):
                if n >= 0:
                    words[: stop - start] = keys[v - first, start:stop]
                    words[stop - start :] = -1
                    at = (v * W + start) * K
                    near = at + words.shape[0] * K > scores.shape[0]
                    n = _add_stretch(
                        ending if near else scores, at - elsewhere if near else at, K, stride, words, scales[thread],
                        stretches[thread, 1], stretches[thread, 2], table, table_rows[thread], own_key, own_count,
                        own_sums, n,
                    )  # fmt: skip
        entries[band] = n
        for e in range(n):
            spread[band, partition_of(own_key[e])] += 1


@helper
def _add_stretch(scores, at, K, stride, words, scale, run_word, run_end, table, table_row, key, count, sums, n):
    """Add a stretch of pixels to their n voxels; return the number of voxels after it, or -1 without room.

    - `scores`, `at`: their scores begin at scores[at]
    - `words`: their keys, and at least LANES times -1 behind the last one, up to a multiple of LANES; the keys of
      pixels without a prediction become -1
    """
    pixels = words.shape[0] - LANES
    for u in range(0, pixels, LANES):
        some = words[u] & words[u + 1] & words[u + 2] & words[u + 3]
        if (some & words[u + 4] & words[u + 5] & words[u + 6] & words[u + 7]) >= 0:
            scale_eight(scores, at + u * K, K, words, scale, u)
    runs = runs_of(words[: pixels + 1], run_word, run_end)
    begin = np.int64(0)
    for i in range(runs):
        k, end = run_word[i], run_end[i]
        if k >= 0:
            slot = np.int64((np.uint64(k) * GOLDEN) >> SHIFT)
            fresh = table[slot] != k
            if fresh:
                if n == key.shape[0]:
                    return np.int64(-1)
                table[slot], table_row[slot] = k, n
                key[n], count[n] = k, 0
                n += 1
            e = np.int64(table_row[slot])
            count[e] += end - begin
            while begin < end:
                add_two(scores, at, K, scale, begin, end, sums, e * stride, fresh)
                begin += 2
                fresh = False
        begin = end
    return n


@parallel
def scatter_rows(key, count, room, stride, entries, offset, out_key, out_pixels, out_row):
    """Order entries by partition, within one by band and appearance; `out_row` is the index of their sums."""
    for band in nb.prange(entries.shape[0]):
        cursor = offset[band].copy()
        for e in range(band * room, band * room + entries[band]):
            p = partition_of(key[e])
            at = cursor[p]
            cursor[p] = at + 1
            out_key[at], out_pixels[at], out_row[at] = key[e], count[e], e * stride


@parallel
def merge_rows(edges, key, pixels, row, again, first, sums, K, voxels):
    """Add up the entries of each voxel in place: in its first one, and in its sums; their number goes into `voxels`.

    - `again`, `first`: work space: the sums of an entry of a voxel that has one already, and those of its first one
    """
    for p in nb.prange(PARTITIONS):
        low, high = edges[p], edges[p + 1]
        mask = 15
        while mask < 2 * (high - low):
            mask = 2 * mask + 1
        slot = np.full(mask + 1, -1, dtype=np.int32)
        n = low
        repeated = low
        for i in range(low, high):
            k = key[i]
            at = np.int64(mix(k) & np.uint64(mask))
            while slot[at] >= 0 and key[low + slot[at]] != k:
                at = (at + 1) & mask
            if slot[at] < 0:
                slot[at] = n - low
                key[n], pixels[n], row[n] = k, pixels[i], row[i]
                n += 1
            else:
                v = low + slot[at]
                pixels[v] += pixels[i]
                again[repeated], first[repeated] = row[i], row[v]
                repeated += 1
        for i in range(low, repeated):
            to, added = sums[first[i] : first[i] + K], sums[again[i] : again[i] + K]
            for k in range(K):
                to[k] += added[k]
        voxels[p] = n - low
