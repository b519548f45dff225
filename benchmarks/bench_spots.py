"""What the spots cost that alpha rests on: CPU time of a frame, beside fusing it, and memory of a long flight.

    NUMBA_NUM_THREADS=1 python benchmarks/bench_spots.py [--sizes 640x480 3840x2160] [--noise 0 0.3] [--rounds 5]
                                                         [--frames 500] [--classes 19] [--json FILE]

A UAV flies over blocks of houses (flight.py), 1.5 m a frame; depth has noise of so many percent. `--warm` frames are
added first, so that all code is compiled and most spots that a frame shows are known. Then every second frame is added
to the sampler, and fused by backend `numba`: this is the baseline of the ratio. The frames between are timed part by
part, for the second table. Numbers are medians over `--rounds` frames of user and system time of all threads. *Known*
are the spots before a frame, *answers* the spots that a frame answers for, about half of the spots that it sees. The
third table has the memory of a flight of `--frames` frames at the first size: what the sampler holds, and the most that
it holds together with what it needs while it adds a frame (tracemalloc); and the time of a frame at the flight's end.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import statistics
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

from semstab.core.process import configure_process

configure_process()  # as the command line does, before anything starts threads

import numpy as np  # noqa: E402
from flight import frame as flown  # noqa: E402

from semstab.backends import create  # noqa: E402
from semstab.core.files import write_json  # noqa: E402
from semstab.data.frames import Frame  # noqa: E402
from semstab.statistics import Sampler  # noqa: E402
from semstab.statistics import sampler as sampling  # noqa: E402
from semstab.statistics.loops import spots as loops  # noqa: E402

VIEW_OF = "view: hash of labels, mean area"
PARTS = {
    "is depth sparse": (sampling, "_sparse"),
    VIEW_OF: (Sampler, "_view_of"),
    "  mean area": (loops, "mean_area"),
    "new spots": (Sampler, "_find"),
    "projection": (loops, "project"),
    "tolerance": (Sampler, "_learn"),
    "answers": (loops, "answer"),
    "keeping them": (Sampler, "_take"),
}
"""Parts of `Sampler.add` and what does them, in order; an indented one is in the one above."""

REST = "median depth, room for answers"

LAST = 5
"""Frames at the end of the long flight that are timed."""


def made(index: int, size: tuple[int, int], K: int, noise: float) -> Frame:
    """Return a frame of the flight with noise of depth, in percent."""
    frame = flown(index, *size, K)
    if not noise:
        return frame
    normal = np.random.default_rng(index).standard_normal(frame.depth.shape, dtype=np.float32)
    return dataclasses.replace(frame, depth=frame.depth * (1 + noise / 100 * normal))


def milliseconds(work: Callable[..., Any], frame: Frame) -> float:
    """Return CPU time of one call with a copy of the frame, as what a frame remembers is part of the work."""
    frame = dataclasses.replace(frame)
    began = time.process_time_ns()
    work(frame)
    return (time.process_time_ns() - began) / 1e6


@contextlib.contextmanager
def parts(found: dict[str, float]) -> Iterator[None]:
    """Add up the milliseconds of each part of what is done meanwhile."""

    def watched(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            began = time.process_time_ns()
            result = call(*arguments)
            found[name] += (time.process_time_ns() - began) / 1e6
            return result

        return timed

    with contextlib.ExitStack() as stack:
        for name, (owner, attribute) in PARTS.items():
            stack.enter_context(mock.patch.object(owner, attribute, watched(name, getattr(owner, attribute))))
        yield


def cost(size: tuple[int, int], noise: float, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the cost of a frame of a size, with noise of depth in percent."""
    K = arguments.classes
    sampler, backend = Sampler(K), create("numba", voxel_size=arguments.voxel_size, num_classes=K)
    added, fused, answers, known = [], [], [], []
    by_part: dict[str, list[float]] = defaultdict(list)
    for index in range(arguments.warm + 2 * arguments.rounds):
        frame, before, spots = made(index, size, K, noise), sampler._answers, sampler._spots
        if index < arguments.warm:
            sampler.add(frame)
            backend.integrate(frame)
        elif index % 2:  # every second frame is timed part by part, which takes time itself
            found: dict[str, float] = defaultdict(float)
            with parts(found):
                found["all"] = milliseconds(sampler.add, frame)
            found[REST] = found["all"] - sum(own for name, own in found.items() if name in PARTS and name[0] != " ")
            for name, own in found.items():
                by_part[name].append(own)
        else:
            added.append(milliseconds(sampler.add, frame))
            fused.append(milliseconds(backend.integrate, frame))
            answers.append(sampler._answers - before)
            known.append(spots)
    mine, its = statistics.median(added), statistics.median(fused)
    return {
        "size": "x".join(map(str, size)), "noise": noise, "spots": statistics.median(known),
        "answers": statistics.median(answers),
        "ms": mine, "fusion_ms": its, "ratio": mine / its,
        "parts": {name: statistics.median(own) for name, own in by_part.items()},
    }  # fmt: skip


