"""CPU time of the statistics beside that of the loop whose log they read, and the memory that both take.

    python benchmarks/bench_statistics.py [--frames 200] [--size 640x480] [--voxel-size 0.05] [--classes 7] [--rooms 1]
    python benchmarks/bench_statistics.py --flight --frames 50 --voxel-size 0.2 [--flipped 0.05] [--scores 3]

A camera walks round a furnished room and sees each place again and again (room.py); with --rooms it goes on to the next
one; with --flight it flies over a field and sees most places twice (flight.py); --flipped is a share of pixels whose
label is any. With --scores each pixel has probabilities instead, of the label and of classes at random, of which the so
many largest are kept. The frames are read from PNG, scores from NPZ, as the loop of a run does, whose other parts are
flicker and fusion. Time is user and system time of all threads; compiled code is loaded before.
Memory is the most that the process took since the step before, above what it took with its modules loaded.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import flight
import numpy as np
import room

from semstab import Frame, statistics
from semstab.backends import create
from semstab.core.files import write_json
from semstab.core.process import configure_process
from semstab.data.events import Events
from semstab.data.voxels import VoxelTable
from semstab.datasets import open_dataset
from semstab.metrics import flicker_percent, summarise

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from posed_writer import write_posed

PAGE = resource.getpagesize()
LEG, BESIDE, STEP = 10, 40.0, 30.0
UNITS = 500  # of depth in a metre
LOOP = ("reading", "flicker", "fusion")


class Watch:
    """CPU time of steps, and the most memory that each sees resident."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.peak: dict[str, int] = {}
        self.before = resident()

    def __call__(self, name: str, call: Callable[[], Any]) -> Any:
        highest, over = resident(), threading.Event()

        def look() -> None:
            nonlocal highest
            while not over.wait(0.005):
                highest = max(highest, resident())

        thread = threading.Thread(target=look)
        thread.start()
        started = cpu_seconds()
        found = call()
        self.seconds[name] = self.seconds.get(name, 0.0) + cpu_seconds() - started
        over.set()
        thread.join()
        self.peak[name] = max(self.peak.get(name, 0), highest - self.before, resident() - self.before)
        return found


