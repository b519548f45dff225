"""How models err, at exact image coordinates: for `exact.py`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from exact_scenes import Array, Ints
from exact_views import ExactFlight, ImagePoints
from scipy import ndimage
from scipy.stats import norm

Labeller = Callable[[ImagePoints], Ints]
"""The label (n,) that a frame gives at image coordinates, the same whenever it is asked."""

Number = Callable[[ImagePoints], Array]


class Errors(Protocol):
    """A way to err."""

    def __call__(self, flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
        """Return the labels of a flight; strength: 1 where errors are as frequent, or as large, as described."""
        ...


IGNORED = 255
PAD = 8
"""Pixels around an image at which smooth fields are known as well."""

BLOB, BLOCK, METRES, SHIFT, LASTS = 4.0, 8, 3.0, 2.0, 4
"""Blur of blobs in pixels, edge of blocks in pixels, width of errors of a place, most pixels of a border, frames."""


def smooth(flight: ExactFlight, blur: float, rng: np.random.Generator) -> Number:
    """Return a smooth random field of each frame, of variance 1."""
    shape = flight.sensor.height + 2 * PAD, flight.sensor.width + 2 * PAD
    fields = []
    for _ in flight.poses:
        blurred = ndimage.gaussian_filter(rng.standard_normal(shape), blur, mode="wrap")
        fields.append(ndimage.spline_filter(blurred * 2 * blur * np.sqrt(np.pi)))

    def at(image: ImagePoints) -> Array:
        where = np.stack([image.v + PAD, image.u + PAD])
        found: Array = ndimage.map_coordinates(fields[image.frame], where, prefilter=False, mode="nearest")
        return found

    return at


def squares(flight: ExactFlight, edge: int, rng: np.random.Generator) -> Number:
    """Return a uniform number that is the same all over a square of pixels, and independent in each frame."""
    shape = len(flight.poses), -(-flight.sensor.height // edge), -(-flight.sensor.width // edge)
    drawn = rng.random(shape)

    def at(image: ImagePoints) -> Array:
        v, u = (np.floor(x + 0.5).astype(int) // edge for x in (image.v, image.u))
        return drawn[image.frame, v, u]

    return at


def of_place(metres: float, rng: np.random.Generator) -> Number:
    """Return a smooth field over space, of variance 1."""
    waves, phase = rng.normal(0, 1 / metres, (32, 3)), rng.uniform(0, 2 * np.pi, 32)
    return lambda image: np.cos(image.point @ waves.T + phase).sum(axis=1) / 4


def other(truth: Ints, by: Array, K: int) -> Ints:
    """Return another class than the true one; by: (n,) from 0 to 1."""
    return (truth + 1 + np.minimum((by * (K - 1)).astype(int), K - 2)) % K


def in_blobs(share: Number, flight: ExactFlight, K: int, rng: np.random.Generator) -> Labeller:
    """Return errors in blobs, of which `share` says how frequent they are; three classes at most stand in."""
    error, by = smooth(flight, BLOB, rng), smooth(flight, 2 * BLOB, rng)

    def label(image: ImagePoints) -> Ints:
        instead = other(image.truth, norm.cdf(by(image)) * min(3, K - 1) / (K - 1), K)
        return np.where(error(image) > norm.isf(share(image)), instead, image.truth)

    return label


def in_squares(share: float, edge: int, flight: ExactFlight, K: int, rng: np.random.Generator) -> Labeller:
    """Return errors of whole squares of pixels."""
    error, by = squares(flight, edge, rng), squares(flight, edge, rng)
    return lambda image: np.where(error(image) < share, other(image.truth, by(image), K), image.truth)


def none(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return the truth."""
    return lambda image: image.truth


