"""What differs between runs; in JSON as the fields say. Undefined numbers are NaN."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semstab.model.statistics import Interval
from semstab.model.statistics.comparison import CommonLooks, MapCoverage

Basis = Literal["looks", "voxels", "cubes", "flights"]
"""What was paired: looks (a place in a frame) that all made; voxels that all saw twice or more; cubes of space, each
map with all its voxels; nothing, each flight by itself."""


@dataclass(frozen=True)
class Contrast:
    """A measure in a run, beside that in the base.

    measure     its key
    of          the class whose places it is of; empty: all
    difference  the run's less the base's, with its interval, the question that this answers, and the p-value that there
                is none
    p_holm      that p-value corrected for all that stand in one list with it (Holm 1979)
    change      what is said of it: 'better', 'worse', or nothing
    """

    measure: str
    of: str
    base: float
    other: float
    difference: Interval
    p_holm: float
    change: Literal["better", "worse", ""]


@dataclass(frozen=True)
class Blame:
    """A frame, and its share of what was lost."""

    frame: int
    share: float


@dataclass(frozen=True)
class Place:
    """Neighbouring voxels of a class that got worse.

    number   from 1 on, the largest loss first; in the column `place`
    what     'agreement': frames agree less; 'truth': right before, wrong now
    of       the class that both runs together give these voxels, or the true one
    instead  the class that the blamed looks give
    voxels   how many
    loss     mean over them: of agreement between frames, or 1
    centre   metres, as the run has coordinates
    size     metres from end to end
    rivals   places that improved by as much or more, in all: what chance gives where nothing got worse
    frames   to blame, the worst first; empty where the looks were not kept
    """

    number: int
    what: Literal["agreement", "truth"]
    of: str
    instead: str
    voxels: int
    loss: float
    centre: tuple[float, float, float]
    size: float
    rivals: int
    frames: tuple[Blame, ...]


@dataclass(frozen=True)
class Against:
    """A run against the base on one scene, or on all.

    compared  voxels whose change is known
    worse, better  voxels whose frames agree less, or more, by a fifth or more
    blamed    frames, of all places together
    columns   file of each voxel's change and place, relative to the folder
    """

    other: str
    contrasts: tuple[Contrast, ...]
    by_class: tuple[Contrast, ...] = ()
    compared: int = 0
    worse: int = 0
    better: int = 0
    places: tuple[Place, ...] = ()
    blamed: tuple[Blame, ...] = ()
    columns: Path | None = None


@dataclass(frozen=True)
class SceneComparison:
    """The runs on one scene.

    remarks   what cannot be compared here, and why
    voxels    that all saw twice or more; 0 where they are not known
    frames    that they come from, about
    """

    scene: str
    basis: Basis
    remarks: tuple[str, ...]
    voxels: int
    frames: int
    coverage: tuple[MapCoverage, ...]
    looks: CommonLooks | None
    against: tuple[Against, ...]


@dataclass(frozen=True)
class Compared:
    """A run as it was named, the file or folder it was read from, and its label source."""

    name: str
    source: Path
    backbone: str


@dataclass(frozen=True)
class RunComparison:
    """Runs beside the first one, the base.

    overall  macro means over the scenes, each counting once
    """

    schema: int
    base: str
    runs: tuple[Compared, ...]
    overall: tuple[Against, ...]
    scenes: tuple[SceneComparison, ...]
