"""The effect of relabelling: pixels confirmed, changed and dropped, and accuracy with ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Int64
from semstab.data.frames import Frame
from semstab.data.statistics import short
from semstab.exports.fused_labels import UNSEEN, UNSTABLE
from semstab.metrics.correctness import mean_iou


@dataclass(frozen=True)
class Accuracy:
    """The accuracy and mean IoU of a number of pixels with ground truth."""

    pixels: int
    accuracy: float
    miou: float

    @classmethod
    def from_confusion(cls, confusion: Int64) -> Accuracy:
        """Return the accuracy of pixels (K, K) by true and given class; a class without pixels does not count."""
        right, n = confusion.diagonal(), int(confusion.sum())
        miou = mean_iou(right, confusion.sum(axis=1), confusion.sum(axis=0))
        return cls(n, float(right.sum() / n) if n else math.nan, float(miou))


@dataclass(frozen=True)
class RelabelCorrectness:
    """The accuracy of labels by ground truth, before and after: on all pixels, and on those with a label in both.

    Attributes:
        all_before, all_after: Accuracy on all pixels with such a label.
        before, after: Accuracy on the same pixels, those that have a label before and after.
    """

    all_before: Accuracy
    before: Accuracy
    after: Accuracy
    all_after: Accuracy


@dataclass(frozen=True)
class Relabelled:
    """The numbers of pixels of a relabelled source, whose maps are in `folder`.

    Attributes:
        confirmed: Pixels with the same class as before.
        changed: Pixels with another class than before.
        filled: Pixels that had no class.
        unseen: Pixels that had a class, and have no depth or no voxel.
        unstable: Pixels that had a class, and whose voxel fails the criteria.
    """

    scene: str
    model: str
    name: str
    folder: str
    frames: int
    pixels: int
    confirmed: int
    changed: int
    filled: int
    unseen: int
    unstable: int
    leave_one_out: bool = False
    correctness: RelabelCorrectness | None = None

    def lines(self) -> Iterator[str]:
        """Yield the report, a line each."""
        yield f"{self.scene}, {self.name}: {self.frames} frames in {self.folder}"
        counts = {
            "confirmed": self.confirmed, "changed": self.changed, "filled in": self.filled,
            "dropped without depth or voxel": self.unseen, "dropped by the criteria": self.unstable,
        }  # fmt: skip
        yield f"  of {self.pixels:,} pixels"
        yield from (f"    {n / self.pixels:6.1%} {what}" for what, n in counts.items())
        if self.correctness is not None:
            c = self.correctness
            yield f"  where both have a label and ground truth, {c.after.pixels:,} pixels:"
            yield f"    accuracy {short(c.before.accuracy, digits=3)} before, {short(c.after.accuracy, digits=3)} after"
            yield f"    mean IoU {short(c.before.miou, digits=3)} before, {short(c.after.miou, digits=3)} after"
        if not self.leave_one_out:
            yield "  do not assess the stability of these maps: a voxel has one class in all of them"


class PixelTally:
    """A count of pixels, frame by frame."""

    def __init__(self, K: int) -> None:
        self._K = K
        self.counts = dict.fromkeys(("pixels", "confirmed", "changed", "filled", "unseen", "unstable"), 0)
        self._confusion = {name: np.zeros((K, K), np.int64) for name in ("all_before", "before", "after", "all_after")}

    def add(self, frame: Frame, fused: Int64, truth: Frame | None) -> None:
        """Count the pixels of a frame, its fused rows (H, W), and its ground truth in the same classes."""
        before = np.where(frame.predicted == frame.ignore_id, UNSEEN, frame.predicted.astype(np.int64))
        had, has = before >= 0, fused >= 0
        masks = {
            "pixels": np.ones(fused.shape, np.bool_),
            "confirmed": had & has & (before == fused),
            "changed": had & has & (before != fused),
            "filled": ~had & has,
            "unseen": had & (fused == UNSEEN),
            "unstable": had & (fused == UNSTABLE),
        }
        for name, mask in masks.items():
            self.counts[name] += int(np.count_nonzero(mask))
        if truth is None or truth.shape != fused.shape:
            return
        true, has_truth = truth.predicted.astype(np.int64), truth.predicted != truth.ignore_id
        compared = {
            "all_before": (before, has_truth & had),
            "before": (before, has_truth & had & has),
            "after": (fused, has_truth & had & has),
            "all_after": (fused, has_truth & has),
        }
        for name, (labels, mask) in compared.items():
            pairs = true[mask] * self._K + labels[mask]
            self._confusion[name] += np.bincount(pairs, minlength=self._K**2).reshape(self._K, self._K)

    def correctness(self) -> RelabelCorrectness | None:
        """Return the accuracies, or None without ground truth."""
        if not self._confusion["all_before"].any():
            return None
        return RelabelCorrectness(
            **{name: Accuracy.from_confusion(confusion) for name, confusion in self._confusion.items()}
        )
