"""Frames that do not fit their neighbours, and poses that jump: each frame beside those before and after it."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Convention
from semstab.check.geometry import Verdict
from semstab.check.reprojection import Pair, Sample, View, median_of_seen, motion, reader
from semstab.core.arrays import evenly
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64, Int64, Mask
from semstab.datasets import Scene
from semstab.errors import DataError

MOST_FRAMES, LEAST_FRAMES = 300, 44
MOST_PIXELS = 300 * 640 * 480
"""Frames that are read one after the other: so many, of large images fewer, of no size fewer than the second number,
which a quick check reads."""

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

SAME_RATIO, ANOTHER_UNIT = 0.05, 1.2
"""Spread of the ratio of two depths, relative, up to which one of them is that many times too long, and the least
ratio: a pose that is a little off looks alike."""

MOST_NAMED = 5
MOST_BAD = 0.1
"""Frames that are named in one line, and the share of the frames from which on they are no exceptions."""

POINTS = 500
"""Points of each frame."""

LEAST_CHAIN = 5
"""Fewer frames tell nothing of which is the exception."""


@dataclass(frozen=True)
class Link:
    """The agreement of two frames.

    Attributes:
        error: Median relative depth error of the points that are seen again, NaN where too few are.
        share: Share of the points that are seen again.
        ratio: Median of the depth that the second frame has there to the depth that it should have.
        steady: Whether that ratio is nearly the same at all points.
        agreement: Share of the points on one surface whose labels agree, NaN without labels.
    """

    error: float
    share: float
    ratio: float
    steady: bool
    agreement: float


@dataclass(frozen=True)
class Chain:
    """Frames in order, each compared with the next one and with the one after that.

    Attributes:
        positions: Those of the frames, ascending.
        links: Agreement by two positions.
        usual: The median error of frames that follow each other; NaN where none sees another.
    """

    positions: Sequence[int]
    links: Mapping[Pair, Link]
    usual: float

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

    def misfits(self) -> list[int]:
        """Return the positions of frames that contradict both neighbours, which fit each other."""
        triples = zip(self.positions, self.positions[1:], self.positions[2:], strict=False)
        return [b for a, b, c in triples if self._strange((a, b), (a, c)) and self._strange((b, c), (a, c))]

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

    def mislabelled(self) -> list[int]:
        """Return the positions of frames whose labels agree with neither neighbour, while those agree."""
        return [
            b
            for a, b, c in zip(self.positions, self.positions[1:], self.positions[2:], strict=False)
            if {(a, b), (b, c), (a, c)} <= self.links.keys()
            and max(self.links[a, b].agreement, self.links[b, c].agreement) < self.links[a, c].agreement - DISAGREE
        ]


def chained(views: Iterable[tuple[int, View | None]], configured: Convention) -> Chain:
    """Compare views in order; two are held in memory beside the one that comes. Those without depth are passed over."""
    positions, links, last = list[int](), dict[Pair, Link](), list[tuple[int, View]]()
    for position, view in views:
        if view is None or len(view.u) < LEAST_SEEN:
            continue
        links |= {(other, position): linked(before, view, configured) for other, before in last}
        positions.append(position)
        last = [*last[-1:], (position, view)]
    errors = [links[pair].error for pair in itertools.pairwise(positions) if math.isfinite(links[pair].error)]
    return Chain(positions, links, float(np.median(errors)) if errors else math.nan)


def linked(first: View, second: View, configured: Convention) -> Link:
    """Compare two views: points of each in the other."""
    sample, one = Sample({0: first, 1: second}, [(0, 1), (1, 0)], configured), np.array([1.0])
    there, back = (sample.matched(pair, configured, one) for pair in sample.pairs)
    errors = np.concatenate([there.error[0], back.error[0]])
    seen = np.isfinite(errors)
    if seen.sum() < LEAST_SEEN or seen.mean() < LEAST_SHARE:
        return Link(math.nan, float(seen.mean()), math.nan, False, math.nan)
    own, other = np.isfinite(there.error[0]), np.isfinite(back.error[0])
    with np.errstate(all="ignore"):
        logs = np.log(np.concatenate([(there.depth / there.z)[0][own], (back.z / back.depth)[0][other]]))
    ratio = float(np.median(logs))
    return Link(
        error=float(median_of_seen(errors)),
        share=float(seen.mean()),
        ratio=math.exp(ratio),
        steady=bool(np.median(np.abs(logs - ratio)) < SAME_RATIO),
        agreement=_agreement(first, second, there.u[0][own], there.v[0][own], own),
    )


def _agreement(first: View, second: View, u: Int64, v: Int64, seen: Mask) -> float:
    if first.labels is None or second.labels is None:
        return math.nan
    a, b = first.labels[first.v[seen], first.u[seen]], second.labels[v, u]
    known = (a != first.ignore_id) & (b != second.ignore_id)
    return float(np.mean(a[known] == b[known])) if known.sum() >= LEAST_SEEN else math.nan


# The frames of a scene in order, and what is said of them.


def with_continuity(verdict: Verdict, neighbours: Neighbours, positions: Iterable[int]) -> Verdict:
    """Return the verdict, with the frame from which on poses jump, and notes on frames that do not fit the others.

    Args:
        verdict: The verdict of other checks, of which one that names a mend is left alone.
        neighbours: The frames of the scene.
        positions: Those that are compared, beside those at striking steps of the camera.
    """
    if verdict.mend:
        return verdict
    chain = neighbours.chain({*positions, *neighbours.striking()})
    remarks = [*verdict.remarks, *neighbours.said_of_misfits(chain), *neighbours.said_of_labels(chain)]
    verdict = dataclasses.replace(verdict, remarks=tuple(remarks))
    broken = next(filter(None, map(neighbours.located, chain.breaks())), None)
    if broken is None:
        return verdict
    text = neighbours.said_of_break(broken)
    return dataclasses.replace(verdict, state="unsound", text=text, undetermined=(), reason="")


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
        """Return the positions of the frames to compare; a thorough check takes fewer of large images (w, h) only."""
        most = min(MOST_FRAMES, max(LEAST_FRAMES, MOST_PIXELS // (size[0] * size[1])))
        return evenly(len(self.indices), most if thorough else LEAST_FRAMES)

    def striking(self) -> set[int]:
        """Return the positions around the longest steps of the camera, where they are far longer than those near them.

        A scene that reads a whole frame for its pose has none.
        """
        if type(self.scene).T_wc is Scene.T_wc or len(self.indices) < LEAST_CHAIN:
            return set()
        poses = [self._pose(index) for index in self.indices]
        steps = np.array([_step(a, b) for a, b in itertools.pairwise(poses)])
        ratios = np.nan_to_num([_ratio_to_those_around(steps, k) for k in range(len(steps))])
        largest = [int(k) for k in np.argsort(-ratios)[:MOST_STEPS] if ratios[k] >= STRIKING_STEP]
        return {p for k in largest for p in range(k - 1, k + 3) if 0 <= p < len(self.indices)}

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

    def said_of_misfits(self, chain: Chain) -> Iterator[str]:
        """Yield a line on frames whose depth or pose does not fit that of their neighbours."""
        misfits = chain.misfits()
        if not misfits or len(misfits) > MOST_BAD * len(chain.positions):
            return
        for position in misfits[:MOST_NAMED]:
            yield f"{self._misfit(chain, position)}; correct it, or leave the frame out (setting frames.list)"
        if len(misfits) > MOST_NAMED:
            more = misfits[MOST_NAMED:]
            yield f"{len(more)} more frames do not fit their neighbours: {self._list(more)}"

    def _misfit(self, chain: Chain, position: int) -> str:
        at = chain.positions.index(position)
        before, after = chain.positions[at - 1], chain.positions[at + 1]
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
        if not mislabelled or self.source is None or len(mislabelled) > MOST_BAD * len(chain.positions):
            return
        for position in mislabelled[:MOST_NAMED]:
            at = chain.positions.index(position)
            before, after = chain.positions[at - 1], chain.positions[at + 1]
            agreement = max(chain.links[before, position].agreement, chain.links[position, after].agreement)
            yield (
                f"labels of {self.source}: the map of frame {self.named(position)} ({self._file(position, 'labels')})"
                f" agrees with those of the frames beside it in {agreement:.0%} of the points, they with each other in"
                f" {chain.links[before, after].agreement:.0%}: is it of another frame? Predict it again"
            )
        if len(mislabelled) > MOST_NAMED:
            yield f"labels of {self.source}: so it is in {len(mislabelled) - MOST_NAMED} more frames"

    def _list(self, positions: Sequence[int]) -> str:
        listed = ", ".join(map(self.named, positions[:MOST_NAMED]))
        return f"{listed}, ..." if len(positions) > MOST_NAMED else listed

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
