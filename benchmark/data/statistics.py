"""The statistics of a map; JSON has the names of the fields.

Undefined numbers are NaN; a section that could not be computed is None.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Literal

from semstab.core.json_form import INLINE
from semstab.core.types import THESE_FRAMES, Scope
from semstab.data.measures import MeasureMeans

# --- Parts ------------------------------------------------------------------------------------------------------------


CONFIDENCE = 0.95
"""Level of confidence intervals, where no other is asked for."""


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval, and the level of that; NaN where undefined."""

    value: float
    low: float
    high: float
    level: float = field(default=CONFIDENCE, kw_only=True)

    @property
    def ends(self) -> Estimate:
        """The value with its interval alone."""
        return Estimate(self.value, self.low, self.high, level=self.level)

    @property
    def percent(self) -> Estimate:
        """The share in percent."""
        return Estimate(100 * self.value, 100 * self.low, 100 * self.high, level=self.level)

    @property
    def of(self) -> str:
        """The interval's name in print, '95 % CI'."""
        return f"{100 * self.level:g} % CI"

    def text(self, sign: str = "") -> str:
        """Return '.68 (.52 to .78)'; '.68' without an interval."""
        ends = "" if math.isnan(self.low) else f" ({short(self.low, sign)} to {short(self.high, sign)})"
        return f"{short(self.value, sign)}{ends}"


def short(value: float, sign: str = "", *, digits: int = 2) -> str:
    """Return a number from -1 to 1 without the 0 before its point: '.55', '-.19', '1.00'; '-' where it is undefined."""
    return "-" if math.isnan(value) else re.sub(r"^([+-]?)0\.", r"\1.", f"{value:{sign}z.{digits}f}")


