"""Two visits of one place: agreement within each of them and across, and the places that changed."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.data.statistics.intervals import Interval


@dataclass(frozen=True)
class Across:
    """Agreement beyond chance at the spots that both visits see.

    Attributes:
        first, second: Alpha of two views of the first visit, and of two views of the second one.
        across: The same of a view of the first visit and one of the second.
        cost: Mean of `first` and `second` less `across`.
    """

    first: Interval
    second: Interval
    across: Interval
    cost: Interval


@dataclass(frozen=True)
class VisitedClass:
    """A class in two visits, by the class that most views of a visit give a spot.

    Attributes:
        name: The class.
        spots: Spots of it in the first visit that the second one sees again, changed or not.
        alpha: Agreement on it against all other classes.
        gone: Share of its spots whose surface is gone in the second visit.
        new: Share of its spots in the second visit whose surface was not there in the first one.
        relabelled: Share of its spots that have the same surface and another class in the second visit.
        becomes: The class that most of these have there; '' without any.
    """

    name: str
    spots: int
    alpha: Across
    gone: float
    new: float
    relabelled: float
    becomes: str


@dataclass(frozen=True)
class TwoVisits:
    """Agreement within two visits and across, at spots that did not change, and the spots that did.

    Attributes:
        spots: Spots that two views or more of each visit label, without those that changed or moved.
        alpha: Agreement at them.
        stayed: Spots that views of both visits show to be there in both.
        gone: Spots of the first visit that views of the second one see through.
        new: Spots of the second visit that views of the first one see through.
        moved: Spots that other views of the same visit see through.
        unknown: Spots of which one visit or both do not tell.
        relabelled: Share of `spots` whose class differs between the visits.
        by_chance: What this share would be if the views of one visit had answered for both.
        classes: By class, without those that no view gives a spot.
        misplaced: Number of frames of each visit whose poses do not fit the others of it.
    """

    spots: int
    alpha: Across
    stayed: int
    gone: int
    new: int
    moved: int
    unknown: int
    relabelled: float
    by_chance: float
    classes: tuple[VisitedClass, ...]
    misplaced: tuple[int, int] = (0, 0)
