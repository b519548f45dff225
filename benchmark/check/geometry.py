"""A check that depth, poses and intrinsics agree, and of the other conventions under which they would.

Every convention is assessed by the median relative depth error of points that one frame sees again in another, and by
the share of points that it sees again at all: an alternative with little overlap is no evidence.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from semstab.check.conventions import Convention, Reading, alternatives
from semstab.check.reprojection import Sample, median_of_seen
from semstab.core.types import Float64

DECADES: Float64 = np.power(10.0, np.arange(-5, 6))
FINE: Float64 = np.power(10.0, np.arange(-30, 31) / 6)
"""Factors on depth that are tried; the outermost decades only to see whether the ones inside can be distinguished."""

LARGEST_FACTOR = 1e4
"""Factors from 1 / this to this are reported."""

MIN_POINTS = 100
MIN_SHARE = 0.03
"""A convention under which fewer points are seen again, in number or share, has no evidence for or against it."""

LEAST_OF_OTHER = 0.2
"""The least part of what the configured convention sees that an alternative must see again, too."""

BETTER = 0.75
MIN_GAIN = 0.001
"""An error is clearly lower where it is at most this part of the other one, and lower by this (0.1 points)."""

WON_PAIRS = 0.8
"""An alternative must also be better in this share of the pairs of frames that both see, of those with ..."""

PAIR_POINTS = 20
LEAST_PAIRS = 3
"""The least pairs with enough points seen again; where fewer have, it must stand out from all others instead."""

GOOD = 0.05
"""A convention with a larger error is not proposed, and as configured it is not called sound."""

MOST_ERROR = {3: 0.02, 4: 0.02, 5: 0.02}
"""The largest error of a convention that changes so many settings at once: of many combinations one fits a little."""

STRIKING = 0.02
"""The error that refutes a configured convention without evidence of its own, ..."""

CONTRAST = 1 / 3
"""... where it is at most this part of the error of every other convention."""

HOPELESS_ERROR = 0.1
HOPELESS_SHARE = 0.3
HOPELESS_POINTS = 1000
"""The overlap at which a larger configured error makes the data unsound, though nothing explains it."""

SCALE_APART = 2.5
"""Factors nearer to each other than this are one hypothesis about the unit, measured twice."""

LEAST_SCALE_ERROR = 1.1
"""Depth that is too long or too short by less is measurement, not a wrong unit."""

MOST_CANDIDATES = 3
"""Alternatives that are named in addition to the best one, where they fit as well."""

SIMPLER = 1.1
"""The factor within which errors of conventions count as equal: the one with the fewest changes is taken."""

HARDLY_MOVES = 0.01
HARDLY_TURNS = 1.0
HARDLY_DEEP = 1.05
"""Limits below which a reason says what frames cannot tell: motion as a share of depth, degrees, and the ratio of
the 90th to the 10th percentile of depth."""

State = Literal["sound", "imprecise", "unsound", "unclear"]


@dataclass(frozen=True)
class Fit:
    """The error of depth that is reprojected under a convention.

    Attributes:
        error: Median relative depth error of the points that are seen again; NaN where none is.
        share: Share of the sampled points that are seen again, 0 to 1.
        points: Their number.
    """

    convention: Convention
    error: float
    share: float
    points: int

    @property
    def has_evidence(self) -> bool:
        """Return whether enough points are seen again for the error to count."""
        return self.points >= MIN_POINTS and self.share >= MIN_SHARE

    def clearly_beats(self, other: Fit) -> bool:
        """Return whether its error is clearly lower; one with enough overlap beats one with too little."""
        if not other.has_evidence or other.share < LEAST_OF_OTHER * self.share:
            return True
        return self.error <= min(BETTER * other.error, other.error - MIN_GAIN)


@dataclass(frozen=True)
class Verdict:
    """The outcome of a check of the geometry.

    Attributes:
        state: Sound; imprecise, where depth agrees far worse than its noise explains; unsound; or unclear, where the
            frames do not tell.
        text: The reason, in one line.
        mend: Lines of configuration that would mend it, where they are known.
        error, share: Those of the configured convention, see `Fit`.
        frames, pairs: Numbers of those that were looked at.
        undetermined: Parts of it that these frames cannot tell, because an alternative fits as well, and the reason
            where it is known.
        remarks: Lines on what looks wrong but leaves the state.
        fits: The configured convention and the alternatives of interest, by name.
    """

    state: State
    text: str
    mend: tuple[str, ...] = ()
    error: float = math.nan
    share: float = 0.0
    frames: int = 0
    pairs: int = 0
    undetermined: tuple[str, ...] = ()
    reason: str = ""
    remarks: tuple[str, ...] = ()
    fits: tuple[tuple[str, Fit], ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return the part that a run's manifest holds."""
        return {name: getattr(self, name) for name in ("state", "text", "error", "share", "frames", "pairs")}

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        rows = [{"name": name, **dataclasses.asdict(fit)} for name, fit in self.fits]
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)} | {"fits": rows}


