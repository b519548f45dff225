"""Stored values that mean 'no depth', where they would be taken for metres: 65535 of 16 bits is 65 m away."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.types import Float32
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.predict.dataset import NAME as PREDICTED

FRAMES = 8
"""Frames of a scene, evenly spaced over all, in which such a value is looked for."""

OPTION = "invalid_depth"

FULL = 65535.0
"""The largest number of 16 bits: hardly ever a distance."""

LEAST_SHARE = 1e-3
"""The least share of the pixels with depth that have one and the same value, the largest of all."""

GAP = 2.0
"""A value marks pixels without depth if it is at least this multiple of the largest depth below it."""


@dataclass(frozen=True)
class Sentinel:
    """A value that stands alone at the far end of the depths.

    Attributes:
        value: The value as it is stored.
        metres: The depth that it is read as.
        share: Share of the pixels with depth.
        next: The largest depth below it, metres.
    """

    value: float
    metres: float
    share: float
    next: float

    def __str__(self) -> str:
        return (
            f"{self.share:.1%} of the pixels with depth have the value {self.value:.15g} ({self.metres:.4g} m), and"
            f" nothing lies between it and {self.next:.4g} m: it means 'no depth'"
        )


def find_sentinel(depths: Iterable[Float32], scale: float) -> Sentinel | None:
    """Return the value that many `depths` (metres, `scale` stored units each) have at the far end, none near it."""
    valid = [depth[(depth > 0) & (depth < np.inf)] for depth in depths]
    pixels = sum(values.size for values in valid)
    largest = max((values.max() for values in valid if values.size), default=np.float32(0))
    below = max((rest.max() for values in valid if (rest := values[values < largest]).size), default=np.float32(0))
    share = sum(np.count_nonzero(values == largest) for values in valid) / max(1, pixels)
    value = float(f"{float(largest) * scale:.6g}")
    stands_alone = largest >= GAP * below or value == FULL
    if below == 0 or share < LEAST_SHARE or not stands_alone:
        return None
    return Sentinel(value, float(largest), share, float(below))


def with_invalid_depth(config: Config, scenes: Mapping[str, Scene]) -> tuple[Config, dict[str, str]]:
    """Return the configuration under which values that mean 'no depth' are left out, and a line by scene that has some.

    The scenes have to be opened again by that configuration. Those whose files hold no depth along the optical axis are
    passed over, as are frames that cannot be read.
    """
    sentinels = {name: sentinel for name, scene in scenes.items() if (sentinel := _of_scene(scene)) is not None}
    if not sentinels:
        return config, {}
    configured = (value for name in sentinels for value in scenes[name].settings.get(OPTION) or ())
    values = [*dict.fromkeys((*configured, *(sentinel.value for sentinel in sentinels.values())))]
    listed = ", ".join(f"{value:.15g}" for value in values)
    return _with_option(config, values), {
        name: f"{sentinel}; it is left out ({OPTION}: [{listed}])" for name, sentinel in sentinels.items()
    }


def _of_scene(scene: Scene) -> Sentinel | None:
    if OPTION not in scene.settings or scene.surface is not None or scene.settings.get("depth_kind") != "planar":
        return None
    return find_sentinel(_depths(scene), scene.depth_scale or 1)


def _depths(scene: Scene) -> Iterator[Float32]:
    for index in evenly(len(scene), FRAMES):
        with contextlib.suppress(DataError):
            yield scene.depth(index)


def _with_option(config: Config, values: list[float]) -> Config:
    """Return the configuration with these values that mean 'no depth'; where models predict, of the dataset below."""
    options = dict(config.dataset.options)
    if config.dataset.name == PREDICTED:
        below = options["dataset"]
        options["dataset"] = {**below, "options": {**below["options"], OPTION: values}}
    else:
        options[OPTION] = values
    return config.model_copy(update={"dataset": config.dataset.model_copy(update={"options": options})})
