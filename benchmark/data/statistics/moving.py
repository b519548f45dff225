"""Spots that moved, and agreement of what stayed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.data.statistics.intervals import Interval, short

LEAST_MOVED, LEAST_SHARE = 20, 0.005
"""Moved spots, and their share, from which on movers were found: static sequences have less by errors alone."""

MOSTLY_UNKNOWN = 0.5
"""The share of spots of which it is not known whether they moved from which on that is told."""


@dataclass(frozen=True)
class MovedClass:
    """A class that moved.

    Attributes:
        name: The class that most views give its spots.
        spots: Its spots of which it is known whether they moved.
        moved: Share of them that moved.
    """

    name: str
    spots: int
    moved: float


@dataclass(frozen=True)
class MisplacedFrame:
    """A frame whose pose does not fit those of the others.

    Attributes:
        frame: Its index.
        name: The name of its file.
        through: Share of its spots that it sees through, or other frames see through.
    """

    frame: int
    name: str
    through: float


@dataclass(frozen=True)
class MovedSpots:
    """Spots that moved: other views see through them.

    Attributes:
        spots: Spots of which it is known whether they moved.
        unknown: Share of the spots of which it is not known.
        moved: Share of the known spots that moved.
        disagreement: Share of the disagreement at known spots that is at those that moved.
        alpha: Alpha of the others, 'alpha (static)'.
        gap: How much farther than a spot, relative, all is that a view shows which sees through it.
        false_rate: Share of the votes on what stayed that see through it.
        false_share: Largest share of the known spots that such votes call moved, if they are independent.
        classes: Classes by the share of their spots that moved, most first, without those that did not move.
        misplaced: Frames whose poses do not fit; what they see counts for nothing here.
    """

    spots: int
    unknown: float
    moved: float
    disagreement: float
    alpha: Interval
    gap: float
    false_rate: float
    false_share: float
    classes: tuple[MovedClass, ...]
    misplaced: tuple[MisplacedFrame, ...]

    @property
    def are_found(self) -> bool:
        """Return whether more spots moved than static sequences have by errors: the verdict then is of the others."""
        enough = self.moved * self.spots >= LEAST_MOVED and self.moved >= LEAST_SHARE
        return enough and not math.isnan(self.alpha.value)

    def text(self, alpha: float) -> str:
        """'3.1 % of the spots moved (others see through them): 41 % of the disagreement; alpha of what stayed .84'.

        alpha is that of all spots.
        """
        share = "" if math.isnan(self.disagreement) else f": {100 * self.disagreement:.0f} % of the disagreement"
        moved = f"{100 * self.moved:.1f} % of the spots moved (other views see through them){share}"
        return f"{moved}; alpha of what stayed {short(self.alpha.value)}, of all {short(alpha)}"

    @property
    def of_classes(self) -> str:
        """'moved: 46 % of moving car, 55 % of human'."""
        rows = [f"{100 * row.moved:.0f} % of {row.name}" for row in self.classes if row.moved >= LEAST_SHARE]
        more = f" and {len(rows) - MOST_CLASSES} more classes" if len(rows) > MOST_CLASSES else ""
        return f"moved: {', '.join(rows[:MOST_CLASSES])}{more}"

    @property
    def of_poses(self) -> str:
        """Text on poses that do not fit, see `poses_that_do_not_fit`."""
        return poses_that_do_not_fit(self.misplaced)


MOST_CLASSES = 4
"""Most classes that are named in a sentence."""

MOST_RUNS = 6
"""Most stretches of frames that are named in a sentence."""


def poses_that_do_not_fit(misplaced: Sequence[MisplacedFrame]) -> str:
    """Return 'poses of frames a to b, d do not fit: 31 % of their spots are seen through'; '' if all fit."""
    if not misplaced:
        return ""
    runs: list[list[MisplacedFrame]] = []
    for misfit in sorted(misplaced, key=lambda pose: pose.frame):
        if runs and misfit.frame == runs[-1][-1].frame + 1:
            runs[-1].append(misfit)
        else:
            runs.append([misfit])
    run_names = [run[0].name if len(run) == 1 else f"{run[0].name} to {run[-1].name}" for run in runs]
    more = f" and {len(run_names) - MOST_RUNS} more" if len(run_names) > MOST_RUNS else ""
    share = sum(misfit.through for misfit in misplaced) / len(misplaced)
    listed = f"{', '.join(run_names[:MOST_RUNS])}{more}"
    if len(misplaced) == 1:
        return f"the pose of frame {listed} does not fit: {100 * share:.0f} % of its spots are seen through"
    return f"poses of frames {listed} do not fit: {100 * share:.0f} % of their spots are seen through"
