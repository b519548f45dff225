"""Agreement of two visits of one place, beyond chance, at the spots that did not change.

Agreement across is that of a view of one visit with a view of the other (Schouten 1982, Statistica Neerlandica 36,
agreement between groups of observers). Chance is Krippendorff's expected disagreement, of two answers from anywhere,
for such pairs (Krippendorff 2018, Content Analysis, ch. 12):

    alpha = 1 - (1 - mean_s p_s . q_s) / (1 - p . q)

with the shares p_s, q_s of the classes among the answers of each visit for spot s, and p, q their means. Within a visit
it is alpha, of pairs of different views; across, pairs of views from one place do not count either, so that a run
beside itself costs nothing. All three are of the same spots with the same weights, so that

    mean of both within - across

is 0 in expectation if the views of both visits give the same labels: disagreement across exceeds disagreement within by
half the squared distance |p_s - q_s|^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64
from semstab.data.statistics import UNKNOWN as NOT_KNOWN
from semstab.data.statistics import Across, Interval, TwoVisits, VisitedClass
from semstab.statistics.agreement import beyond_chance
from semstab.statistics.cluster_sums import MOST_CLASSES, ClusterSums, Functional, cubes_of, lever_from
from semstab.statistics.intervals import estimate
from semstab.statistics.observations import PARTS
from semstab.statistics.visits import GONE, MOVED, NEW, STAYED, UNKNOWN, VISITS, VisitedSpots, agreeing

FIRST, SECOND, ACROSS = range(3)
"""Pairs of views: both of the first visit, both of the second one, or one of each."""

ANSWERS = 2
"""Answers whose agreement is extrapolated to the spot; the third one tells by which lever."""

LEAST_SPOTS = 50
"""Least number of common spots of a class whose alpha is told."""

Levers = tuple[float, float, float]
"""By which agreement is extrapolated to the spot, for each kind of pairs, see `lever_of`."""


def two_visits(visited: VisitedSpots) -> TwoVisits:
    """Return agreement within two visits and across, by class, and what changed."""
    asked = visited.counts.sum(axis=0) > 0
    change = np.bincount(visited.change[asked], minlength=MOVED + 1)
    alpha, levers = _across(visited, visited.spots.K)
    spots = int(visited.common.sum())
    return TwoVisits(
        spots=spots,
        alpha=alpha,
        **{name: int(change[kind]) for name, kind in KINDS.items()},
        relabelled=int(visited.relabelled.sum()) / spots if spots else math.nan,
        by_chance=visited.relabelled_by_chance(),
        classes=tuple(_classes(visited, levers)),
        misplaced=(int(visited.votes[0].misplaced.sum()), int(visited.votes[1].misplaced.sum())),
    )


KINDS = {"stayed": STAYED, "gone": GONE, "new": NEW, "moved": MOVED, "unknown": UNKNOWN}
"""Fates of the surface at a spot, by name."""


def _classes(visited: VisitedSpots, levers: Levers) -> list[VisitedClass]:
    """Return each class that views give spots: agreement on it against all others, and how its spots changed."""
    K = visited.spots.K
    names = visited.spots.classes or tuple(str(k) for k in range(K))
    before, after = visited.dominant
    decided = np.isin(visited.change, (STAYED, GONE, NEW))
    common = [np.bincount(label[visited.common], minlength=K) for label in (before, after)]
    rows = []
    for k in range(K):
        earlier, then = (before == k) & decided, (after == k) & decided
        if not (earlier.any() or then.any() or common[0][k]):
            continue
        enough = K <= MOST_CLASSES and max(common[0][k], common[1][k]) >= LEAST_SPOTS
        other = after[visited.relabelled & (before == k)]
        rows.append(
            VisitedClass(
                name=names[k],
                spots=int(earlier.sum()),
                alpha=_across(visited, 2, of=k, levers=levers)[0] if enough else NOTHING,
                gone=_share(visited.change[earlier] == GONE),
                new=_share(visited.change[then] == NEW),
                relabelled=len(other) / int(common[0][k]) if common[0][k] else math.nan,
                becomes=names[int(np.bincount(other).argmax())] if len(other) else "",
            )
        )
    return rows


def _share(where: npt.NDArray[np.bool_]) -> float:
    return float(where.mean()) if len(where) else math.nan


NOTHING = Across(NOT_KNOWN, NOT_KNOWN, NOT_KNOWN, NOT_KNOWN)


# --- Alpha ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over cubes of the common spots, each with the weight of all its answers.

    Attributes:
        columns: (G, C) for first answers, then for second ones: how often pairs of each kind agree (3), and answers of
            each class of the first visit (K) and of the second one (K); at last the weight.
        own: (2,) sums of the squared weights of single answers of each visit.
    """

    cell: npt.NDArray[np.int32]
    edge: float
    columns: Float64
    own: Float64
    levers: Levers

    def estimate(self, which: int | None) -> Interval:
        """Return alpha of one kind of pairs, or what another visit costs, with its interval over places."""

        def alpha(sums: Float64, kind: int) -> Float64:
            n, parts = sums[..., -1], np.split(sums[..., :-1], ANSWERS, axis=-1)
            first, second = (self._alpha(part, n, kind) for part in parts)
            return first + self.levers[kind] * (first - second)

        def cost(sums: Float64) -> Float64:
            within: Float64 = (alpha(sums, FIRST) + alpha(sums, SECOND)) / 2
            return within - alpha(sums, ACROSS)

        amount = np.array([FIRST if which is None else which, -1])
        rest = np.setdiff1d(np.arange(self.columns.shape[1]), amount % self.columns.shape[1])
        order = np.concatenate([amount % self.columns.shape[1], rest])  # what agrees and the weight come first
        back = np.argsort(order)
        sums = ClusterSums.of_cubes(self.cell, self.edge, {"": self.columns[:, order]})
        if which is None:
            return estimate(sums, Functional(("",), lambda totals: cost(totals[..., back]), -2.0, 2.0, "plain"))
        return estimate(sums, Functional(("",), lambda totals: alpha(totals[..., back], which), -1.0, 1.0, "agreement"))

    def _alpha(self, part: Float64, n: Float64, kind: int) -> Float64:
        """Return alpha (...,) of the answers of one part of the columns."""
        evidence = np.split(part[..., 3:], VISITS, axis=-1)
        first, second = (evidence[0], evidence[1]) if kind == ACROSS else (evidence[kind], evidence[kind])
        self_pairs = 0.0 if kind == ACROSS else self.own[kind]
        expected = ((first * second).sum(axis=-1) - self_pairs) / (n * n - self_pairs)
        return beyond_chance(1 - part[..., kind] / n, 1 - expected)


