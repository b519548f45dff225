"""The level of an alpha that is known, and the level that a verdict states for one that is not."""

from __future__ import annotations

from semstab.data.statistics import Interval, Level
from semstab.statistics.verdict import DECIDED, LIMITS, holds_all_levels, level_probabilities


def level_of(alpha: float) -> Level:
    """Return the level of an alpha that is known."""
    return "stable" if alpha >= LIMITS.stable else "usable" if alpha >= LIMITS.usable else "unstable"


def stated(alpha: Interval) -> tuple[str, float]:
    """Return the level that a verdict states for alpha, or 'undecided', and how probable it is."""
    levels = level_probabilities(alpha)
    level = max(levels, key=lambda name: levels[name])
    decided = levels[level] >= DECIDED and not holds_all_levels(alpha)
    return level if decided else "undecided", levels[level]
