"""Soft scores class by class, as they go to disk: one map in memory at a time, or few where the largest are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from semstab.datasets.views.same_view import fitted

Maps = Callable[[], Iterator[npt.NDArray[np.float32]]]
"""Gives the scores (H, W) of each class in order, anew at each call."""


def resized(maps: Maps, shape: tuple[int, ...], where: str) -> Maps:
    """The maps at the pixels of an image (H, W) of the same view; linear. Raises DataError for another view."""
    return lambda: (fitted(each[..., None], shape, where)[..., 0] for each in maps())


def largest_only(maps: Maps, count: int) -> Maps:
    """The maps with 0 in the place of all but each pixel's largest scores; more than `count` where some are equal."""

    def kept() -> Iterator[npt.NDArray[np.float32]]:
        largest: list[npt.NDArray[np.float32]] = []  # in falling order, (H, W) each
        for each in maps():
            rest = each
            for k, value in enumerate(largest):
                largest[k], rest = np.maximum(value, rest), np.minimum(value, rest)
            if len(largest) < count:
                largest.append(rest)
        for each in maps():
            yield np.where(each >= largest[-1], each, np.float32(0))

    return kept
