"""The differences between runs; JSON has the names of the fields."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semstab.data.statistics import Interval


@dataclass(frozen=True)
class MapCoverage:
    """The coverage of a model's map: `repeated` is OP >= 2, `recurrent` OP >= 3, `alone` voxels in no other map."""

    model: str
    voxels: int
    observations: int
    mean_op: float
    repeated: int
    recurrent: int
    common_share: float
    alone: int


@dataclass(frozen=True)
class Ignored:
    """The observations that a model left out of those that any model labelled, and bounds of their effect.

    Attributes:
        missing: Share of their pixels.
        psa_low, psa_high: Bounds of the agreement of two views of a spot, whatever the missing observations would have
            been (Manski 1990): the worst case, and the best.
        alpha: By the convention that a pair of views disagrees if the model left out one of them: see `LabelledPairs`.
    """

    model: str
    missing: float
    psa_low: float
    psa_high: float
    alpha: float


@dataclass(frozen=True)
class ComparedObservations:
    """The compared observations: the spots that all models labelled in a view, each with the same weight.

    Attributes:
        spots, observations: The ones that they are of.
        order: Order of the models by alpha on these observations, the best first.
        order_ignored: The same by that convention.
        bounded: Whether the bounds of the agreement keep the order of the models, whatever was left out.
    """

    spots: int
    observations: int
    ignored: tuple[Ignored, ...]
    order: tuple[str, ...]
    order_ignored: tuple[str, ...]
    bounded: bool

    @property
    def depends(self) -> bool:
        """Return whether the order depends on what was left out."""
        return self.order != self.order_ignored or not self.bounded


Basis = Literal["observations", "voxels", "cubes", "flights", "images"]
"""The unit of pairing: observations (a spot in a view) that all made; voxels that all saw twice or more; cubes,
each map with all its voxels; nothing, each flight by itself; images of a video, which has no map."""


@dataclass(frozen=True)
class Contrast:
    """A measure in a run, compared with that in the base.

    Attributes:
        measure: Its key.
        of: The class whose locations it concerns; empty: all.
        difference: The run's less the base's, with its interval, the scope that this answers, and the p-value that
            there is none.
        p_holm: The p-value corrected for all that stand in one list with it (Holm 1979).
        change: Verdict: 'better', 'worse', or nothing.
    """

    measure: str
    of: str
    base: float
    other: float
    difference: Interval
    p_holm: float
    change: Literal["better", "worse", ""]


@dataclass(frozen=True)
class FrameShare:
    """A frame, its share of the loss, and its name."""

    frame: int
    share: float
    name: str = ""


@dataclass(frozen=True)
class Area:
    """Neighbouring voxels of a class that got worse.

    Attributes:
        number: Number from 1 on, the largest loss first; in the column `area`.
        what: 'agreement': frames agree less; 'truth': right before, wrong now.
        of: The class that both runs together give these voxels, or the true one.
        confused_with: The class that the top contributing frames give.
        voxels: Number of voxels.
        loss: Mean over them: of agreement between frames, or 1.
        centre: Metres in the coordinates of the exports, see `SceneComparison.crs`.
        size: Metres from end to end.
        improved_alike: Areas that improved by as much or more, in all: what chance gives if nothing got worse.
        frames: The top contributing ones, the worst first; empty where the observations were not stored.
    """

    number: int
    what: Literal["agreement", "truth"]
    of: str
    confused_with: str
    voxels: int
    loss: float
    centre: tuple[float, float, float]
    size: float
    improved_alike: int
    frames: tuple[FrameShare, ...]


@dataclass(frozen=True)
class Against:
    """A run against the base on one scene, or on all.

    Attributes:
        compared: Voxels whose change is known.
        worse, better: Voxels whose frames agree less, or more, by a fifth or more.
        top_frames: The top contributing frames of all areas together.
        columns: File of each voxel's change and area, relative to the folder.
    """

    other: str
    contrasts: tuple[Contrast, ...]
    by_class: tuple[Contrast, ...] = ()
    compared: int = 0
    worse: int = 0
    better: int = 0
    areas: tuple[Area, ...] = ()
    top_frames: tuple[FrameShare, ...] = ()
    columns: Path | None = None

    def __repr__(self) -> str:
        return f"<Against {self.stated}>"

    @property
    def stated(self) -> str:
        """The first difference, and the measures in which a difference is shown."""
        first = self.contrasts[0] if self.contrasts else None
        changes = [
            f"{change} in {', '.join(measure_names)}"
            for change in ("worse", "better")
            if (measure_names := [row.measure for row in self.contrasts if row.change == change])
        ]
        first_text = "" if first is None else f": {first.measure} {first.difference.text('+')}, p {first.p_holm:.2g}"
        return f"{self.other}{first_text}; {'; '.join(changes) or 'no difference is shown'}"


@dataclass(frozen=True)
class SceneComparison:
    """The runs on one scene.

    Attributes:
        notes: Notes on the parts that cannot be compared here, with the reason.
        voxels: Number of voxels that all saw twice or more; 0 where they are not known.
        frames: Number of frames that they come from, about.
        crs: Name of the reference system that centres of areas are in; '' for the scene's own coordinates.
    """

    scene: str
    basis: Basis
    notes: tuple[str, ...]
    voxels: int
    frames: int
    coverage: tuple[MapCoverage, ...]
    observations: ComparedObservations | None
    against: tuple[Against, ...]
    crs: str = ""

    def __repr__(self) -> str:
        lines = [f"<SceneComparison of {self.scene}: {self.voxels:,} voxels that all saw twice, {self.frames} frames>"]
        return "\n".join([*lines, *(f"  {against.stated}" for against in self.against)])


@dataclass(frozen=True)
class Compared:
    """A run as it was named, the file or folder it was read from (None: a program held it), and its label source.

    Attributes:
        uninformative: Nearly the whole map is one class in every scene: its alpha ranks nothing.
    """

    name: str
    source: Path | None
    model: str
    uninformative: bool = False


@dataclass(frozen=True)
class RunComparison:
    """Runs compared with the first one, the base.

    Attributes:
        overall: Macro means over the scenes, each counting once.
        cautions: What stands against taking the more stable run for the better one.
    """

    schema: int
    base: str
    runs: tuple[Compared, ...]
    overall: tuple[Against, ...]
    scenes: tuple[SceneComparison, ...]
    cautions: tuple[str, ...] = ()

    def __repr__(self) -> str:
        scenes = ", ".join(scene.scene for scene in self.scenes)
        lines = [f"<RunComparison with {self.base} on {scenes}>"]
        lines += [f"  {against.stated}" for against in self.overall]
        lines += [f"  caution: {text}" for text in self.cautions]
        return "\n".join(lines)
