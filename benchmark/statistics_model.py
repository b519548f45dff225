"""What `semstab.statistics` says of a map, and of several maps beside each other; in JSON as the fields say.

Undefined numbers are NaN; a section that could not be computed is None.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from semstab.json_form import INLINE
from semstab.measures import Measure, MeasureMeans, Quantity

# --- Parts ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % confidence interval; NaN where undefined."""

    value: float
    low: float
    high: float

    @property
    def percent(self) -> Estimate:
        """Of a share, in percent."""
        return Estimate(100 * self.value, 100 * self.low, 100 * self.high)


UNDEFINED = Estimate(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class StabilityVerdict:
    """What the evidence says of a backbone on a scene: a key of ADVICE, and the line that gives the reason."""

    level: str
    line: str


@dataclass(frozen=True)
class Repeated:
    """The voxels with OP >= 2: how many they are, and of all voxels."""

    voxels: int
    share: float


@dataclass(frozen=True)
class BlockCut:
    """Into how many occupied blocks the voxels with OP >= 2 were cut, and their edge in metres."""

    count: int
    size: float


@dataclass(frozen=True)
class ClassAgreement:
    """Agreement on one class against all others, over the voxels with OP >= 2; NaN where undefined.

    observations is the evidence for the class in these voxels, in frames.
    """

    name: str
    observations: float
    kappa: float
    alpha: float


@dataclass(frozen=True)
class FrameAgreement:
    """Do frames agree about a place? Over the voxels with OP >= 2."""

    psa: Estimate
    kappa: Estimate
    alpha: Estimate
    vss: Estimate
    classes: tuple[ClassAgreement, ...]


@dataclass(frozen=True)
class DriftTests:
    """The order of observations, tested: `SceneDrift` and how many voxels were tested one by one, and found.

    trend_excess  the trend less that in random order
    """

    sbd_p: float
    trend: float
    trend_null: float
    trend_excess: Estimate
    trend_p: float
    tested_voxels: int
    unusual_sbd_voxels: int
    drifting_voxels: int


@dataclass(frozen=True)
class FlipRates:
    """Share of the steps at which the predicted class changes, that in random order; frames since the last change."""

    rate: Estimate
    null: Estimate
    excess: Estimate
    frames_since: Estimate


@dataclass(frozen=True)
class DriftStatistics:
    """SBD in bits beside that of the same observations in random order, over the `voxels` where that is known."""

    voxels: int
    sbd: Estimate
    null: Estimate
    excess: Estimate
    tests: DriftTests | None = None
    flips: FlipRates | None = None


@dataclass(frozen=True)
class EntropyParts:
    """Mean entropy of the belief, and of that what is there within each frame and between them."""

    entropy: Estimate
    within: Estimate
    between: Estimate


@dataclass(frozen=True)
class Losses:
    """The pairwise disagreement 1 - PSA over voxels with OP >= 2 in both maps, and whose it is.

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
    """How right the fused labels of a group of voxels are; NaN where no voxel has a true class.

    miou   mean over the classes that are true or predicted somewhere, of intersection over union
    ece    expected calibration error: mean |accuracy - confidence| over 15 bins of the largest belief, by voxels
    brier  mean over voxels of sum_k (p_k - y_k)^2, 0 to 2
    """

    name: str
    voxels: int
    accuracy: float
    miou: float
    ece: float
    brier: float


@dataclass(frozen=True)
class Quadrants:
    """Shares of the voxels with OP >= 3 and a true class that are stable or not, right or wrong.

    wrong_of_stable is the share of the stable voxels that are wrong: what to expect where the map looks safe.
    """

    voxels: int
    stable_right: Estimate
    stable_wrong: Estimate
    unstable_right: Estimate
    unstable_wrong: Estimate
    wrong_of_stable: Estimate


@dataclass(frozen=True)
class CorrectnessStatistics:
    """Right beside stable; strata has all voxels with a true class first, then each stratum of OP."""

    accuracy: Estimate
    strata: tuple[Correctness, ...]
    reliability: tuple[Reliability, ...]
    quadrants: Quadrants


@dataclass(frozen=True)
class RuleMeans:
    """Means over the voxels with OP >= 2 under a rule of fusion; how right it is where ground truth tells, else NaN."""

    means: MeasureMeans = field(metadata=INLINE)
    accuracy: float = math.nan
    miou: float = math.nan
    ece: float = math.nan
    brier: float = math.nan

    def __getitem__(self, measure: Measure) -> float:
        return self.means[measure]


@dataclass(frozen=True)
class RuleOutcome:
    """What a rule of fusion makes of a map; relabelled_share is the part of the voxels that get another class."""

    rule: str
    values: RuleMeans = field(metadata=INLINE)
    relabelled_share: float


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


# --- One map ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MapStatistics:
    """All that the statistics say of one map."""

    schema: int
    name: str
    seed: int
    K: int
    voxel_size: float
    voxels: int
    observations: int
    repeated: Repeated
    blocks: BlockCut
    verdict: StabilityVerdict
    agreement: FrameAgreement
    drift: DriftStatistics
    uncertainty: EntropyParts
    geometry: Losses | None
    correctness: CorrectnessStatistics | None
    fusion_rules: tuple[RuleOutcome, ...] | None
    strata: tuple[StratumStatistics, ...]

    @property
    def sections(self) -> int:
        """How many of the sections that need more than the map could be computed."""
        return sum(section is not None for section in (self.geometry, self.correctness, self.fusion_rules))


# --- Several maps -----------------------------------------------------------------------------------------------------

ByBackbone = Mapping[str, Estimate]


@dataclass(frozen=True)
class MapCoverage:
    """What a backbone's map covers. `repeated` is OP >= 2, `recurrent` OP >= 3, `alone` voxels in no other map."""

    backbone: str
    voxels: int
    observations: int
    mean_op: float
    repeated: int
    recurrent: int
    common_share: float
    alone: int


@dataclass(frozen=True)
class Standardised:
    """Means at a common distribution of OP, by the key of what is compared and backbone.

    edges    upper edges of the strata of OP
    weights  of the strata
    """

    edges: tuple[int, ...]
    weights: tuple[float, ...]
    values: Mapping[str, ByBackbone]

    def of(self, quantity: Quantity, backbone: str) -> Estimate:
        """A backbone's mean; undefined for what is no mean over voxels."""
        return self.values.get(quantity.key, {}).get(backbone, UNDEFINED)


@dataclass(frozen=True)
class PairedDifference:
    """A measure of backbone a minus that of b on the voxels that all saw twice or more.

    p_value  of the paired sign-flip test over blocks, for measures with one value a voxel; p_holm corrects it for the
             number of pairs (Holm 1979)
    """

    measure: str
    a: str
    b: str
    difference: Estimate
    p_value: float
    p_holm: float


@dataclass(frozen=True)
class Rank:
    """A backbone's place, 1 being the best, with the range that holds 95 % of the resamples.

    best is the share of the resamples in which it is first.
    """

    backbone: str
    value: float
    rank: int
    low: int
    high: int
    best: float


@dataclass(frozen=True)
class Ranking:
    """The backbones by one measure on common voxels, the best first."""

    measure: str
    ranks: tuple[Rank, ...]


@dataclass(frozen=True)
class Paired:
    """Backbones on the voxels that every one of them observed at least twice.

    values  what is `compared`, by its key and backbone
    """

    voxels: int
    blocks: int
    block_size: float
    values: Mapping[str, ByBackbone]
    differences: tuple[PairedDifference, ...]
    rankings: tuple[Ranking, ...]

    def of(self, quantity: Quantity) -> ByBackbone:
        """The values of what is compared, by backbone."""
        return self.values[quantity.key]


@dataclass(frozen=True)
class RuleComparison:
    """The backbones under each rule of fusion, on their common voxels with OP >= 2.

    values         by rule and backbone
    orders         by the key of what is compared and rule, the best backbone first
    order_changes  by key, whether the order depends on the rule
    """

    voxels: int
    values: Mapping[str, Mapping[str, RuleMeans]]
    orders: Mapping[str, Mapping[str, tuple[str, ...]]]
    order_changes: Mapping[str, bool]


@dataclass(frozen=True)
class BackboneComparison:
    """Several backbones' maps of one scene beside each other."""

    scene: str
    schema: int
    seed: int
    backbones: tuple[str, ...]
    coverage: tuple[MapCoverage, ...]
    standardised: Standardised
    paired: Paired
    fusion_rules: RuleComparison | None
