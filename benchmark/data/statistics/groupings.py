"""Groupings of classes, and the agreement of views on the groups: they tell which distinctions hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from semstab.data.statistics.intervals import Interval


@dataclass(frozen=True)
class Merge:
    """A step from finer to coarser groups: two groups become one.

    Attributes:
        first, second: Classes of the two groups.
        groups: Number of groups after it that have a label anywhere.
        effective: exp of the entropy of the groups' shares, after it.
        alpha: Agreement on the groups after it, without what the choice of merges flatters.
    """

    first: tuple[str, ...]
    second: tuple[str, ...]
    groups: int
    effective: float
    alpha: float


@dataclass(frozen=True)
class Grouping:
    """Groups of classes on which views agree.

    Attributes:
        level: 'stable' or 'usable'.
        merged: Classes of each group that has two or more; all other classes stay alone.
        groups: Number of groups.
        effective: exp of the entropy of the groups' shares: how many of equal size would tell as much.
        alpha: Agreement on the groups with its interval, without what the choice of merges flatters.
    """

    level: Literal["stable", "usable"]
    merged: tuple[tuple[str, ...], ...]
    groups: int
    effective: float
    alpha: Interval

    @property
    def text(self) -> str:
        """The groups in words: 'door + curtain, window + picture + blinds'."""
        return ", ".join(" + ".join(group) for group in self.merged)


@dataclass(frozen=True)
class Groupings:
    """Merges of classes, from all classes down to two groups.

    Each merge is the one that raises alpha most. What this choice flatters is taken off: by how much, on one half of
    the space, groups that were chosen there have a larger alpha than groups that were chosen on the other half.

    Attributes:
        classes: Number of classes that have a label anywhere.
        merges: All steps, in order.
        stable: The finest groups that are stable, by two views of a spot; None if all classes are, or no groups.
        usable: The same of groups that are usable, if they are finer than the stable ones.
    """

    classes: int
    merges: tuple[Merge, ...]
    stable: Grouping | None
    usable: Grouping | None

    @property
    def told(self) -> Grouping | None:
        """The grouping that is told: the stable one, else the usable one."""
        return self.stable or self.usable

    @property
    def text(self) -> str:
        """'stable if 17 classes become 11, worth 6.2 of equal share: door + curtain; alpha .82 (.80 to .84)', or ''."""
        if (grouping := self.told) is None:
            return ""
        return (
            f"{grouping.level} if {self.classes} classes become {grouping.groups}, worth {grouping.effective:.1f} of"
            f" equal share: {grouping.text}; alpha {grouping.alpha.text()}"
        )
