"""CPU time a frame of each filter, on one core.

    python benchmarks/bench_filters.py [--size 640x480] [--classes 8] [--frames 12]

A camera moves along a wall; beliefs are random. Milliseconds are CPU time of all threads, medians over the frames after
the first four, which fill what a filter remembers and compile.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import numpy as np

from semstab.data.frames import Frame, Intrinsics
from semstab.predict.filters import REGISTRY, Shown, parse


def main() -> None:
    """Print one line a filter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--classes", type=int, default=8)
    parser.add_argument("--frames", type=int, default=12)
    given = parser.parse_args()
    W, H = map(int, given.size.split("x"))
    for name in REGISTRY.builtin:
        spec = parse(name)
        took = milliseconds(spec(), W, H, given.classes, given.frames)
        print(f"{spec!s:16} {took:6.0f} ms")


def milliseconds(step: object, W: int, H: int, K: int, frames: int) -> float:
    """Of one filter."""
    import cv2

    cv2.setNumThreads(1)
    rng, taken = np.random.default_rng(0), []
    camera = Intrinsics(W / 2, W / 2, (W - 1) / 2, (H - 1) / 2)
    image = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    for k in range(frames):
        belief = rng.random((H, W, K), dtype=np.float32)
        belief /= belief.sum(axis=2, keepdims=True)
        T = np.eye(4)
        T[0, 3] = 0.02 * k
        frame = Frame(k, np.full((H, W), 5, np.float32), camera, T, labels=np.zeros((H, W), np.uint8))
        started = time.process_time()
        step(belief, Shown(image, frame))  # type: ignore[operator]
        taken.append(time.process_time() - started)
    return 1e3 * median(taken[4:])


if __name__ == "__main__":
    main()
