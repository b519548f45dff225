"""Frames in order, each compared with those just before it: which do not fit their neighbours, and where poses jump."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.check.conventions import Convention
from semstab.check.reprojection import Pair, Sample, Shared, View, median_of_seen

GAPS = (1, 2, 3, 8)
"""Distances in the chain at which two frames are compared."""

LEAST_SEEN, LEAST_SHARE = 50, 0.2
"""Points, and their share, that one frame has to see of another for their error to count."""

UNSEEN, SEEN = 0.02, 0.5
"""A frame that sees less of both neighbours, while these see more of each other, does not fit them either."""

CONTRADICTS = 0.02
APART = 4.0
"""Two frames contradict each other if their error is at least CONTRADICTS, APART times the error of neighbouring
frames, and APART times the usual error."""

FITS = 0.05
"""Frames fit each other up to this error, if it is not APART times the usual error."""

DISAGREE = 0.25
"""Share of the points by which labels of a frame agree less with its neighbours' than these with each other."""

SEVERAL = 3
"""Classes of the maps around one that looks wrong."""

SAME_RATIO, ANOTHER_UNIT = 0.05, 1.2
"""One of two depths is too long by their ratio if the relative spread of the ratio is at most SAME_RATIO, and the ratio
at least ANOTHER_UNIT: a small error of a pose looks like a smaller ratio."""

MOST_BESIDE = 2
"""Frames side by side that do not fit those around them, which fit each other."""

SHIFTED, STRIKING_SHIFT, LEAST_SHIFTED = 1.6, 2.5, 0.005
WON_LINKS = 0.8
"""Poses also shift if the error of frames on both sides of a place is large: SHIFTED times the usual error of frames as
far apart and of frames just before and after, and at least LEAST_SHIFTED. From STRIKING_SHIFT times on, the scene is
unsound. WON_LINKS is the least share of the pairs whose error is larger than 95 of 100 other errors."""

GOES_ON, ALIKE = 1.5, 0.5
"""The view goes on from one frame to the next if the change of depth, pixel by pixel, is small. It is at most GOES_ON
times the change between the frames before and after, and at most ALIKE times the change between distant frames."""

TINY = 1e-6
"""Errors below this are none."""

LEAST_CHAIN = 5
"""Fewer frames tell nothing of which is the exception."""

