"""What a model leaves out of its own observations: pixels that have depth and no label."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from semstab.statistics.observations import CellObservations
from semstab.statistics.paired_differences import pairs_labelled


@dataclass(frozen=True)
class Silence:
    """What a model labels of the observations with depth.

    Attributes:
        pixels: Share of the sampled pixels that have a label.
        pairs: Share of the pairs of two views of a spot of which both have a label, spots counting by their views.
            A view whose pixels at the spot are labelled in part counts by that part.
    """

    pixels: float
    pairs: float


def silence(cells: CellObservations) -> Silence:
    """Return what a model labels of its own sample; NaN without pixels, or without a spot that two views saw.

    Alpha times the share of the pairs is alpha if what is left out counts as disagreeing: a pair of which one has no
    label agrees no better than by chance.
    """
    labelled, pixels = cells.label < cells.K, float(cells.weight.sum())
    if not pixels:
        return Silence(math.nan, math.nan)
    if labelled.all():
        return Silence(1.0, 1.0)
    log = dataclasses.replace(cells, K=cells.K + 1, classes=()).observations()  # the last class: no label
    return Silence(float(cells.weight[labelled].sum()) / pixels, min(pairs_labelled(log), 1.0))
