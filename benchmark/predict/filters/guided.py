"""Borders of classes that follow those of the image: the guided filter (He, Sun and Tang 2013, TPAMI)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.predict.filters import Belief, Filter, Parameter, Shown, normalised

EPSILON = 0.05**2
"""Variance of grey values, black 0 and white 1, from which an edge is kept rather than smoothed over."""

Grey = npt.NDArray[Any]
"""(H, W) float32."""


class Guided(Filter):
    """Each class's belief as a linear function of the grey value in every window of that radius, averaged.

    Means over windows of (2 radius + 1)^2 pixels: the time does not depend on the radius. Pixels of which nothing is
    said have no part.
    """

    parameter = Parameter("the radius of the windows in pixels", 8, 1, 500, whole=True)
    wants_color = True

    def __call__(self, belief: Belief, shown: Shown) -> Belief:
        """See `Filter`."""
        import cv2

        grey = cv2.cvtColor(shown.image, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255)
        said = belief.any(axis=2).astype(np.float32)
        count = np.maximum(self._sum(said), 1)
        mean = self._sum(grey * said) / count
        variance = self._sum(grey * grey * said) / count - mean * mean
        filtered = np.empty_like(belief)
        for k in range(belief.shape[2]):
            p = np.ascontiguousarray(belief[..., k])
            mean_p = self._sum(p) / count
            a = (self._sum(grey * p) / count - mean * mean_p) / (variance + EPSILON)
            b = mean_p - a * mean
            filtered[..., k] = (self._sum(a * said) * grey + self._sum(b * said)) / count
        return normalised(np.maximum(filtered, 0))

    def _sum(self, values: Any) -> Grey:
        """Over the window of each pixel."""
        import cv2

        side = 2 * int(self.value) + 1
        return np.asarray(cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT))