def cpu_seconds() -> float:
    """User and system time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def resident() -> int:
    """Bytes that this process has in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def walked(frames: int, size: tuple[int, int], K: int, rooms: int) -> Iterator[Frame]:
    """Frames of the walk."""
    for index in range(frames):
        yield room.frame(index, *size, K=K, step=frames // rooms)


def flown(frames: int, size: tuple[int, int], K: int) -> Iterator[Frame]:
    """Frames of the flight, to and fro."""
    for index in range(frames):
        leg, along = divmod(index, LEG)
        yield flight.frame(index, *size, K, (BESIDE * leg, STEP * (LEG - 1 - along if leg % 2 else along)))


def flipped(frames: Iterable[Frame], share: float, K: int) -> Iterator[Frame]:
    """The frames with any label in a share of their pixels."""
    rng = np.random.default_rng(0)
    for frame in frames:
        assert frame.labels is not None
        labels, where = frame.labels.copy(), rng.random(frame.shape) < share
        labels[where] = rng.integers(K, size=np.count_nonzero(where))
        yield replace(frame, labels=labels)


def soft(frames: Iterable[Frame], kept: int, K: int) -> Iterator[Frame]:
    """The frames with probabilities in place of labels: 0.4 to 1 for the label, the rest for classes at random.

    Of each pixel those of `kept` classes, the label among them.
    """
    for frame in frames:
        assert frame.labels is not None
        rng, n, labels = np.random.default_rng(frame.index), frame.labels.size, frame.labels.reshape(-1, 1)
        others = (rng.integers(1, K, n)[:, None] + np.arange(kept - 1)) % (K - 1) + 1
        share = rng.random((n, kept - 1), dtype=np.float32)
        share *= rng.uniform(0.0, 0.6, (n, 1)).astype(np.float32) / share.sum(axis=1, keepdims=True)
        scores = np.zeros((n, K), dtype=np.float16)
        np.put_along_axis(scores, (labels + others) % K, share.astype(np.float16), axis=1)
        np.put_along_axis(scores, labels.astype(np.int64), 1 - share.sum(axis=1, keepdims=True), axis=1)
        yield replace(frame, labels=None, scores=scores.reshape(*frame.shape, K))


def written(folder: Path, count: int, frames: Iterable[Frame], K: int) -> Path:
    """So many frames as PNGs in a folder, scores as NPZ."""
    frames = (replace(frame, depth=(np.round(frame.depth * UNITS) / UNITS).astype(np.float32)) for frame in frames)
    names, classes = [f"{index:05d}" for index in range(count)], [f"class{k}" for k in range(K)]
    write_posed(folder / "scene", names, {"a": frames}, scale=UNITS, classes=classes)
    return folder


def fused(watch: Watch, folder: Path, voxel_size: float, K: int) -> Any:
    """The map of the frames of a folder, with its history."""
    fusion = create("numba", voxel_size=voxel_size, num_classes=K, history=True)
    scene = open_dataset("posed_folder", {"root": str(folder)}).scene("scene")
    (name,), before = scene.models, None
    for index in range(len(scene)):
        frame = watch("reading", lambda index=index: scene.frame(index, name))
        if before is not None:
            watch("flicker", lambda one=before, other=frame: flicker_percent(one, other))
        watch("fusion", lambda frame=frame: fusion.integrate(frame))
        before = frame
    return fusion


def sections(table: VoxelTable, events: Events) -> dict[str, Callable[[], Any]]:
    """What of the statistics is timed by itself."""
    return {
        "drift in random order": lambda: statistics.expected_sbd(table, events),
        "flips": lambda: statistics.flips(events),
        "agreement by class": lambda: statistics.class_agreement(table, events),
    }


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds and bytes of each step, with the number of voxels and observations."""
    width, height = (int(side) for side in arguments.size.split("x"))
    K, size = arguments.classes, (width, height)

    def taken(count: int, size: tuple[int, int], rooms: int = 1) -> Iterator[Frame]:
        frames = flown(count, size, K) if arguments.flight else walked(count, size, K, rooms)
        frames = flipped(frames, arguments.flipped, K) if arguments.flipped else frames
        return soft(frames, arguments.scores, K) if arguments.scores else frames

    with tempfile.TemporaryDirectory() as there:
        warm = fused(Watch(), written(Path(there) / "few", 8, taken(8, (96, 72)), K), 4 * arguments.voxel_size, K)
        statistics.describe(warm.table(), warm.events(), warm.table())
        count = arguments.frames
        folder = written(Path(there), count, taken(count, size, arguments.rooms), K)
        watch = Watch()
        fusion = fused(watch, folder, arguments.voxel_size, K)
    table = watch("table", fusion.table)
    watch("summary", lambda: summarise(table))
    events = watch("log", fusion.events)
    watch("all statistics", lambda: statistics.describe(table, events, table))
    for name, call in sections(table, events).items():
        watch(f"  {name}", call)
    counts = {"voxels": len(table), "observations": len(events), "frames": arguments.frames}
    return {**counts, "K": K, "seconds": watch.seconds, "peak": watch.peak}


def main() -> None:
    """Print the table."""
    configure_process()  # as the command line does
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--voxel-size", type=float, default=0.05, help="metres")
    parser.add_argument("--classes", type=int, default=7)
    parser.add_argument("--rooms", type=int, default=1)
    parser.add_argument("--flight", action="store_true")
    parser.add_argument("--flipped", type=float, default=0.0, help="share of pixels with any label")
    parser.add_argument(
        "--scores", type=int, default=0, help="classes of which a pixel has a probability; else a label"
    )
    arguments = parser.parse_args()
    found = measure(arguments)
    n, m, fusion = found["voxels"], found["observations"], found["seconds"]["fusion"]
    loop = sum(found["seconds"][name] for name in LOOP)
    print(f"{found['frames']} frames, {m:,} observations of {n:,} voxels ({m / n:.1f} each), K = {found['K']}")
    print(f"{'step':<24}{'CPU s':>9}{'us/observation':>16}{'of fusion':>11}{'of loop':>9}{'peak bytes/voxel':>18}")
    for name, seconds in found["seconds"].items():
        row = f"{name:<24}{seconds:9.2f}{1e6 * seconds / m:16.3f}{seconds / fusion:11.2f}{seconds / loop:9.2f}"
        print(f"{row}{found['peak'][name] / n:18,.0f}")
    if arguments.json:
        write_json(arguments.json, found)


if __name__ == "__main__":
    main()
