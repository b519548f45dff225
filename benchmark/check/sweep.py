"""Scans that were not deskewed: their points lie nearer to surfaces where the motion in a sweep is taken out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from semstab.check.geometry import WON_PAIRS, Verdict
from semstab.check.reprojection import Pair, motion
from semstab.check.scans import ScanSample
from semstab.core.types import Float64
from semstab.datasets.geometry.sweeps import SWEEPS, Sweep, carried, motion_in_sweep, share_of_sweep

NEIGHBOURS = 8
"""Points of the other scan that make a surface, ..."""

FLAT = 0.05
"""... where the least of their extents is, squared, at most this part of the middle one."""

NEAR = 2.0
"""Metres to the nearest of them, at most."""

BETTER = 0.75
"""A sweep is right where it leaves at most this part of the distance, ..."""

LEAST = 0.001
"""... and takes away a millimetre."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of one scan beside surfaces of another.

    Attributes:
        points: (n, 3) in the axes of their own sensor.
        middle, normal: (n, 3) of the surfaces, in the axes of the other.
        turn, shift: (3, 3), (3,) from the one sensor to the other.
    """

    points: Float64
    middle: Float64
    normal: Float64
    turn: Float64
    shift: Float64

    @classmethod
    def of(cls, sample: ScanSample, pair: Pair) -> Surfaces:
        """Find the surface nearest to each of the points that are sought."""
        turn, shift = motion(*(sample.scans[position].T_wc for position in pair))
        points, other = sample.sought(pair[0]), sample.points(pair[1])
        distance, nearest = sample.tree(pair[1]).query(points @ turn.T + shift, k=min(NEIGHBOURS, len(other)))
        around = other[nearest]
        middle = around.mean(axis=1)
        extents, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", *(2 * [around - middle[:, None]])))
        flat = (extents[:, 0] <= FLAT * extents[:, 1]) & (distance[:, 0] <= NEAR)
        return cls(points[flat], middle[flat], axes[flat][:, :, 0], turn, shift)

    def distances(self, motions: tuple[Float64, Float64] | None = None, sweep: Sweep | None = None) -> Float64:
        """Return (n,) metres from points to surfaces, with both sensors' motion (6,) in a sweep taken out."""
        points, middle, normal = self.points, self.middle, self.normal
        if motions is not None and sweep is not None:
            points = carried(points, motions[0], share_of_sweep(points, sweep))
            share = share_of_sweep(middle, sweep)
            normal = carried(normal, motions[1] * [1, 1, 1, 0, 0, 0], share)
            middle = carried(middle, motions[1], share)
        along = ((points @ self.turn.T + self.shift - middle) * normal).sum(axis=1)
        return np.asarray(np.abs(along), np.float64)


def with_sweep(verdict: Verdict, sample: ScanSample) -> Verdict:
    """Return the verdict with a remark where points lie clearly nearer to surfaces once scans are deskewed."""
    if verdict.state != "sound" or sample.scene.settings.get("deskew") is not None:
        return verdict
    known = {pair: Surfaces.of(sample, pair) for pair in sample.pairs}
    known = {pair: surfaces for pair, surfaces in known.items() if len(surfaces.points)}
    if not known:
        return verdict
    moved = {position: _motion(sample, position) for pair in known for position in pair}
    now = [surfaces.distances() for surfaces in known.values()]
    under = {sweep: [each.distances((moved[a], moved[b]), sweep) for (a, b), each in known.items()] for sweep in SWEEPS}
    best = min(SWEEPS, key=lambda sweep: float(np.median(np.concatenate(under[sweep]))))
    before, after = (float(np.median(np.concatenate(each))) for each in (now, under[best]))
    won = np.mean([np.median(a) < np.median(b) for a, b in zip(under[best], now, strict=True)])
    if after > min(BETTER * before, before - LEAST) or won < WON_PAIRS:
        return verdict
    text = (
        f"scans look as if they were not deskewed: points lie {100 * before:.1f} cm from the surfaces of other scans,"
        f" {100 * after:.1f} cm where the motion in a sweep is taken out; set deskew: {best} (--option deskew={best}),"
        " or deskew them by the times of their points"
    )
    return dataclasses.replace(verdict, remarks=(*verdict.remarks, text))


def _motion(sample: ScanSample, position: int) -> Float64:
    """Return (6,) the motion in the sweep of the scan at a position, from its neighbours in the whole sequence."""
    scene, index = sample.scene, sample.scans[position].index
    before, after = (scene.T_wc(k) if 0 <= k < len(scene) else None for k in (index - 1, index + 1))
    return motion_in_sweep(before, scene.T_wc(index), after)