def _across(
    visited: VisitedSpots, K: int, of: int | None = None, levers: Levers | None = None
) -> tuple[Across, Levers]:
    """Return agreement of all classes, or of class `of` against all others, with its levers."""
    sums = _sums(visited, K, of, levers)
    if sums is None:
        return NOTHING, (0.0, 0.0, 0.0)
    return Across(*(sums.estimate(which) for which in (FIRST, SECOND, ACROSS, None))), sums.levers


def _sums(visited: VisitedSpots, K: int, of: int | None, levers: Levers | None) -> _Sums | None:
    from scipy.sparse import csr_array

    spots, common = visited.answers, np.flatnonzero(visited.common)
    if not len(common):
        return None
    counts = visited.counts[:, common]
    weight = counts.sum(axis=0).astype(np.float64)
    place = spots.places(common).astype(np.int32)
    cell, at, edge = cubes_of((place[:, 0], place[:, 1], place[:, 2]), spots.spacing / PARTS)
    into = csr_array((weight, (at, np.arange(len(common)))), shape=(len(cell), len(common)))
    columns, agree = [], []
    for answer in (spots.label, spots.neighbour, spots.beyond):
        label = answer if of is None else (answer == of).astype(np.int64)
        shares = visited.shares_of(label, K)
        common_shares = shares[0][common], shares[1][common]
        agree.append(agreeing(common_shares, counts, visited.from_one_place(label)[:, common]))
        columns += [into @ agree[-1].T, *((into @ share).toarray() for share in common_shares)]
    self_pairs = (weight**2 / counts).sum(axis=1)
    levers = levers or _levers(visited, common, weight, agree)
    of_answers = columns[: ANSWERS * (1 + VISITS)]
    return _Sums(cell, edge, np.hstack([*of_answers, into.sum(axis=1)[:, None]]), self_pairs, levers)


def _levers(visited: VisitedSpots, common: Int64, weight: Float64, agree: Sequence[Float64]) -> Levers:
    """Return the levers from agreement (3, n) of pairs of first, second and third answers for common spots."""
    spots, total = visited.answers, weight.sum()
    of, squares = visited.visit[spots.view], []
    for square in (spots.near, spots.far):
        sums = [
            np.bincount(spots.spot[of == visit], square[of == visit], len(spots.point))[common]
            for visit in range(VISITS)
        ]
        means = np.stack(sums) / visited.counts[:, common] @ weight / total
        squares.append([*means, means.mean()])
    falls = [agreement @ weight / total for agreement in agree]
    return (
        lever_from(squares[0][FIRST], squares[1][FIRST], [float(fall[FIRST]) for fall in falls]),
        lever_from(squares[0][SECOND], squares[1][SECOND], [float(fall[SECOND]) for fall in falls]),
        lever_from(squares[0][ACROSS], squares[1][ACROSS], [float(fall[ACROSS]) for fall in falls]),
    )
