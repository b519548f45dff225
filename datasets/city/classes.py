"""Ids of the uavid8 classes, by which every face of the town is labelled."""

from __future__ import annotations

from functools import cache

from semstab.model.labels import LabelSpace

CLUTTER, BUILDING, ROAD, STATIC_CAR, TREE, LOW_VEGETATION, HUMAN, MOVING_CAR = range(8)


@cache
def uavid8() -> LabelSpace:
    """The label space of the town's ground truth and of every simulated backbone."""
    return LabelSpace.load("uavid8")
