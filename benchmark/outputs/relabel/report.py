"""What relabelling did: pixels confirmed, changed and dropped, and whether it helped where there is ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame
from semstab.outputs.relabel.fused_labels import UNSEEN, UNSTABLE

Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Accuracy:
    """Of pixels with ground truth: how many, the share that is right, and the mean intersection over union."""

    pixels: int
    accuracy: float
    miou: float

    @classmethod
    def of(cls, confusion: Int64) -> Accuracy:
        """From (K, K) pixels by true and given class; a class counts for the mean where either has it."""
        right, n = confusion.diagonal(), int(confusion.sum())
        union = confusion.sum(axis=0) + confusion.sum(axis=1) - right
        there = union > 0
        miou = float((right[there] / union[there]).mean()) if there.any() else math.nan
        return cls(n, float(right.sum() / n) if n else math.nan, miou)


@dataclass(frozen=True)
class Correctness:
    """Against ground truth: the labels before; of the pixels that have a label before and after, both; all after.

    all_before, all_after  of all pixels with such a label
    before, after          of the same pixels, those that kept a label or took another
    """

    all_before: Accuracy
    before: Accuracy
    after: Accuracy
    all_after: Accuracy


@dataclass(frozen=True)
class Relabelled:
    """What became of the pixels of a label source; its maps are in `folder`.

    confirmed  have the class that they had      changed   have another one
    filled     had none                          unseen    had one, and have no depth or no voxel
    unstable   had one, and their voxel is not believed
    """

    scene: str
    backbone: str
    name: str
    folder: str
    frames: int
    pixels: int
    confirmed: int
    changed: int
    filled: int
    unseen: int
    unstable: int
    leave_own_out: bool = False
    correctness: Correctness | None = None

    def lines(self) -> Iterator[str]:
        """What to tell."""
        yield f"{self.scene}, {self.name}: {self.frames} frames in {self.folder}"
        counts = [
            (self.confirmed, "confirmed"),
            (self.changed, "changed"),
            (self.filled, "filled in"),
            (self.unseen, "dropped for want of depth or a voxel"),
            (self.unstable, "dropped as unstable"),
        ]
        yield f"  of {self.pixels:,} pixels " + ", ".join(f"{n / self.pixels:.1%} {what}" for n, what in counts)
        if not self.leave_own_out:
            yield "  the stability of these maps says nothing: a voxel has one class in all of them"
        if self.correctness is not None:
            c = self.correctness
            yield (
                f"  accuracy {c.before.accuracy:.4f} before and {c.after.accuracy:.4f} after, mean IoU"
                f" {c.before.miou:.4f} and {c.after.miou:.4f}: {c.after.pixels:,} pixels with ground truth and a label"
                f" in both; all {c.all_before.pixels:,} before: {c.all_before.accuracy:.4f},"
                f" mean IoU {c.all_before.miou:.4f}"
            )


class Tally:
    """Pixels, counted frame by frame."""

    def __init__(self, K: int) -> None:
        self._K = K
        self.counts = dict.fromkeys(("pixels", "confirmed", "changed", "filled", "unseen", "unstable"), 0)
        self._confusion = {name: np.zeros((K, K), np.int64) for name in ("all_before", "before", "after", "all_after")}

    def add(self, own: Frame, fused: Int64, truth: Frame | None) -> None:
        """A frame as it was, its fused rows (H, W), and its ground truth in the same classes."""
        before = np.where(own.predicted == own.ignore_id, UNSEEN, own.predicted.astype(np.int64))
        had, has = before >= 0, fused >= 0
        found = {
            "pixels": np.ones(fused.shape, np.bool_),
            "confirmed": had & has & (before == fused),
            "changed": had & has & (before != fused),
            "filled": ~had & has,
            "unseen": had & (fused == UNSEEN),
            "unstable": had & (fused == UNSTABLE),
        }
        for name, where in found.items():
            self.counts[name] += int(np.count_nonzero(where))
        if truth is not None and truth.shape == fused.shape:
            right = truth.predicted.astype(np.int64)
            known = truth.predicted != truth.ignore_id
            self._count("all_before", right, before, known & had)
            self._count("before", right, before, known & had & has)
            self._count("after", right, fused, known & had & has)
            self._count("all_after", right, fused, known & has)

    def correctness(self) -> Correctness | None:
        """None where no pixel had ground truth."""
        if not self._confusion["all_before"].any():
            return None
        return Correctness(**{name: Accuracy.of(confusion) for name, confusion in self._confusion.items()})

    def _count(self, name: str, right: Int64, given: Int64, where: npt.NDArray[np.bool_]) -> None:
        pairs = right[where] * self._K + given[where]
        self._confusion[name] += np.bincount(pairs, minlength=self._K**2).reshape(self._K, self._K)
