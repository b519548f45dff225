"""Label maps from frame to frame: ids that are renamed from a frame on, maps that are empty or of one class."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.continuity import Chain, MapContent, Neighbours
from semstab.core.types import Int64, Mask

LEAST_POINTS = 15
"""Points of a class that tell what its id is in another frame, ..."""

MOSTLY = 0.5
"""... and the share of them that must have that id."""

LEAST_RENAMED = 2
"""Classes whose ids change at once: a model that changes its mind about one thing renames one."""

REACH = 8
"""Frames on each side of a place, in the chain, that tell whether ids stay there."""

ROLLING = 0.5
"""Share of the places that tell at which ids change: from then on they change from frame to frame."""

MANY = 4
"""A map of one class is remarkable where those around it have so many, and agree less with it than usual."""

MOST_NAMED = 5


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


class Ids:
    """The ids of points that two frames of a chain see, counted between places in it.

    `counts(over)` is (K, K): how often an id, of the ids in ascending order, is another one in the later frame.
    """

    def __init__(self, chain: Chain) -> None:
        place = {position: k for k, position in enumerate(chain.positions)}
        linked = [((place[a], place[b]), link.labels) for (a, b), link in chain.links.items() if link.labels.size]
        self.count = len(chain.positions)
        self.first: Int64 = np.array([a for (a, _), _ in linked], dtype=np.int64)
        self.second: Int64 = np.array([b for (_, b), _ in linked], dtype=np.int64)
        both = np.concatenate([labels for _, labels in linked], axis=1) if linked else np.empty((2, 0), np.int64)
        self.ids, codes = np.unique(both, return_inverse=True)
        codes = codes.reshape(both.shape)
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
        across = self.counts(near & (first < at) & (second >= at))
        before, after = self.counts(near & (second < at)), self.counts(near & (first >= at))
        seen, later = across.sum(axis=1), across.argmax(axis=1)
        told = seen >= LEAST_POINTS
        told &= across.max(axis=1, initial=0) >= MOSTLY * seen
        stays = told & (later == np.arange(len(later)))
        moved = told & ~stays & _same(before) & _same(after)[later] & ~stays[later]
        targets = later[moved]
        if len(targets) < LEAST_RENAMED or len(set(targets.tolist())) < len(targets):
            return Renaming(at, (), 0.0, int(told.sum()) >= LEAST_RENAMED)
        pairs = tuple((int(self.ids[i]), int(self.ids[later[i]])) for i in np.flatnonzero(moved))
        share = float(across[moved, targets].sum() / seen[moved].sum())
        return Renaming(at, pairs, share, tells=True)

    def changes(self) -> Iterator[Renaming]:
        """Yield for each frame but the first whether its ids differ from those of the frame before it alone."""
        first, second = self.first, self.second
        for at in range(1, self.count):
            across = self.counts((first == at - 1) & (second == at))
            seen, later = across.sum(axis=1), across.argmax(axis=1)
            told = (seen >= LEAST_POINTS) & (across.max(axis=1, initial=0) >= MOSTLY * seen)
            moved = told & (later != np.arange(len(later)))
            one_to_one = len(set(later[moved].tolist())) == moved.sum() and not (told & ~moved)[later[moved]].any()
            pairs = tuple((int(self.ids[i]), int(self.ids[later[i]])) for i in np.flatnonzero(moved))
            is_one = moved.sum() >= LEAST_RENAMED and one_to_one
            yield Renaming(at, pairs if is_one else (), 1.0, int(told.sum()) >= LEAST_RENAMED)


def _same(counts: Int64) -> Mask:
    """Return (K,) whether an id mostly stays, or is not seen, among frames on one side."""
    seen = counts.sum(axis=1)
    return np.asarray((seen < LEAST_POINTS) | (np.diag(counts) >= MOSTLY * seen))


def wrong_ids(neighbours: Neighbours, chain: Chain) -> str | None:
    """Return the line on ids that are not those of one taxonomy in all frames; completes 'labels of X ...'."""
    ids = Ids(chain)
    if not len(ids.ids):
        return None
    changes = [change for change in ids.changes() if change.tells]
    rolling = [change for change in changes if change.ids]
    if len(rolling) >= max(LEAST_POINTS // 3, ROLLING * len(changes)):
        named = neighbours.named(chain.positions[rolling[0].at])
        return (
            f"have other ids from frame to frame, first from frame {named} on ({_listed(rolling[0])}), and so at"
            f" {len(rolling)} of {len(changes)} frames: write class ids of one taxonomy in all frames"
        )
    found = [each for each in (ids.renaming(at, REACH) for at in range(2, ids.count - 1)) if each.ids]
    apart = list[Renaming]()
    for each in sorted(found, key=lambda one: -one.share * len(one.ids)):
        if all(abs(each.at - other.at) > REACH for other in apart):
            apart.append(each)
    if not apart:
        return None
    first = min(apart, key=lambda each: each.at)
    again = "" if len(apart) == 1 else f", and again {len(apart) - 1} more times"
    return (
        f"have other ids from frame {neighbours.named(chain.positions[first.at])} on{again}: {_listed(first)}"
        f" ({first.share:.0%} of the points of these classes): write the ids of one taxonomy in all frames"
    )


def _listed(renaming: Renaming) -> str:
    said = ", ".join(f"{a} becomes {b}" for a, b in renaming.ids[:MOST_NAMED])
    return f"{said}, ..." if len(renaming.ids) > MOST_NAMED else said


def remarks_on_maps(neighbours: Neighbours, chain: Chain) -> Iterator[str]:
    """Yield lines on maps that are empty, or of one class where those around have several; 'labels of X ...'."""
    maps, named = chain.maps, neighbours.named
    empty = [position for position, content in maps.items() if not content.labelled]
    if empty and len(empty) < len(maps):
        yield (
            f"have no label at all in {len(empty)} of {len(maps)} frames: {_frames(empty, named)}; predict them again,"
            " or leave them out (setting frames.list)"
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
            f"have one class, id {name}, in {len(positions)} of {len(maps)} frames ({_frames(positions, named)}), while"
            f" the maps around have {MANY} or more: are the files right? Predict them again"
        )


def _agreement_with_others(chain: Chain, position: int) -> float:
    """Return the median agreement with maps of several classes; NaN where none was compared."""
    known = [
        link.agreement
        for pair, link in chain.links.items()
        if position in pair and not any(chain.maps[one].single for one in pair if one != position)
    ]
    told = [agreement for agreement in known if np.isfinite(agreement)]
    return float(np.median(told)) if told else math.nan


def _of_one_class(maps: dict[int, MapContent]) -> Iterator[int]:
    """Yield the positions of maps of one class, where the nearest others before and after have several."""
    positions = sorted(maps)
    single = {k for k in positions if maps[k].single}
    others = np.array([k for k in positions if k not in single])
    for k in sorted(single):
        at = int(np.searchsorted(others, k))
        beside = others[max(0, at - 1) : at + 1].tolist()
        if beside and all(maps[one].classes >= MANY for one in beside):
            yield k


def _frames(positions: Sequence[int], named: Callable[[int], str]) -> str:
    shown = ", ".join(named(k) for k in positions[: 2 * MOST_NAMED])
    return f"{shown}, ..." if len(positions) > 2 * MOST_NAMED else shown
