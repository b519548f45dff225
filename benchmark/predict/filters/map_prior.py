"""The belief of the map so far as a prior: what was said of a place before speaks for the same again."""

from __future__ import annotations

import numpy as np

from semstab.predict.filters import Belief, Filter, Parameter, Shown, normalised
from semstab.predict.filters.prior_map import PriorMap

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
