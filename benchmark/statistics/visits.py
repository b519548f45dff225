"""Two visits of one place: agreement of views within each of them and across, and the places that changed.

Frames of both visits come by turns and answer for the same spots, so that nothing depends on how near two spots are.
`visit_agreement` tells how far they agree.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask
from semstab.data.frames import Frame
from semstab.statistics.cluster_sums import distinct_rows
from semstab.statistics.kept_depth import DepthMemory
from semstab.statistics.observations import SpotObservations
from semstab.statistics.sampler import BUDGET, STILL, Anchor, Sampler
from semstab.statistics.votes import SpotVotes

VISITS = 2

APART = 1 << 24
"""Indices of the frames of the second visit are larger by this."""

LEAST_ANSWERS = 2
"""Labels that each visit must give a spot, so that its views can agree with one another."""

CHANGED = 0.5
"""A spot has another class if its dominant class differs and views across the visits disagree more often than views
within them by this: half the squared distance of the shares of classes, which is 1 if all views changed."""

DRAWS = 10
"""How often two visits are drawn from the answers of one, to see which share of the spots differs by chance."""

UNKNOWN, STAYED, GONE, NEW, MOVED = range(5)
"""Fates of the surface at a spot between two visits."""


class VisitSampler(Sampler):
    """Asks the views of two visits at the same spots.

    Args:
        num_classes: K, the number of classes.
        budget: Most answers of a sample.
    """

    def __init__(self, num_classes: int, budget: int = BUDGET) -> None:
        super().__init__(num_classes, budget)
        self._memories = [DepthMemory() for _ in range(VISITS)]
        self._states: list[tuple[Any, Any]] = [(None, {}) for _ in range(VISITS)]
        self._visit, self._visit_of_view = 0, list[int]()
        self._anchors, self._places = list[Anchor](), list[int]()

    def add_of(self, visit: int, frame: Frame) -> None:
        """Add the answers of a frame of a visit, 0 or 1; frames of both should come by turns."""
        self._visit, self._memory = visit, self._memories[visit]
        self._anchor, self._seen = self._states[visit]
        self.add(dataclasses.replace(frame, index=frame.index + visit * APART))
        self._states[visit] = self._anchor, self._seen

    def _view_of(self, frame: Frame, depth: float, sparse: Any) -> int | None:
        view = super()._view_of(frame, depth, sparse)
        if len(self._views) > len(self._visit_of_view):
            assert self._anchor is not None
            self._visit_of_view.append(self._visit)
            self._places.append(self._place_of(frame))
            self._anchors.append(self._anchor)
        return view

    def _place_of(self, frame: Frame) -> int:
        """Return the first view that sees what a frame sees from its place, or the next view's number."""
        centre = frame.T_wc[:3, 3]
        for view, (anchor, place) in enumerate(zip(self._anchors, self._places, strict=True)):
            near = np.abs(anchor.T_wc[:3, 3] - centre).max() * anchor.focal <= STILL * anchor.depth
            if place == view and near and anchor.sees_alike(frame):
                return view
        return len(self._anchors)

    def _remember(self, view: int, frame: Frame, T: Float64, sparse: Any) -> None:
        """Keep depth by the number of the view among those of its visit; `_found` holds 2 * number + visit."""
        number = self._visit_of_view[:view].count(self._visit)
        super()._remember(number, frame, T, sparse)
        self._found[self._known : self._spots] = VISITS * number + self._visit

    def _votes(self) -> None:
        """Return nothing: what moved within a visit is asked by visit, see `visits`."""

    def visits(self, classes: tuple[str, ...] = ()) -> VisitedSpots:
        """Return the answers of both visits, and what the views of each say of all spots."""
        visit, n = np.array(self._visit_of_view, np.int64), self._spots
        votes = []
        for visit_index, memory in enumerate(self._memories):
            views = int(np.count_nonzero(visit == visit_index))
            number, of = np.divmod(self._found[:n], VISITS)
            finding_view = np.where(of == visit_index, number, views).astype(np.int32)
            of_visit = self._point[:n], finding_view, self._firm[:n]
            votes.append(memory.votes_on(*of_visit, views + 1, self._sigma, 0.0))
        return VisitedSpots(self.sample(classes), visit, np.array(self._places, np.int64), (votes[0], votes[1]))


