"""Frames that do not fit their neighbours, and poses that jump: each frame beside those before and after it."""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import functools
import itertools
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.check.conventions import Convention
from semstab.check.lost import lost_tracking, origin_of
from semstab.check.reprojection import Matches, Pair, Sample, View, median_of_seen, motion, reader
from semstab.check.verdict import Verdict
from semstab.core.arrays import evenly
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64, Mask
from semstab.datasets import Scene
from semstab.errors import DataError

MOST_FRAMES, LEAST_FRAMES = 300, 44
MOST_PIXELS = 300 * 640 * 480
"""Frames that are read one after the other: so many, of large images as many as have so many pixels, of no size fewer
than the second number, which a quick check reads."""

GAPS = (1, 2, 3, 8)
"""Distances in the chain at which two frames are compared."""

LEAST_SEEN, LEAST_SHARE = 50, 0.2
"""Points, and their share, that one frame has to see of another for their error to count."""

UNSEEN, SEEN = 0.02, 0.5
"""A frame that sees less of both neighbours, while these see more of each other, does not fit them either."""

CONTRADICTS = 0.02
APART = 4.0
"""Two frames contradict each other where the error is this, so many times that of frames beside them, and so many
times the usual one."""

FITS = 0.05
"""Frames fit each other up to this error, where it is not so many times the usual one."""

STRIKING_STEP = 4.0
AROUND = 15
MOST_STEPS = 3
"""Steps of the camera that are looked at: so many times the median of so many on each side; the largest ones."""

DISAGREE = 0.25
"""Share of the points by which labels of a frame agree less with those beside it than these with each other."""

SEVERAL = 3
"""Classes of the maps around one that looks wrong."""

SAME_RATIO, ANOTHER_UNIT = 0.05, 1.2
"""Spread of the ratio of two depths, relative, up to which one of them is that many times too long, and the least
ratio: a pose that is a little off looks alike."""

MOST_NAMED = 5
MOST_BAD = 0.1
"""Frames that are named in one line, and the share of the frames from which on the scene is unsound for them."""

MOST_LOST = 20
"""Frames that are named where all of them are to be left out."""

LEAVE_OUT = "write nan in place of the pose, or list the others in the setting frames.list"

MOST_BESIDE = 2
"""Frames side by side that do not fit those around them, which fit each other."""

SHIFTED, STRIKING_SHIFT, LEAST_SHIFTED = 1.6, 2.5, 0.005
WON_LINKS = 0.8
"""Poses also shift where frames on both sides of a place have so many times the usual error of frames as far apart, and
of those just before and after, and this much; from the second number on the scene is unsound. Last the share of them in
which it is larger than in any 95 of 100 others."""

GOES_ON, ALIKE = 1.5, 0.5
"""The view goes on from one frame to the next where depth, pixel by pixel, changes at most so many times as much as
between the frames before and after, and at most by this part of what it does between distant frames."""

POINTS = 500
"""Points of each frame."""