def pixels(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors of 15 % of the pixels, each by itself."""
    return in_squares(0.15 * strength, 1, flight, K, rng)


def blobs(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors of blobs, 20 % of each image."""
    return in_blobs(lambda image: np.full(len(image.u), 0.2 * strength), flight, K, rng)


def blocks(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors of 20 % of the blocks of 8 x 8 pixels."""
    return in_squares(0.2 * strength, BLOCK, flight, K, rng)


def place(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors that stay at their place."""
    field = of_place(METRES, rng)
    return lambda image: np.where(field(image) > norm.isf(0.3 * strength), (image.truth + 1) % K, image.truth)


def view(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return frames of different quality: errors of up to 60 % of the image."""
    share = strength * rng.uniform(0, 0.6, len(flight.poses))
    return in_blobs(lambda image: np.full(len(image.u), share[image.frame]), flight, K, rng)


def classes(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors of every third class: half of its blocks are taken for the next one."""
    error = squares(flight, BLOCK, rng)

    def label(image: ImagePoints) -> Ints:
        taken = (image.truth % 3 == 0) & (error(image) < 0.5 * strength)
        return np.where(taken, (image.truth + 1) % K, image.truth)

    return label


def border(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return borders in the wrong place: the class of where another ray goes, up to 2 pixels away."""
    right, down = smooth(flight, BLOB, rng), smooth(flight, BLOB, rng)

    def label(image: ImagePoints) -> Ints:
        du, dv = (strength * SHIFT * np.clip(field(image) / 2, -1, 1) for field in (right, down))
        moved = flight.look(image.frame, image.u + du, image.v + dv).truth
        return np.where(moved >= 0, moved, image.truth)

    return label


def burst(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors of 60 % in every fourth frame, one after another, and of 5 % in the others."""
    F = len(flight.poses)
    bad = max(1, F // 4)
    first = rng.integers(0, F - bad + 1)
    share = strength * np.where((np.arange(F) >= first) & (np.arange(F) < first + bad), 0.6, 0.05)
    return in_blobs(lambda image: np.full(len(image.u), share[image.frame]), flight, K, rng)


def lasting(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors that stay at their place for 4 frames."""
    fields = [of_place(METRES, rng) for _ in range(len(flight.poses) // LASTS + 1)]
    least = norm.isf(0.25 * strength)
    return lambda image: np.where(fields[image.frame // LASTS](image) > least, (image.truth + 1) % K, image.truth)


def with_range(most: float) -> Errors:
    """Return errors that grow with range, from none to `most`, between the 5 and 95 % quantiles over the pixels."""

    def errors(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
        distance = np.concatenate([image.distance[image.face >= 0] for image in flight.images])
        low, high = np.quantile(distance, (0.05, 0.95))
        far = strength * most / (high - low)
        return in_blobs(lambda image: np.clip(far * (image.distance - low), 0, strength * most), flight, K, rng)

    return errors


def grazing(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors that grow from 30 degrees off the surface's normal to 70 % at 90."""
    return in_blobs(lambda image: 0.7 * strength * np.clip((image.angle - 30) / 60, 0, 1), flight, K, rng)


def corners(flight: ExactFlight, K: int, rng: np.random.Generator, strength: float = 1.0) -> Labeller:
    """Return errors that grow with the square of the image radius, to 60 % in the corners."""
    H, W = flight.sensor.height, flight.sensor.width

    def share(image: ImagePoints) -> Array:
        away = (image.u - (W - 1) / 2) ** 2 + (image.v - (H - 1) / 2) ** 2
        return np.clip(0.6 * strength * away / ((W / 2) ** 2 + (H / 2) ** 2), 0, 1)

    return in_blobs(share, flight, K, rng)


ERRORS: dict[str, Errors] = {
    "none": none, "pixels": pixels, "blobs": blobs, "blocks": blocks, "place": place, "view": view,
    "class": classes, "border": border, "burst": burst, "lasting": lasting, "range": with_range(0.35),
    "strong range": with_range(0.7), "angle": grazing, "radius": corners,
}  # fmt: skip


def unlabelled(labeller: Labeller, share: float, flight: ExactFlight, rng: np.random.Generator) -> Labeller:
    """Return the labeller without labels in blobs, a share of each image, and at pixels without a surface."""
    field = smooth(flight, BLOB, rng)

    def label(image: ImagePoints) -> Ints:
        without = image.face < 0
        if share:
            without |= field(image) < norm.ppf(share)
        return np.where(without, IGNORED, labeller(image))

    return label
