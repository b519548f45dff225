"""Trees, bushes, hedges and fences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semstab.datasets.city.classes import CLUTTER, LOW_VEGETATION, TREE
from semstab.datasets.city.mesh import Float64, Shape, Surface, blob, box, choose, combine, cone, moved
from semstab.datasets.city.plots import Barrier, Spot, columns
from semstab.datasets.city.terrain import Site

BARK = (0.33, 0.26, 0.20)
LEAVES = np.array([[0.20, 0.34, 0.12], [0.26, 0.40, 0.14], [0.17, 0.29, 0.13], [0.33, 0.41, 0.16], [0.24, 0.33, 0.20]])
NEEDLES = np.array([[0.12, 0.25, 0.15], [0.15, 0.28, 0.14]])
HEDGE = np.array([[0.22, 0.36, 0.13], [0.29, 0.40, 0.17]])
WOOD = np.array([[0.46, 0.37, 0.28], [0.60, 0.58, 0.55], [0.36, 0.29, 0.24]])
PIECE = 3.0
"""Metres of a hedge's or fence's pieces; each follows the slope under it."""


def trees(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> list[Surface]:
    """Broad-leaved trees of six forms and, one in six, conifers; a spot's size 1 is about 9 m."""
    s, t, _, size = columns(spots)
    position = site.on(s, t)
    forms = [_broadleaf(rng) for _ in range(6)] + [_conifer()]
    form = rng.integers(len(forms), size=len(spots))
    yaw = rng.uniform(0, 2 * np.pi, len(spots))
    slim = rng.uniform(0.8, 1.15, size=(len(spots), 3)) * size[:, None]
    needles = (form == len(forms) - 1)[:, None]
    tint = np.where(needles, choose(NEEDLES, len(spots), rng), choose(LEAVES, len(spots), rng))
    tint = tint * rng.uniform(0.85, 1.15, size=(len(spots), 1))
    rows = [np.flatnonzero(form == k) for k in range(len(forms))]
    return [forms[k].place(TREE, position[r], yaw[r], slim[r], tint[r]) for k, r in enumerate(rows) if len(r)]


def bushes(spots: Sequence[Spot], site: Site, rng: np.random.Generator) -> Surface:
    """Low round bushes, up to about 1.5 m."""
    s, t, _, size = columns(spots)
    position = site.on(s, t, -0.1)
    bush = moved(blob(0, rng, 0.18), (0, 0, 0.45), (0.85, 0.85, 0.8))
    extent = rng.uniform(0.75, 1.3, size=(len(spots), 3)) * size[:, None]
    tint = choose(HEDGE, len(spots), rng) * rng.uniform(0.8, 1.25, size=(len(spots), 1))
    return bush.place(LOW_VEGETATION, position, rng.uniform(0, 6.28, len(spots)), extent, tint)


def hedges(barriers: Sequence[Barrier], site: Site, rng: np.random.Generator) -> Surface:
    """Hedges 0.9 m thick and about 1.4 m high."""
    return _barriers(barriers, (0.9, 1.4), LOW_VEGETATION, HEDGE, site, rng)


def fences(barriers: Sequence[Barrier], site: Site, rng: np.random.Generator) -> Surface:
    """Fences 8 cm thick and about 1.2 m high."""
    return _barriers(barriers, (0.08, 1.2), CLUTTER, WOOD, site, rng)


def _barriers(
    barriers: Sequence[Barrier],
    profile: tuple[float, float],
    class_id: int,
    colors: Float64,
    site: Site,
    rng: np.random.Generator,
) -> Surface:
    ends = columns(barriers).T
    counts = np.maximum(1, np.ceil(np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) / PIECE)).astype(int)
    owner = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    start, stop = (
        np.stack(site.layout.to_world(*_between(ends[owner], (number + k) / counts[owner])), axis=1) for k in (0, 1)
    )
    middle, along = (start + stop) / 2, stop - start
    size = np.stack(
        [np.hypot(*along.T) + 0.05, np.full(len(owner), profile[0]), np.full(len(owner), profile[1])], axis=1
    )
    size[:, 2] *= rng.uniform(0.9, 1.1, len(owner)) * rng.uniform(0.8, 1.2, len(ends))[owner]
    tint = choose(colors, len(ends), rng)[owner] * rng.uniform(0.92, 1.08, size=(len(owner), 1))
    position = site.terrain.on(middle[:, 0], middle[:, 1], -0.15)
    lean = site.terrain.slope(middle[:, 0], middle[:, 1])
    return box().place(class_id, position, np.arctan2(along[:, 1], along[:, 0]), size, tint, lean)


def _between(ends: Float64, share: Float64) -> tuple[Float64, Float64]:
    return ends[:, 0] + share * (ends[:, 2] - ends[:, 0]), ends[:, 1] + share * (ends[:, 3] - ends[:, 1])


def _broadleaf(rng: np.random.Generator) -> Shape:
    """A trunk and a crown of one large and three smaller dented balls; 9 m high, 6 to 7 m wide."""
    crown = [moved(blob(1, rng, 0.16), (0, 0, 5.6), (2.9, 2.9, 3.1))]
    for angle in rng.uniform(0, 0.8) + np.arange(3) * 2.1:
        reach, z, radius = rng.uniform(1.3, 2.0), rng.uniform(4.6, 6.8), rng.uniform(1.5, 2.0)
        centre = (reach * np.cos(angle), reach * np.sin(angle), z)
        crown.append(moved(blob(0, rng, 0.14), centre, (radius, radius, radius * 0.9)))
    return combine(cone(6, (-0.3, 4.0), (0.28, 0.2), color=BARK), *crown)


def _conifer() -> Shape:
    """A trunk under three stacked cones; 11 m high."""
    tiers = [cone(9, (z, z + h), (r, 0.02)) for z, h, r in ((1.4, 4.6, 2.3), (4.2, 4.2, 1.75), (7.0, 4.0, 1.15))]
    return combine(cone(6, (-0.3, 2.0), (0.25, 0.22), color=BARK), *tiers)