ONE_SURFACE = 0.05
"""Points are on one surface where their depths differ by at most this share."""

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
        error: Median relative depth error of the points that are seen again, NaN where too few are.
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
        positions: Those of the frames, ascending.
        links: Agreement by two positions.
        usual: The median error of frames that follow each other; NaN where none sees another.
        maps: What the label maps hold, by position; empty without labels.
    """

    positions: Sequence[int]
    links: Mapping[Pair, Link]
    usual: float
    maps: Mapping[int, MapContent] = dataclasses.field(default_factory=dict)

    def error(self, a: int, b: int) -> float:
        """Return the error of two frames; NaN where they were not compared."""
        link = self.links.get((a, b))
        return math.nan if link is None else link.error

    def fits(self, a: int, b: int) -> bool:
        """Return whether two frames fit each other."""
        return self.error(a, b) <= min(FITS, max(CONTRADICTS, APART * self.usual))

    def contradicts(self, pair: Pair, *neighbours: Pair) -> bool:
        """Return whether two frames contradict each other, and those beside them do not."""
        if not all(self.fits(*one) for one in neighbours):
            return False
        least = max(CONTRADICTS, *(APART * error for error in (self.usual, *(self.error(*one) for one in neighbours))))
        return self.error(*pair) >= least

    def without(self, positions: Sequence[int]) -> Chain:
        """Return the chain without these frames."""
        left = [position for position in self.positions if position not in positions]
        links = {pair: link for pair, link in self.links.items() if not {*pair} & {*positions}}
        return dataclasses.replace(self, positions=left, links=links)

    def misfits(self) -> list[tuple[int, Pair]]:
        """Return the positions of frames that contradict both neighbours, which fit each other; with these.

        Neighbours are the nearest frames on both sides, or those beside two such frames.
        """
        found = dict[int, Pair]()
        for a, between, c in self._around():
            if all(self._strange((a, b), (a, c)) and self._strange((b, c), (a, c)) for b in between):
                found |= {b: found.get(b, (a, c)) for b in between}
        return sorted(found.items())

    def _around(self) -> Iterator[tuple[int, Sequence[int], int]]:
        """Yield one or more frames side by side, between the frames before and after them."""
        for width in range(1, MOST_BESIDE + 1):
            for k in range(len(self.positions) - width - 1):
                yield self.positions[k], self.positions[k + 1 : k + 1 + width], self.positions[k + 1 + width]

    def _strange(self, pair: Pair, neighbour: Pair) -> bool:
        """Return whether two frames contradict each other, or see nothing of each other where those beside them do."""
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
        """Return the two successive frames between which poses shift; None where they do not.

        Errors of frames on both sides are compared with the usual ones of frames as far apart.

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

        Those beside them on each side see each other.
        """
        far = [link.still for (a, b), link in self.links.items() if self._gap(a, b) == GAPS[-1]]
        runs = zip(self.positions, self.positions[1:], self.positions[2:], self.positions[3:], strict=False)
        return [(b, c) for a, b, c, d in runs if self._departs((a, b), (b, c), (c, d), float(np.median(far or [0.0])))]

    def _departs(self, before: Pair, across: Pair, after: Pair, distant: float) -> bool:
        one, link, other = (self.links[pair] for pair in (before, across, after))
        goes_on = link.still <= min(GOES_ON * max(one.still, other.still), ALIKE * distant)
        return link.share < UNSEEN <= SEEN <= min(one.share, other.share) and goes_on

    def _gap(self, a: int, b: int) -> int:
        return bisect.bisect_left(self.positions, b) - bisect.bisect_left(self.positions, a)

    def mislabelled(self) -> list[tuple[int, Pair]]:
        """Return the positions of frames whose labels agree with neither neighbour, while those agree; with these.

        These have several classes: a network that sees nothing there, but something in between, flickers. Maps of one
        class are named as such.
        """
        found = dict[int, Pair]()
        for a, between, c in self._around():
            if any(self.maps[k].classes < SEVERAL for k in (a, c) if k in self.maps):
                continue
            limit = self.agreement(a, c) - DISAGREE
            if all(max(self.agreement(a, b), self.agreement(b, c)) < limit for b in between):
                found |= {b: found.get(b, (a, c)) for b in between if not self.maps[b].single}
        return sorted(found.items())

    def agreement(self, a: int, b: int) -> float:
        """Return the agreement of two frames' labels; NaN where they were not compared."""
        link = self.links.get((a, b))
        return math.nan if link is None else link.agreement


@dataclass(frozen=True)
class MapContent:
    """What a label map holds: the share of its pixels that have a label, and their classes.

    Attributes:
        labelled: Share of the pixels, 0 to 1.
        single: Whether all of these have one class.
        classes: Number of the classes that 0.5 % or more of these have.
        name: Id of the most frequent class; -1 without labels.
    """

    labelled: float
    single: bool
    classes: int
    name: int

    @classmethod
    def of(cls, view: View) -> MapContent:
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
            maps[position] = MapContent.of(view)
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
    sample, one = Sample({0: first, 1: second}, [(0, 1), (1, 0)], configured), np.array([1.0])
    there, back = (sample.matched(pair, configured, one) for pair in sample.pairs)
    errors = np.concatenate([there.error[0], back.error[0]])
    seen = np.isfinite(errors)
    if seen.sum() < LEAST_SEEN or seen.mean() < LEAST_SHARE:
        return Link(math.nan, float(seen.mean()), math.nan, False, math.nan, _still(first, second))
    own, other = np.isfinite(there.error[0]), np.isfinite(back.error[0])
    with np.errstate(all="ignore"):
        logs = np.log(np.concatenate([(there.depth / there.z)[0][own], (back.z / back.depth)[0][other]]))
    ratio = float(np.median(logs))
    here, again = (matches.error[0] <= ONE_SURFACE for matches in (there, back))
    labels = np.concatenate([_labels(first, second, there, here), _labels(second, first, back, again)[::-1]], axis=1)
    return Link(
        error=float(median_of_seen(errors)),
        share=float(seen.mean()),
        ratio=math.exp(ratio),
        steady=bool(np.median(np.abs(logs - ratio)) < SAME_RATIO),
        agreement=float(np.mean(labels[0] == labels[1])) if labels.shape[1] >= LEAST_SEEN else math.nan,
        still=_still(first, second),
        labels=labels,
    )