def by_turns(first: Iterable[Any], second: Iterable[Any], counts: tuple[int, int]) -> Iterator[tuple[int, Any]]:
    """Yield (visit, item) of two series of these lengths, evenly mixed, each in its order."""
    when = [(2 * k + 1) / (2 * max(n, 1)) for n in counts for k in range(n)]
    which = np.repeat(np.arange(VISITS), counts)
    series = iter(first), iter(second)
    for visit in which[np.argsort(when, kind="stable")].tolist():
        yield visit, next(series[visit])


@dataclass(frozen=True, eq=False)
class VisitedSpots:
    """Spots of two visits.

    Attributes:
        spots: Answers of the views of both.
        visit: (V,) 0 or 1, the visit of each view.
        place: (V,) the first view that was taken from the place of each view, within a pixel.
        votes: What the views of each visit say of all spots: whether the surface is there.
    """

    spots: SpotObservations
    visit: Int64
    place: Int64
    votes: tuple[SpotVotes, SpotVotes]

    @cached_property
    def change(self) -> Int64:
        """(n,) what happened to the surface at each spot: UNKNOWN, STAYED, GONE, NEW or MOVED.

        A visit shows that nothing is there if the spot moved by the votes of its views: if they see through it. A spot
        moved within a visit if some of its views see it nevertheless.
        """
        first, second = self.votes
        change = np.full(len(self.spots.point), UNKNOWN)
        change[first.static & second.static] = STAYED
        change[first.static & second.moved] = GONE
        change[first.moved & second.static] = NEW
        for votes in self.votes:
            change[(votes.seen > 0) & votes.moved] = MOVED
        return change

    @cached_property
    def answers(self) -> SpotObservations:
        """The labelled answers, one of a spot and view."""
        spots = self.spots.labelled()
        key = spots.spot.astype(np.int64) * max(len(spots.views), 1) + spots.view
        return spots.only(np.unique(key, return_index=True)[1])

    @cached_property
    def counts(self) -> Int64:
        """(2, n) answers of each visit for each spot."""
        of, n = self.visit[self.answers.view], len(self.spots.point)
        return np.stack([np.bincount(self.answers.spot[of == visit], minlength=n) for visit in range(VISITS)])

    @cached_property
    def common(self) -> Mask:
        """(n,) spots that views of both visits label twice or more, without those that changed or moved."""
        enough = (self.counts >= LEAST_ANSWERS).all(axis=0)
        return np.asarray(enough & np.isin(self.change, (UNKNOWN, STAYED)), np.bool_)

    @cached_property
    def shares(self) -> tuple[Any, Any]:
        """(n, K) sparse: the shares of the classes among the answers of each visit for each spot."""
        return self.shares_of(self.answers.label, self.spots.K)

    def shares_of(self, label: npt.NDArray[np.integer[Any]], K: int) -> tuple[Any, Any]:
        """Return the same of other labels (m,) of the answers, 0 to K - 1."""
        from scipy.sparse import csr_array

        of = self.visit[self.answers.view]
        shape, made = (len(self.spots.point), K), []
        for visit in range(VISITS):
            rows = np.flatnonzero(of == visit)
            spot = self.answers.spot[rows]
            share = 1.0 / np.maximum(self.counts[visit], 1)
            made.append(csr_array((share[spot], (spot, label[rows].astype(np.int64))), shape=shape))
        return made[0], made[1]

    def from_one_place(self, label: npt.NDArray[np.integer[Any]]) -> Float64:
        """Return (2, n) pairs of an answer of each visit that were taken from one place, and those that agree.

        Two views of one visit are of two places. So are the views of a pair across: views from one place show the
        same pixels and make the same errors.
        """
        answers, n = self.answers, len(self.spots.point)
        of, place = self.visit[answers.view], self.place[answers.view]
        pairs = np.zeros((2, n))
        for row, keys in enumerate(((place,), (place, label.astype(np.int64)))):
            _, key = distinct_rows(np.stack([answers.spot, *keys], axis=1))
            there = np.bincount(key[of == 0], minlength=int(key.max(initial=0)) + 1)
            pairs[row] = np.bincount(answers.spot[of == 1], there[key[of == 1]], n)
        return pairs

    @cached_property
    def dominant(self) -> tuple[Int64, Int64]:
        """(n,) the class that most views of each visit give a spot, the lowest of equals; -1 without any."""
        return _dominant(self.shares[0]), _dominant(self.shares[1])

    @cached_property
    def relabelled(self) -> Mask:
        """(n,) common spots that have another class in the second visit, see CHANGED."""
        return self.common & _differ(*self.shares, self.counts, self.from_one_place(self.answers.label))

    def relabelled_by_chance(self) -> float:
        """Return the share of the common spots that two visits give other classes by chance, without any change.

        The answers of both visits are drawn with replacement from those of one, as often as each visit answers; it is
        the mean over draws from the first visit and from the second one.
        """
        if not self.common.any():
            return math.nan
        rng, num_relabelled = np.random.default_rng(0), 0
        for visit in range(VISITS):
            rows = np.flatnonzero(self.common[self.answers.spot] & (self.visit[self.answers.view] == visit))
            rows = rows[np.argsort(self.answers.spot[rows], kind="stable")]
            starts = np.concatenate([[0], np.cumsum(np.where(self.common, self.counts[visit], 0))])[:-1]
            spot = self.answers.spot
            for _ in range(DRAWS):
                draws = starts[spot] + rng.integers(0, np.maximum(self.counts[visit][spot], 1))
                label = self.answers.label[rows[np.where(self.common[spot], draws, 0)]]
                num_relabelled += int((self.common & _differ(*self.shares_of(label, self.spots.K), self.counts)).sum())
        return num_relabelled / (VISITS * DRAWS) / int(self.common.sum())


