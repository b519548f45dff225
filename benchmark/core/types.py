"""The types that signatures name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int64 = npt.NDArray[np.int64]
Int32 = npt.NDArray[np.int32]
UInt64 = npt.NDArray[np.uint64]
UInt32 = npt.NDArray[np.uint32]
UInt16 = npt.NDArray[np.uint16]
UInt8 = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

Scope = Literal["these frames", "this scene", "other scenes"]
"""The source of variation in an interval: locations, frames of the same scene flown again, or both."""

THESE_FRAMES: Scope = "these frames"
THIS_SCENE: Scope = "this scene"
OTHER_SCENES: Scope = "other scenes"

SCOPE_WORDS: Mapping[Scope, str] = {
    THESE_FRAMES: "for these very frames",
    THIS_SCENE: "for this scene flown again",
    OTHER_SCENES: "for other scenes like these",
}
"""The words of a sentence that say what an interval is for."""
