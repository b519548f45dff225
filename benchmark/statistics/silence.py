"""Observations that a model leaves out: pixels that have depth and no label."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.data.events import Events
from semstab.statistics.observations import SpotObservations


@dataclass(frozen=True)
class Silence:
    """Shares of the observations with depth that a model labels.

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


def pairs_labelled(log: Events) -> float:
    """Return the share of the pairs of two views of a spot of which neither is the last class, spots by their views."""
    op = np.bincount(log.voxel)
    return (
        float(np.average(mean_products(log, 1 - log.evidence[:, -1:]), weights=op[op >= 2]))
        if (op >= 2).any()
        else math.nan
    )


def mean_products(log: Events, shares: Float64) -> Float64:
    """Return the mean of s . s' (v,) over the pairs of observations of each spot with two or more, shares (m, C)."""
    starts = log.starts
    T = np.diff(np.append(starts, len(log))).astype(np.float64)
    again = T >= 2
    total = np.add.reduceat(shares, starts, axis=0)[again] if len(T) else np.zeros((0, shares.shape[1]))
    squares = np.add.reduceat((shares**2).sum(axis=1), starts)[again] if len(T) else np.zeros(0)
    products: Float64 = ((total**2).sum(axis=1) - squares) / (T * (T - 1))[again]
    return products
