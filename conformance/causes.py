"""The likely cause of a wrong table, in words: the mistakes that everyone makes once, each tried on the case."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semstab.backends.from_observations import FromObservations, Given
from semstab.backends.shared.association import back_project, in_world
from semstab.conformance.files import Rows, as_rows
from semstab.core.types import Float64
from semstab.data.frames import Frame
from semstab.errors import DataError

NEAR = 1e-4
"""Evidence that differs by less is explained: what rounding adds to a mistake."""

MOST_FRAMES, MOST_PIXELS = 400, 1 << 20
"""Cases of more frames or pixels are not tried: they are there for counters."""


def _world(frame: Frame, voxel_size: float) -> Float64:  # noqa: ARG001  as all mistakes
    return back_project(frame)


def _half_off(frame: Frame, voxel_size: float) -> Float64:
    return back_project(frame) + voxel_size / 2


def _single(frame: Frame, voxel_size: float) -> Float64:  # noqa: ARG001
    """Return world coordinates as float32 gives them."""
    row, column = np.nonzero(frame.valid)
    z, T_wc = frame.depth[row, column], frame.T_wc.astype(np.float32)
    if frame.points is not None:
        x, y, z = frame.points[row, column].T
    else:
        x, y = (ray.astype(np.float32)[at] * z for ray, at in zip(frame.rays, (column, row), strict=True))
    return in_world((x, y, z), T_wc)  # type: ignore[arg-type]


def _rounded(frame: Frame, voxel_size: float) -> Float64:  # noqa: ARG001
    return back_project(frame).astype(np.float32)


def _floor(q: Float64) -> Float64:
    below: Float64 = np.floor(q)
    return below


@dataclass(frozen=True)
class Mistake:
    """A mistake: changes of a frame, of its points (3, n) and of the voxels of points (n, 3), and the mend in words."""

    words: str
    read: Callable[[Frame], Frame] = lambda frame: frame
    points: Callable[[Frame, float], Float64] = _world
    index: Callable[[Float64], Float64] = _floor


def _inverse(frame: Frame) -> Frame:
    return replace(frame, T_wc=np.linalg.inv(frame.T_wc).astype(np.float64))


def _exchanged(frame: Frame) -> Frame:
    if frame.scores is None:
        return frame
    H, W, K = frame.scores.shape
    return replace(frame, scores=np.ascontiguousarray(frame.scores.reshape(K, H, W).transpose(1, 2, 0)))


MISTAKES = (
    Mistake("indices are rounded, half a voxel off; take floor(x_w / r)", points=_half_off),
    Mistake("indices are cut towards zero; take floor(x_w / r)", index=np.trunc),
    Mistake("the pose is applied as world to camera; [R T] is camera to world", read=_inverse),
    Mistake("positions are float32; compute x_w and x_w / r in float64", points=_single),
    Mistake("positions are float32; compute x_w and x_w / r in float64", points=_rounded),
    Mistake("the class axis is exchanged: scores are (H, W, K), the K scores of a pixel together", read=_exchanged),
)


class _Mistaken(FromObservations):
    """The reference with a mistake."""

    def __init__(self, voxel_size: float, num_classes: int, mistake: Mistake) -> None:
        super().__init__(voxel_size, num_classes)
        self._mistake = mistake

    def observe(self, frame: Frame) -> Given:
        """Return the frame's observations, with the mistake."""
        frame, K = self._mistake.read(frame), self.num_classes
        points, valid = self._mistake.points(frame, self.voxel_size), frame.valid
        q = self._mistake.index(points.T / np.array(self.voxel_size, points.dtype)).astype(np.int64)
        index, voxel, pixels = np.unique(q, axis=0, return_inverse=True, return_counts=True)
        s = np.eye(K)[frame.labels[valid]] if frame.scores is None else frame.scores[valid].astype(np.float64)  # type: ignore[index]
        evidence = np.zeros((len(index), K))
        np.add.at(evidence, voxel.ravel(), s / s.sum(axis=1, keepdims=True))
        return index, evidence, pixels


def likely_cause(voxel_size: float, num_classes: int, frames: Sequence[Frame], expected: Rows, actual: Rows) -> str:
    """Return the mistake that gives the actual rows of these frames, in words with its mend, or ''."""
    return next(_causes(voxel_size, num_classes, frames, expected, actual), "")


def _causes(
    voxel_size: float, num_classes: int, frames: Sequence[Frame], expected: Rows, actual: Rows
) -> Iterator[str]:
    if not actual:
        return
    classes = [f"evidence_{k}" for k in range(num_classes)]
    if expected.keys() == actual.keys():
        op, pixels = ({q: row[name] for q, row in expected.items()} for name in ("op", "pixels"))
        given = {q: row["op"] for q, row in actual.items()}
        if op != pixels and given == pixels:
            yield "OP counts pixels; it counts the frames that saw the voxel"
        if op == given and all(name in next(iter(actual.values())) for name in classes):
            yield from _of_evidence(classes, expected, actual)
    if len(frames) > MOST_FRAMES or sum(frame.depth.size for frame in frames) > MOST_PIXELS:
        return
    for mistake in MISTAKES:
        backend = _Mistaken(voxel_size, num_classes, mistake)
        try:
            for frame in frames:
                backend.integrate(frame)
        except DataError:  # the mistake puts points out of reach
            continue
        made = as_rows(backend.table())
        if _alike(made, actual) and not _alike(made, expected):
            yield mistake.words


def _of_evidence(classes: Sequence[str], expected: Rows, actual: Rows) -> Iterator[str]:
    right, given = ([[row[name] for name in classes] for _, row in sorted(rows.items())] for rows in (expected, actual))
    pixels = [row["pixels"] for _, row in sorted(expected.items())]
    sums = [math.fsum(row) for row in given]
    if np.allclose(sums, pixels) and not np.allclose(sums, [math.fsum(row) for row in right]):
        yield "pixels are counted, not averaged; divide a frame's sums in a voxel by its pixels there"
    a, b = (np.array(rows).T.round(9) for rows in (right, given))
    if not np.array_equal(a, b) and sorted(a.tolist()) == sorted(b.tolist()):
        yield "classes are exchanged: evidence_k is that of class k"


def _alike(made: Rows, actual: Rows) -> bool:
    """Return whether voxels, OP and evidence are the same, as far as they are given."""
    if made.keys() != actual.keys():
        return False
    names = [name for name in next(iter(actual.values())) if name == "op" or name.startswith("evidence_")]
    return all(
        abs(row[name] - made[q].get(name, math.inf)) <= NEAR * row["op"] for q, row in actual.items() for name in names
    )