def _dominant(shares: Any) -> Int64:
    """Return the class (n,) of the largest share in each row; -1 of an empty one."""
    entries = shares.tocoo()
    order = np.lexsort((-entries.col, entries.data, entries.row))
    dominant = np.full(shares.shape[0], -1, np.int64)
    dominant[entries.row[order]] = entries.col[order]
    return dominant


def _products(first: Any, second: Any) -> Float64:
    """Return the sum (n,) over classes of the products of two shares (n, K)."""
    return np.asarray(first.multiply(second).sum(axis=1), np.float64).ravel()


def agreeing(shares: tuple[Any, Any], counts: Int64, from_one_place: Float64 | None = None) -> Float64:
    """Return (3, n): how often two answers of the first visit agree, of the second one, and one of each.

    Args:
        shares: (n, K) of the classes among the answers of each visit.
        counts: (2, n) answers.
        from_one_place: (2, n) pairs across that do not count, and those of them that agree.
    """
    within = []
    for share, n in zip(shares, counts, strict=True):
        pairs = _products(share, share) * n**2 - n
        within.append(pairs / np.maximum(n * (n - 1), 1))
    excluded, total = np.zeros((2, counts.shape[1])) if from_one_place is None else from_one_place, counts.prod(axis=0)
    return np.stack([*within, (_products(*shares) * total - excluded[1]) / np.maximum(total - excluded[0], 1)])


def _differ(first: Any, second: Any, counts: Int64, from_one_place: Float64 | None = None) -> Mask:
    """Return which spots (n,) have another class in the second visit, see CHANGED."""
    within, other, across = agreeing((first, second), counts, from_one_place)
    excess = (within + other) / 2 - across
    return np.asarray((_dominant(first) != _dominant(second)) & (excess >= CHANGED), np.bool_)
