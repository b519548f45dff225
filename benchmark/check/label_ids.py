"""Ids of label maps: renamed from a frame on, counted from 1, interpolated; maps that are empty or of one class."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.check.chain import Chain, MapContent
from semstab.check.continuity import Neighbours
from semstab.core.types import Int64, Mask
from semstab.data.features import OF_FEATURES
from semstab.data.labels import LabelSpace

LEAST_POINTS = 15
"""Points of a class that tell what its id is in another frame, ..."""

MOSTLY = 0.5
"""... and the share of them that must have that id."""

LEAST_RENAMED = 2
"""Classes whose ids change at once: a model that changes its mind about one thing renames one."""

REACH = 8
"""Frames on each side of a place, in the chain, that tell whether ids stay there."""

BESIDE = 2
"""Places before and after the found one at which ids may have changed."""

ROLLING = 0.5
"""Share of the places that tell at which ids change: from then on they change from frame to frame."""

MANY = 4
"""A map of one class is remarkable if the maps around it have this number of classes, and agree less than usual."""

MOST_NAMED = 5

BAND_SHARE = 0.5
BAND_PAIRS = 2
BAND_BORDERS = 50
"""The share of the borders of two classes at which the pixel between has an id between, which shows interpolation (real
networks: up to 0.1, resized maps from 0.9); BAND_PAIRS pairs of classes with BAND_BORDERS border pixels need it."""

ID_SHARE = 0.75
"""The share of the ids between the first and the last that are used if ids are suspected to count from 1."""

NOTHINGS = ("background", "clutter", "ignore", "none", "other", "unknown", "unlabeled", "unlabelled", "void")
"""Words in the name of a first class that labels may well lack."""

LEAST_MAPS = 4
"""The least maps that tell of one class in all frames."""

Ids = npt.NDArray[Any]


@dataclass(frozen=True)
class Renaming:
    """Ids that change from one frame to the next.

    Attributes:
        at: Place in the chain of the first frame after it.
        ids: Ids before, and after.
        share: Share of the points of these classes that follow it.
        tells: Whether enough classes are seen for any to be found.
    """

    at: int
    ids: tuple[tuple[int, int], ...]
    share: float
    tells: bool


class Renamings:
    """The ids of points that two frames of a chain see, counted between places in it.

    `counts(over)` is (K, K): how often an id, of the ids in ascending order, is another one in the later frame.
    """

    def __init__(self, chain: Chain) -> None:
        place = {position: k for k, position in enumerate(chain.positions)}
        linked = [((place[a], place[b]), link.labels) for (a, b), link in chain.links.items() if link.labels.size]
        self.count = len(chain.positions)
        self.first: Int64 = np.array([a for (a, _), _ in linked], dtype=np.int64)
        self.second: Int64 = np.array([b for (_, b), _ in linked], dtype=np.int64)
        label_pairs = np.concatenate([labels for _, labels in linked], axis=1) if linked else np.empty((2, 0), np.int64)
        self.ids, codes = np.unique(label_pairs, return_inverse=True)
        codes = codes.reshape(label_pairs.shape)
        self._key = codes[0] * len(self.ids) + codes[1]
        self._of = np.repeat(np.arange(len(linked)), [labels.shape[1] for _, labels in linked])

    def counts(self, links: Mask) -> Int64:
        """Return (K, K) counts of some links (n,)."""
        K = len(self.ids)
        return np.bincount(self._key[links[self._of]], minlength=K * K).reshape(K, K)

    def renaming(self, at: int, reach: int) -> Renaming:
        """Return the ids that change between the frames before a place in the chain and those from it on."""
        first, second = self.first, self.second
        near = (first >= at - reach) & (second < at + reach)
        across = self._across(at, reach)
        before, after = self.counts(near & (second < at)), self.counts(near & (first >= at))
        totals, later = across.sum(axis=1), across.argmax(axis=1)
        is_decided = totals >= LEAST_POINTS
        is_decided &= across.max(axis=1, initial=0) >= MOSTLY * totals
        stays = is_decided & (later == np.arange(len(later)))
        moved = is_decided & ~stays & _same(before) & _same(after)[later] & ~stays[later]
        targets = later[moved]
        if len(targets) < LEAST_RENAMED or len(set(targets.tolist())) < len(targets):
            return Renaming(at, (), 0.0, int(is_decided.sum()) >= LEAST_RENAMED)
        pairs = tuple((int(self.ids[i]), int(self.ids[later[i]])) for i in np.flatnonzero(moved))
        share = float(across[moved, targets].sum() / totals[moved].sum())
        return Renaming(at, pairs, share, tells=True)

    def _across(self, at: int, reach: int) -> Int64:
        """Return (K, K) counts over a place in the chain, of frames near it."""
        first, second = self.first, self.second
        return self.counts((first >= at - reach) & (first < at) & (second >= at) & (second < at + reach))

    def placed(self, found: Renaming, reach: int) -> Renaming:
        """Return a renaming at the place, of those next to it, over which most points of its classes follow it.

        One place too early or late, more than half of the points may follow it, too.
        """
        before, after = (np.searchsorted(self.ids, side) for side in zip(*found.ids, strict=True))

        def moved(at: int) -> Renaming:
            across = self._across(at, reach)
            share = float(across[before, after].sum() / max(1, across[before].sum()))
            return dataclasses.replace(found, at=at, share=share)

        nearby = range(max(1, found.at - BESIDE), min(self.count, found.at + BESIDE + 1))
        return max(map(moved, nearby), key=lambda renaming: renaming.share)


def _same(counts: Int64) -> Mask:
    """Return (K,) whether an id mostly stays, or is not seen, among frames on one side."""
    totals = counts.sum(axis=1)
    return np.asarray((totals < LEAST_POINTS) | (np.diag(counts) >= MOSTLY * totals))


def wrong_ids(neighbours: Neighbours, chain: Chain) -> str | None:
    """Return the line on ids that are not those of one taxonomy in all frames; completes 'labels of X ...'."""
    ids = Renamings(chain)
    if not len(ids.ids):
        return None
    changes = [change for change in (ids.renaming(place, 1) for place in range(1, ids.count)) if change.tells]
    rolling = [change for change in changes if change.ids]
    if len(rolling) >= max(LEAST_POINTS // 3, ROLLING * len(changes)):
        frame_name = neighbours.frame_name(chain.positions[rolling[0].at])
        return (
            f"have other ids from frame to frame, first from frame {frame_name} on ({_listed(rolling[0])}), and so at"
            f" {len(rolling)} of {len(changes)} frames: write class ids of one taxonomy in all frames"
        )
    renamings = [change for change in (ids.renaming(place, REACH) for place in range(2, ids.count - 1)) if change.ids]
    separate = list[Renaming]()
    for change in sorted(renamings, key=lambda renaming: -renaming.share * len(renaming.ids)):
        if all(abs(change.at - other.at) > REACH for other in separate):
            separate.append(change)
    if not separate:
        return None
    first = ids.placed(min(separate, key=lambda change: change.at), REACH)
    repeats = {0: "", 1: ", and once more"}.get(more := len(separate) - 1, f", and {more} more times")
    return (
        f"have other ids from frame {neighbours.frame_name(chain.positions[first.at])} on{repeats}: {_listed(first)}"
        f" ({first.share:.0%} of the points of these classes): write the ids of one taxonomy in all frames"
    )


def _listed(renaming: Renaming) -> str:
    listed = ", ".join(f"{a} becomes {b}" for a, b in renaming.ids[:MOST_NAMED])
    return f"{listed}, ..." if len(renaming.ids) > MOST_NAMED else listed


def remarks_on_maps(neighbours: Neighbours, chain: Chain) -> Iterator[str]:
    """Yield lines on maps that are empty, or of one class where those around have several; 'labels of X ...'."""
    maps, frame_name = chain.maps, neighbours.frame_name
    empty = [position for position, content in maps.items() if not content.labelled]
    if empty and len(empty) < len(maps):
        yield (
            f"have no label at all in {len(empty)} of {len(maps)} frames: {_frames(empty, frame_name)}; predict them"
            " again, or leave them out (setting frames.list)"
        )
    agreements = [link.agreement for link in chain.links.values() if np.isfinite(link.agreement)]
    usual = float(np.median(agreements)) if agreements else math.nan
    lonely = [
        position
        for position in _of_one_class({k: v for k, v in maps.items() if v.labelled})
        if not _agreement_with_others(chain, position) >= usual
    ]
    for name, group in itertools.groupby(sorted(lonely, key=lambda k: maps[k].name), lambda k: maps[k].name):
        positions = sorted(group)
        yield (
            f"have one class, id {name}, in {len(positions)} of {len(maps)} frames ({_frames(positions, frame_name)}),"
            f" while the maps around have {MANY} or more: are the files right? Predict them again"
        )


def _agreement_with_others(chain: Chain, position: int) -> float:
    """Return the median agreement with maps of several classes, or NaN without a comparison."""
    agreements = [
        link.agreement
        for pair, link in chain.links.items()
        if position in pair and not any(chain.maps[neighbour].single for neighbour in pair if neighbour != position)
    ]
    finite = [agreement for agreement in agreements if np.isfinite(agreement)]
    return float(np.median(finite)) if finite else math.nan


def _of_one_class(maps: dict[int, MapContent]) -> Iterator[int]:
    """Yield the positions of maps of one class, where the nearest others before and after have several."""
    positions = sorted(maps)
    single = {k for k in positions if maps[k].single}
    several = np.array([k for k in positions if k not in single])
    for k in sorted(single):
        position = int(np.searchsorted(several, k))
        neighbours = several[max(0, position - 1) : position + 1].tolist()
        if neighbours and all(maps[neighbour].classes >= MANY for neighbour in neighbours):
            yield k


def _frames(positions: Sequence[int], frame_name: Callable[[int], str]) -> str:
    listed = ", ".join(frame_name(k) for k in positions[: 2 * MOST_NAMED])
    return f"{listed}, ..." if len(positions) > 2 * MOST_NAMED else listed


def id_remarks(maps: Sequence[Ids], ignore: int, space: LabelSpace | None, whole: Sequence[Ids]) -> Iterator[str]:
    """Yield what ids of label maps (H, W) look wrong in, each with the mend; completes 'labels of X ...'.

    `whole` are maps of which no pixel was left out.
    """
    used = sorted({int(i) for labels in maps for i in np.unique(labels)} - {ignore})
    if space == OF_FEATURES:
        return
    if len(used) == 1 and len(maps) >= LEAST_MAPS:
        name = f" ({space.classes[space.ids.index(used[0])]})" if space is not None and used[0] in space.ids else ""
        yield f"have one class, id {used[0]}{name}, in all {len(maps)} frames that were read: are the files right?"
    if space is not None and _from_one(used, space):
        first, last = space.classes[0], space.classes[-1]
        yield (
            f"never have the first id, {space.ids[0]} ({first}), but the last, {space.ids[-1]} ({last}): if they count"
            " from 1, subtract 1"
        )
    if _is_interpolated(whole, ignore):
        yield "have thin bands of ids between those of the two sides at their borders: resize them by the nearest"


def _from_one(used: Sequence[int], space: LabelSpace) -> bool:
    ids = sorted(space.ids)
    if (
        len(ids) < 3
        or ids[0] in used
        or ids[-1] not in used
        or any(word in space.classes[0].lower() for word in NOTHINGS)
    ):
        return False
    return sum(i in used for i in ids[1:]) >= ID_SHARE * (len(ids) - 1)


def _is_interpolated(maps: Sequence[Ids], ignore: int) -> bool:
    """Return whether between two classes more than one id apart there mostly is an id between them."""
    low, middle, high = np.concatenate([_borders(labels, ignore) for labels in maps], axis=1)
    pairs, inverse, counts = np.unique(np.stack([low, high]), axis=1, return_inverse=True, return_counts=True)
    hits = np.bincount(inverse.reshape(-1), weights=(low < middle) & (middle < high), minlength=pairs.shape[1])
    shares = (hits / counts)[counts >= BAND_BORDERS]
    return len(shares) >= BAND_PAIRS and float(np.median(shares)) >= BAND_SHARE


def _borders(labels: Ids, ignore: int) -> Int64:
    """Return (3, n) lower id, id between and higher id, where those of pixels two apart differ by 2 or more."""
    H, W = labels.shape
    along = ((labels[:, k : W - 2 + k].ravel(), labels[k : H - 2 + k].ravel()) for k in range(3))
    first, between, last = (np.concatenate(directions).astype(np.int64) for directions in along)
    differ = (np.abs(first - last) >= 2) & (first != ignore) & (last != ignore) & (between != ignore)
    return np.stack([np.minimum(first, last), between, np.maximum(first, last)])[:, differ]
