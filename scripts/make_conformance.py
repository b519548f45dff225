"""Write all conformance cases anew, fused by the reference: python scripts/make_conformance.py conformance/cases."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semstab.conformance import EXPECTED, write_case
from semstab.conformance.fuse import fuse
from semstab.core.files import write_text
from semstab.core.types import Float64
from semstab.data.frames import Frame, Intrinsics

Case = tuple[float, int, list[Frame]]
"""Voxel size in metres, number of classes, frames."""

FAR = 2.0**60
"""So long a focal length, in pixels, that all pixels look along one line."""


def line(index: int, hits: Sequence[tuple[float, Any]], start: Sequence[float] = (0.5, 0.5, 0.0)) -> Frame:
    """A frame whose pixel i lies at start + (0, 0, depth_i), with a label or scores."""
    T_wc = np.eye(4)
    T_wc[:3, 3] = start
    depth = np.array([[d for d, _ in hits]], np.float32)
    values = np.array([[value for _, value in hits]])
    given: dict[str, Any] = {"scores": values.astype(np.float32)} if values.ndim == 3 else {"labels": values}
    return Frame(index, depth, Intrinsics(FAR, FAR, 0, 0), T_wc, **given)


def cases() -> Mapping[str, Case]:
    """All of them, simple ones first."""
    half = 0.5
    return {
        "one_pixel": (1.0, 3, [line(0, [(half, 1)])]),
        "pinhole": (0.25, 3, [_pinhole()]),
        "pixels_of_one_frame": (1.0, 3, [line(0, [(0.2, 0), (0.4, 0), (0.6, 1)]), line(1, [(half, 1)])]),
        "drift": (1.0, 3, [line(t, [(half, label)]) for t, label in enumerate((0, 1, 0, 2, 2))]),
        "gaps": (1.0, 3, [line(3, [(half, 0)]), line(9, [(1.5, 2)]), line(5, [(half, 1), (1.5, 2)])]),
        "ties": (1.0, 4, [line(0, [(half, 2), (1.5, 3)]), line(1, [(half, 1), (1.5, 3)]), line(2, [(half, 0)])]),
        "faces": (1.0, 2, [line(t, [(1.0, t % 2), (2.0, 0)], (1.0 * t, -1.0, 0.0)) for t in range(3)]),
        "decimal_faces": (0.2, 2, [line(t, [(half, t % 2)], (0.2 * t, -0.2 * t, 0.2 * t - half)) for t in range(16)]),
        "negative": (1.0, 2, [line(t, [(half, 0), (2.25, 1)], (-0.25, -1.0, -1.5 - t)) for t in range(3)]),
        "utm": (0.2, 3, _walk(3, 3, np.array([448262.3, 5411932.7, 301.1]))),
        "ignored": (1.0, 3, [_ignored(np.uint8, 255), _ignored(np.uint16, 65535, index=1)]),
        "many_classes": (1.0, 300, [line(t, [(half, np.uint16(label)), (1.5, 7)]) for t, label in enumerate((3, 299))]),
        "scores": (1.0, 3, [line(t, hits) for t, hits in enumerate(_scored())]),
        "half_scores": (0.5, 3, _walk(2, 3, np.zeros(3), soft=np.float16)),
        "random": (0.5, 4, _walk(6, 4, np.array([0.03, -0.04, 0.05]))),
        "random_scores": (0.5, 4, _walk(4, 4, np.array([0.03, -0.04, 0.05]), soft=np.float32)),
    }


def _pinhole() -> Frame:
    """Unlike focal lengths, a centre off the middle, and a camera that is turned about an axis of no plane."""
    depth = np.array([[1.0, 1.5, 2.0, 2.5], [1.1, 1.6, 2.1, 2.6], [3.0, 3.25, 3.5, 3.75]], np.float32)
    labels = (np.arange(12).reshape(3, 4) % 3).astype(np.uint8)
    return Frame(0, depth, Intrinsics(3.0, 4.0, 1.25, 0.75), _pose((0.3, -0.5, 0.7), (0.1, 0.2, -0.3)), labels=labels)


def _ignored(kind: type[Any], ignore: int, index: int = 0) -> Frame:
    """Depth that is none, and labels that are none: of eight pixels two count."""
    depth = np.array([[0.5, 0.0, -1.0, np.nan, np.inf, 0.5, 1.5, 2.5]], np.float32)
    labels = np.array([[0, 1, 1, 1, 1, ignore, 2, ignore]], kind)
    T_wc = np.eye(4)
    T_wc[:3, 3] = 0.5, 0.5, 0.0
    return Frame(index, depth, Intrinsics(FAR, FAR, 0, 0), T_wc, labels=labels)


def _scored() -> list[list[tuple[float, tuple[float, ...]]]]:
    """Scores that sum to 1 and that do not; none at all; not finite; two pixels in one voxel."""
    nan, inf = float("nan"), float("inf")
    return [
        [(0.5, (0.5, 0.25, 0.25)), (1.5, (2.0, 1.0, 1.0))],
        [(0.5, (0.0, 0.0, 0.0)), (1.5, (nan, 1.0, 0.0)), (2.5, (inf, 0.0, 0.0)), (0.7, (0.0, 3.0, 1.0))],
        [(0.2, (1.0, 0.0, 0.0)), (0.4, (0.0, 0.0, 8.0)), (1.5, (0.1, 0.2, 0.7))],
    ]


def _walk(count: int, K: int, start: Float64, soft: type[Any] | None = None) -> list[Frame]:
    """A camera that wanders and turns before a scattered scene with gaps; labels, or scores of a type."""
    rng = np.random.default_rng(count)
    frames = []
    for index in range(count):
        depth = rng.uniform(0.5, 3, (6, 8)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0
        labels = rng.choice([*range(K), 255], size=depth.shape).astype(np.uint8)
        given: dict[str, Any] = {"labels": labels}
        if soft is not None:
            given = {"scores": rng.random((*depth.shape, K)).astype(soft)}
        T_wc = _pose(rng.normal(0, 0.2, 3), start + rng.normal(0, 0.3, 3))
        frames.append(Frame(index, depth, Intrinsics(7.0, 7.5, 3.4, 2.6), T_wc, **given))
    return frames


def _pose(turn: Sequence[float] | Float64, at: Any) -> Float64:
    """Camera-to-world: turned about x, then y, then z (radians)."""
    T_wc = np.eye(4)
    for axis, angle in enumerate(turn):
        R, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
        R[i, i] = R[j, j] = np.cos(angle)
        R[i, j], R[j, i] = -np.sin(angle), np.sin(angle)
        T_wc[:3, :3] = R @ T_wc[:3, :3]
    T_wc[:3, 3] = at
    return T_wc


def make(folder: Path) -> None:
    """Write every case into a folder of its own."""
    for name, (voxel_size, classes, frames) in cases().items():
        write_case(folder / name, voxel_size, classes, frames)
        fuse("numpy", folder / name, folder / name / EXPECTED)
    write_text(folder / "order.txt", "\n".join([*cases(), ""]))


if __name__ == "__main__":
    make(Path(sys.argv[1]))
