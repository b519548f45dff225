"""Hypotheses on what is wrong with data, tried and ranked: what each changes, and when it is right.

The agreement of the frames is measured for the data as they are, and after the change that each hypothesis supposes,
over the same pairs of frames. This holds for cameras and scans, poses, depth, times, intrinsics and label maps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from semstab.check.verdict import BETTER, MIN_GAIN, Fit
from semstab.core.types import Float64

CLEAR = 4.0
"""Standard errors by which a change is better beyond chance, in the mean over frames or pairs, ..."""

WON = 0.8
"""... and the share of them in which it is better, ..."""

LEAST_TOLD = 4
"""... of so many that tell."""

BETTER_FIT, LEAST_FIT = 1.15, 0.08
"""The factor by which edges of labels must correlate better with those of depth and colour, and the least."""

TINY = 1e-9
"""Errors below this are none."""


class Judged(Protocol):
    """Data whose frames are compared in pairs."""

    def fit(self) -> Fit:
        """Return how well frames agree, over all pairs."""

    def by_pair(self) -> Float64:
        """Return (pairs,) the error of each pair, or NaN for a pair without information."""


T = TypeVar("T")
D = TypeVar("D", bound=Judged)
P = TypeVar("P", bound=Hashable)


@dataclass(frozen=True)
class Hypothesis(Generic[T]):
    """A mistake that data may have.

    Attributes:
        name: What it is, in words.
        change: From data as they are read to data as they would be without it.
        mend: What to do about it, in words.
        options: The lines that mend it, by an option's present name and value; such a line replaces `mend`.
        applies: Whether data may have it; of changes that hardly move anything one always looks better.
    """

    name: str
    change: Callable[[T], T]
    mend: str
    options: Mapping[tuple[str, str], str] = field(default_factory=dict)
    applies: Callable[[T], bool] = lambda data: True


@dataclass(frozen=True, eq=False)
class Trial(Generic[D]):
    """A hypothesis, the data as it changes them, and how well these agree."""

    hypothesis: Hypothesis[D]
    data: D
    fit: Fit

    def is_right(self, given: D, now: Fit, part: float) -> bool:
        """Return whether the error falls to this part of what it is as given, and falls in most pairs of frames."""
        return self.fit.error <= part * now.error and falls(self.data.by_pair(), given.by_pair()).wins


def ranked(hypotheses: Iterable[Hypothesis[D]], data: D) -> list[Trial[D]]:
    """Try the hypotheses that apply, the one under which frames agree best first."""
    changed = [(hypothesis, hypothesis.change(data)) for hypothesis in hypotheses if hypothesis.applies(data)]
    trials = [Trial(hypothesis, other, other.fit()) for hypothesis, other in changed]
    return sorted(trials, key=lambda trial: (not trial.fit.has_evidence, trial.fit.error))


def fitted(start: P, moves: Iterable[Callable[[P], Iterable[P]]], errors: Callable[[P], Float64]) -> P:
    """Return the change whose errors (pairs,) are lowest: each move proposes others than the best one so far."""
    best = start
    for move in moves:
        best = min((best, *move(best)), key=lambda change: mean_log(errors(change)))
    return best


@dataclass(frozen=True)
class FitContrast:
    """A change against data as given, over frames or pairs of them, in the same ones.

    Attributes:
        given, other: Means of the measure, of which more is better.
        z: Mean difference over its standard error.
        won: Share in which the change is better.
        count: Number of frames or pairs.
    """

    given: float
    other: float
    z: float
    won: float
    count: int

    @classmethod
    def between(cls, given: Sequence[float] | Float64, other: Sequence[float] | Float64) -> FitContrast:
        """Compare two measures, one pair of numbers for each frame or pair; NaN does not count."""
        pairs = np.array([given, other], dtype=np.float64).reshape(2, -1)
        pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
        n = pairs.shape[1]
        gain, won = pairs[1] - pairs[0], float(np.mean(pairs[1] > pairs[0])) if n else 0.0
        if n < 2:
            return cls(math.nan, math.nan, 0.0, won, n)
        error = max(float(gain.std(ddof=1)) / math.sqrt(n), 1e-9)
        return cls(float(pairs[0].mean()), float(pairs[1].mean()), float(gain.mean()) / error, won, n)

    @property
    def wins(self) -> bool:
        """Return whether the change is better in most pairs."""
        return self.won >= WON

    @property
    def is_clear(self) -> bool:
        """Return whether the change is better beyond chance: one that was searched for always is a little."""
        return self.count >= LEAST_TOLD and self.z > CLEAR and self.won >= WON

    @property
    def fits_better(self) -> bool:
        """Return whether correlations of edges are clearly better, and some."""
        return self.is_clear and self.other >= max(LEAST_FIT, BETTER_FIT * self.given)


def falls(errors: Float64, present: Float64, least: float = 0.0) -> FitContrast:
    """Compare errors (pairs,) with the present ones, by their logarithms; of pairs that change by less none counts."""
    now, other = (-np.log(np.maximum(values, TINY)) for values in (present, errors))
    return FitContrast.between(now, np.where(np.abs(other - now) > least, other, np.nan) if least else other)


def clearly_falls(errors: Float64, present: Float64) -> bool:
    """Return whether the median error (pairs,) is clearly lower than the present one, and beyond chance."""
    now = middle(present)
    return middle(errors) <= min(BETTER * now, now - MIN_GAIN) and falls(errors, present).is_clear


def mean_log(errors: Float64) -> float:
    """Return the mean logarithm of the known errors (pairs,), or inf without known errors."""
    finite = errors[np.isfinite(errors)]
    return float(np.log(np.maximum(finite, TINY)).mean()) if len(finite) else math.inf


def middle(errors: Float64) -> float:
    """Return the median of the known errors (pairs,), or inf without known errors."""
    return float(np.nanmedian(errors)) if np.isfinite(errors).any() else math.inf
