"""Frames that do not fit their neighbours, and poses that jump: each frame against the frames before and after it."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from semstab.check.chain import ANOTHER_UNIT, LEAST_CHAIN, LEAST_SEEN, STRIKING_SHIFT, Chain, Link, chained, linked
from semstab.check.conventions import Convention
from semstab.check.lost import lost_tracking, origin_of
from semstab.check.reprojection import Pair, View, motion, reader
from semstab.check.verdict import Verdict
from semstab.core.arrays import evenly
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64
from semstab.datasets import Scene
from semstab.errors import DataError

MOST_FRAMES, LEAST_FRAMES = 300, 44
MOST_PIXELS = 300 * 640 * 480
"""Frames that are read one after the other: at most MOST_FRAMES, with at most MOST_PIXELS pixels together, but at least
LEAST_FRAMES, which is also the number for a quick check."""

STRIKING_STEP = 4.0
AROUND = 15
MOST_STEPS = 3
"""Steps of the camera that are looked at: the MOST_STEPS largest steps of at least STRIKING_STEP times the median of
AROUND steps on each side."""

MOST_NAMED = 5
MOST_BAD = 0.1
"""Frames that are named in one line, and the share of the frames from which on the scene is unsound for them."""

MOST_LOST = 20
"""Frames that are named where all of them are to be left out."""

LEAVE_OUT = "write nan in place of the pose, or list the others in the setting frames.list"

POINTS = 500
"""Points of each frame."""


def with_continuity(verdict: Verdict, neighbours: Neighbours, chain: Chain, *, explained: bool = False) -> Verdict:
    """Return the verdict, with lost tracking, poses that jump, and notes on frames that do not fit the others.

    Args:
        verdict: The verdict of other checks, of which one that names a mend is left alone.
        neighbours: The frames of the scene.
        chain: Frames in order, with those at striking steps of the camera.
        explained: Whether something that holds for all frames explains the error, such as a wrong focal length; errors
            then differ along the sequence, and no shift of the poses is looked for.
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
    if explained or (shift := chain.without(positions).shift()) is None:
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
        views: Mapping[int, View] | None = None,
    ) -> None:
        self.scene, self.indices, self.source, self._configured = scene, indices, source, configured
        self._known, self._read = views or {}, reader(scene, source)

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
        """Poses (4, 4) of all frames; NaN for a frame without a pose."""
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
            return View.from_frame(self._read(self.indices[position]), POINTS, labelled=self.source is not None)
        if self.source is not None:
            with contextlib.suppress(DataError):
                return View.from_frame(reader(self.scene, None)(self.indices[position]), POINTS, labelled=False)
        return None

    def located(self, pair: Pair) -> tuple[int, Chain] | None:
        """Return the first frame after a jump between two positions, and the chain around it; None without a jump."""
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

    def frame_name(self, position: int) -> str:
        """Return the name of a frame for people."""
        return self.scene.frame_name(self.indices[position])

    def said_of_jumps(self, chain: Chain) -> str | None:
        """Return the line on the first frame at which poses jump, or None without a jump."""
        broken = next(filter(None, map(self.located, chain.breaks())), None)
        if broken is not None:
            return self.said_of_break(broken)
        departures = chain.departures()
        return self.said_of_departure(departures[0]) if departures else None

    def said_of_break(self, broken: tuple[int, Chain]) -> str:
        """Return the line on poses that jump."""
        first, chain = broken
        across = chain.error(first - 1, first)
        around = max(chain.error(first - 2, first - 1), chain.error(first, first + 1))
        return self._jump(
            (first - 1, first),
            f"depth reprojects with {across:.1%} error from frame {self.frame_name(first - 1)} to it, with {around:.2%}"
            " among the frames before and among those after",
        )

    def said_of_departure(self, pair: Pair) -> str:
        """Return the line on poses that go on in another frame of reference, while the view goes on."""
        return self._jump(
            pair,
            f"by its pose it sees nothing of what frame {self.frame_name(pair[0])} sees, though their depth images are"
            " nearly the same: the poses from it on are in another frame of reference",
            "bring them into one",
        )

    def said_of_shift(self, pair: Pair, error: float, usual: float) -> str:
        """Return the line on poses that are shifted or turned from a frame on."""
        return self._jump(
            pair,
            f"depth reprojects with {error:.2%} error between frames before it and from it on, with {usual:.2%} between"
            " others as far apart: they are shifted or turned against each other, if the intrinsics are right",
        )

    def _jump(self, pair: Pair, why: str, mend: str = "correct the poses") -> str:
        before, index = (self.indices[position] for position in pair)
        return (
            f"poses jump at frame {self.frame_name(pair[1])}: {why}; {mend}, or fuse the two parts one by one"
            f" (--frames :{before + 1} and --frames {index}:)"
        )

    def said_of_lost(self) -> str | None:
        """Return the line on frames whose tracking was lost, or None without lost tracking."""
        if type(self.scene).T_wc is Scene.T_wc or len(self.indices) < LEAST_CHAIN:
            return None
        poses = self._poses
        lost = lost_tracking(poses, self._configured, self._links)
        if not lost:
            return None
        is_identity = any(np.allclose(poses[k], origin_of(self._configured), atol=1e-9) for k in lost)
        what = "the identity as pose" if is_identity else "the pose of a frame before once more"
        frames = f"frame {self.frame_name(lost[0])} has {what}"
        if len(lost) > 1:
            frames = f"{len(lost)} frames have {what} ({self._list(lost, MOST_LOST)})"
        return (
            f"tracking was lost: {frames}, though depth shows that the camera is elsewhere; leave out such frames:"
            f" {LEAVE_OUT}"
        )

    def _links(self, pairs: Sequence[Pair]) -> list[Link | None]:
        """Return how pairs of frames agree; None for frames without depth or that cannot be read."""
        views = {position: self._view(position) for position in sorted({p for pair in pairs for p in pair})}
        usable = {p: view for p, view in views.items() if view is not None and len(view.u) >= LEAST_SEEN}
        return [
            linked(usable[a], usable[b], self._configured) if a in usable and b in usable else None for a, b in pairs
        ]

    def said_of_many(self, chain: Chain, misfits: Sequence[int]) -> str:
        """Return the line on frames that do not fit their neighbours, if there are many."""
        return (
            f"{len(misfits)} of {len(chain.positions)} frames do not fit the frames beside them, which fit each other:"
            f" {self._list(misfits, MOST_LOST)}; their poses or depth are wrong: correct them, or leave them out:"
            f" {LEAVE_OUT}"
        )

    def said_of_misfits(self, chain: Chain, misfits: Sequence[tuple[int, Pair]]) -> Iterator[str]:
        """Yield a line on frames that do not fit their neighbours."""
        for position, neighbours in misfits[:MOST_NAMED]:
            yield f"{self._misfit(chain, position, neighbours)}; correct it, or leave the frame out ({LEAVE_OUT})"
        if len(misfits) > MOST_NAMED:
            more = [position for position, _ in misfits[MOST_NAMED:]]
            yield f"{len(more)} more frames do not fit their neighbours: {self._list(more)}"

    def _misfit(self, chain: Chain, position: int, neighbours: Pair) -> str:
        before, after = neighbours
        link, without = chain.links[before, position], chain.error(before, after)
        beside = f"frames {self.frame_name(before)} and {self.frame_name(after)}"
        text = f"frame {self.frame_name(position)} does not fit {beside} beside it"
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
                f"labels of {self.source}: the map of frame {self.frame_name(position)}"
                f" ({self._file(position, 'labels')}) agrees with those of the frames beside it in {agreement:.0%}"
                f" of the points, they with each other in {chain.agreement(before, after):.0%}: is it of another frame?"
                f" Predict it again"
            )
        if len(mislabelled) > MOST_NAMED:
            yield f"labels of {self.source}: so it is in {len(mislabelled) - MOST_NAMED} more frames"

    def _list(self, positions: Sequence[int], most: int = MOST_NAMED) -> str:
        listed = ", ".join(map(self.frame_name, positions[:most]))
        return f"{listed}, ..." if len(positions) > most else listed

    def _file(self, position: int, what: str) -> str:
        frame = self._read(self.indices[position])
        return frame.where(what if what != "labels" or frame.scores is None else "scores")


def _step(first: Float64, second: Float64) -> float:
    """Return how far a camera moves and turns; the number only compares a step with its neighbours."""
    R, t = motion(first, second)
    return float(np.linalg.norm(t) + np.linalg.norm(R - np.eye(3)))


def _ratio_to_those_around(steps: Float64, k: int) -> float:
    """Return a step's ratio to the median of those on both sides of it."""
    near = np.concatenate([steps[max(0, k - AROUND) : k], steps[k + 1 : k + 1 + AROUND]])
    return float(steps[k] / max(1e-9, np.nanmedian(near)))