def assess(sample: Sample, reading: Reading, *, thorough: bool) -> Verdict:
    """Compare the configured convention with the alternatives; thorough: each with every factor on depth."""
    return Assessment(sample, reading, thorough).verdict()


class Assessment:
    """The fits of every convention that was tried, and the verdict that follows from them."""

    def __init__(self, sample: Sample, reading: Reading, thorough: bool) -> None:
        self.sample, self.reading = sample, reading
        self.fits = list(_all_fits(sample, reading, thorough))
        self.configured = next(fit for fit in self.fits if fit.convention == sample.configured)
        self.fits += self._measured_scale(self.configured)

    def verdict(self) -> Verdict:
        """Return the verdict in words."""
        if (best := self._best()) is not None:
            return self._refuted(best)
        return self._as(*(self._without_evidence() or self._unexplained() or self._in_agreement()))

    def _without_evidence(self) -> tuple[State, str] | None:
        mine = self.configured
        if not any(len(view.u) for view in self.sample.views.values()):
            return "unclear", "no pixel of the sampled frames has valid depth"
        if not mine.has_evidence:
            return "unclear", (
                f"{mine.share:.1%} of the sampled points ({mine.points}) are seen again by another frame: too few to"
                " tell whether depth and poses agree"
            )
        return None

    def _unexplained(self) -> tuple[State, str] | None:
        mine = self.configured
        if mine.error > HOPELESS_ERROR and mine.share >= HOPELESS_SHARE and mine.points >= HOPELESS_POINTS:
            return "unsound", (
                f"depth reprojects with {mine.error:.0%} error, and no other convention explains it; do poses, depth"
                " and intrinsics belong together, frame by frame?"
            )
        if mine.error > GOOD:
            return "unclear", (
                f"depth reprojects with {mine.error:.1%} error, and no other convention explains it; are poses and"
                " depth this imprecise?"
            )
        return None

    def _in_agreement(self) -> tuple[State, str]:
        mine = self.configured
        text = f"depth reprojects with {mine.error:.2%} median error, {mine.share:.0%} co-visible"
        if all(self._is_undetermined(fit) for fit in self._single_changes() if _is_of_poses(fit, mine)):
            return "unclear", f"{text}, but it does so under every other convention of the poses as well"
        return "sound", text

    def _as(self, state: State, text: str, mend: tuple[str, ...] = (), best: Fit | None = None) -> Verdict:
        undetermined = self._undetermined() if state != "unsound" and self.configured.has_evidence else ()
        return Verdict(
            state=state,
            text=text,
            mend=mend,
            error=self.configured.error,
            share=self.configured.share,
            frames=len(self.sample.views),
            pairs=len(self.sample.pairs),
            undetermined=undetermined,
            reason=_reason(self.sample) if undetermined else "",
            fits=tuple(self._shown(best)),
        )

    # --- another convention ------------------------------------------------------------------------------------------

    def _best(self) -> Fit | None:
        """Return the alternative that clearly beats the configured convention.

        See `_candidates` for several ones.
        """
        return self._refuting[0] if self._refuting else None

    @cached_property
    def _refuting(self) -> list[Fit]:
        """The alternatives that show that the configured convention is wrong: the best one, then those as good."""
        possible = sorted((fit for fit in self.fits if self._may_refute(fit)), key=lambda fit: fit.error)
        best: Fit | None = None
        refuting: list[Fit] = []
        for fit in possible:
            if best is not None and best.clearly_beats(fit):
                break
            if not any(_one_hypothesis(fit, other) for other in refuting) and self._is_confirmed(fit):
                refuting.append(fit)
                best = best or fit
        return sorted(
            map(self._rounded, refuting), key=lambda fit: (fit.error > SIMPLER * refuting[0].error, *self._changes(fit))
        )

    def _changes(self, fit: Fit) -> tuple[int, float]:
        return len(fit.convention.differs_in(self.sample.configured)), fit.error

    def _rounded(self, fit: Fit) -> Fit:
        """Return the fit with its factor measured, then at a unit that datasets use if near and as good a fit."""
        if fit.convention.factor == 1:
            return fit
        measured = min([fit, *self._measured_scale(fit)], key=lambda one: one.error)
        factor = self.reading.usual_factor(measured.convention.factor, fit.convention.depth)
        (known,) = fits_of(self.sample, fit.convention, np.array([factor]))
        return measured if measured.clearly_beats(known) else known

    def _may_refute(self, fit: Fit) -> bool:
        """Return whether a fit meets those conditions for refuting the configured one that are cheap to check."""
        mine, factor = self.configured, fit.convention.factor
        size = max(factor, 1 / factor)
        if fit is mine or not fit.has_evidence or fit.share < LEAST_OF_OTHER * mine.share:
            return False
        if not mine.has_evidence and _one_hypothesis(fit, mine):
            return False
        if factor != 1 and not LEAST_SCALE_ERROR <= size <= 1.001 * LARGEST_FACTOR:
            return False
        limit = GOOD if mine.has_evidence else STRIKING
        return fit.clearly_beats(mine) and fit.error <= min(limit, self._limit(fit))

    def _limit(self, fit: Fit) -> float:
        """Return the largest error with which a fit refutes: the less, the more it changes at once."""
        return MOST_ERROR.get(self._changes(fit)[0], GOOD)

    def _is_confirmed(self, fit: Fit) -> bool:
        if fit.convention.factor != 1 and not self._scale_is_told(fit):
            return False
        won = self._won_pairs(fit) if self.configured.has_evidence else []
        return sum(won) >= WON_PAIRS * len(won) if len(won) >= LEAST_PAIRS else self._stands_out(fit)

    def _scale_is_told(self, fit: Fit) -> bool:
        """Return whether depth ten times as long and as short fits clearly worse: not where the camera hardly moves."""
        others = fits_of(self.sample, fit.convention, fit.convention.factor * np.array([0.1, 10]))
        return all(fit.clearly_beats(other) for other in others)

    def _stands_out(self, fit: Fit) -> bool:
        """Return whether every convention with another motion between the frames fits far worse."""
        near = (other for other in self.fits if other.has_evidence and other.error * CONTRAST < fit.error)
        same_depth = (
            dataclasses.replace(one, convention=dataclasses.replace(one.convention, depth=fit.convention.depth))
            for one in near
        )
        return all(_one_hypothesis(fit, other) or self._moves_alike(fit, other) for other in same_depth)

    def _won_pairs(self, fit: Fit) -> list[bool]:
        """Return for each pair of frames where both see enough whether the alternative has the lower error."""
        errors = [
            self.sample.errors(one.convention, np.array([one.convention.factor])) for one in (fit, self.configured)
        ]
        return pairs_won(*errors)

    def _moves_alike(self, fit: Fit, other: Fit) -> bool:
        """Return whether two conventions give the same motion between the frames.

        Then they make the same map, but turned.
        """
        if fit.convention.ratio != other.convention.ratio or fit.convention.depth != other.convention.depth:
            return False
        f, g = fit.convention.factor, other.convention.factor
        motions = zip(self.sample.motions(fit.convention), self.sample.motions(other.convention), strict=True)
        tolerance = 0.005 * _typical(self.sample, lambda depths: float(np.median(depths)))
        return all(np.abs(R - Q).max() < 0.01 and np.abs(s / f - t / g).max() < tolerance for (R, s), (Q, t) in motions)

    def _measured_scale(self, near: Fit) -> list[Fit]:
        """Return fits of the same convention with factors around a given one.

        The first ones lie between those of the search, the others nearer.
        """
        coarse = fits_of(self.sample, near.convention, near.convention.factor * np.power(10.0, np.arange(-12, 13) / 72))
        best = min(coarse, key=lambda fit: (math.isnan(fit.error), fit.error)).convention
        fine = fits_of(self.sample, best, best.factor * np.power(10.0, np.arange(-10, 11) / 720))
        return [fit for fit in (*coarse, *fine) if fit.convention != near.convention]

    def _refuted(self, best: Fit) -> Verdict:
        mine, lines = self.configured, self.reading.lines(best.convention)
        if mine.has_evidence:
            evidence = f"depth reprojects with {mine.error:.1%} error as configured, but with"
        else:
            evidence = f"{mine.share:.1%} of the points are seen again as configured; depth reprojects with"
        text = f"{evidence} {best.error:.2%} error under {', '.join(lines)} ({self.reading.advice(best.convention)})"
        if candidates := [self._name(fit) for fit in self._refuting[1:]][:MOST_CANDIDATES]:
            text += f"; these frames cannot tell it from {' or '.join(candidates)}"
        return self._as("unsound", text, lines, best)

    # --- undetermined settings ---------------------------------------------------------------------------------------

    def _single_changes(self) -> Iterator[Fit]:
        """Yield the fits that differ from the configured convention in one thing; of factors only ten and a tenth."""
        for fit in self.fits:
            changed = fit.convention.differs_in(self.sample.configured)
            decade = math.isclose(abs(math.log10(fit.convention.factor)), 1, abs_tol=1e-9)
            if len(changed) == 1 and (changed != ("factor",) or decade):
                yield fit

    def _is_undetermined(self, fit: Fit) -> bool:
        return not self.configured.clearly_beats(fit)

    def _undetermined(self) -> tuple[str, ...]:
        """Return settings that could be otherwise; of scales and sizes the setting alone, of the others the value."""
        names = []
        for fit in filter(self._is_undetermined, self._single_changes()):
            (changed,) = fit.convention.differs_in(self.sample.configured)
            name = self._name(fit)
            if changed in ("factor", "ratio"):
                name = name.partition(":")[0]
            elif changed != "depth" and self._moves_alike(self.configured, fit):
                name += " (the same motion: the map is only turned)"
            names.append(name)
        return tuple(dict.fromkeys(names))

    def _name(self, fit: Fit) -> str:
        return ", ".join(self.reading.lines(fit.convention)) or "as configured"

    def _shown(self, best: Fit | None) -> Iterator[tuple[str, Fit]]:
        """Yield the configured convention, the best one, and those that differ in one thing."""
        yield "as configured", self.configured
        if best is not None:
            yield self._name(best), best
        for fit in self._single_changes():
            if best is None or fit.convention != best.convention:
                yield self._name(fit), fit