def held(sampler: Sampler) -> int:
    """Return the bytes of a sampler's arrays."""
    arrays = sampler._point, sampler._hash, sampler._table, *sampler._columns.values(), sampler._views.table()
    return sum(array.nbytes for array in arrays)


def memory(size: tuple[int, int], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return megabytes of a sampler over a flight, and the cost of a frame at its end."""
    sampler, most, last = Sampler(arguments.classes), 0, []
    tracemalloc.start()
    for index in range(arguments.frames):
        frame, own = made(index, size, arguments.classes, 0.0), held(sampler)
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        sampler.add(frame)
        most = max(most, own + tracemalloc.get_traced_memory()[1] - before)
    tracemalloc.stop()
    own, spots, answers = held(sampler), sampler._spots, sampler._answers
    for index in range(arguments.frames, arguments.frames + LAST):
        last.append(milliseconds(sampler.add, made(index, size, arguments.classes, 0.0)))
    return {
        "size": "x".join(map(str, size)), "frames": arguments.frames, "spots": spots, "answers": answers,
        "held_mb": own / 1e6, "peak_mb": most / 1e6, "last_ms": statistics.median(last),
    }  # fmt: skip


def rows(head: list[str], body: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--sizes", nargs="+", default=["640x480", "3840x2160"])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.3], help="of depth, percent")
    parser.add_argument("--classes", type=int, default=19)
    parser.add_argument("--voxel-size", type=float, default=0.2, help="metres, of the fusion")
    parser.add_argument("--warm", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=500, help="of the flight whose memory is measured")
    arguments = parser.parse_args()
    sizes: list[Any] = [tuple(int(side) for side in size.split("x")) for size in arguments.sizes]
    costs = [cost(size, noise, arguments) for size in sizes for noise in arguments.noise]
    names = [f"{own['size']}, {own['noise']:g} %" for own in costs]
    print(f"CPU milliseconds a frame, K = {arguments.classes}\n")
    print(
        rows(
            ["size, noise of depth", "known", "answers", "sampler ms", "fusion ms", "ratio"],
            [
                [
                    name, f"{own['spots']:,.0f}", f"{own['answers']:,.0f}", f"{own['ms']:.2f}",
                    f"{own['fusion_ms']:.2f}", f"{own['ratio']:.2f}",
                ]
                for name, own in zip(names, costs, strict=True)
            ],
        )
    )  # fmt: skip
    known = [name for name in (*PARTS, REST, "all") if any(name in own["parts"] for own in costs)]
    print(rows(["part", *names], [[name, *(f"{own['parts'][name]:.2f}" for own in costs)] for name in known]))
    long = memory(sizes[0], arguments)
    print(
        rows(
            ["flight", "spots", "answers", "held MB", "peak MB", "sampler ms at its end"],
            [
                [
                    f"{long['frames']} frames of {long['size']}", f"{long['spots']:,}", f"{long['answers']:,}",
                    f"{long['held_mb']:.1f}", f"{long['peak_mb']:.1f}", f"{long['last_ms']:.2f}",
                ]
            ],
        )
    )  # fmt: skip
    if arguments.json:
        write_json(arguments.json, {"costs": costs, "memory": long})


if __name__ == "__main__":
    main()
