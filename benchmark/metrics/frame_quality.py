"""Quality of the labels of single frames: accuracy, stability, next-frame consistency, lag behind a true change."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Mask
from semstab.data.frames import Frame
from semstab.data.image_measures import FrameQuality
from semstab.metrics.correctness import mean_iou
from semstab.pixels.warp import Correspondence, correspond

HORIZON = 8
"""Frames after a change over which lag is counted."""

NONE = -1

COUNTS = ("said", "changed", "seen", "flickering", "labelled", "sayable", "foreseen", "met", "stale", "compared")
"""The pixels that are counted, over all frames."""


class FrameQualityMeter:
    """The quality of frames in order, from the labels of a filter, of the model, and of the ground truth.

    All have labels in one label space of K classes and one size; the truth may be missing.
    """

    def __init__(self, num_classes: int) -> None:
        self._K = num_classes
        self._confusion = np.zeros((num_classes, num_classes), dtype=np.int64)
        self._counts = np.zeros(len(COUNTS))
        self._lag = Lag()
        self._before: tuple[Frame, Frame, Frame | None] | None = None
        self._accuracy: list[float] = []
        self._next_frame: list[float] = []

    def add(self, frame: Frame, model: Frame, truth: Frame | None) -> None:
        """Add the next frame."""
        if truth is not None:
            valid = frame.valid & truth.valid
            pairs = truth.predicted[valid].astype(np.int64) * self._K + frame.predicted[valid]
            confusion = np.bincount(pairs, minlength=self._K**2).reshape(self._K, self._K)
            self._confusion += confusion
            self._accuracy.append(_share(np.trace(confusion), confusion.sum()))
        is_labelled = model.predicted != model.ignore_id
        self._count(labelled=frame.valid, sayable=model.valid)
        self._count(said=is_labelled, changed=is_labelled & (frame.predicted != model.predicted))
        if self._before is not None and self._before[0].shape == frame.shape:
            self._compare(*self._before, frame, model, truth)
        self._before = frame, model, truth

    def result(self, model: str, filters: str, milliseconds: float) -> FrameQuality:
        """Return the quality so far of filters over a model; `milliseconds` is the time of the filters per frame."""
        n = dict(zip(COUNTS, self._counts.tolist(), strict=True))
        right = np.diag(self._confusion)
        return FrameQuality(
            model=model,
            filters=filters,
            changed=_share(n["changed"], n["said"]),
            flicker=_share(n["flickering"], n["seen"]),
            seen=_share(n["seen"], n["said"]),
            coverage=_share(n["labelled"], n["sayable"]),
            next_frame=_share(n["foreseen"], n["met"]),
            accuracy=_share(right.sum(), self._confusion.sum()),
            miou=float(mean_iou(right, self._confusion.sum(axis=1), self._confusion.sum(axis=0))),
            consistent_wrong=_share(n["stale"], n["compared"]),
            lag=self._lag.mean,
            changes=self._lag.changes,
            milliseconds=milliseconds,
            accuracy_by_frame=tuple(self._accuracy),
            next_frame_by_frame=tuple(self._next_frame),
        )

    def _compare(
        self, frame: Frame, model: Frame, truth: Frame | None, now: Frame, model_now: Frame, truth_now: Frame | None
    ) -> None:
        where = correspond(now, frame, depth_tolerance=math.inf)
        labelled = _not_hidden(now, frame, where) & where.bring(frame.predicted != frame.ignore_id, fill=False)
        before = where.bring(frame.predicted)
        visible = labelled & now.valid
        self._count(seen=visible, flickering=visible & (before != now.predicted))
        met = labelled & model_now.valid
        foreseen = met & (before == model_now.predicted)
        self._next_frame.append(_share(foreseen.sum(), met.sum()))
        self._count(foreseen=foreseen, met=met)
        if truth is None or truth_now is None:
            return
        compared = labelled & now.valid & truth_now.valid
        self._count(
            stale=compared & (before == now.predicted) & (now.predicted != truth_now.predicted), compared=compared
        )
        self._lag.add(where, now, model_now, truth, truth_now)

    def _count(self, **masks: Mask) -> None:
        for name, mask in masks.items():
            self._counts[COUNTS.index(name)] += np.count_nonzero(mask)


def _not_hidden(now: Frame, before: Frame, where: Correspondence) -> Mask:
    """Return the pixels (H, W) whose surface point the frame before sees: its depth there is the point's, or not known.

    Where depth is sparse, its labels are known at places of which its depth is not.
    """
    has_depth = where.bring((before.depth > 0) & (before.depth < np.inf), fill=False)
    is_visible: Mask = where.visible & (correspond(now, before).visible | ~has_depth)
    return is_visible


class Lag:
    """Frames from a true change in a direction until the labels follow, where the model follows at once.

    Each pixel is followed back to the position of its point in the frame before, even if it was hidden there: a car
    that leaves uncovers the road. It changed where its true class was not within a pixel of that position. The mean
    over `HORIZON` frames is estimated by Kaplan and Meier's product, as pixels leave the view or change again before
    their label follows; a pixel that never follows has `HORIZON`.
    """

    def __init__(self) -> None:
        self._waiting = np.zeros(HORIZON, dtype=np.int64)
        self._followed = np.zeros(HORIZON, dtype=np.int64)
        self._age: npt.NDArray[np.int16] | None = None

    def add(self, where: Correspondence, now: Frame, model: Frame, truth: Frame, truth_now: Frame) -> None:
        """Add the next frame; `where` has the positions of its pixels in the frame before, whose truth is `truth`."""
        if self._age is None:
            self._age = np.full(truth.shape, NONE, dtype=np.int16)
        true = truth_now.predicted
        valid = truth_now.valid & where.bring(truth.valid, fill=False)
        changed = valid & ~_near(truth, where, true)
        same = valid & (where.bring(truth.predicted) == true)
        age = np.where(same, where.bring(self._age, fill=NONE), NONE)
        age = np.where(age >= 0, age + 1, NONE)
        age[changed & model.valid & (model.predicted == true)] = 0
        age[age >= HORIZON] = NONE
        followed = (age >= 0) & now.valid & (now.predicted == true)
        self._waiting += np.bincount(age[age >= 0], minlength=HORIZON)
        self._followed += np.bincount(age[followed], minlength=HORIZON)
        age[followed] = NONE
        self._age = age.astype(np.int16)

    @property
    def changes(self) -> int:
        """Return how many pixels changed, where the model followed at once."""
        return int(self._waiting[0])

    @property
    def mean(self) -> float:
        """The mean in frames; NaN without changes."""
        if not self._waiting[0]:
            return math.nan
        waiting = np.maximum(self._waiting, 1)
        return float(np.cumprod(1 - self._followed / waiting).sum())


def _near(truth: Frame, where: Correspondence, true: npt.NDArray[Any]) -> Mask:
    """Return pixels whose class was seen within a pixel of their position in the frame before."""
    padded = np.pad(truth.predicted, 1, mode="edge")
    H, W = truth.shape
    near = np.zeros(true.shape, dtype=np.bool_)
    for dv in range(3):
        for du in range(3):
            near |= where.bring(np.ascontiguousarray(padded[dv : dv + H, du : du + W])) == true
    return near


def _share(part: float, of: float) -> float:
    return float(part) / float(of) if of else math.nan
