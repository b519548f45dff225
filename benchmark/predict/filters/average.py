"""Exponential averages of beliefs: at the pixel, or at the place."""

from __future__ import annotations

import numpy as np

from semstab.model.frames import Frame
from semstab.pixels.carry import carry
from semstab.predict.filters import Belief, Filter, Parameter, Shown


class Ema(Filter):
    """b_t = keep b_{t-1} + (1 - keep) p_t at each pixel, whatever it shows; it begins with p_t."""

    parameter = Parameter("the share that is kept of the belief before", 0.6, 0, 0.999)
    sequential = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._before: Belief | None = None

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        self._before = belief if self._before is None else mixed(self._before, belief, self.value)
        return self._before


class EmaWarped(Filter):
    """The same of each place: b_{t-1} is looked up where the pixel's surface point was, by depth and pose.

    A pixel begins anew where that point was hidden or out of view, or where there is no depth.
    """

    parameter = Ema.parameter
    sequential = True
    wants_geometry = True

    def __init__(self, value: float) -> None:
        super().__init__(value)
        self._before: tuple[Belief, Frame] | None = None

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        now = shown.geometry
        if self._before is not None:
            belief = mixed(carry(*self._before, now), belief, self.value)
        self._before = belief, now
        return belief


def mixed(before: Belief, now: Belief, keep: float) -> Belief:
    """keep * before + (1 - keep) * now; one of them alone where the other says nothing."""
    weight = np.where(now.any(axis=2), np.where(before.any(axis=2), keep, 0.0), 1.0).astype(np.float32)[..., None]
    return weight * before + (1 - weight) * now
