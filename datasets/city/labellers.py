"""Labellers that agree with themselves for the wrong reasons, as simulated models: no verdict may be gained so."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

import cv2
import numpy as np

from semstab.core.types import UInt8
from semstab.data.labels import IGNORE_8BIT
from semstab.datasets.city.hashing import hash_integers
from semstab.datasets.city.mesh import BUILDING, ROAD, TREE
from semstab.datasets.city.simulation import CityView, Simulation

CLASSES, BORDER, CELL, DRAWS = 8, 4, 2.0, 3
"""Classes of the taxonomy; pixels about a border without label; metres of a cell of one label; predictions to agree."""

Labeller = Callable[[UInt8, CityView, Simulation], UInt8]


def _blurred(predicted: UInt8, _view: CityView, _model: Simulation, size: int) -> UInt8:
    """Return the class that most pixels of a window have."""
    shares = [cv2.blur((predicted == k).astype(np.float32), (size, size)) for k in range(CLASSES)]
    return np.asarray(np.argmax(shares, axis=0), np.uint8)


def _coarse(predicted: UInt8, _view: CityView, _model: Simulation, size: int) -> UInt8:
    """Return the label of the pixel in the middle of a block, for all of it."""
    v, u = (np.minimum(np.arange(n) // size * size + size // 2, n - 1) for n in predicted.shape)
    return np.asarray(predicted[v[:, None], u])


def _without_borders(predicted: UInt8, _view: CityView, _model: Simulation) -> UInt8:
    window = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    border = cv2.dilate(predicted, window) != cv2.erode(predicted, window)
    return np.where(border, np.uint8(IGNORE_8BIT), predicted)


def _without_doubt(predicted: UInt8, view: CityView, model: Simulation) -> UInt8:
    """Return labels without the pixels that the model would label otherwise in another frame from the same position."""
    redrawn = [model.labels(dataclasses.replace(view, frame=view.frame + 10**6 * k)) for k in range(1, DRAWS)]
    sure = np.all([other == predicted for other in redrawn], axis=0) & (view.rendered.incidence > 0.5)
    return np.where(sure, predicted, np.uint8(IGNORE_8BIT))


def _locked_to_the_world(predicted: UInt8, view: CityView, _model: Simulation) -> UInt8:
    cells = (np.floor(axis / CELL).astype(np.int64) for axis in view.positions(slice(0, len(predicted))))
    return (hash_integers(11, *cells) % np.uint64(CLASSES)).astype(np.uint8)


def _by_row(predicted: UInt8, _view: CityView, _model: Simulation) -> UInt8:
    third = np.arange(len(predicted)) * 3 // len(predicted)
    return np.broadcast_to(np.array([BUILDING, TREE, ROAD], np.uint8)[third, None], predicted.shape)


LABELLERS: Mapping[str, Labeller] = {
    "constant": lambda predicted, _view, _model: np.full_like(predicted, BUILDING),
    "two-class": lambda predicted, _view, _model: np.where(predicted == BUILDING, predicted, np.uint8(ROAD)),
    "blur-31": partial(_blurred, size=31),
    "blur-81": partial(_blurred, size=81),
    "coarse-16": partial(_coarse, size=16),
    "coarse-48": partial(_coarse, size=48),
    "border-ignoring": _without_borders,
    "hard-ignoring": _without_doubt,
    "world-locked": _locked_to_the_world,
    "by-row": _by_row,
}
"""The labellers by name; each changes a model's labels."""


def relabelled(model: Simulation, view: CityView) -> UInt8:
    """Return the labels of a model, changed by its labeller if it has one; 255 for pixels without a surface."""
    predicted = model.labels(view)
    if not model.model.labeller:
        return predicted
    nothing = view.rendered.classes == IGNORE_8BIT
    return np.where(nothing, np.uint8(IGNORE_8BIT), LABELLERS[model.model.labeller](predicted, view, model))
