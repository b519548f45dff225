"""Agreement of frames on voxels, of views at spots, by range and by distance between observations."""

from __future__ import annotations

import math
from dataclasses import dataclass

from semstab.data.statistics.intervals import Interval


@dataclass(frozen=True)
class ClassAgreement:
    """Agreement on one class against all others, over the voxels with OP >= 2; NaN if undefined.

    observations is the evidence for the class in these voxels, in frames.
    """

    name: str
    observations: float
    kappa_op2: float
    voxel_alpha_op2: float


@dataclass(frozen=True)
class FrameAgreement:
    """Agreement of frames at the voxels with OP >= 2, whose size it depends on.

    Attributes:
        psa_op2: Probability that two frames agree.
        kappa_op2: Fleiss' kappa.
        voxel_alpha_op2: Krippendorff's alpha.
        vss_op2: The paper's VSS.
        within: Part of 1 - PSA that is there within a frame.
        between: Part of 1 - PSA that is there between frames.
        classes: The same of each class.
    """

    psa_op2: Interval
    kappa_op2: Interval
    voxel_alpha_op2: Interval
    vss_op2: Interval
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
        unstable: Probability that alpha is below the level 'usable'; NaN if unknown.
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
class Meaning:
    """Agreement with distances between classes.

    Attributes:
        alpha: 1 minus the mean distance of the labels that two views give a spot, over the mean distance of any two
            labels.
        near: Share of the disagreement that is between classes whose distance is at most half of the largest one; NaN
            without disagreement.
    """

    alpha: Interval
    near: float

    @property
    def text(self) -> str:
        """'by meaning: alpha .91 (.90 to .92); 63 % of the disagreement is between classes of near meaning'."""
        near_text = (
            ""
            if math.isnan(self.near)
            else f"; {100 * self.near:.0f} % of the disagreement is between classes of near meaning"
        )
        return f"by meaning: alpha {self.alpha.text()}{near_text}"


@dataclass(frozen=True)
class RangeStratum:
    """Observations from some range.

    Attributes:
        low, high: Ends of the range in metres; the high one is not part of it.
        share: Share of all sampled observations.
        spots: Spots that two views saw from there.
        alpha: Alpha of these observations; NaN if two views saw too few spots from there, or nearly all observations
            are of one class.
    """

    low: float
    high: float
    share: float
    spots: int
    alpha: Interval

    @property
    def is_assessed(self) -> bool:
        """Return whether agreement tells anything of these observations."""
        return not math.isnan(self.alpha.value)


def metres(distance: float) -> str:
    """Return a distance in metres with three digits, rounded down: '91.8', '150'."""
    if not (math.isfinite(distance) and distance > 0):
        return f"{distance:g}"
    unit = math.floor(math.log10(distance)) - 2
    return f"{math.floor(round(distance / 10.0**unit, 6)) * 10.0**unit:.6g}"


@dataclass(frozen=True)
class RangeAgreement:
    """Agreement by the distance from which spots were seen.

    Attributes:
        strata: By range, the nearest first.
        usable: The level above which labels can be used.
        reliable: Metres up to which alpha stays above this level, 0 if it never does.
        low, high: The least and the largest value of `reliable`, by the intervals of the strata.
    """

    strata: tuple[RangeStratum, ...]
    usable: float
    reliable: float
    low: float
    high: float

    @property
    def farthest(self) -> float:
        """Return the end of the last stratum that was assessed, metres."""
        return max((row.high for row in self.strata if row.is_assessed), default=0.0)

    @property
    def is_told(self) -> bool:
        """Return whether the number is printed: labels are reliable near by and may not be farther out, or not there.

        Where neither is known, or the interval is all that was seen, the verdict alone is printed.
        """
        is_bounded = self.low > 0 or self.high < self.farthest
        return is_bounded and self.low < self.farthest and (self.reliable > 0 or self.high == 0)

    @property
    def text(self) -> str:
        """Return the one number for people: 'reliable up to 30 m (20 to 50 m)'."""
        number, note = self.parts
        stated = f"reliable {number}" if self.reliable else f"{number.replace('not', 'not reliable', 1)}"
        return f"{stated} {note}".rstrip()

    @property
    def parts(self) -> tuple[str, str]:
        """Return the number, and its interval or the reason: ('up to 30 m', '(20 to 50 m)')."""
        if self.reliable:
            ends = "" if self.low == self.high else f"{metres(self.low)} to {metres(self.high)} m"
            far = "the farthest seen" if self.reliable == self.farthest else ""
            note = ", ".join(filter(None, (ends, far, self._not_assessed)))
            return f"up to {metres(self.reliable)} m", note and f"({note})"
        first = next((row for row in self.strata if row.is_assessed), self.strata[0])
        return f"not from {metres(first.low)} to {metres(first.high)} m", f"(alpha {first.alpha.text()})"

    @property
    def _not_assessed(self) -> str:
        """Return the strata within the reliable range that were not assessed: '2 to 3, 5 to 7 m not assessed'."""
        rows = [row for row in self.strata if row.high <= self.reliable and not row.is_assessed]
        listed = ", ".join(f"{metres(row.low)} to {metres(row.high)}" for row in rows)
        return f"{listed} m not assessed" if listed else ""


