"""What a model leaves out of its own observations: pixels that have depth and no label."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from semstab.statistics.observations import SpotObservations
from semstab.statistics.paired_differences import pairs_labelled


@dataclass(frozen=True)
class Silence:
    """What a model labels of the observations with depth.

    Attributes:
        pixels: Share of the answers that are a label.
        pairs: Share of the pairs of two views of a spot of which both have a label, spots counting by their views.
            A view whose pixels at the spot are labelled in part counts by that part.
    """

    pixels: float
    pairs: float


def silence(spots: SpotObservations) -> Silence:
    """Return what a model labels of its own sample; NaN without pixels, or without a spot that two views saw.

    Alpha of all pairs follows, in which a pair of which one has no label disagrees: see `LabelledPairs`.
    """
    labelled = spots.label < spots.K
    if not len(labelled):
        return Silence(math.nan, math.nan)
    if labelled.all():
        return Silence(1.0, 1.0)
    log = dataclasses.replace(spots, K=spots.K + 1, classes=()).observations()  # the last class: no label
    return Silence(float(labelled.mean()), min(pairs_labelled(log), 1.0))
