"""CPU time of a frame's spots, on which alpha rests, and of fusing it; and the memory of spots over a flight.

A UAV flies over blocks of houses, 1.5 m a frame. After `--warm` frames all code is compiled, and most spots that a
frame shows are known. Then every second frame is added to the sampler, and fused by backend `numba`, the baseline of
the ratio; the frames between are timed part by part, for the second table. Numbers are medians of user and system time
of all threads: `NUMBA_NUM_THREADS=1` leaves one. *Known* are the spots before a frame, *answers* those that it answers
for. The third table has the memory of a flight of `--frames` frames of the first size: the arrays of the sampler, and
their most together with what it needs while it adds a frame (tracemalloc).
"""

from __future__ import annotations

import contextlib
import dataclasses
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any
from unittest import mock

import flight
import measuring
import numpy as np

from semstab.backends import create
from semstab.data.frames import Frame
from semstab.statistics import Sampler
from semstab.statistics.loops import answers as loops
from semstab.statistics.sparse_depth import SparseDepth

PARTS: dict[str, tuple[Any, str]] = {
    "is depth sparse": (SparseDepth, "from_frame"),
    "view: hash of labels, mean area": (Sampler, "_view_of"),
    "new spots": (Sampler, "_find"),
    "projection": (loops, "project"),
    "tolerance": (Sampler, "_learn"),
    "answers": (loops, "answer"),
    "keeping them": (Sampler, "_take"),
}
"""Parts of `Sampler.add` and what does them, in order."""

LAST = 5
"""Frames at the end of the long flight that are timed."""


def made(index: int, size: tuple[int, int], K: int, noise: float) -> Frame:
    """A frame of the flight with noise of depth, in percent."""
    frame = flight.frame(index, *size, K)
    if not noise:
        return frame
    normal = np.random.default_rng(index).standard_normal(frame.depth.shape, dtype=np.float32)
    return dataclasses.replace(frame, depth=frame.depth * (1 + noise / 100 * normal))


def milliseconds(work: Callable[..., Any], frame: Frame) -> float:
    """Return the milliseconds of one call with a copy of the frame: filling a frame's caches is part of the work."""
    return measuring.cpu_ms(work, dataclasses.replace(frame))


@contextlib.contextmanager
def parts(found: dict[str, float]) -> Iterator[None]:
    """Add up the milliseconds of each part of what is done meanwhile."""

    def watched(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            result: list[Any] = []
            found[name] += measuring.cpu_ms(lambda: result.append(call(*arguments)))
            return result[0]

        return timed

    with contextlib.ExitStack() as stack:
        for name, (owner, attribute) in PARTS.items():
            stack.enter_context(mock.patch.object(owner, attribute, watched(name, getattr(owner, attribute))))
        yield


def cost(
    size: tuple[int, int], noise: float, K: int, voxel_size: float, warm: int, rounds: int
) -> tuple[dict[str, Any], dict[str, float]]:
    """The cost of a frame, and of its parts."""
    sampler, backend = Sampler(K), create("numba", voxel_size=voxel_size, num_classes=K)
    rows, by_part = [], defaultdict(list)
    for index in range(warm + 2 * rounds):
        frame = made(index, size, K, noise)
        if index < warm:
            sampler.add(frame)
            backend.integrate(frame)
        elif (index - warm) % 2:  # timing part by part takes time itself
            found: dict[str, float] = defaultdict(float)
            with parts(found):
                found["all"] = milliseconds(sampler.add, frame)
            found["the rest"] = found["all"] - sum(ms for name, ms in found.items() if name in PARTS)
            for name, ms in found.items():
                by_part[name].append(ms)
        else:
            answers, spots = sampler._answers, sampler._spots
            added, fused = milliseconds(sampler.add, frame), milliseconds(backend.integrate, frame)
            rows.append(
                {"known": spots, "answers": sampler._answers - answers, "sampler_ms": added, "fusion_ms": fused}
            )
    whole = measuring.medians(rows)
    return whole | {"ratio": whole["sampler_ms"] / whole["fusion_ms"]}, {k: median(ms) for k, ms in by_part.items()}


def held(sampler: Sampler) -> int:
    """Bytes of a sampler's arrays."""
    arrays = sampler._point, sampler._hash, sampler._table, *sampler._columns.values(), sampler._views.table()
    return sum(array.nbytes for array in arrays)


def memory(size: tuple[int, int], K: int, frames: int) -> dict[str, Any]:
    """Megabytes of a sampler over a flight, and the cost of a frame at its end."""
    sampler, most = Sampler(K), 0
    tracemalloc.start()
    for index in range(frames):
        frame, held_bytes = made(index, size, K, 0.0), held(sampler)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        sampler.add(frame)
        most = max(most, held_bytes + tracemalloc.get_traced_memory()[1] - before)
    tracemalloc.stop()
    held_bytes, spots, answers = held(sampler), sampler._spots, sampler._answers
    last = [milliseconds(sampler.add, made(index, size, K, 0.0)) for index in range(frames, frames + LAST)]
    return {
        "frames": frames, "spots": spots, "answers": answers, "held_MB": held_bytes / 1e6, "peak_MB": most / 1e6,
        "ms_at_its_end": median(last),
    }  # fmt: skip


def main(
    sizes: tuple[str, ...] = ("640x480", "3840x2160"),
    noise: tuple[float, ...] = (0.0, 0.3),
    classes: int = 19,
    voxel_size: float = 0.2,
    warm: int = 6,
    rounds: int = 5,
    frames: int = 500,
) -> Any:
    table = measuring.MarkdownTable(
        size="", noise="g", known=",.0f", answers=",.0f", sampler_ms=".2f", fusion_ms=".2f", ratio=".2f"
    )
    details = []
    for size in sizes:
        for percent in noise:
            whole, by_part = cost(measuring.sides(size), percent, classes, voxel_size, warm, rounds)
            table.add(size=size, noise=percent, **whole)
            details += [(size, percent, name, by_part[name]) for name in (*PARTS, "the rest", "all") if name in by_part]
    print()
    part = measuring.MarkdownTable(size="", noise="g", part="", ms=".2f")
    for size, percent, name, ms in details:
        part.add(size=size, noise=percent, part=name, ms=ms)
    print()
    long = measuring.MarkdownTable(
        size="", frames="", spots=",.0f", answers=",.0f", held_MB=".1f", peak_MB=".1f", ms_at_its_end=".2f"
    )
    long.add(size=sizes[0], **memory(measuring.sides(sizes[0]), classes, frames))
    return table.rows + part.rows + long.rows
