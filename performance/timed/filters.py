"""CPU time a frame of each filter, on one core.

A camera moves along a wall; beliefs are random. Milliseconds are CPU time of all threads, medians over the frames after
the first four, which fill what a filter remembers and compile.
"""

from __future__ import annotations

from statistics import median
from typing import Any

import measuring
import numpy as np

from semstab.data.frames import Frame, Intrinsics
from semstab.predict.filters import REGISTRY, Shown, parse


def milliseconds(step: Any, W: int, H: int, K: int, frames: int) -> float:
    """Return the median CPU milliseconds a frame of one filter."""
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
        taken.append(measuring.cpu_ms(step, belief, Shown(image, frame)))
    return median(taken[4:])


def main(size: str = "640x480", classes: int = 8, frames: int = 12) -> Any:
    table = measuring.MarkdownTable(filter="", CPU_ms=".0f")
    for name in REGISTRY.builtin:
        spec = parse(name)
        table.add(filter=str(spec), CPU_ms=milliseconds(spec(), *measuring.sides(size), classes, frames))
    return table.rows