Ids = npt.NDArray[np.int64]
NO_LABELS: Ids = np.empty((2, 0), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Link:
    """The agreement of two frames.

    Attributes:
        error: Median relative depth error of the points that are seen again, NaN with too few points.
        share: Share of the points that are seen again.
        ratio: Median of the depth that the second frame has there to the depth that it should have.
        steady: Whether that ratio is nearly the same at all points.
        agreement: Share of the points on one surface whose labels agree, NaN without labels.
        still: Median relative change of depth from image to image, pixel by pixel, whatever the poses are.
        labels: (2, n) ids of those points, of the first and of the second frame.
    """

    error: float
    share: float
    ratio: float
    steady: bool
    agreement: float
    still: float = math.nan
    labels: Ids = dataclasses.field(default_factory=lambda: NO_LABELS)


@dataclass(frozen=True)
class Chain:
    """Frames in order, each compared with those that are `GAPS` before it.

    Attributes:
        positions: Positions of the frames, ascending.
        links: Agreement by two positions.
        usual: The median error of frames that follow each other; NaN if no frame sees another.
        maps: Contents of the label maps, by position; empty without labels.
        contradicting: The least error of frames that contradict each other.
    """

    positions: Sequence[int]
    links: Mapping[Pair, Link]
    usual: float
    maps: Mapping[int, MapContent] = dataclasses.field(default_factory=dict)
    contradicting: float = CONTRADICTS

    def error(self, a: int, b: int) -> float:
        """Return the error of two frames, or NaN if they were not compared."""
        link = self.links.get((a, b))
        return math.nan if link is None else link.error

    def fits(self, a: int, b: int) -> bool:
        """Return whether two frames fit each other."""
        return self.error(a, b) <= min(FITS, max(self.contradicting, APART * self.usual))

    def contradicts(self, pair: Pair, *neighbours: Pair) -> bool:
        """Return whether two frames contradict each other, and their neighbours do not."""
        if not all(self.fits(*neighbour) for neighbour in neighbours):
            return False
        least = max(
            self.contradicting,
            *(APART * error for error in (self.usual, *(self.error(*neighbour) for neighbour in neighbours))),
        )
        return self.error(*pair) >= least

    def without(self, positions: Sequence[int]) -> Chain:
        """Return the chain without these frames."""
        remaining = [position for position in self.positions if position not in positions]
        links = {pair: link for pair, link in self.links.items() if not {*pair} & {*positions}}
        return dataclasses.replace(self, positions=remaining, links=links)

    def misfits(self) -> list[tuple[int, Pair]]:
        """Return the positions of frames that contradict both neighbours, which fit each other; with these.

        Neighbours are the nearest frames on both sides, or the frames next to two such frames.
        """
        pairs = dict[int, Pair]()
        for a, between, c in self._around():
            if all(self._strange((a, b), (a, c)) and self._strange((b, c), (a, c)) for b in between):
                pairs |= {b: pairs.get(b, (a, c)) for b in between}
        return sorted(pairs.items())

    def _around(self) -> Iterator[tuple[int, Sequence[int], int]]:
        """Yield one or more frames side by side, between the frames before and after them."""
        for width in range(1, MOST_BESIDE + 1):
            for k in range(len(self.positions) - width - 1):
                yield self.positions[k], self.positions[k + 1 : k + 1 + width], self.positions[k + 1 + width]

    def _strange(self, pair: Pair, neighbour: Pair) -> bool:
        """Return whether two frames contradict each other, or see nothing of each other while their neighbours do."""
        if self.contradicts(pair, neighbour):
            return True
        share = self.links[pair].share if pair in self.links else 1.0
        return self.fits(*neighbour) and share < UNSEEN <= SEEN <= self.links[neighbour].share

    def breaks(self) -> list[Pair]:
        """Return two successive frames between which poses jump: those before fit each other, as do those after."""
        runs = zip(self.positions, self.positions[1:], self.positions[2:], self.positions[3:], strict=False)
        return [(b, c) for a, b, c, d in runs if self.contradicts((b, c), (a, b), (c, d)) and self._apart(a, b, c, d)]

    def _apart(self, a: int, b: int, c: int, d: int) -> bool:
        """Return whether the frames one further do not fit each other either, as far as they see each other."""
        return not self.fits(a, c) and not self.fits(b, d)

    def shift(self) -> tuple[Pair, float, float] | None:
        """Return the two successive frames between which poses shift, or None without a shift.

        Errors of frames on both sides are compared with the usual errors of frames as far apart.

        Returns:
            The frames, the median error of frames on both sides, and the usual one of frames as far apart.
        """
        place = {position: k for k, position in enumerate(self.positions)}
        rows = [(place[a], place[b], link.error) for (a, b), link in self.links.items() if math.isfinite(link.error)]
        if len(rows) < 4 * LEAST_CHAIN:
            return None
        first, second, errors = (np.array(column) for column in zip(*rows, strict=True))
        errors = np.maximum(errors, TINY)
        usual = np.empty(len(errors))
        for gap in np.unique(second - first):
            usual[second - first == gap] = np.median(errors[second - first == gap])
        times, best = errors / usual, None
        for k in range(1, len(self.positions) - 2):
            over = (first <= k) & (second > k)
            if over.sum() < LEAST_CHAIN or over.sum() > len(over) / 2:
                continue
            high = float(np.percentile(times[~over], 95))
            by, error = float(np.median(times[over])), float(np.median(errors[over]))
            sides = ((first >= k - GAPS[-1]) & (second <= k), (first > k) & (second <= k + 1 + GAPS[-1]))
            by /= max(1.0, *(float(np.median(times[side])) if side.any() else math.inf for side in sides))
            if by >= SHIFTED and error >= LEAST_SHIFTED and np.mean(times[over] > high) >= WON_LINKS:
                best = max(best or (0.0, k, 0.0, 0.0), (by, k, error, float(np.median(usual[over]))))
        if best is None:
            return None
        _, k, error, common = best
        return (self.positions[k], self.positions[k + 1]), error, common

    def departures(self) -> list[Pair]:
        """Return two successive frames that see nothing of each other by their poses, though the view goes on.

        Their neighbours on each side see each other.
        """
        far = [link.still for (a, b), link in self.links.items() if self._gap(a, b) == GAPS[-1]]
        runs = zip(self.positions, self.positions[1:], self.positions[2:], self.positions[3:], strict=False)
        return [(b, c) for a, b, c, d in runs if self._departs((a, b), (b, c), (c, d), float(np.median(far or [0.0])))]

    def _departs(self, before: Pair, across: Pair, after: Pair, distant: float) -> bool:
        link_before, link, link_after = (self.links[pair] for pair in (before, across, after))
        goes_on = link.still <= min(GOES_ON * max(link_before.still, link_after.still), ALIKE * distant)
        return link.share < UNSEEN <= SEEN <= min(link_before.share, link_after.share) and goes_on

    def _gap(self, a: int, b: int) -> int:
        return bisect.bisect_left(self.positions, b) - bisect.bisect_left(self.positions, a)

    def mislabelled(self) -> list[tuple[int, Pair]]:
        """Return the positions of frames whose labels agree with neither neighbour, while those agree; with these.

        These have several classes: a network that sees nothing there, but something in between, flickers. Maps of one
        class are named as such.
        """
        pairs = dict[int, Pair]()
        for a, between, c in self._around():
            if any(self.maps[k].classes < SEVERAL for k in (a, c) if k in self.maps):
                continue
            limit = self.agreement(a, c) - DISAGREE
            if all(max(self.agreement(a, b), self.agreement(b, c)) < limit for b in between):
                pairs |= {b: pairs.get(b, (a, c)) for b in between if not self.maps[b].single}
        return sorted(pairs.items())

    def agreement(self, a: int, b: int) -> float:
        """Return the agreement of two frames' labels, or NaN if they were not compared."""
        link = self.links.get((a, b))
        return math.nan if link is None else link.agreement


@dataclass(frozen=True)
class MapContent:
    """Content of a label map: the share of its pixels that have a label, and their classes.

    Attributes:
        labelled: Share of the pixels, 0 to 1.
        single: Whether all labelled pixels have one class.
        classes: Number of the classes that 0.5 % or more of the labelled pixels have.
        name: Id of the most frequent class; -1 without labels.
    """

    labelled: float
    single: bool
    classes: int
    name: int

    @classmethod
    def from_view(cls, view: View) -> MapContent:
        """Count the labels of a view that has some."""
        assert view.labels is not None
        counts = np.bincount(view.labels[view.labels != view.ignore_id].ravel())
        total = int(counts.sum())
        most = int(counts.argmax()) if total else -1
        return cls(
            total / max(1, view.labels.size), np.count_nonzero(counts) == 1, int(np.sum(counts > 0.005 * total)), most
        )


def chained(views: Iterable[tuple[int, View | None]], configured: Convention) -> Chain:
    """Compare views in order; the last ones are held in memory. Those without depth are left out."""
    positions, links, last = list[int](), dict[Pair, Link](), deque[tuple[int, View]](maxlen=GAPS[-1])
    maps = dict[int, MapContent]()
    for position, view in views:
        if view is not None and view.labels is not None:
            maps[position] = MapContent.from_view(view)
        if view is None or len(view.u) < LEAST_SEEN:
            continue
        for gap in (gap for gap in GAPS if gap <= len(last)):
            other, before = last[-gap]
            links[other, position] = linked(before, view, configured)
        positions.append(position)
        last.append((position, view))
    errors = [links[pair].error for pair in itertools.pairwise(positions) if math.isfinite(links[pair].error)]
    return Chain(positions, links, float(np.median(errors)) if errors else math.nan, maps)


def linked(first: View, second: View, configured: Convention) -> Link:
    """Compare two views: points of each in the other."""
    sample, factors = Sample({0: first, 1: second}, [(0, 1), (1, 0)], configured), np.array([1.0])
    matches, back = (sample.matched(pair, configured, factors) for pair in sample.pairs)
    errors = np.concatenate([matches.error[0], back.error[0]])
    finite = np.isfinite(errors)
    if finite.sum() < LEAST_SEEN or finite.mean() < LEAST_SHARE:
        return Link(math.nan, float(finite.mean()), math.nan, False, math.nan, _still(first, second))
    finite_first, finite_second = np.isfinite(matches.error[0]), np.isfinite(back.error[0])
    with np.errstate(all="ignore"):
        logs = np.log(
            np.concatenate([(matches.depth / matches.z)[0][finite_first], (back.z / back.depth)[0][finite_second]])
        )
    ratio = float(np.median(logs))
    forth = Shared.from_matches(first, matches).labels(first.labels, second.labels, first.ignore_id, second.ignore_id)
    labels_back = Shared.from_matches(second, back).labels(
        second.labels, first.labels, second.ignore_id, first.ignore_id
    )
    labels = np.concatenate([forth, labels_back[::-1]], axis=1)
    return Link(
        error=float(median_of_seen(errors)),
        share=float(finite.mean()),
        ratio=math.exp(ratio),
        steady=bool(np.median(np.abs(logs - ratio)) < SAME_RATIO),
        agreement=float(np.mean(labels[0] == labels[1])) if labels.shape[1] >= LEAST_SEEN else math.nan,
        still=_still(first, second),
        labels=labels,
    )


def _still(first: View, second: View) -> float:
    """Return the median relative change of depth from image to image, pixel by pixel, or NaN without common pixels."""
    if first.depth.shape != second.depth.shape:
        return math.nan
    with np.errstate(all="ignore"):
        logs = np.abs(np.log(first.depth[first.v, first.u] / second.depth[first.v, first.u]))
    finite = logs[np.isfinite(logs)]
    return float(np.median(finite)) if len(finite) >= LEAST_SEEN else math.nan