def _labels(first: View, second: View, matches: Matches, seen: Mask) -> Ids:
    """Return (2, n) the labels of points of one view, and those of the pixels of another that see them."""
    if first.labels is None or second.labels is None:
        return NO_LABELS
    a, b = first.labels[first.v[seen], first.u[seen]], second.labels[matches.v[0][seen], matches.u[0][seen]]
    known = (a != first.ignore_id) & (b != second.ignore_id)
    return np.stack([a[known], b[known]]).astype(np.int64)


def _still(first: View, second: View) -> float:
    """Return the median relative change of depth from image to image, pixel by pixel; NaN where they cannot be."""
    if first.depth.shape != second.depth.shape:
        return math.nan
    with np.errstate(all="ignore"):
        logs = np.abs(np.log(first.depth[first.v, first.u] / second.depth[first.v, first.u]))
    told = logs[np.isfinite(logs)]
    return float(np.median(told)) if len(told) >= LEAST_SEEN else math.nan


# The frames of a scene in order, and what is said of them.


def with_continuity(verdict: Verdict, neighbours: Neighbours, chain: Chain) -> Verdict:
    """Return the verdict, with lost tracking, poses that jump, and notes on frames that do not fit the others.

    Args:
        verdict: The verdict of other checks, of which one that names a mend is left alone.
        neighbours: The frames of the scene.
        chain: Frames in order, with those at striking steps of the camera.
    """
    if verdict.mend:
        return verdict
    misfits = chain.misfits()
    positions = [position for position, _ in misfits]
    many = len(misfits) > MOST_BAD * len(chain.positions)
    text = neighbours.said_of_lost() or (neighbours.said_of_many(chain, positions) if many else None)
    if text is not None:
        return verdict.refuted(text)
    verdict = verdict.remarking(*neighbours.said_of_misfits(chain, misfits))
    if (text := neighbours.said_of_jumps(chain)) is not None:
        return verdict.refuted(text)
    if (shift := chain.without(positions).shift()) is None:
        return verdict
    text, (_, error, usual) = neighbours.said_of_shift(*shift), shift
    if error >= STRIKING_SHIFT * usual:
        return verdict.refuted(text)
    return verdict.remarking(text)


