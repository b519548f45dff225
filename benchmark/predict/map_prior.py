"""The belief of the map so far as a prior: what was said of a place before speaks for the same again."""

from __future__ import annotations

import numpy as np

from semstab.core.types import Float64
from semstab.model.frames import Frame
from semstab.predict.filters import Belief, Filter, Parameter, Shown, normalised
from semstab.predict.prior_kernel import add_frame, find, move, priors

# A map that answers for each pixel what frames before said of its voxel.

FIRST_SLOTS = 1 << 16


class PriorMap:
    """Sums of the beliefs of frames by voxel; a frame counts once in each voxel that it sees, by its pixels' mean.

    Open addressing with one int64 key a slot; nothing is done that grows with the map, but when it doubles.
    """

    def __init__(self, voxel_size: float, num_classes: int) -> None:
        self._size = voxel_size
        self._origin: Float64 | None = None
        self._keys = np.full(FIRST_SLOTS, -1, dtype=np.int64)
        self._rows = np.zeros(FIRST_SLOTS, dtype=np.int32)
        self._sums = np.zeros((1024, num_classes), dtype=np.float32)
        self._pixels = np.zeros(1024, dtype=np.int32)
        self._used = 0

    def prior(self, belief: Belief, frame: Frame) -> Belief:
        """(E + 1/K) / (n + 1) of each pixel's voxel (H, W, K), 1/K without depth; then the frame is added."""
        if self._origin is None:
            self._origin = np.floor(frame.T_wc[:3, 3] / self._size)
        self._make_room(frame.depth.size)
        (H, W), K, R = frame.shape, frame.intrinsics, frame.T_wc[:3, :3]
        rays = (np.arange(W) - K.cx) / K.fx, (np.arange(H) - K.cy) / K.fy
        t = frame.T_wc[:3, 3] - self._origin * self._size  # small numbers also in UTM coordinates
        row = np.empty((H, W), dtype=np.int32)
        self._used = find(frame.depth, rays, R, t, self._size, self._keys, self._rows, self._used, row)
        prior = np.empty_like(belief)
        priors(row, self._sums, prior)
        add_frame(row, belief, self._sums, self._pixels)
        return prior

    def _make_room(self, more: int) -> None:
        """For so many new voxels."""
        need = self._used + more
        if len(self._sums) < need:
            grown = np.zeros((max(need, 2 * len(self._sums)), self._sums.shape[1]), dtype=np.float32)
            grown[: self._used] = self._sums[: self._used]
            self._sums, self._pixels = grown, np.zeros(len(grown), dtype=np.int32)
        if 2 * need > len(self._keys):
            slots = 1 << int(np.ceil(np.log2(2 * need)))
            keys, rows = np.full(slots, -1, dtype=np.int64), np.zeros(slots, dtype=np.int32)
            move(self._keys, self._rows, keys, rows)
            self._keys, self._rows = keys, rows


SURE = 0.8
"""How sure a model can be at most: one that is certain, as labels without scores are, would listen to no prior."""


class MapPrior(Filter):
    """s_t(k) (E(k) + 1/K) / (n + 1), normalised, where s = SURE p + (1 - SURE) / K.

    E is the sum of what the n frames before said of the pixel's voxel. The map takes what the model said itself, not
    what came of it: it cannot confirm itself.
    """

    parameter = Parameter("the edge of a voxel in metres", 0.2, 1e-3, 1e6)
    sequential = True
    wants_geometry = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._map: PriorMap | None = None

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        K = belief.shape[2]
        if self._map is None:
            self._map = PriorMap(self.value, K)
        return normalised(capped(belief) * self._map.prior(belief, shown.geometry))


def capped(belief: Belief) -> Belief:
    """SURE p + (1 - SURE) / K, where something is said."""
    said = belief.any(axis=2, keepdims=True).astype(np.float32)
    return np.float32(SURE) * belief + np.float32((1 - SURE) / belief.shape[2]) * said
