"""All statistics of one map: the verdict, the numbers that it rests on, and every section."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from semstab.core.json_form import INLINE
from semstab.data.measures import MeasureMeans
from semstab.data.statistics.agreement import Correlogram, FrameAgreement, RangeAgreement, SpotAgreement
from semstab.data.statistics.correctness import CorrectnessStatistics, Losses
from semstab.data.statistics.drift import DriftStatistics, Flipping, OutlyingFrames
from semstab.data.statistics.features import FeatureAgreement
from semstab.data.statistics.groupings import Groupings
from semstab.data.statistics.intervals import Interval, short
from semstab.data.statistics.moving import MovedSpots

Level = Literal[
    "stable", "usable", "unstable", "undecided", "uninformative", "misleading", "no verdict",
]  # fmt: skip


@dataclass(frozen=True)
class StabilityVerdict:
    """A model on a scene.

    Attributes:
        level: Level of the surface that the model labels, see ADVICE.
        probability: Probability that the level is right, for the same scene flown again; NaN if no threshold decides.
        line: The reasons.
        of_all: The level if pixels without a label count as disagreeing, or None if it equals `level`.
        labelled: Share of the pixels with depth that have a label; NaN if not stored.
        probability_of_all: Probability that `of_all` is right; NaN without `of_all`.
    """

    level: Level
    probability: float
    line: str
    of_all: Level | None = None
    labelled: float = math.nan
    probability_of_all: float = math.nan

    @property
    def decisive(self) -> Level:
        """Level that counts against other models: the level of the whole surface, with labels or without."""
        return self.of_all or self.level

    @property
    def decisive_probability(self) -> float:
        """The probability that the decisive level is right; NaN if no threshold decides."""
        return self.probability if self.of_all is None else self.probability_of_all

    @property
    def difference(self) -> str:
        """The two levels where they differ: 'stable of the 92 % that it labels, usable of all'; else ''."""
        if self.of_all is None:
            return ""
        share = "more than 99 %" if self.labelled >= 0.995 else f"{100 * self.labelled:.0f} %"
        return f"{self.level} of the {share} that it labels, {self.of_all} of all"

    @property
    def stated(self) -> str:
        """Probability in print: '(p .71)', '(p > .99)', not a share of a map; '' if no level is probable enough."""
        p = self.probability
        return "" if math.isnan(p) or self.level == "undecided" else "(p > .99)" if p >= 0.995 else f"(p {short(p)})"

    @property
    def in_words(self) -> str:
        """Probability with its name, which no reader takes for a p-value: '(probability .71)'."""
        return self.stated.replace("p", "probability", 1)

    def __str__(self) -> str:
        """Return 'stable (p .98)'."""
        return f"{self.level} {self.stated}".rstrip()


@dataclass(frozen=True)
class Repeated:
    """The voxels with OP >= 2: how many they are, and of all voxels."""

    voxels: int
    share: float


@dataclass(frozen=True)
class HeadlineStatistics:
    """The numbers that a verdict rests on, with intervals for the same scene flown again.

    If frames are not known, or too few to tell, the intervals are for these frames, as their `scope` says. alpha is
    of spots, NaN without them; the others are of voxels; the last two are undefined without ground truth.
    """

    alpha: Interval
    psa_op2: Interval
    vss_op3: Interval
    accuracy_op2: Interval
    wrong_of_consistent_op3: Interval


@dataclass(frozen=True)
class EntropyParts:
    """Mean entropy of the belief at OP >= 2, and its parts within each frame and between them."""

    entropy_op2: Interval
    within: Interval
    between: Interval


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


ORDER_KNOWN = 0.25
"""Share of the locations seen twice from which on SBD less that in random order is reported."""


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
    spots: SpotAgreement | None
    correlogram: Correlogram | None
    drift: DriftStatistics
    uncertainty: EntropyParts
    geometry: Losses | None
    correctness: CorrectnessStatistics | None
    strata: tuple[StratumStatistics, ...]
    outlying_frames: OutlyingFrames | None = None
    ranges: RangeAgreement | None = None
    groupings: Groupings | None = None
    moved: MovedSpots | None = None
    moving_untold: str = ""
    features: FeatureAgreement | None = None

    def __repr__(self) -> str:
        return f"<MapStatistics '{self.name}': {self.stated}>"

    @property
    def stated(self) -> str:
        """The verdict and the number that it rests on: 'stable (p .98), alpha .93 (.92 to .95)'."""
        if self.features is not None and self.features.alone:
            return f"alpha of features {self.features.alpha.text()}"
        static = "" if self.static is None else f", alpha (static) {self.static.alpha.text()}"
        return f"{self.verdict}, alpha {self.headline.alpha.text()}{static}"

    @property
    def static(self) -> MovedSpots | None:
        """The spots that moved, if some were found: the verdict is of the others then."""
        return self.moved if self.moved is not None and self.moved.are_found else None

    @property
    def decisive_alpha(self) -> Interval:
        """The alpha that the verdict reads: of what stayed if movers were found, else of all spots."""
        return self.headline.alpha if self.static is None else self.static.alpha

    @property
    def moving_lines(self) -> tuple[str, ...]:
        """Sentences on moving things; empty if nothing moved."""
        if self.static is None:
            return (self.moving_untold,) if self.moving_untold else ()
        return (f"{self.static.text(self.headline.alpha.value)}; the verdict is of what stayed", self.static.of_classes)

    @property
    def agreeing(self) -> float:
        """The share of the spots at which two views see the same class; NaN without spots."""
        return math.nan if self.spots is None else self.spots.agreeing(self.headline.alpha.value)

    @property
    def order_known(self) -> bool:
        """Return whether a random order of the observations was drawn for a quarter of the locations.

        For soft scores without a log that is so for a few of them only, which are no random sample.
        """
        return self.drift.voxels >= ORDER_KNOWN * self.repeated.voxels

    @property
    def told_ranges(self) -> RangeAgreement | None:
        """Return the agreement by range where a range is printed: only where labels are acted on, see `is_told`."""
        acted_on = {self.verdict.level, self.verdict.decisive} <= {"stable", "usable"}
        return self.ranges if acted_on and self.ranges is not None and self.ranges.is_told else None

    @property
    def sections(self) -> int:
        """Return how many of the sections that need more than the map could be computed."""
        return sum(section is not None for section in (self.geometry, self.correctness))
