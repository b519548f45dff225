"""Several maps on the very looks that all of them made, and what their order owes to the looks that some left out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.errors import DataError
from semstab.model.events import Events
from semstab.model.evidence import Evidence
from semstab.statistics.looks.entries import CellObservations
from semstab.statistics.looks.views import Views


@dataclass(frozen=True, eq=False)
class Common:
    """Maps of one scene, observed alike.

    logs      of each map: the looks at cells that all made, each with as many pixels as the map with fewest has there
    ignoring  of each map: the looks that any made, with one class more, the last, for what the map did not label
    missing   share of the pixels of these that the map did not label
    """

    logs: tuple[Events, ...]
    ignoring: tuple[Events, ...]
    missing: tuple[float, ...]


def common(maps: Sequence[CellObservations]) -> Common:
    """What samples of the same frames have in common. Raises DataError where they differ in K or voxel size."""
    if len({(looks.K, looks.voxel_size) for looks in maps}) > 1:
        raise DataError("samples of other classes or voxel sizes cannot be compared; fuse both alike")
    maps = _of_the_same_voxels(maps)
    look, first = _numbered(maps)
    pixels = np.stack([np.bincount(own, looks.weight, len(first)) for own, looks in zip(look, maps, strict=True)])
    least, most = pixels.min(axis=0), pixels.max(axis=0)
    places = CellObservations.joined(maps).only(first)
    logs, ignoring = [], []
    for looks, own, seen in zip(maps, look, pixels, strict=True):
        shared = dataclasses.replace(looks, weight=looks.weight * (least / np.where(seen > 0, seen, 1.0))[own])
        logs.append(shared.only(least[own] > 0).observations())
        ignoring.append(_filled(looks, places, most - seen).observations())
    total = most.sum()
    missing = tuple(float(1 - seen.sum() / total) if total else math.nan for seen in pixels)
    return Common(tuple(logs), tuple(ignoring), missing)


def _of_the_same_voxels(maps: Sequence[CellObservations]) -> list[CellObservations]:
    """The voxels that are in all samples by their hash, with the frames of all numbered alike."""
    share = min(looks.share for looks in maps)
    views = Views.joined([looks.views for looks in maps])
    views = views.take(np.sort(np.unique(views.frame, return_index=True)[1]))
    same = []
    for looks in maps:
        kept = looks.only(looks.drawn < share)
        rank = views.rank(looks.views.frame)
        same.append(dataclasses.replace(kept, view=rank[kept.view].astype(np.int32), views=views, share=share))
    return same


def _numbered(maps: Sequence[CellObservations]) -> tuple[list[Int64], Int64]:
    """The number of each entry's look, the same in all maps, and one entry of each look among those of all maps."""
    F = max((len(looks.views) for looks in maps), default=1)
    all_of_them = CellObservations.joined(maps)
    _, cell = np.unique(all_of_them.key, return_inverse=True)
    _, first, look = np.unique(cell * F + all_of_them.view, return_index=True, return_inverse=True)
    return np.split(look, np.cumsum([len(looks) for looks in maps])[:-1]), first


def _filled(looks: CellObservations, places: CellObservations, ignored: Float64) -> CellObservations:
    """A map's entries, and those of a further class that has the pixels `ignored` of each of the places."""
    further = dataclasses.replace(places, label=np.full(len(places), looks.K, np.uint16), weight=ignored).only(
        ignored > 0
    )
    return dataclasses.replace(CellObservations.joined([looks, further]), K=looks.K + 1, classes=())


def decided(log: Events) -> Events:
    """Each look reduced to its largest class, the lowest on ties: what labels and scores have in common."""
    label = log.evidence.rowwise(lambda s: s.round(9).argmax(axis=1))  # sums in another order are equal still
    one_hot = Evidence(np.arange(len(log) + 1), label.astype(np.uint16), np.ones(len(log)), log.K)
    return dataclasses.replace(log, evidence=one_hot)


def psa_bounds(log: Events) -> tuple[float, float]:
    """The least and the largest that the mean PSA can be, whatever the looks at the last class would have said.

    Manski (1990, American Economic Review 80): pairs of looks of which one is missing agree never, or always.
    """
    starts = log.starts
    T = np.diff(np.append(starts, len(log))).astype(np.float64)
    again = T >= 2
    if not again.any():
        return math.nan, math.nan
    said = log.evidence[:, :-1]
    known = said.sum(axis=1)

    def pairs(values: Float64) -> Float64:
        total = np.add.reduceat(values, starts, axis=0)
        own = np.add.reduceat((values**2).sum(axis=1), starts)
        products: Float64 = ((total**2).sum(axis=1) - own)[again] / (T * (T - 1))[again]
        return products

    low = pairs(said)
    high = low + 1 - pairs(known[:, None])
    return float(low.mean()), float(high.mean())
