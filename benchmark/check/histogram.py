"""Which classes a label source predicts, how often, and which ids no class has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from semstab.model.frames import Frame
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace

MOST_IDS = 5


@dataclass(frozen=True)
class Histogram:
    """The labels of a backbone in some frames.

    space     its taxonomy's name, or None where none is known
    pixels    looked at
    classes   share of them by class, in the taxonomy's order; by id where no taxonomy is known
    ignored   share with the ignore id, or without usable scores
    unknown   share by id that no class has
    problem   what is wrong, or None
    """

    backbone: str
    space: str | None
    pixels: int
    classes: Mapping[str, float]
    ignored: float
    unknown: Mapping[int, float]
    problem: str | None


class Tally:
    """Counts the labels of a backbone, frame by frame."""

    def __init__(self, backbone: str) -> None:
        self.backbone = backbone
        self._ids: Counter[int] = Counter()
        self._ignored = 0
        self._widths: set[int] = set()

    def add(self, frame: Frame) -> None:
        """Count a frame's labels, or the classes of its largest scores."""
        counts = np.bincount(frame.predicted.ravel())
        found = {int(i): int(counts[i]) for i in np.flatnonzero(counts)}
        self._ignored += found.pop(frame.ignore_id, 0)
        self._ids.update(found)
        if frame.scores is not None:
            self._widths.add(frame.scores.shape[2])

    def histogram(self, space: LabelSpace | None, missing: str | None = None) -> Histogram:
        """The shares, with what is wrong about them; `missing` says why there is no taxonomy."""
        ids = self._named(space)
        total = max(1, self._ignored + ids.total())
        if space is None:
            classes, unknown = {str(i): n / total for i, n in sorted(ids.items())}, {}
        else:
            classes = {name: ids[i] / total for name, i in zip(space.classes, space.ids, strict=True)}
            unknown = {i: n / total for i, n in sorted(ids.items()) if i not in space.ids}
        return Histogram(
            backbone=self.backbone,
            space=None if space is None else space.name,
            pixels=self._ignored + ids.total(),
            classes=classes,
            ignored=self._ignored / total,
            unknown=unknown,
            problem=missing or self._problem(space, unknown, ids.total()),
        )

    def _named(self, space: LabelSpace | None) -> Counter[int]:
        """The counts by the taxonomy's ids: scores count in its order, and 255 in a 16-bit map may mean 'ignore'."""
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
            return f"scores of {self.backbone} hold {widths} classes, {space.name} has {len(space)}"
        if space is not None and unknown:
            listed = ", ".join(map(str, list(unknown)[:MOST_IDS])) + (", ..." if len(unknown) > MOST_IDS else "")
            return (
                f"labels of {self.backbone}: id {listed} ({sum(unknown.values()):.2%} of the pixels) is outside the"
                f" taxonomy {space.name} (ids {min(space.ids)} to {max(space.ids)})"
            )
        return None if labelled else f"labels of {self.backbone}: no pixel has a label"
