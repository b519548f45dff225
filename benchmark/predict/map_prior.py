"""The filter `map-prior`: the belief of the map so far is the prior of what the model predicts."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from semstab.backends.shared.keys import HALF
from semstab.core.compiled import serial
from semstab.core.types import Int32
from semstab.data.frames import Frame
from semstab.predict.filters import Belief, Filter, Parameter, Shown, normalised

MOST_CERTAIN = 0.8
"""The largest probability that a prediction may give a class: labels without scores would ignore every prior."""


class MapPrior(Filter):
    """s_t(k) (E(k) + 1/K) / (n + 1), normalised, where s = MOST_CERTAIN p + (1 - MOST_CERTAIN) / K.

    E is the sum of the mean beliefs of the n frames before in the pixel's voxel; a pixel without a voxel has the prior
    1/K. The map takes the model's own beliefs, not the filter's: the filter cannot confirm itself.
    """

    parameter = Parameter("the edge of a voxel in metres", 0.2, 1e-3, 1e6)
    sequential = True
    wants_geometry = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._row_of_voxel = nb.typed.Dict.empty(nb.int64, nb.int32)
        self._evidence = np.zeros((0, 0), dtype=np.float32)
        self._pixels = np.zeros(0, dtype=np.int32)
        self._origin = np.zeros(3)

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        K = belief.shape[2]
        row, known = self._rows(shown.geometry), len(self._evidence)
        if len(self._row_of_voxel) > known:
            grown = np.zeros((len(self._row_of_voxel) + known // 4, K), dtype=np.float32)
            grown[:known] = self._evidence.reshape(-1, K)
            self._evidence, self._pixels = grown, np.zeros(len(grown), dtype=np.int32)
        prior = np.empty_like(belief)
        read_priors(row, self._evidence, prior)
        add_frame(row, belief, self._evidence, self._pixels)
        uniform = np.float32((1 - MOST_CERTAIN) / K) * belief.any(axis=2, keepdims=True).astype(np.float32)
        return normalised((np.float32(MOST_CERTAIN) * belief + uniform) * prior)

    def _rows(self, frame: Frame) -> Int32:
        """Return (H, W) the row of each pixel's voxel in the evidence, -1 without depth or out of reach."""
        if not len(self._row_of_voxel):
            self._origin = np.floor(frame.T_wc[:3, 3] / self.value)
        T = frame.T_wc.copy()
        T[:3, 3] -= self._origin * self.value  # small numbers in UTM coordinates too
        row = np.empty(frame.shape, dtype=np.int32)
        find_rows(frame.depth, frame.rays, T, self.value, self._row_of_voxel, row)
        return row


@serial
def find_rows(depth: Any, rays: Any, T: Any, size: float, row_of_voxel: Any, out: Any) -> None:
    """Fill `out` (H, W) int32 with the row of each pixel's voxel, -1 where it has none; a new voxel takes the next row.

    - `rays`: (u - cx) / fx of each column, then (v - cy) / fy of each row
    """
    ray_x, ray_y = rays
    before, row = np.int64(-1), np.int32(-1)
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            out[v, u] = -1
            d = float(depth[v, u])
            if not 0.0 < d < math.inf:
                continue
            x, y = ray_x[u] * d, ray_y[v] * d
            key, near = np.int64(0), True
            for axis in range(3):
                i = math.floor((T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * d + T[axis, 3]) / size) + HALF
                near = near and 0 <= i < 2 * HALF
                key = (key << 21) | np.int64(i)
            if near and key != before:  # neighbours often share a voxel
                before, row = key, row_of_voxel.setdefault(key, np.int32(len(row_of_voxel)))
            if near:
                out[v, u] = row


@serial
def read_priors(row: Any, evidence: Any, out: Any) -> None:
    """Fill `out` (H, W, K) with (E + 1/K) / (n + 1) of each pixel's row of `evidence`, n its sum; 1/K without a row."""
    K = out.shape[2]
    for v in range(row.shape[0]):
        for u in range(row.shape[1]):
            at, n = row[v, u], np.float32(1.0)
            if at >= 0:
                for k in range(K):
                    n += evidence[at, k]
            for k in range(K):
                own = evidence[at, k] if at >= 0 else np.float32(0.0)
                out[v, u, k] = (own + np.float32(1.0 / K)) / n


@serial
def add_frame(row: Any, belief: Any, evidence: Any, pixels: Any) -> None:
    """Add to each row of `evidence` the mean belief of its pixels with a prediction.

    `pixels` (n,) are zeros before and after.
    """
    H, W, K = belief.shape
    for step in range(3):
        for v in range(H):
            for u in range(W):
                at = row[v, u]
                if at < 0 or belief[v, u].sum() <= 0:
                    continue
                if step == 0:
                    pixels[at] += 1
                elif step == 1:
                    for k in range(K):
                        evidence[at, k] += belief[v, u, k] / pixels[at]
                else:
                    pixels[at] = 0