UNDEFINED = Estimate(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Interval(Estimate):
    """A value with its confidence interval.

    Attributes:
        scope: The source of variation. 'this scene': the frames, when the same scene is flown again; 'other scenes':
            frames and locations; 'these frames': locations like these in these very frames.
        frames: Number of frames that were fused, about; 0 where they are not known.
        locations: Number of cubes of space that hold something that counts.
        degrees: Degrees of freedom of the standard error.
        undecided: The reason why nothing may be claimed, and the remedy; empty where something may.
        p_value: P-value that a difference is 0.
    """

    scope: Scope = THESE_FRAMES
    frames: int = 0
    locations: int = 0
    degrees: float = math.nan
    undecided: str = ""
    p_value: float = math.nan

    @property
    def decided(self) -> bool:
        """Return whether something may be claimed."""
        return not self.undecided


UNKNOWN = Interval(math.nan, math.nan, math.nan)

Level = Literal[
    "stable", "usable", "unstable", "undecided", "uninformative", "misleading", "no verdict",
]  # fmt: skip


@dataclass(frozen=True)
class StabilityVerdict:
    """A model on a scene.

    Attributes:
        level: See ADVICE.
        probability: Probability that the level is right, for the same scene flown again; NaN where no threshold
            decides.
        line: The reasons.
    """

    level: Level
    probability: float
    line: str

    @property
    def stated(self) -> str:
        """The probability in print: '(p .71)', '(p > .99)', no share of a map; '' where no level has enough."""
        p = self.probability
        return "" if math.isnan(p) or self.level == "undecided" else "(p > .99)" if p >= 0.995 else f"(p {short(p)})"

    def __str__(self) -> str:
        """Return 'stable (p .98)'."""
        return f"{self.level} {self.stated}".rstrip()


@dataclass(frozen=True)
class Repeated:
    """The voxels with OP >= 2: how many they are, and of all voxels."""

    voxels: int
    share: float


@dataclass(frozen=True)
class ClassAgreement:
    """Agreement on one class against all others, over the voxels with OP >= 2; NaN where undefined.

    observations is the evidence for the class in these voxels, in frames.
    """

    name: str
    observations: float
    kappa: float
    voxel_alpha: float


@dataclass(frozen=True)
class FrameAgreement:
    """Agreement of frames at the voxels with OP >= 2, whose size it depends on.

    Attributes:
        psa: Probability that two frames agree.
        kappa: Fleiss' kappa.
        voxel_alpha: Krippendorff's alpha.
        vss: The paper's VSS.
        within: Part of 1 - PSA that is there within a frame.
        between: Part of 1 - PSA that is there between frames.
        classes: The same of each class.
    """

    psa: Interval
    kappa: Interval
    voxel_alpha: Interval
    vss: Interval
    within: Interval
    between: Interval
    classes: tuple[ClassAgreement, ...]


@dataclass(frozen=True)
class ClassAlpha:
    """Alpha of one class against all others.

    Attributes:
        name: The class.
        locations: Voxels with OP >= 2 of which it is the dominant class.
        counts_for_verdict: Whether the verdict depends on it.
        alpha: Alpha with its interval.
        unstable: Probability that alpha is below the level 'usable'; NaN where that is not known.
        disagreement: Its share of the disagreement between views: of two labels that differ, each class has one half.
    """

    name: str
    locations: float
    counts_for_verdict: bool
    alpha: Interval
    unstable: float
    disagreement: float


@dataclass(frozen=True)
class MovingClasses:
    """Disagreement where the map has classes that move, as vehicles and persons do.

    Attributes:
        classes: Their names.
        disagreement: Share of all disagreement that is at locations with one of these as dominant class.
        alpha: Of all other locations.
    """

    classes: tuple[str, ...]
    disagreement: float
    alpha: float


@dataclass(frozen=True)
class RangeStratum:
    """Observations from some range.

    Attributes:
        low, high: Ends of the range in metres; the high one is not part of it.
        share: Share of all sampled observations.
        cells: Cells that two views saw from there.
        alpha: Alpha of these observations.
    """

    low: float
    high: float
    share: float
    cells: int
    alpha: Interval


@dataclass(frozen=True)
class RangeAgreement:
    """Agreement by the distance from which spots were seen.

    Attributes:
        strata: By range, the nearest first.
        usable: The level above which labels can be used.
        reliable: Metres up to which alpha stays above it, 0 where it never does.
        low, high: The least and the largest that this may be, by the intervals of the strata.
    """

    strata: tuple[RangeStratum, ...]
    usable: float
    reliable: float
    low: float
    high: float

    @property
    def farthest(self) -> float:
        """Return the end of the last stratum in which two views saw a spot, metres."""
        return max((row.high for row in self.strata if not math.isnan(row.alpha.value)), default=0.0)

    @property
    def is_told(self) -> bool:
        """Return whether the number is for people: labels may be unreliable farther out, and are reliable near by.

        Or they are so at no range; what is not known either way is the verdict's to say.
        """
        return self.low < self.farthest and (self.reliable > 0 or self.high == 0)

    @property
    def text(self) -> str:
        """Return the one number for people: 'reliable up to 30 m (20 to 50 m)'."""
        return " ".join(filter(None, ("reliable", *self.parts)))

    @property
    def parts(self) -> tuple[str, str]:
        """Return the number, and what belongs to it: ('up to 30 m', '(20 to 50 m)')."""
        if self.reliable:
            ends = "" if self.low == self.high else f"{self.low:g} to {self.high:g} m"
            far = "the farthest seen" if self.reliable == self.farthest else ""
            note = ", ".join(filter(None, (ends, far)))
            return f"up to {self.reliable:g} m", note and f"({note})"
        first = next((row for row in self.strata if not math.isnan(row.alpha.value)), self.strata[0])
        found = f"(alpha {first.alpha.text()} from {first.low:g} to {first.high:g} m)"
        return "at no range", found


@dataclass(frozen=True)
class CellAgreement:
    """The observations that alpha rests on: labels of sampled cells, about as wide as a pixel's footprint.

    Attributes:
        cell_size: Edge of a fine cell in metres.
        cells: Fine cells that two views saw or more.
        cubes: Cubes of space that hold them.
        frames: Frames that were fused.
        views: Distinct views among them: a camera that stands still has one.
        chance: Probability that two observations from anywhere on the map agree.
        largest_class: The class with most observations, and `largest_share` its share of them.
        labelled: Share of the locations with depth that have a label in at least half of their observations.
        classes: Alpha of each class.
        moving: The classes that move, where much of the disagreement is theirs; else None.
    """

    cell_size: float
    cells: int
    cubes: int
    frames: int
    views: int
    chance: float
    largest_class: str
    largest_share: float
    labelled: float
    classes: tuple[ClassAlpha, ...]
    moving: MovingClasses | None = None

    @property
    def effective_classes(self) -> float:
        """1 / chance: as many classes of equal size have this chance (Hill 1973, Ecology 54, of order 2)."""
        return 1 / self.chance if self.chance > 0 else math.nan

    def agreeing(self, alpha: float) -> float:
        """Return the share of the spots at which two views see the same class, as an alpha of these cells has it."""
        return 1 - (1 - alpha) * (1 - self.chance)

    @property
    def critical_classes(self) -> tuple[ClassAlpha, ...]:
        """The classes that count for the verdict, those most probably unstable first."""
        known = [row for row in self.classes if row.counts_for_verdict and not math.isnan(row.unstable)]
        return tuple(sorted(known, key=lambda row: (-row.unstable, row.alpha.value)))


@dataclass(frozen=True)
class LagBin:
    """Pairs of observations of a cell that are `low` to `high` apart, `mean` in the mean.

    Attributes:
        alpha: Of these pairs, beyond their own chance.
    """

    low: float
    high: float
    mean: float
    pairs: int
    alpha: Interval


@dataclass(frozen=True)
class Correlogram:
    """Agreement beyond chance by how far apart two observations are; bins with few pairs are left out.

    Attributes:
        time: Frames.
        angle: Degrees between the directions of view.
        range: Ratio of the distances to the location, the larger one above.
        baseline: Metres between the cameras.
        standard: The pairs with 5 to 15 degrees between them, for models and flights to be compared at.
    """

    time: tuple[LagBin, ...]
    angle: tuple[LagBin, ...]
    range: tuple[LagBin, ...]
    baseline: tuple[LagBin, ...]
    standard: LagBin


@dataclass(frozen=True)
class HeadlineStatistics:
    """The numbers that a verdict rests on, with intervals for the same scene flown again.

    If frames are not known, or too few to tell, the intervals are for these frames, as their `scope` says. alpha is
    of sampled cells, NaN without them; psa and vss are of voxels, at OP >= 2 and OP >= 3; the last two are undefined
    without ground truth.
    """

    alpha: Interval
    psa: Interval
    vss: Interval
    accuracy: Interval
    wrong_of_consistent: Interval


@dataclass(frozen=True)
class Flipping:
    """Locations about which frames do not agree: with OP >= 2, and two frames agree with a probability below 0.8.

    Attributes:
        share: Share of these locations, each counting by how likely it is one, for these frames.
        seen: The part of them that four frames or more saw: fewer observations do not show whether errors
            recur at the same locations.
        a, b: The two classes between which most of them flip, with the part of all flips that is between these.
    """

    share: Interval
    seen: float
    a: str = ""
    b: str = ""
    part: float = math.nan


@dataclass(frozen=True)
class Trend:
    """The movement of the belief in time: the share of the disagreement that odd and even observations both show.

    It is 0 in the mean if frames err independently. Drift of the model cannot be distinguished from errors that depend
    on the view, or that last over frames. `voxels` is the number of voxels behind it: those with OP >= 6 whose
    observations differ.
    """

    share: Interval
    voxels: int


@dataclass(frozen=True)
class FlipRates:
    """Share of the steps at which the predicted class changes, that in random order; frames since the last change."""

    rate: Interval
    null: Interval
    excess: Interval
    frames_since: Interval


@dataclass(frozen=True)
class DriftStatistics:
    """SBD in bits, and that of the same observations in random order, over the `voxels` where that is known."""

    voxels: int
    sbd: Interval
    null: Interval
    excess: Interval
    trend: Trend | None = None
    flips: FlipRates | None = None


@dataclass(frozen=True)
class EntropyParts:
    """Mean entropy of the belief, and its parts within each frame and between them."""

    entropy: Interval
    within: Interval
    between: Interval


@dataclass(frozen=True)
class Losses:
    """The pairwise disagreement 1 - PSA over voxels with OP >= 2 in both maps, and its sources.

    share is geometry's part of the total. Negative parts of the model mean that its labels agree better than the
    view-independent ones: it errs alike in all views.
    """

    voxels: int
    total: Estimate
    geometry: Estimate
    model: Estimate
    share: Estimate


@dataclass(frozen=True)
class Reliability:
    """One bin of the reliability diagram: voxels whose largest belief lies in (low, high]."""

    low: float
    high: float
    voxels: int
    confidence: float
    accuracy: float


@dataclass(frozen=True)
class Correctness:
    """Accuracy of the fused labels of a group of voxels; NaN where no voxel has a true class.

    Attributes:
        miou: Mean over the classes that are true or predicted somewhere, of intersection over union.
        ece: Expected calibration error: mean |accuracy - confidence| over 15 bins of the largest belief, by voxels.
        brier: Mean over voxels of sum_k (p_k - y_k)^2, 0 to 2.
    """

    name: str
    voxels: int
    accuracy: float
    miou: float
    ece: float
    brier: float


@dataclass(frozen=True)
class Quadrants:
    """Shares of the voxels with OP >= 3 and a true class that are consistent or not, right or wrong.

    wrong_of_consistent is the share of the consistent voxels that are wrong: the error where the map looks safe.
    """

    voxels: int
    consistent_right: Interval
    consistent_wrong: Interval
    inconsistent_right: Interval
    inconsistent_wrong: Interval
    wrong_of_consistent: Interval


@dataclass(frozen=True)
class CorrectnessStatistics:
    """Stability vs. accuracy of the fused labels.

    Attributes:
        accuracy, miou: Of the voxels seen twice or more, as `compare` and gates have them.
        strata: All voxels with a true class, then each stratum of OP.
    """

    accuracy: Interval
    strata: tuple[Correctness, ...]
    reliability: tuple[Reliability, ...]
    quadrants: Quadrants
    miou: Interval = UNKNOWN


@dataclass(frozen=True)
class StratumStatistics:
    """Means over a stratum of OP."""

    name: str
    voxels: int
    means: MeasureMeans = field(metadata=INLINE)
    psa: float
    sbd_null: float
    sbd_excess: float
    entropy_within: float
    entropy_between: float


@dataclass(frozen=True)
class FrameDisagreement:
    """A frame that stands alone.

    Attributes:
        frame: Its index, of frames that share a view the first one's.
        name: The name of its file.
        places: The sampled places that it saw, as two other views did at least.
        share: Share of these at which its neighbours, the views before and after it, agree on another class.
        null: The mean of that over the other views of the same places.
    """

    frame: int
    name: str
    places: int
    share: float
    null: float

    @property
    def excess(self) -> float:
        """Share less its null."""
        return self.share - self.null


@dataclass(frozen=True)
class OutlyingFrames:
    """The frames that stand alone more often than frames of the same quality do.

    Attributes:
        judged: Number of views that could be judged; 0 where they are too few for one to stand out.
        unjudged: Number of views that see too few places which two other views saw.
        usual: Mean excess of the frames that are not named.
        frames: Those that are named, the largest excess first.
    """

    judged: int
    unjudged: int
    usual: float
    frames: tuple[FrameDisagreement, ...] = ()


ORDER_KNOWN = 0.25
"""Share of the locations seen twice from which on SBD less that in random order is reported."""


# --- One map ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MapStatistics:
    """All statistics of one map."""

    schema: int
    name: str
    seed: int
    K: int
    voxel_size: float
    voxels: int
    observations: int
    repeated: Repeated
    cubes: int
    verdict: StabilityVerdict
    agreement: FrameAgreement
    flipping: Flipping | None
    headline: HeadlineStatistics
    cells: CellAgreement | None
    correlogram: Correlogram | None
    drift: DriftStatistics
    uncertainty: EntropyParts
    geometry: Losses | None
    correctness: CorrectnessStatistics | None
    strata: tuple[StratumStatistics, ...]
    outlying_frames: OutlyingFrames | None = None
    ranges: RangeAgreement | None = None

    def __repr__(self) -> str:
        return f"<MapStatistics '{self.name}': {self.stated}>"

    @property
    def stated(self) -> str:
        """The verdict and the number that it rests on: 'stable (p .98), alpha .93 (.92 to .95)'."""
        return f"{self.verdict}, alpha {self.headline.alpha.text()}"

    @property
    def agreeing(self) -> float:
        """The share of the spots at which two views see the same class; NaN without sampled cells."""
        return math.nan if self.cells is None else self.cells.agreeing(self.headline.alpha.value)

    @property
    def order_known(self) -> bool:
        """Return whether a random order of the observations was drawn for a quarter of the locations.

        For soft scores without a log that is so for a few of them only, which are no random sample.
        """
        return self.drift.voxels >= ORDER_KNOWN * self.repeated.voxels

    @property
    def sections(self) -> int:
        """Return how many of the sections that need more than the map could be computed."""
        return sum(section is not None for section in (self.geometry, self.correctness))
