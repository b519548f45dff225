"""A number with its confidence interval, and how it is printed."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

from semstab.core.types import THESE_FRAMES, Scope

CONFIDENCE = 0.95
"""Default level of confidence intervals."""


@dataclass(frozen=True)
class Estimate:
    """A value with its confidence interval, and the level of the interval; NaN if undefined."""

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
    def interval_name(self) -> str:
        """The interval's name in print, '95 % CI'."""
        return f"{100 * self.level:g} % CI"

    def text(self, sign: str = "", *, digits: int = 2) -> str:
        """Return '.68 (.52 to .78)'; '.68' without an interval."""
        value, low, high = (short(number, sign, digits=digits) for number in (self.value, self.low, self.high))
        return value if math.isnan(self.low) else f"{value} ({low} to {high})"


def short(value: float, sign: str = "", *, digits: int = 2) -> str:
    """Return a number from -1 to 1 without the 0 before its point: '.55', '-.19', '1.00'; '-' if undefined."""
    return "-" if math.isnan(value) else without_zero(f"{value:{sign}z.{digits}f}")


def without_zero(text: str) -> str:
    """Return printed numbers without the 0 before their point: '.550 (-.101, 1.000)'."""
    return re.sub(r"(?<![\d.,])0(?=\.\d)", "", text)


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
