"""Write all conformance cases, fused by the reference: python scripts/make_conformance.py conformance/cases."""

from __future__ import annotations

import dataclasses
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

Case = tuple[float, int, list[Frame]] | tuple[float, int, list[Frame], int]
"""Voxel size in metres, number of classes, frames; how often all of them are fused, one round after the other."""

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


def many_cases() -> Mapping[str, Case]:
    """Return the cases of much: frames, pixels, classes, rows, range, digits."""
    half = 0.5
    return {
        "alike": (1.0, 3, [line(t, [(half, int(t == 3)), (1.5, 2)]) for t in range(20)], 15),
        "labels_then_scores": (1.0, 3, _mixed()),
        "frame_numbers": (
            1.0,
            2,
            [line(t, [(half, t % 2), (1.5, 0)][: 1 + n // 3]) for n, t in enumerate(FRAME_NUMBERS)],
        ),
        "small_scores": (1.0, 4, [line(t, hits) for t, hits in enumerate(_small_scores())]),
        "classes_41": (1.0, 41, [_classes(t, 41, np.uint8) for t in range(3)]),
        "classes_300": (1.0, 300, [_classes(t, 300, np.uint16) for t in range(3)]),
        "pixels_1000": (1.0, 3, [line(t, [(half, (t + n) * n % 3) for n in range(1050 - t)]) for t in range(3)]),
        "images_4096": (1.0, 3, _large_images()),
        "ranges": (0.02, 3, [_ranges(t) for t in range(3)]),
        "near": (0.0005, 3, [_rays(t, 0.001, 0.01) for t in range(3)]),
        "rays": (0.05, 3, [_at_faces(t, 0.05) for t in range(4)]),
        "quotients": (0.25, 3, [_quotients(t, f) for t, f in enumerate((49, 103, 107, 161, 187, 197))]),
        "utm_origins": (0.02, 3, _on_faces(30, 0.02)),
        "utm_faces": (0.2, 3, [_utm_face(t) for t in range(len(OFF_A_FACE) * 3)]),
        "frames_255": (1.0, 3, [line(0, [(0.2, 0), (0.4, 0), (0.6, 1)]), line(1, SEVEN)], 150),
        "frames_65536": (1.0, 3, [line(0, [(half, 0)]), line(1, [(half, 1)])], 32769),
    }


SEVEN = [*((0.1 + n / 10, (2, 2, 2, 0, 1, 1, 1)[n]) for n in range(7)), (1.5, 1)]
"""Seven pixels in one voxel, whose sevenths no binary number holds, and one in the next."""

FRAME_NUMBERS = (16777216, 3, 2147483647, 16777217)
"""Some that float32 cannot tell from another, and the largest; the last one sees a voxel alone."""

OFF_A_FACE = (0.0, 1e-7, -1e-7, 3e-8, -3e-8, 5e-9, -5e-9, 2e-9, -2e-9)
"""Metres between a face and a point; float64 numbers are 9.3e-10 m apart at 5.4e6 m, and 5.8e-11 m at 4.5e5 m."""


def _numbered() -> list[Frame]:
    return [line(t, [(0.5, t % 2), (1.5, 0)][: 1 + n // 3]) for n, t in enumerate(FRAME_NUMBERS)]


def _mixed() -> list[Frame]:
    """Labels, then scores, then labels, of 8 and of 16 bits, in two voxels."""
    return [
        line(0, [(0.5, 0), (1.5, 2)]),
        line(1, [(0.5, (0.5, 0.375, 0.125)), (1.5, (0.25, 0.25, 0.5))]),
        line(2, [(0.4, (0.125, 0.75, 0.125)), (0.6, (0.5, 0.5, 0.0))]),
        line(3, [(0.5, np.uint16(1)), (1.5, np.uint16(2))]),
    ]


def _small_scores() -> list[list[tuple[float, tuple[float, ...]]]]:
    """Scores below .001 next to large scores, down to 1e-7, and pixels whose scores are all small."""
    return [
        [(0.5, (0.9985, 0.0005, 0.0007, 0.0003)), (1.5, (1.0, 1e-5, 1e-6, 1e-7))],
        [(0.5, (0.9, 0.0995, 0.0004, 0.0001)), (0.6, (1e-4, 2e-4, 3e-4, 4e-4)), (1.5, (1e-7, 1.0, 0.0, 1e-4))],
        [(0.5, (0.0009, 0.9991, 0.0, 0.0)), (1.5, (2e-7, 1e-7, 1e-7, 4e-7))],
    ]


def _classes(t: int, K: int, kind: type[Any]) -> Frame:
    """A pixel of each class but the last t, and a second one of class t, in one voxel; one pixel in the next."""
    labels = [*range(K - t), t, (K // 2 + t) % K]
    T_wc = np.eye(4)
    T_wc[:3, 3] = 0.5, 0.5, 0.0
    depth = np.full((1, len(labels)), 0.5, np.float32)
    depth[0, -1] = 1.5
    return Frame(t, depth, Intrinsics(FAR, FAR, 0, 0), T_wc, labels=np.array([labels], kind))


def _large_images() -> list[Frame]:
    """Images of 65, 257 and 4,100 rows, and of 4,100 columns; 64 pixels share a voxel."""
    frames = []
    for t, (W, H) in enumerate([(2, 65), (2, 257), (1, 4100), (4100, 1)]):
        v, u = np.indices((H, W))
        labels = ((u + v) % 7 % 3).astype(np.uint8)
        depth = np.ones((H, W), np.float32)
        frames.append(Frame(t, depth, Intrinsics(64.0, 64.0, -0.5, -0.5), np.eye(4), labels=labels))
    return frames


def _ranges(t: int) -> Frame:
    """Depth from 1 mm to 10 km, in equal steps of its logarithm, in a narrow camera that looks past the origin."""
    return _rays(t, 0.001, 10_000.0, focal=4000.0, turn=(0.001, 0.002, 0.3))


def _rays(t: int, low: float, high: float, focal: float = 40.0, turn: Sequence[float] = (0.0, 0.0, 0.0)) -> Frame:
    """Twelve by six pixels with depth from low to high, metres."""
    depth = np.geomspace(low, high, 72).reshape(6, 12).astype(np.float32)
    labels = ((np.arange(72) * (t + 1)) % 5 % 3).reshape(6, 12).astype(np.uint8)
    T_wc = _pose(turn, (0.0001 * t, 0.0002, -0.0001))
    return Frame(t, depth, Intrinsics(focal, focal + 0.7, 5.3, 2.9), T_wc, labels=labels)


def _at_faces(t: int, voxel_size: float) -> Frame:
    """Intrinsics that float32 cannot hold, and depth that puts x as close to a face as float32 depth can."""
    camera = Intrinsics(fx=525.123456789012, fy=517.987654321098, cx=0.123456789012, cy=0.456789012345)
    u = 1 + np.arange(48).reshape(4, 12) * 13 % 599
    face = (1 + (u * 7 + t * 5) % 40) * voxel_size
    ray = (np.arange(12) - camera.cx) / camera.fx
    depth = np.full((4, 12), 0.0)
    depth[:, 1:] = face[:, 1:] / ray[None, 1:]
    labels = ((u + t) % 3).astype(np.uint8)
    T_wc = np.eye(4)
    T_wc[1, 3] = 0.013
    return Frame(t, depth.astype(np.float32), camera, T_wc, labels=labels)


def _quotients(t: int, focal: int) -> Frame:
    """A row of pixels, or a column, whose rays meet a plane in the faces: (u - c) / f times 0.25 f is (u - c) 0.25.

    In float64 a third of these products are a last digit above or below, and those of (u - c) (1 / f) are others.
    """
    n, W, H = 240, *((240, 1) if t % 2 == 0 else (1, 240))
    depth, labels = np.full((H, W), 0.25 * focal, np.float32), (np.arange(n) * (t + 1) % 7 % 3).astype(np.uint8)
    camera = Intrinsics(float(focal), float(focal), *((n / 2, 0.0) if t % 2 == 0 else (0.0, n / 2)))
    return Frame(t, depth, camera, np.eye(4), labels=labels.reshape(H, W))


def _on_faces(count: int, voxel_size: float) -> list[Frame]:
    """Points at UTM coordinates on faces of all three axes, as close as float64 knows them, in voxels apart."""
    rng = np.random.default_rng(count)
    near = np.round(np.array([448262.3, 5411932.7, 301.1]) / voxel_size)
    corners = (near + rng.integers(-500, 500, (count, 3))) * voxel_size
    return [line(t, [(0.5, t % 3)], start=at - (0.0, 0.0, 0.5)) for t, at in enumerate(corners)]


def _utm_face(n: int) -> Frame:
    """A point at UTM coordinates, on a face of a voxel or at most 1e-7 m off it, on each axis in turn."""
    axis, off = n % 3, OFF_A_FACE[n // 3]
    at = np.array([448262.3, 5411932.7, 301.1])
    at[axis] = round(at[axis] / 0.2) * 0.2 + off
    return line(n, [(0.5, n % 2), (0.5, 2 * (n % 2))], start=at - (0.0, 0.0, 0.5))


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
        **many_cases(),
        **scan_cases(),
    }


def scan_cases() -> Mapping[str, Case]:
    """Return the cases of scans."""
    images = _walk(2, 3, np.zeros(3))
    return {
        "scan": (0.5, 3, [_scan(t, 3) for t in range(4)]),
        "scan_scores": (0.5, 3, [_scan(t, 3, soft=np.float16 if t % 2 else np.float32) for t in range(4)]),
        "scan_faces": (0.2, 3, [_scan_at_faces(t, np.array([0.2 * t, 0.0, -0.4])) for t in range(3)]),
        "scan_utm": (0.2, 3, [_scan_at_faces(t, np.array([448262.2, 5411932.6, 301.0 + t])) for t in range(3)]),
        "scans_and_images": (0.5, 3, [images[0], _scan(1, 3), dataclasses.replace(images[1], index=2), _scan(3, 3)]),
    }


def _scan(t: int, K: int, soft: type[Any] | None = None) -> Frame:
    """A sensor that wanders and turns among scattered points, of which some are none: not finite, or at the sensor."""
    rng = np.random.default_rng(50 + t)
    points = rng.normal(0, 1.5, (60, 3)).astype(np.float32)
    points[:6] = [[0, 0, 0], [np.nan, 1, 1], [1, np.inf, 1], [1, 1, -np.inf], [0, 0, 1.5], [0.5, 0, 0]]
    labels = rng.choice([*range(K), 65535 if t % 2 else 255], size=60).astype(np.uint16 if t % 2 else np.uint8)
    given: dict[str, Any] = {"labels": labels}
    if soft is not None:
        given = {"scores": rng.random((60, K)).astype(soft)}
    return Frame(t, points=points, T_wc=_pose(rng.normal(0, 0.3, 3), rng.normal(0, 0.4, 3)), **given)


def _scan_at_faces(t: int, at: Float64) -> Frame:
    """Points on faces of voxels of 0.2 m, or next to them: 0.6 / 0.2 is what float64 says."""
    points = np.array([(0.2 * n, -0.2 * (n % 7), 0.2 * (n % 5) + 0.1) for n in range(1, 31)], np.float32)
    T_wc = np.eye(4)
    T_wc[:3, 3] = at
    return Frame(t, points=points, T_wc=T_wc, labels=(np.arange(30) * (t + 1) % 3).astype(np.uint8))


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


def make(folder: Path, *, leaving_out: Sequence[str] = ()) -> None:
    """Write every case into a folder of its own, but for some tables that take long."""
    for name, (voxel_size, classes, frames, *rounds) in cases().items():
        write_case(folder / name, voxel_size, classes, frames, *rounds)
        if name not in leaving_out:
            fuse("numpy", folder / name, folder / name / EXPECTED)
    write_text(folder / "order.txt", "\n".join([*cases(), ""]))


if __name__ == "__main__":
    make(Path(sys.argv[1]))
