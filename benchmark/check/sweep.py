"""Scans that were not deskewed: their points lie nearer to surfaces where the motion in a sweep is taken out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Convention
from semstab.check.scan_sample import ScanSample
from semstab.check.surfaces import Surfaces
from semstab.check.trials import Hypothesis, ranked
from semstab.check.verdict import BETTER, Fit, Verdict
from semstab.core.types import Float64
from semstab.datasets.geometry.sweeps import SWEEPS, Sweep, carried, motion_in_sweep, share_of_sweep

LEAST = 0.001
"""A sweep is also right if it reduces the error by a millimetre."""


@dataclass(frozen=True, eq=False)
class Swept:
    """Points of scans against surfaces of other scans, and the motions (6,) of both sensors in a sweep, by pair."""

    pairs: tuple[tuple[Surfaces, Float64, Float64], ...]

    @classmethod
    def from_sample(cls, sample: ScanSample) -> Swept:
        """Seek the points of each pair of scans; pairs of which no point is near to a surface are left out."""
        motions = {p: _motion(sample, p) for pair in sample.pairs for p in pair}
        sought = [(sample.surfaces((a, b)), motions[a], motions[b]) for a, b in sample.pairs]
        return cls(tuple(sought_pair for sought_pair in sought if sought_pair[0].met.any()))

    def by_pair(self) -> Float64:
        """Return (pairs,) the median distance of points from surfaces, metres."""
        return np.array([np.median(surfaces.distance[surfaces.met]) for surfaces, *_ in self.pairs])

    def fit(self) -> Fit:
        """Return the median distance of all points from surfaces, metres."""
        distances = np.concatenate([surfaces.distance[surfaces.met] for surfaces, *_ in self.pairs])
        return Fit(Convention(), float(np.median(distances)), 1.0, len(distances))


def _deskewed(sweep: Sweep) -> Callable[[Swept], Swept]:
    """Return how points and surfaces lie with the motion in such a sweep taken out."""

    def deskewed_pair(surfaces: Surfaces, motion: Float64, motion_of_other: Float64) -> Surfaces:
        share = share_of_sweep(surfaces.middle, sweep)
        return dataclasses.replace(
            surfaces,
            points=carried(surfaces.points, motion, share_of_sweep(surfaces.points, sweep)),
            normal=carried(surfaces.normal, motion_of_other * [1, 1, 1, 0, 0, 0], share),
            middle=carried(surfaces.middle, motion_of_other, share),
        )

    return lambda swept: Swept(tuple((deskewed_pair(*pair), *pair[1:]) for pair in swept.pairs))


HYPOTHESES = tuple(
    Hypothesis(f"a sweep {sweep}", _deskewed(sweep), f"set deskew: {sweep} (--option deskew={sweep})")
    for sweep in SWEEPS
)


def with_sweep(verdict: Verdict, sample: ScanSample) -> Verdict:
    """Return the verdict with a remark where points lie clearly nearer to surfaces once scans are deskewed."""
    if verdict.state != "sound" or sample.scene.settings.get("deskew") is not None:
        return verdict
    if not (swept := Swept.from_sample(sample)).pairs:
        return verdict
    now, best = swept.fit(), ranked(HYPOTHESES, swept)[0]
    if best.fit.error > now.error - LEAST or not best.is_right(swept, now, BETTER):
        return verdict
    return verdict.remarking(
        f"scans look as if they were not deskewed: points lie {100 * now.error:.1f} cm from the surfaces of other"
        f" scans, {100 * best.fit.error:.1f} cm where the motion in a sweep is taken out; {best.hypothesis.mend},"
        " or deskew them by the times of their points"
    )


def _motion(sample: ScanSample, position: int) -> Float64:
    """Return (6,) the motion in the sweep of the scan at a position, from its neighbours in the whole sequence."""
    scene, index = sample.scene, sample.scans[position].index
    before, after = (scene.T_wc(k) if 0 <= k < len(scene) else None for k in (index - 1, index + 1))
    return motion_in_sweep(before, scene.T_wc(index), after)
