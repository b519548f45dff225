"""Agreement with distances between classes: two views that say 'cabinet' and 'cupboard' differ less than by a class.

Classes are points: z_a with |z_a - z_b|^2 = d(a, b), by classical scaling (Torgerson 1952, Psychometrika 17). Then
observed and expected disagreement follow from sums of points, as they follow from counts for labels that are equal or
not, and sums of clusters give intervals and differences.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32
from semstab.data.events import Events

NEAR = 0.5
"""Classes are near each other if their distance is at most this share of the largest one."""


def products_of(distances: Float64) -> Float64:
    """Return z_a . z_b (K, K) of points whose squared distances are these; their mean is 0."""
    rows = distances.mean(axis=0)
    products: Float64 = -0.5 * (distances - rows[:, None] - rows[None, :] + distances.mean())
    return products


def points_of(products: Float64) -> tuple[Float64, Float64]:
    """Return coordinates (K, K) that count positively, and (K, K) that count negatively: z z^T - y y^T = products.

    Distances that no points have, as of a near b near c with a far from c, need the second ones.
    """
    size, axis = np.linalg.eigh(products)
    return axis * np.sqrt(size.clip(min=0)), axis * np.sqrt((-size).clip(min=0))


def add_meaning(
    log: Events,
    cube: Int32,
    group: Int32,
    groups: int,
    distances: Float64,
    slices: Mapping[str, slice],
    sums: npt.NDArray[np.float64],
) -> None:
    """Add the sums of points to sums (cubes * groups, C), whose evidence is there.

    Args:
        log: Labels that views give spots.
        cube: (n,) the cube of each spot, -1 for those that do not count.
        group: (m,) group of frames of each observation.
        groups: Number of groups of frames.
        distances: (K, K) between classes.
        slices: Columns of the sums.
        sums: Where they are added.
    """
    from semstab.statistics.loops.pairs import add_similarity

    products = products_of(distances)
    toward, against = points_of(products)
    evidence = sums[:, slices["evidence"]]
    sums[:, slices["norm"].start] = evidence @ np.diag(products)
    sums[:, slices["toward"]], sums[:, slices["against"]] = evidence @ toward, evidence @ against
    columns = np.array([slices[name].start for name in ("similar", "similar_own", "twice_similar")])
    add_similarity(log.bounds, log.evidence.entries, cube, group, groups, products, columns, sums)


def share_near(pairs: Float64, distances: Float64) -> float:
    """Return the share of the disagreement that is between near classes, from coincidences (K, K).

    NaN if nothing disagrees.
    """
    disagreeing = pairs * (1 - np.eye(len(pairs)))
    near = distances <= NEAR * distances.max()
    return float(disagreeing[near].sum() / disagreeing.sum()) if disagreeing.sum() > 0 else float("nan")
