"""What the ids of a label map mean where that is not the taxonomy's own: other tables, ids for 'no label'."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.views.resampling import Labels, Scores
from semstab.errors import DataError
from semstab.model.labels import IGNORE_16BIT, ignore_id

NO_ID = IGNORE_16BIT - 1
"""In a table of class ids: an id that is not in it."""


def translated(labels: Labels, table: npt.NDArray[np.uint16], path: Path) -> Labels:
    """table[labels]. Raises DataError for an id that the table does not have."""
    ids: Labels = table[labels]
    if (unknown := ids == NO_ID).any():
        raise DataError(f"{path}: the id {labels[unknown][0]} is not in the table of classes; is it the right table?")
    return ids


def without_labels(labels: Labels, void: Collection[int]) -> Labels:
    """The ids, where one of `void` is the ignore id."""
    return np.where(np.isin(labels, [*void]), labels.dtype.type(ignore_id(labels)), labels)


def without_scores(scores: Scores, ids: Sequence[int], void: Collection[int]) -> Scores:
    """The scores (H, W, K) of classes with these ids, 0 where one of `void` has the largest."""
    ignored = np.isin(scores.argmax(axis=2), [row for row, class_id in enumerate(ids) if class_id in void])
    return np.where(ignored[..., None], scores.dtype.type(0), scores)
