"""Coordinate frames that hang from each other, each by a transform over time, as ROS publishes them on /tf.

Source: Foote, tf: The transform library, TePRA 2013; REP 105 (frames of mobile platforms).
"""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.geometry.cameras import Poses, between_times, from_quaternions

NANOSECONDS = 1e9


@dataclass
class Trajectory:
    """Poses over time: integer nanoseconds, and x y z qx qy qz qw in metres for each.

    Attributes:
        fixed: Whether the last pose holds at all times.
    """

    fixed: bool = False
    stamps: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.stamps)

    def add(self, stamp: int, numbers: Sequence[float]) -> None:
        """Add the pose x y z qx qy qz qw at a stamp; stamps may come in any order, of equal ones the last counts."""
        self.stamps.append(stamp)
        self.numbers.extend(numbers)

    def poses_at(self, stamps: Sequence[int], max_gap: float, path: Path) -> Poses:
        """Return (n, 4, 4) at stamps, NaN for a stamp that is not between two poses at most `max_gap` seconds apart.

        Raises:
            DataError: For a quaternion that is not of length 1, with `path`.
        """
        numbers = np.frombuffer(self.numbers, dtype=np.float64).reshape(-1, 7)
        poses = from_quaternions(numbers[:, :3], numbers[:, 3:], path)
        if self.fixed:
            return np.repeat(poses[-1:], len(stamps), axis=0)
        all_stamps = np.frombuffer(self.stamps, dtype=np.int64)
        order = np.argsort(all_stamps, kind="stable")
        last = np.append(np.diff(all_stamps[order]) > 0, True)
        times, start = all_stamps[order][last], int(all_stamps.min())
        queries = np.array([stamp - start for stamp in stamps], dtype=np.int64)
        return between_times(_seconds(times - start), poses[order][last], _seconds(queries), max_gap)


def _seconds(stamps: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Float64:
    return stamps.astype(np.float64) / NANOSECONDS


class Transforms:
    """A forest of frames; names count without a leading '/'."""

    def __init__(self) -> None:
        self._above: dict[str, dict[str, Trajectory]] = {}

    def add(self, parent: str, child: str, stamp: int, numbers: Sequence[float], *, fixed: bool) -> None:
        """Add the pose x y z qx qy qz qw of a child in its parent."""
        series = self._above.setdefault(bare(child), {}).setdefault(bare(parent), Trajectory(fixed))
        series.fixed = series.fixed and fixed
        series.add(stamp, numbers)

    def frames(self) -> list[str]:
        """Return the frames that hang from others, by name."""
        return sorted(self._above)

    def parents(self, frame: str) -> list[str]:
        """Return the frames that a frame hangs from, those with most transforms first."""
        above = self._above.get(bare(frame), {})
        return sorted(above, key=lambda parent: -len(above[parent]))

    def upwards(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on to the root; of two parents the one with more transforms."""
        chain = [bare(frame)]
        while (above := self.parents(chain[-1])) and above[0] not in chain:
            chain.append(above[0])
        return chain

    def moves(self, chain: Sequence[str]) -> bool:
        """Return whether any transform along the chain, from a frame upwards, changes over time."""
        return any(not self._above[child][parent].fixed for child, parent in itertools.pairwise(chain))

    def poses_at(self, chain: Sequence[str], stamps: Sequence[int], max_gap: float, path: Path) -> Poses:
        """Return poses (n, 4, 4) of the chain's first frame in its last one; NaN as `Trajectory.at`."""
        T = np.repeat(np.eye(4)[None], len(stamps), axis=0)
        for child, parent in itertools.pairwise(chain):
            T = self._above[child][parent].poses_at(stamps, max_gap, Path(f"{path}, {child} in {parent}")) @ T
        return T


def bare(frame: str) -> str:
    """Return the name of a frame without a leading '/', which the first version of tf has."""
    return frame.removeprefix("/")
