"""Cases that are written by a formula, frames and table: as files they would be large. README.md states the formula."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.conformance.files import EXPECTED, write_case, write_rows
from semstab.core.types import Float64, Int64
from semstab.data.frames import Frame, Intrinsics
from semstab.data.voxels import VoxelTable

ALONG_ONE_LINE = 2.0**60
"""So long a focal length, in pixels, that all pixels look along one line."""

K = 3


@dataclass(frozen=True)
class Formula:
    """Frames t = 0, 1, ... of W x H pixels; the label of pixel (u, v) is (t + 1) (v W + u) mod 3. Voxels are of 1 m.

    A sheet: pixel (u, v) of frame t falls into the voxel (u + t, v, 1), alone. Else: all fall into the voxel (0, 0, 0).

    Attributes:
        width, height: W and H.
        frames: Number of frames.
        sheet: Whether it is a sheet.
    """

    width: int
    height: int
    frames: int
    sheet: bool = True

    def write(self, folder: Path) -> None:
        """Write the case and its table."""
        write_case(folder, 1.0, K, [self._frame(t) for t in range(self.frames)])
        write_rows(folder / EXPECTED, self.table())

    def table(self) -> VoxelTable:
        """Return the table by its definition, from the voxel and the label of each pixel."""
        wide = self.width + self.frames if self.sheet else 1
        n = wide * (self.height if self.sheet else 1)
        evidence, sums = np.zeros((n, K)), {name: np.zeros(n) for name in ("drift", "own", "entropy")}
        op, pixels, first_frame, last_frame = (np.zeros(n, np.int64) for _ in range(4))
        for t in range(self.frames):
            voxel = self._voxels(t, wide)
            count = np.bincount(voxel * K + self._labels(t).ravel(), minlength=n * K).reshape(n, K)
            present = count.any(axis=1)
            total = count[present].sum(axis=1)
            s_bar = count[present] / total[:, None]
            before, again = evidence[present], op[present] > 0
            after = before + s_bar
            p, q = after / after.sum(axis=1, keepdims=True), before / np.maximum(op[present], 1)[:, None]
            drift = _entropy((p + q) / 2) - (_entropy(p) + _entropy(q)) / 2
            sums["drift"][present] += np.where(again, drift, 0.0)
            sums["own"][present] += (s_bar**2).sum(axis=1)
            sums["entropy"][present] += _entropy(s_bar)
            evidence[present] = after
            first_frame[present] = np.where(again, first_frame[present], t)
            last_frame[present] = t
            op[present] += 1
            pixels[present] += total
        there = np.flatnonzero(op)
        ix, iy = np.divmod(np.arange(n), n // wide)
        columns: dict[str, Any] = {"op": op, "evidence": evidence, "drift_sum": sums["drift"], "pixels": pixels}
        columns |= {"first_frame": first_frame, "last_frame": last_frame, "self_sum": sums["own"]}
        columns |= {"frame_entropy_sum": sums["entropy"], "ix": ix, "iy": iy, "iz": np.full(n, int(self.sheet))}
        return VoxelTable(**{name: column[there] for name, column in columns.items()}, voxel_size=1.0)

    def _frame(self, t: int) -> Frame:
        T_wc = np.eye(4)
        T_wc[:3, 3] = (t, 0.0, 0.5) if self.sheet else (0.5, 0.5, 0.0)
        focal, centre, depth = (1.0, -0.5, 1.0) if self.sheet else (ALONG_ONE_LINE, 0.0, 0.5)
        camera = Intrinsics(focal, focal, centre, centre)
        return Frame(t, np.full((self.height, self.width), depth, np.float32), camera, T_wc, labels=self._labels(t))

    def _labels(self, t: int) -> Any:
        n = np.arange(self.height * self.width).reshape(self.height, self.width)
        return ((t + 1) * n % K).astype(np.uint8)

    def _voxels(self, t: int, wide: int) -> Int64:
        """Return the voxel of each pixel, row by row; voxels count by ix, then iy."""
        v, u = np.indices((self.height, self.width))
        voxel: Int64 = ((u + t) * self.height + v if self.sheet else 0 * u).ravel().astype(np.int64)
        return voxel


def _entropy(p: Float64) -> Float64:
    """Return the entropy of each row of p, bits."""
    terms = np.zeros_like(p)
    np.log2(p, out=terms, where=p > 0)
    entropy: Float64 = -(p * terms).sum(axis=1)
    return entropy


FORMULAS = {
    "voxels_4096": Formula(64, 65, 3),
    "voxels_65536": Formula(16, 4112, 2),
    "pixels_65536": Formula(257, 256, 2, sheet=False),
}
"""The cases by name."""