def _all_fits(sample: Sample, reading: Reading, thorough: bool) -> Iterator[Fit]:
    one = np.array([1.0])
    for convention in alternatives(sample.configured, reading.ratios):
        known_camera = convention.ratio == (1.0, 1.0)
        factors = (FINE if thorough or convention == sample.configured else DECADES) if known_camera else one
        yield from fits_of(sample, convention, factors)


def fits_of(sample: Sample, convention: Convention, factors: Float64) -> list[Fit]:
    """Return the fit under a convention with each of the factors (F,) on depth."""
    errors = sample.errors(convention, factors)
    pooled = np.concatenate(errors, axis=1) if errors else np.empty((len(factors), 0))
    points = np.isfinite(pooled).sum(axis=1)
    medians = median_of_seen(pooled) if pooled.size else np.full(len(factors), np.nan)
    return [
        Fit(dataclasses.replace(convention, factor=f), median, n / max(1, pooled.shape[1]), n)
        for f, median, n in zip(factors.tolist(), medians.tolist(), points.tolist(), strict=True)
    ]


def pairs_won(errors: Sequence[Float64], others: Sequence[Float64]) -> list[bool]:
    """Return for each pair of frames where both see enough whether the first has the lower median of errors (1, N)."""
    rows = [[(float(median_of_seen(e)[0]), int(np.isfinite(e).sum())) for e in each] for each in (errors, others)]
    return [a < b for (a, m), (b, n) in zip(*rows, strict=True) if min(m, n) >= PAIR_POINTS]


