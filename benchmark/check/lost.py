"""Lost tracking that was written as a pose: the identity, or the last known pose again, while the view moves on."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.chain import Link
from semstab.check.conventions import Convention
from semstab.check.reprojection import Pair
from semstab.core.types import Float64
from semstab.datasets.geometry.cameras import CAMERA_AXES

DIGITS = 9
"""Decimals to which poses are equal."""

CONTRADICTS, APART = 0.02, 4.0
"""Two frames contradict each other if the error is CONTRADICTS, and APART times the error of frames around them."""

UNSEEN = 0.02
"""A frame that sees less of both neighbours is elsewhere, too."""

MOST_RUNS = 30
"""Runs of frames with one pose whose images are read, the longest first."""


Compare = Callable[[Sequence[Pair]], Sequence[Link | None]]


@dataclass(frozen=True)
class PoseRun:
    """Frames in a row that have one pose, which is the identity, or the pose of another frame, too.

    Attributes:
        first, last: Positions of its first and last frame.
        before, after: Positions of the nearest frames that are in no run, or None without such a frame.
    """

    first: int
    last: int
    before: int | None
    after: int | None

    @property
    def within(self) -> list[Pair]:
        """The pairs of its own frames to compare: the first one, with that in the middle and the last one."""
        return [(self.first, k) for k in sorted({(self.first + self.last) // 2, self.last} - {self.first})]

    @property
    def pairs(self) -> list[Pair]:
        """The pairs of frames to compare: those within it, then its ends with the frames around it."""
        around = [(self.before, self.first), (self.last, self.after)]
        return [*self.within, *((a, b) for a, b in around if a is not None and b is not None)]


def lost_tracking(poses: Sequence[Float64], configured: Convention, compare: Compare) -> list[int]:
    """Return the positions of frames whose pose is the identity or another's, and which depth shows to be elsewhere.

    A camera that stands still has one pose, too; there depth stays as it is. A trajectory may begin with the identity.

    Args:
        poses: (4, 4) camera-to-world of all frames, OpenCV axes; NaN for a frame without a pose.
        configured: The convention in which the files are read.
        compare: Returns the agreement of pairs of frames, or None for frames that cannot be compared.
    """
    runs = runs_of_one_pose(poses, configured)
    if not runs:
        return []
    tried = sorted(runs, key=lambda run: run.first - run.last)[:MOST_RUNS]
    in_runs = {k for run in runs for k in range(run.first, run.last + 1)}
    free = [k for k in range(len(poses)) if k not in in_runs and np.isfinite(poses[k]).all()]
    calm = [pair for pair in itertools.pairwise(free) if pair[1] - pair[0] == 1]
    near = {pair for run in tried for pair in calm if _is_near(pair, run)}
    errors = [link.error for link in compare(sorted(near)) if link is not None and math.isfinite(link.error)]
    limit = max(CONTRADICTS, APART * float(np.median(errors))) if errors else CONTRADICTS
    links = {run: compare(run.pairs) for run in tried}
    lost = {k for run in tried for k in _lost_of(run, links[run], limit)}
    sure = {_key(poses[k]) for k in lost}
    of_same_pose = [run for run in tried if _key(poses[run.last]) in sure and not _fits(run, links[run], limit)]
    return sorted(lost | {k for run in of_same_pose for k in range(run.first, run.last + 1)})


def runs_of_one_pose(poses: Sequence[Float64], configured: Convention) -> list[PoseRun]:
    """Return the runs of frames whose pose is the identity as the files have it, or that of another frame."""
    origin = origin_of(configured)
    frames_by_pose = defaultdict[bytes, list[int]](list)
    for k, pose in enumerate(poses):
        if np.isfinite(pose).all():
            frames_by_pose[_key(pose)].append(k)
    suspects = {
        k for key, positions in frames_by_pose.items() if len(positions) > 1 or key == _key(origin) for k in positions
    }
    free = [k for k in range(len(poses)) if k not in suspects and np.isfinite(poses[k]).all()]
    runs = []
    for positions in frames_by_pose.values():
        members = [k for k in positions if k in suspects]
        for _, part in itertools.groupby(enumerate(members), lambda item: item[1] - item[0]):
            row = [k for _, k in part]
            before = next((k for k in reversed(free) if k < row[0]), None)
            runs.append(PoseRun(row[0], row[-1], before, next((k for k in free if k > row[-1]), None)))
    return runs


def origin_of(configured: Convention) -> Float64:
    """Return the pose (4, 4) that is the identity in the files."""
    origin: Float64 = np.eye(4)
    origin[:3, :3] = CAMERA_AXES[configured.axes]
    return origin


def _key(pose: Float64) -> bytes:
    return bytes((np.round(pose, DIGITS) + 0.0).tobytes())


def _is_near(pair: Pair, run: PoseRun) -> bool:
    return pair[1] == run.before or pair[0] == run.after


def _lost_of(run: PoseRun, links: Sequence[Link | None], limit: float) -> Sequence[int]:
    """Return the frames of a run that are elsewhere: all of them, or all but the first, whose pose the others have."""
    off = {pair: _is_off(link, limit) for pair, link in zip(run.pairs, links, strict=True) if link is not None}
    moves = any(is_off for pair, is_off in off.items() if pair in run.within)
    ends = [is_off for pair, is_off in off.items() if pair not in run.within]
    if run.before is not None and off.get((run.before, run.first)) is False:
        return range(run.first + 1, run.last + 1) if moves else ()
    return range(run.first, run.last + 1) if moves or ends == [True, True] else ()


def _fits(run: PoseRun, links: Sequence[Link | None], limit: float) -> bool:
    """Return whether one of its ends fits the frame next to it."""
    end_links = [
        link for pair, link in zip(run.pairs, links, strict=True) if link is not None and pair not in run.within
    ]
    return any(link.error < limit for link in end_links)


def _is_off(link: Link, limit: float) -> bool:
    return link.error >= limit or (math.isnan(link.error) and link.share < UNSEEN)
