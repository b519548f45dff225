"""Scans that were not deskewed: their points lie nearer to surfaces where the motion in a sweep is taken out."""

from __future__ import annotations

import dataclasses

import numpy as np

from semstab.check.geometry import WON_PAIRS, Verdict
from semstab.check.scans import ScanSample
from semstab.check.surfaces import Surfaces
from semstab.core.types import Float64
from semstab.datasets.geometry.sweeps import SWEEPS, Sweep, carried, motion_in_sweep, share_of_sweep

BETTER = 0.75
"""A sweep is right where it leaves at most this part of the distance, ..."""

LEAST = 0.001
"""... and takes away a millimetre."""


def _deskewed(surfaces: Surfaces, motion: Float64, motion_of_other: Float64, sweep: Sweep) -> Surfaces:
    """Return points and surfaces with the motion (6,) of their sensors in a sweep taken out."""
    share = share_of_sweep(surfaces.middle, sweep)
    return dataclasses.replace(
        surfaces,
        points=carried(surfaces.points, motion, share_of_sweep(surfaces.points, sweep)),
        normal=carried(surfaces.normal, motion_of_other * [1, 1, 1, 0, 0, 0], share),
        middle=carried(surfaces.middle, motion_of_other, share),
    )


def with_sweep(verdict: Verdict, sample: ScanSample) -> Verdict:
    """Return the verdict with a remark where points lie clearly nearer to surfaces once scans are deskewed."""
    if verdict.state != "sound" or sample.scene.settings.get("deskew") is not None:
        return verdict
    known = {pair: sample.surfaces(pair) for pair in sample.pairs}
    known = {pair: surfaces for pair, surfaces in known.items() if surfaces.met.any()}
    if not known:
        return verdict
    moved = {position: _motion(sample, position) for pair in known for position in pair}
    now = [each.distance[each.met] for each in known.values()]
    under = {
        sweep: [_deskewed(each, moved[a], moved[b], sweep).distance[each.met] for (a, b), each in known.items()]
        for sweep in SWEEPS
    }
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
