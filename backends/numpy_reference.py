"""Backend `numpy`: the reference. Keeps the history H(q) of every voxel and leaves each metric to its definition."""

from __future__ import annotations

import time

import numpy as np
from semstab.backends.association import (
    Float64,
    Int64,
    Observations,
    back_project,
    check_frame,
    check_settings,
    evidence_of,
    no_observations,
    pack,
    unpack,
    voxel_index,
)
from semstab.backends.means import MapMeans
from semstab.frames import Frame
from semstab.results import FrameReport
from semstab.voxels import Events, VoxelTable, index_columns


class NumpyReference:
    """Fusion as the paper writes it: clear before fast; memory grows with every observation."""

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        check_settings(voxel_size, num_classes)
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self._row: dict[tuple[int, int, int], int] = {}  # voxel q -> its row
        self._history: list[tuple[Int64, int, Observations]] = []  # (rows, frame, observations), frame after frame
        self._evidence: list[Float64] = []  # e(q), row by row
        self._op: list[int] = []
        self._means = MapMeans()

    def integrate(self, frame: Frame) -> FrameReport:
        """Append the frame's observations to the history."""
        started = time.perf_counter()
        check_frame(frame, self.num_classes)
        seen = observe(frame, self.voxel_size, self.num_classes)
        rows, before = self._rows(seen)
        after = before + seen.s_bar
        for row, e in zip(rows.tolist(), after, strict=True):
            self._evidence[row] = e
            self._op[row] += 1
        self._history.append((rows, frame.index, seen))
        op = np.array([self._op[row] for row in rows.tolist()], dtype=np.int64)
        drift = self._means.update(before, after, op)
        return self._means.report(frame, seen.pixels, op, drift, time.perf_counter() - started)

    def table(self) -> VoxelTable:
        """The map so far, from the history."""
        return self.events().table()

    def events(self) -> Events:
        """The history: every observation of every voxel."""
        voxels = np.array(list(self._row), dtype=np.int64).reshape(-1, 3)
        order = np.lexsort(voxels.T[::-1])
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        voxel = np.concatenate([rank[rows] for rows, _, _ in self._history] or [order])
        frame = np.concatenate([np.full(len(rows), t) for rows, t, _ in self._history] or [order])
        s_bar = np.concatenate([seen.s_bar for _, _, seen in self._history] or [np.zeros((0, self.num_classes))])
        pixels = np.concatenate([seen.pixels for _, _, seen in self._history] or [order])
        by_voxel = np.argsort(voxel, kind="stable")  # stable: keeps the order of integration within a voxel
        return Events(
            **index_columns(voxels[order]),
            voxel=voxel[by_voxel],
            frame=frame[by_voxel].astype(np.int32),
            evidence=s_bar[by_voxel],
            pixels=pixels[by_voxel],
            voxel_size=self.voxel_size,
        )

    def _rows(self, seen: Observations) -> tuple[Int64, Float64]:
        """The rows of the frame's voxels, new ones added, and their evidence so far (n, K)."""
        rows = np.empty(len(seen.index), dtype=np.int64)
        for i, (ix, iy, iz) in enumerate(seen.index.tolist()):
            rows[i] = row = self._row.setdefault((ix, iy, iz), len(self._row))
            if row == len(self._evidence):
                self._evidence.append(np.zeros(self.num_classes))
                self._op.append(0)
        before = np.array([self._evidence[row] for row in rows.tolist()]).reshape(-1, self.num_classes)
        return rows, before


def observe(frame: Frame, voxel_size: float, num_classes: int) -> Observations:
    """The frame's observations: s_bar(q) = 1/|A_t(q)| sum of s_i over the pixels A_t(q) that fall into voxel q."""
    points = back_project(frame)
    if not points.shape[1]:
        return no_observations(num_classes)
    key, low, size = pack(voxel_index(points, voxel_size, frame), frame)
    voxels, inverse, pixels = np.unique(key, return_inverse=True, return_counts=True)
    s_sum = np.zeros((len(voxels), num_classes))
    np.add.at(s_sum, inverse, evidence_of(frame, num_classes))
    return Observations(unpack(voxels, low, size), s_sum / pixels[:, None], pixels)