def _one_hypothesis(fit: Fit, other: Fit) -> bool:
    """Return whether two conventions differ in no more than how exactly the unit of depth is known."""
    a, b = fit.convention, other.convention
    return 1 / SCALE_APART < a.factor / b.factor < SCALE_APART and set(a.differs_in(b)) <= {"factor"}


def _is_of_poses(fit: Fit, mine: Fit) -> bool:
    """Return whether a fit differs from another one in what the poses mean, or in the unit."""
    return set(fit.convention.differs_in(mine.convention)) <= {"pose", "axes", "factor"}


def shifts_and_turns(sample: Sample) -> tuple[Float64, Float64]:
    """Return for each pair how far the camera moves, as a share of the depth, and turns, in degrees."""
    motions = sample.motions(sample.configured)
    depth = _typical(sample, lambda depths: float(np.median(depths)))
    shifts = np.array([np.linalg.norm(t) / depth for _, t in motions])
    cosines = np.array([(np.trace(R) - 1) / 2 for R, _ in motions])
    return shifts, np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))


def _typical(sample: Sample, measure: Callable[[Float64], float]) -> float:
    """Return the median over the views of a measure of their sampled depths; NaN where none has any."""
    values = [measure(view.depth[view.v, view.u].astype(np.float64)) for view in sample.views.values() if len(view.u)]
    return float(np.median(values)) if values else math.nan


def _reason(sample: Sample) -> str:
    """Return why frames may not tell conventions apart, as far as their motion and depth show it."""
    shifts, turns = shifts_and_turns(sample)
    spread = _typical(sample, lambda depths: float(np.divide(*np.percentile(depths, (90, 10)))))
    reasons = {
        "the camera hardly moves": shifts.max() < HARDLY_MOVES,
        "the camera hardly turns": turns.max() < HARDLY_TURNS,
        "all depths are alike": spread < HARDLY_DEEP,
    }
    return " and ".join(reason for reason, holds in reasons.items() if holds)