@dataclass(frozen=True)
class LabelledPairs:
    """Pairs of views of a spot of which both have a label: alpha of all pairs follows from alpha of these.

    Attributes:
        share: Their share of all pairs.
        chance: Probability that two labels from anywhere agree.
    """

    share: float = 1.0
    chance: float = 0.0

    def of_all(self, alpha: float) -> float:
        """Return alpha if each other pair counts as disagreeing.

        Observed disagreement is then share * D + 1 - share, expected disagreement stays 1 - chance:

            alpha of all = share * alpha - (1 - share) * chance / (1 - chance)

        NaN if chance alone would always agree.
        """
        if self.share >= 1:
            return alpha
        if self.chance >= 1:
            return math.nan
        return self.share * alpha - (1 - self.share) * self.chance / (1 - self.chance)

    def of_labelled(self, alpha: float) -> float:
        """Return the alpha of labelled pairs that is this alpha of all pairs; infinite if no pair has labels.

        NaN if chance alone would always agree.
        """
        if self.share >= 1:
            return alpha
        if self.chance >= 1:
            return math.nan
        if not self.share > 0:
            return math.inf
        return (alpha + (1 - self.share) * self.chance / (1 - self.chance)) / self.share


@dataclass(frozen=True)
class SpotAgreement:
    """The observations that alpha rests on: labels that views give spots of the surface.

    Attributes:
        spacing: Distance of spots in metres: a spot stands for its square of surface.
        spots: Spots that two views saw or more.
        cubes: Cubes of space that hold them.
        frames: Frames that were fused.
        views: Distinct views among them: a camera that stands still has one.
        chance: Probability that two observations from anywhere on the map agree.
        largest_class: The class with most observations, and `largest_share` its share of them.
        labelled: Share of the locations with depth that have a label in at least half of their observations.
        pixels_labelled: Share of the pixels with depth that have a label; NaN if not stored.
        pairs_labelled: Share of the pairs of two views of a spot of which both have a label; NaN if not stored.
        classes: Alpha of each class.
        moving: The classes that move, where much of the disagreement is theirs; else None.
        meaning: Agreement with distances between classes, if there are some.
    """

    spacing: float
    spots: int
    cubes: int
    frames: int
    views: int
    chance: float
    largest_class: str
    largest_share: float
    labelled: float
    classes: tuple[ClassAlpha, ...]
    moving: MovingClasses | None = None
    pixels_labelled: float = math.nan
    pairs_labelled: float = math.nan
    meaning: Meaning | None = None

    @property
    def pairs(self) -> LabelledPairs:
        """Return the pairs of views of a spot of which both have a label; all of them if that was not stored."""
        return LabelledPairs() if math.isnan(self.pairs_labelled) else LabelledPairs(self.pairs_labelled, self.chance)

    @property
    def effective_classes(self) -> float:
        """1 / chance: as many classes of equal size have this chance (Hill 1973, Ecology 54, of order 2)."""
        return 1 / self.chance if self.chance > 0 else math.nan

    def agreeing(self, alpha: float) -> float:
        """Return the share of the spots at which two views see the same class, as an alpha of these spots has it."""
        return 1 - (1 - alpha) * (1 - self.chance)

    @property
    def critical_classes(self) -> tuple[ClassAlpha, ...]:
        """The classes that count for the verdict, those most probably unstable first."""
        critical = [row for row in self.classes if row.counts_for_verdict and not math.isnan(row.unstable)]
        return tuple(sorted(critical, key=lambda row: (-row.unstable, row.alpha.value)))


@dataclass(frozen=True)
class LagBin:
    """Pairs of observations of a spot that are `low` to `high` apart, `mean` in the mean.

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
