"""Unsure pixels are left out."""

from __future__ import annotations

import numpy as np

from semstab.predict.filters import Belief, Filter, Parameter, Shown


class Threshold(Filter):
    """Nothing is said where the largest score is below the threshold."""

    parameter = Parameter("the score from which a pixel counts", 0.6, 0, 1)
    needs_scores = True

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        sure = belief.max(axis=2, keepdims=True) >= np.float32(self.value)
        return np.where(sure, belief, np.float32(0))