class Neighbours:
    """The selected frames of a scene, which are read when they are compared.

    Attributes:
        indices: Indices of the frames, ascending.
        source: Label source whose maps are compared, too; None for none.
    """

    def __init__(
        self,
        scene: Scene,
        indices: Sequence[int],
        source: str | None,
        configured: Convention,
        known: Mapping[int, View] | None = None,
    ) -> None:
        self.scene, self.indices, self.source, self._configured = scene, indices, source, configured
        self._known, self._read = known or {}, reader(scene, source)

    def spread(self, size: tuple[int, int], *, thorough: bool) -> list[int]:
        """Return the positions of the frames to compare: of large images (w, h) fewer, and of a quick check."""
        most = min(MOST_FRAMES, max(LEAST_FRAMES, MOST_PIXELS // (size[0] * size[1])))
        return evenly(len(self.indices), most if thorough else LEAST_FRAMES)

    def striking(self) -> set[int]:
        """Return the positions around the longest steps of the camera, where they are far longer than those near them.

        A scene that reads a whole frame for its pose has none.
        """
        if type(self.scene).T_wc is Scene.T_wc or len(self.indices) < LEAST_CHAIN:
            return set()
        steps = np.array([_step(a, b) for a, b in itertools.pairwise(self._poses)])
        ratios = np.nan_to_num([_ratio_to_those_around(steps, k) for k in range(len(steps))])
        largest = [int(k) for k in np.argsort(-ratios)[:MOST_STEPS] if ratios[k] >= STRIKING_STEP]
        return {p for k in largest for p in range(k - 1, k + 3) if 0 <= p < len(self.indices)}

    @functools.cached_property
    def _poses(self) -> list[Float64]:
        """The poses (4, 4) of all frames; NaN where there is none."""
        return [self._pose(index) for index in self.indices]

    def _pose(self, index: int) -> Float64:
        try:
            return self.scene.T_wc(index)
        except DataError:
            return np.full((4, 4), np.nan)

    def chain(self, positions: Iterable[int]) -> Chain:
        """Compare these frames in order; those that cannot be read are passed over."""
        ordered = sorted(positions)
        if len(ordered) < LEAST_CHAIN:
            return Chain((), {}, math.nan)
        views = (fetched.item for fetched in prefetch(self._view, ordered))
        return chained(zip(ordered, views, strict=True), self._configured)

    def _view(self, position: int) -> View | None:
        if position in self._known:
            return self._known[position]
        with contextlib.suppress(DataError):
            return View.of(self._read(self.indices[position]), POINTS, labelled=self.source is not None)
        if self.source is not None:
            with contextlib.suppress(DataError):
                return View.of(reader(self.scene, None)(self.indices[position]), POINTS, labelled=False)
        return None

    def located(self, pair: Pair) -> tuple[int, Chain] | None:
        """Return the first frame after a jump between two positions, and the chain around it; None where it is none."""
        before, after = pair
        while after - before > 1:
            middle = (before + after) // 2
            near = self.chain_of([before, middle, after])
            if near.contradicts((before, middle), (middle, after)):
                after = middle
            elif near.contradicts((middle, after), (before, middle)):
                before = middle
            else:
                return None
        near = self.chain_of([p for p in range(before - 1, after + 2) if 0 <= p < len(self.indices)])
        return (after, near) if (before, after) in near.breaks() else None

    def chain_of(self, positions: Sequence[int]) -> Chain:
        """Compare few frames, of which one pair may not fit: nothing is usual."""
        return dataclasses.replace(chained(((p, self._view(p)) for p in positions), self._configured), usual=0.0)

    def named(self, position: int) -> str:
        """Return the name of a frame for people."""
        return self.scene.frame_name(self.indices[position])

    def said_of_jumps(self, chain: Chain) -> str | None:
        """Return the line on the first frame at which poses jump; None where they do not."""
        broken = next(filter(None, map(self.located, chain.breaks())), None)
        if broken is not None:
            return self.said_of_break(broken)
        departures = chain.departures()
        return self.said_of_departure(departures[0]) if departures else None

    def said_of_break(self, broken: tuple[int, Chain]) -> str:
        """Return the line on poses that jump."""
        first, chain = broken
        index, before = self.indices[first], self.indices[first - 1]
        across = chain.error(first - 1, first)
        around = max(chain.error(first - 2, first - 1), chain.error(first, first + 1))
        return (
            f"poses jump at frame {self.named(first)}: depth reprojects with {across:.1%} error from frame"
            f" {self.named(first - 1)} to it, with {around:.2%} among the frames before and among those after; correct"
            f" the poses, or fuse the two parts one by one (--frames :{before + 1} and --frames {index}:)"
        )

    def said_of_departure(self, pair: Pair) -> str:
        """Return the line on poses that go on in another frame of reference, while the view goes on."""
        index, before = self.indices[pair[1]], self.indices[pair[0]]
        return (
            f"poses jump at frame {self.named(pair[1])}: by its pose it sees nothing of what frame"
            f" {self.named(pair[0])} sees, though their depth images are nearly the same: the"
            " poses from it on are in another frame of reference; bring them into one, or fuse the two parts one by one"
            f" (--frames :{before + 1} and --frames {index}:)"
        )

    def said_of_shift(self, pair: Pair, error: float, usual: float) -> str:
        """Return the line on poses that are shifted or turned from a frame on."""
        index, before = self.indices[pair[1]], self.indices[pair[0]]
        return (
            f"poses jump at frame {self.named(pair[1])}: depth reprojects with {error:.2%} error between frames"
            f" before it and from it on, with {usual:.2%} between others as far apart: they are shifted or"
            f" turned against each other; correct the poses, or fuse the two parts one by one (--frames :{before + 1}"
            f" and --frames {index}:)"
        )

    def said_of_lost(self) -> str | None:
        """Return the line on frames whose tracking was lost; None where it was not."""
        if type(self.scene).T_wc is Scene.T_wc or len(self.indices) < LEAST_CHAIN:
            return None
        poses = self._poses
        lost = lost_tracking(poses, self._configured, self._links)
        if not lost:
            return None
        same = any(np.allclose(poses[k], origin_of(self._configured), atol=1e-9) for k in lost)
        what = "the identity as pose" if same else "the pose of a frame before once more"
        frames = f"frame {self.named(lost[0])} has {what}"
        if len(lost) > 1:
            frames = f"{len(lost)} frames have {what} ({self._list(lost, MOST_LOST)})"
        return (
            f"tracking was lost: {frames}, though depth shows that the camera is elsewhere; leave out such frames:"
            f" {LEAVE_OUT}"
        )

    def _links(self, pairs: Sequence[Pair]) -> list[Link | None]:
        """Return how pairs of frames agree; None for frames without depth or that cannot be read."""
        views = {position: self._view(position) for position in sorted({p for pair in pairs for p in pair})}
        told = {p: view for p, view in views.items() if view is not None and len(view.u) >= LEAST_SEEN}
        return [linked(told[a], told[b], self._configured) if a in told and b in told else None for a, b in pairs]

    def said_of_many(self, chain: Chain, misfits: Sequence[int]) -> str:
        """Return the line on frames that do not fit those beside them, where they are many."""
        return (
            f"{len(misfits)} of {len(chain.positions)} frames do not fit the frames beside them, which fit each other:"
            f" {self._list(misfits, MOST_LOST)}; their poses or depth are wrong: correct them, or leave them out:"
            f" {LEAVE_OUT}"
        )

    def said_of_misfits(self, chain: Chain, misfits: Sequence[tuple[int, Pair]]) -> Iterator[str]:
        """Yield a line on frames that do not fit those beside them."""
        for position, beside in misfits[:MOST_NAMED]:
            yield f"{self._misfit(chain, position, beside)}; correct it, or leave the frame out ({LEAVE_OUT})"
        if len(misfits) > MOST_NAMED:
            more = [position for position, _ in misfits[MOST_NAMED:]]
            yield f"{len(more)} more frames do not fit their neighbours: {self._list(more)}"

    def _misfit(self, chain: Chain, position: int, beside: Pair) -> str:
        before, after = beside
        link, without = chain.links[before, position], chain.error(before, after)
        text = (
            f"frame {self.named(position)} does not fit frames {self.named(before)} and {self.named(after)} beside it"
        )
        if not math.isfinite(link.error):
            return f"{text}, which see each other, but hardly anything of it: its pose or its depth is wrong"
        text += f": {link.error:.1%} error, they fit each other with {without:.2%}"
        if link.steady and abs(math.log(link.ratio)) > math.log(ANOTHER_UNIT):
            long = f"{link.ratio:.2g} times too long" if link.ratio > 1 else f"{1 / link.ratio:.2g} times too short"
            return f"{text}; its depth ({self._file(position, 'depth')}) is {long}"
        return f"{text}; its pose or its depth ({self._file(position, 'depth')}) is wrong"

    def said_of_labels(self, chain: Chain) -> Iterator[str]:
        """Yield a line on frames whose labels do not agree with those of their neighbours."""
        mislabelled = chain.mislabelled()
        if self.source is None or len(mislabelled) > MOST_BAD * len(chain.positions):
            return
        for position, (before, after) in mislabelled[:MOST_NAMED]:
            agreement = max(chain.agreement(before, position), chain.agreement(position, after))
            yield (
                f"labels of {self.source}: the map of frame {self.named(position)} ({self._file(position, 'labels')})"
                f" agrees with those of the frames beside it in {agreement:.0%} of the points, they with each other in"
                f" {chain.agreement(before, after):.0%}: is it of another frame? Predict it again"
            )
        if len(mislabelled) > MOST_NAMED:
            yield f"labels of {self.source}: so it is in {len(mislabelled) - MOST_NAMED} more frames"

    def _list(self, positions: Sequence[int], most: int = MOST_NAMED) -> str:
        listed = ", ".join(map(self.named, positions[:most]))
        return f"{listed}, ..." if len(positions) > most else listed

    def _file(self, position: int, what: str) -> str:
        frame = self._read(self.indices[position])
        return frame.where(what if what != "labels" or frame.scores is None else "scores")


def _step(first: Float64, second: Float64) -> float:
    """Return how far a camera moves and turns, which only tells a step from those beside it."""
    R, t = motion(first, second)
    return float(np.linalg.norm(t) + np.linalg.norm(R - np.eye(3)))


def _ratio_to_those_around(steps: Float64, k: int) -> float:
    """Return a step's ratio to the median of those on both sides of it."""
    near = np.concatenate([steps[max(0, k - AROUND) : k], steps[k + 1 : k + 1 + AROUND]])
    return float(steps[k] / max(1e-9, np.nanmedian(near)))
