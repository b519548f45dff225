"""The classes that a label source predicts, their frequencies, and the ids that no class has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace

MOST_IDS = 5


@dataclass(frozen=True)
class Histogram:
    """The labels of a model in some frames.

    Attributes:
        space: Its taxonomy's name, or None without a taxonomy.
        pixels: Number of pixels that were counted.
        classes: Share of the pixels by class, in the taxonomy's order; by id without a taxonomy.
        ignored: Share with the ignore id, or without usable scores.
        unknown: Share by id that no class has.
        problem: The fault, or None.
    """

    model: str
    space: str | None
    pixels: int
    classes: Mapping[str, float]
    ignored: float
    unknown: Mapping[int, float]
    problem: str | None


class LabelTally:
    """The labels of a model, counted frame by frame."""

    def __init__(self, model: str) -> None:
        self.model = model
        self._ids: Counter[int] = Counter()
        self._ignored = 0
        self._widths: set[int] = set()

    def add(self, frame: Frame) -> None:
        """Count a frame's labels, or the classes of its largest scores."""
        counts = np.bincount(frame.predicted.ravel())
        by_class = {int(i): int(counts[i]) for i in np.flatnonzero(counts)}
        self._ignored += by_class.pop(frame.ignore_id, 0)
        self._ids.update(by_class)
        if frame.scores is not None:
            self._widths.add(frame.scores.shape[2])

    def histogram(self, space: LabelSpace | None, missing: str | None = None) -> Histogram:
        """Return the shares, with their fault if there is one; `missing` says why there is no taxonomy."""
        ids = self._named(space)
        total = max(1, self._ignored + ids.total())
        if space is None:
            classes, unknown = {str(i): n / total for i, n in sorted(ids.items())}, {}
        else:
            classes = {name: ids[i] / total for name, i in zip(space.classes, space.ids, strict=True)}
            unknown = {i: n / total for i, n in sorted(ids.items()) if i not in space.ids}
        return Histogram(
            model=self.model,
            space=None if space is None else space.name,
            pixels=self._ignored + ids.total(),
            classes=classes,
            ignored=self._ignored / total,
            unknown=unknown,
            problem=missing or self._problem(space, unknown, ids.total()),
        )

    def _named(self, space: LabelSpace | None) -> Counter[int]:
        """Return the counts by the taxonomy's ids: scores count in its order, and 255 of 16 bits may mean 'ignore'."""
        if space is None:
            return self._ids
        if self._widths:
            rows = dict(enumerate(space.ids))
            return Counter({rows.get(row, IGNORE_16BIT + row): n for row, n in self._ids.items()})
        if max(space.ids) < IGNORE_8BIT and IGNORE_8BIT in self._ids:
            self._ignored += self._ids.pop(IGNORE_8BIT)
        return self._ids

    def _problem(self, space: LabelSpace | None, unknown: Mapping[int, float], labelled: int) -> str | None:
        if space is not None and self._widths - {len(space)}:
            widths = ", ".join(map(str, sorted(self._widths)))
            return f"scores of {self.model} hold {widths} classes, but {space.name} has {len(space)}"
        if space is not None and unknown:
            listed = ", ".join(map(str, list(unknown)[:MOST_IDS])) + (", ..." if len(unknown) > MOST_IDS else "")
            return (
                f"labels of {self.model}: id {listed} ({sum(unknown.values()):.2%} of the pixels) is outside the"
                f" taxonomy {space.name} (ids {min(space.ids)} to {max(space.ids)})"
            ) + _counted_from_one(space, self._ids)
        return None if labelled else f"labels of {self.model}: no pixel has a label"


def _counted_from_one(space: LabelSpace, ids: Counter[int]) -> str:
    """Return what explains ids outside of a taxonomy, where they may count from 1 instead of 0."""
    counts_from_one = min(space.ids) == 0 and space.ids[0] not in ids and max(ids) == max(space.ids) + 1
    return (
        "; the ids may count from 1: write them from 0, or name what 0 means as the first class"
        if counts_from_one
        else ""
    )
