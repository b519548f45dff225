"""CPU time of one frame of soft scores, of one read of its scores, and of finding its pixels' voxels.

The frames fly along the street of `fusion`: a third of the image is sky, whose scores nobody needs. 'read' is
one pass over all scores of the frame, 'keys' the voxel of each pixel, each alone and by compiled code on all cores;
'floor' is their sum, 'frame' a whole frame whose voxels are known, association and update. 'rows' reads and writes as
many dense rows of evidence as the frame sees voxels, in random order: what any map costs beside. User and system time
of all threads; the steps take turns.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import flight
import measuring
import numba as nb
import numpy as np
import numpy.typing as npt

import semstab
from semstab import backends
from semstab.backends.shared.pixel_keys import exact_keys_of_row
from semstab.backends.shared.score_loops import LANES, scale_eight
from semstab.core.compiled import parallel

VOXEL = 0.2


@parallel
def read(scores, scales):
    """Each score once."""
    n = scores.shape[0] // scales.shape[0]
    for part in nb.prange(scales.shape[0]):
        scale_eight(scores, part * n, n // LANES, np.zeros(LANES, dtype=np.int64), scales[part], 0)


@parallel
def find_keys(depth, labels, ray_x, ray_y, T, size, origin, keys):
    """The voxel of each pixel."""
    for v in nb.prange(depth.shape[0]):
        exact_keys_of_row(
            depth[v], labels, ray_x, ray_y[v], T, size, float(origin[0]), float(origin[1]), float(origin[2]), 1,
            keys[nb.get_thread_id()],
        )  # fmt: skip


@parallel
def touch_rows(evidence, row):
    """Dense rows read and written."""
    for part in nb.prange(64):
        for i in range(len(row) * part // 64, len(row) * (part + 1) // 64):
            for k in range(evidence.shape[1]):
                evidence[row[i], k] += 1.0


def soft(frame: semstab.Frame, K: int, kind: str) -> semstab.Frame:
    """Scores as a softmax gives them: 0.7 for the label, the rest spread at random over all classes."""
    assert frame.labels is not None
    rng = np.random.default_rng(frame.index)
    rows, W = frame.shape
    scores = np.empty((rows, W, K), dtype=kind)
    for v in range(rows):
        part = rng.random((W, K), dtype=np.float32)
        part *= 0.3 / part.sum(axis=1, keepdims=True)
        part[np.arange(W), frame.labels[v]] += 0.7
        scores[v] = part
    return dataclasses.replace(frame, labels=None, scores=scores)


def steps(frame: semstab.Frame, K: int) -> dict[str, Callable[[], Any]]:
    """Return the steps that are timed, by name, in a map that has seen the frame."""
    assert frame.scores is not None
    H, W = frame.shape
    flat: npt.NDArray[Any] = frame.scores.reshape(-1)
    flat = flat.view(np.uint16) if flat.dtype == np.float16 else flat
    ray_x = (np.arange(W) - frame.intrinsics.cx) / frame.intrinsics.fx
    ray_y = (np.arange(H) - frame.intrinsics.cy) / frame.intrinsics.fy
    depth, T = np.array(frame.depth), np.array(frame.T_wc)
    origin = np.floor(T[:3, 3] / VOXEL).astype(np.int64)
    keys, labels, scales = np.empty((64, W), dtype=np.int64), np.zeros(W, dtype=np.uint8), np.empty((64, LANES))
    map_ = backends.create("numba", voxel_size=VOXEL, num_classes=K)
    report = map_.integrate(frame)
    order = np.random.default_rng(0).permutation(report.voxels)
    evidence = np.zeros((report.voxels, K))
    return {
        "read": lambda: read(flat, scales),
        "keys": lambda: find_keys(depth, labels, ray_x, ray_y, T, VOXEL, origin, keys),
        "rows": lambda: touch_rows(evidence, order),
        "frame": lambda: map_.integrate(frame),
    }


def main(
    sizes: tuple[str, ...] = ("1280x720", "3840x2160"),
    classes: tuple[int, ...] = (7, 20, 150),
    types: tuple[str, ...] = ("float32", "float16"),
    noise: tuple[float, ...] = (0.0,),
    rounds: int = 5,
) -> Any:
    table = measuring.MarkdownTable(
        size="", K="", type="", noise=".2%", voxels=",", read=".1f", keys=".1f", rows=".1f", frame=".1f",
        of_floor=".2f", with_rows=".2f",
    )  # fmt: skip
    for size, K, kind, level in itertools.product(sizes, classes, types, noise):
        frame = soft(flight.street(0, *measuring.sides(size), K, noise=level), K, kind)
        work = steps(frame, K)
        timed = {name: partial(measuring.cpu_ms, step) for name, step in work.items()}
        ms = {name: median(times) for name, times in measuring.in_turns(timed, rounds).items()}
        floor, report = ms["read"] + ms["keys"], work["frame"]()
        ratios = {"of_floor": ms["frame"] / floor, "with_rows": ms["frame"] / (floor + ms["rows"])}
        table.add(size=size, K=K, type=kind, noise=level, voxels=report.voxels, **ms, **ratios)
    return table.rows
