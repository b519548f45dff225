"""CPU time of the statistics and of the loop whose log they read, and the memory that both take.

A camera walks round a furnished room and sees each place again and again (room.py); with --rooms it goes on to the next
one; with --flight it flies over a field and sees most places twice (flight.py); --flipped is a share of pixels whose
label is any. With --scores each pixel has probabilities instead, of the label and of classes at random, of which the so
many largest are kept. The frames are read from PNG, scores from NPZ, as the loop of a run does, whose other parts are
flicker and fusion. Time is user and system time of all threads; compiled code is loaded before.
Memory is the most that the process took since the step before, above what it took with its modules loaded.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import measuring
import numpy as np
import room

from semstab import Frame, statistics
from semstab.backends import create
from semstab.datasets import open_dataset
from semstab.metrics import flicker_percent, summarise

UNITS = 500  # of depth in a metre
LOOP = ("reading", "flicker", "fusion")


def flip(frames: Iterable[Frame], share: float, K: int) -> Iterator[Frame]:
    """The frames with any label in a share of their pixels."""
    rng = np.random.default_rng(0)
    for frame in frames:
        labels, where = frame.labels.copy(), rng.random(frame.shape) < share
        labels[where] = rng.integers(K, size=np.count_nonzero(where))
        yield replace(frame, labels=labels)


def soft(frames: Iterable[Frame], classes: int, K: int) -> Iterator[Frame]:
    """The frames with probabilities in place of labels: 0.4 to 1 for the label, the rest for classes at random.

    Of each pixel those of `classes`, the label among them.
    """
    for frame in frames:
        rng, n, labels = np.random.default_rng(frame.index), frame.labels.size, frame.labels.reshape(-1, 1)
        others = (rng.integers(1, K, n)[:, None] + np.arange(classes - 1)) % (K - 1) + 1
        share = rng.random((n, classes - 1), dtype=np.float32)
        share *= rng.uniform(0.0, 0.6, (n, 1)).astype(np.float32) / share.sum(axis=1, keepdims=True)
        scores = np.zeros((n, K), dtype=np.float16)
        np.put_along_axis(scores, (labels + others) % K, share.astype(np.float16), axis=1)
        np.put_along_axis(scores, labels.astype(np.int64), 1 - share.sum(axis=1, keepdims=True), axis=1)
        yield replace(frame, labels=None, scores=scores.reshape(*frame.shape, K))


def fused(watch: measuring.Watch, count: int, frames: Iterable[Frame], voxel_size: float, K: int) -> Any:
    """The map of frames that are written first, with its history."""
    fusion, before = create("numba", voxel_size=voxel_size, num_classes=K, history=True), None
    frames = (replace(frame, depth=(np.round(frame.depth * UNITS) / UNITS).astype(np.float32)) for frame in frames)
    with tempfile.TemporaryDirectory() as folder:
        measuring.posed(Path(folder) / "scene", count, frames, K, scale=UNITS)
        watch.before = measuring.resident_bytes()
        scene = open_dataset("posed_folder", {"root": folder}).scene("scene")
        for index in range(count):
            frame = watch("reading", lambda index=index: scene.frame(index, "a"))
            if before is not None:
                watch("flicker", lambda one=before, other=frame: flicker_percent(one, other))
            watch("fusion", lambda frame=frame: fusion.integrate(frame))
            before = frame
    return fusion


def main(
    frames: int = 200,
    size: str = "640x480",
    voxel_size: float = 0.05,
    classes: int = 7,
    rooms: int = 1,
    flight: bool = False,
    flipped: float = 0.0,
    scores: int = 0,
) -> Any:
    K = classes

    def taken(count: int, size: tuple[int, int], rooms: int = 1) -> Iterator[Frame]:
        walk = (room.frame(index, *size, K=K, step=count // rooms) for index in range(count))
        made = measuring.to_and_fro(count, size, K) if flight else walk
        made = flip(made, flipped, K) if flipped else made
        return soft(made, scores, K) if scores else made

    warm = fused(measuring.Watch(), 8, taken(8, (96, 72)), 4 * voxel_size, K)
    statistics.describe(warm.table(), warm.events(), warm.table())
    watch = measuring.Watch()
    fusion = fused(watch, frames, taken(frames, measuring.sides(size), rooms), voxel_size, K)
    table = watch("table", fusion.table)
    watch("summary", lambda: summarise(table))
    events = watch("log", fusion.events)
    watch("all statistics", lambda: statistics.describe(table, events, table))
    watch("- drift in random order", lambda: statistics.expected_sbd(table, events))
    watch("- flips", lambda: statistics.flips(events))
    watch("- agreement by class", lambda: statistics.class_agreement(table, events))
    n, m = len(table), len(events)
    print(f"{frames} frames, {m:,} observations of {n:,} voxels ({m / n:.1f} each), K = {K}\n")
    told = measuring.MarkdownTable(
        step="", CPU_s=".2f", us_an_observation=".3f", of_fusion=".2f", of_loop=".2f", peak_bytes_a_voxel=",.0f"
    )
    loop = sum(watch.seconds[name] for name in LOOP)
    for step, s in watch.seconds.items():
        told.add(step=step, CPU_s=s, us_an_observation=1e6 * s / m, of_fusion=s / watch.seconds["fusion"],
                 of_loop=s / loop, peak_bytes_a_voxel=watch.peak[step] / n)  # fmt: skip
    return {"voxels": n, "observations": m, "rows": told.rows}
