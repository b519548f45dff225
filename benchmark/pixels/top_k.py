"""Only the largest scores of each pixel, for models of many classes: less memory, and a loss with a bound.

With lambda the share of a pixel's scores that is left out, its normalised scores change by lambda in total variation:
the k largest grow by a factor of 1 / (1 - lambda), what is left out was lambda. So a voxel's belief, which is a mean of
means of them, changes by at most the mean lambda of its pixels, weighted as they are, and so does its VSS, the largest
part of the belief. lambda is at most 1 - k / K, where all scores are equal, and small for a model that is sure.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from semstab.model.frames import Frame, LeftOut
from semstab.model.labels import flat
from semstab.pixels.top_k_kernel import CHUNKS, cut

BITS = {2: np.uint16, 4: np.uint32, 8: np.uint64}
AS_DOUBLE = {2: (42, 2.0**1008), 4: (29, 2.0**896), 8: (0, 1.0)}
"""By how much the bits of a number are moved up to be those of a double, and the unit that it then counts."""


def keep_largest(frame: Frame, k: int) -> Frame:
    """The frame with the k largest scores of each pixel, of equal ones those of the lowest classes; the rest are 0.

    A pixel without a prediction stays without. `scores_left_out` of the frame says what share of them was left out.
    """
    assert frame.scores is not None
    scores = frame.scores
    if k >= scores.shape[2]:
        return frame
    known = scores.dtype in (np.float16, np.float32)
    scores = np.abs(scores if known else scores.astype(np.float64))  # no -0, whose bits are large
    bits = BITS[scores.dtype.itemsize]
    kept, shares = np.zeros(scores.shape, dtype=bits), np.zeros((CHUNKS, 3))
    infinite = int(np.array(np.inf, dtype=scores.dtype).view(bits))
    shift, unit = AS_DOUBLE[scores.dtype.itemsize]
    cut(flat(scores).view(bits), k, kept.reshape(-1, scores.shape[2]), shift, unit, infinite, shares)
    pixels, total = shares[:, :2].sum(axis=0)
    left_out = LeftOut(float(total / max(pixels, 1)), float(shares[:, 2].max()))
    return dataclasses.replace(frame, scores=kept.view(scores.dtype), scores_left_out=left_out)
