"""The classes and their colours, laid out like words on lines."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.model.labels import LabelSpace

WIDTH, LINE = 780.0, 24.0
"""Of the legend and of one of its lines, in points of a window of 1500."""

LETTER, DOT, GAP = 7.0, 20.0, 34.0
"""Width of a letter, of a dot, and of what is around a name and between it and the next."""

LABEL = -13.5
"""The viewer draws a label below its point: from the middle of the label to its point."""


def log_legend(stream: rr.RecordingStream, entity: str, classes: LabelSpace) -> None:
    """Dots in the classes' colours, and their names in white: a label has its point's colour, which may be dark."""
    at = places(classes)
    middle = DOT + LETTER / 2 * np.array([len(name) for name in classes.classes])
    dots = rr.Points2D(at, colors=classes.colors, radii=rr.Radius.ui_points(5.0))
    beside = at + np.stack([middle, np.full(len(at), LABEL)], axis=1)
    names = rr.Points2D(beside, colors=(255, 255, 255), labels=classes.classes, radii=0.0, show_labels=True)
    stream.log(entity, dots, static=True)
    stream.log(f"{entity}/names", names, static=True)


def size(classes: LabelSpace) -> tuple[float, float]:
    """Width and height that the legend takes."""
    return WIDTH, float(places(classes)[:, 1].max()) + LINE / 2


def places(classes: LabelSpace) -> npt.NDArray[np.float64]:
    """(K, 2) where the classes' dots are; a name is right of its dot."""
    left, line = 0.0, 0
    at = []
    for name in classes.classes:
        width = DOT + LETTER * len(name) + GAP
        if left + width > WIDTH and left > 0:
            left, line = 0.0, line + 1
        at.append((left + DOT / 2, (line + 0.5) * LINE))
        left += width
    return np.array(at)
