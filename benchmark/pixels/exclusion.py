"""Things that move are no evidence about a place: pixels of some classes, or under a mask, are left out of fusion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame


def leave_out(frame: Frame, classes: Sequence[int] = (), *, masks: bool = True) -> Frame:
    """The frame without the pixels of these classes, and without masked ones; the frame itself where that is none.

    classes are ids in label maps, and positions in soft scores, where a pixel's class is that of its largest score.
    The pixels lose their label; `left_out` marks those of them that had a valid depth and label.
    """
    masked = frame.mask if masks else None
    if not classes and masked is None:
        return frame
    out = np.isin(frame.predicted, np.array(classes, dtype=np.int64))
    if masked is not None:
        out |= masked
    return dataclasses.replace(frame, left_out=out & frame.valid, **_unlabelled(frame, out))


def _unlabelled(frame: Frame, where: npt.NDArray[np.bool_]) -> dict[str, Any]:
    if frame.labels is not None:
        return {"labels": np.where(where, frame.labels.dtype.type(frame.ignore_id), frame.labels)}
    assert frame.scores is not None
    return {"scores": np.where(where[..., None], frame.scores.dtype.type(0), frame.scores)}
