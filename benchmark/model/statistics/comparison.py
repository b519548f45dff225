"""What `semstab.statistics` says of several backbones' maps of one scene; in JSON as the fields say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from semstab.model.measures import Quantity
from semstab.model.statistics import UNDEFINED, Estimate, RuleMeans

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
    thin     the part of the weights that lies in strata which some map hardly has: values there rest on few voxels
    """

    edges: tuple[int, ...]
    weights: tuple[float, ...]
    thin: float
    values: Mapping[str, ByBackbone]

    def of(self, quantity: Quantity, backbone: str) -> Estimate:
        """A backbone's mean; undefined for what is no mean over voxels."""
        return self.values.get(quantity.key, {}).get(backbone, UNDEFINED)


@dataclass(frozen=True)
class PairedDifference:
    """A measure of backbone a minus that of b on the voxels that all saw twice or more.

    p_value  that there is none, of the primary measure; p_holm corrects it for all pairs, and all scenes of a study, of
             which something may be claimed (Holm 1979). The other measures describe: they have intervals and no test
    question   what interval and p-value answer, see `Interval`
    undecided  why nothing may be claimed; empty where something may
    """

    measure: str
    a: str
    b: str
    difference: Estimate
    p_value: float
    p_holm: float
    question: str = ""
    undecided: str = ""


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

    primary  the key of what is tested
    values   what is `compared`, by its key and backbone
    """

    primary: str
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
class Ignored:
    """What a backbone left out of the looks that any backbone labelled, and what that may be worth.

    missing            share of their pixels
    psa_low, psa_high  bounds of its mean PSA, whatever the missing looks would have said (Manski 1990)
    alpha              between frames, where to leave a place out is a class of its own
    """

    backbone: str
    missing: float
    psa_low: float
    psa_high: float
    alpha: float


@dataclass(frozen=True)
class CommonLooks:
    """What was compared: the looks (cell of a voxel, frame) that all backbones labelled, each with the same weight.

    voxels, observations  sampled ones that they are of
    decided               whether each look was reduced to its largest class: labels were compared with scores
    order                 of the backbones by the primary measure on these looks, the best first
    order_ignored         the same where to leave a place out is a class of its own
    bounded               whether the bounds of PSA keep its order of the backbones, whatever was left out
    """

    voxels: int
    observations: int
    decided: bool
    ignored: tuple[Ignored, ...]
    order: tuple[str, ...]
    order_ignored: tuple[str, ...]
    bounded: bool

    @property
    def depends(self) -> bool:
        """Whether the order depends on what was left out."""
        return self.order != self.order_ignored or not self.bounded


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
    looks: CommonLooks | None
    fusion_rules: RuleComparison | None
