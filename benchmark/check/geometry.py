"""A check that depth, poses and intrinsics agree, and of the other conventions under which they would.

Every convention is assessed by the median relative depth error of points that one frame sees again in another, and by
the share of points that it sees again at all: an alternative with little overlap is no evidence.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np

from semstab.check.conventions import Reading, alternatives
from semstab.check.hypotheses import CAMERAS
from semstab.check.reprojection import Sample
from semstab.check.trials import falls, ranked
from semstab.check.verdict import GOOD, LEAST_OF_OTHER, SIMPLER, Fit, State, Verdict
from semstab.core.types import Float64

DECADES: Float64 = np.power(10.0, np.arange(-5, 6))
FINE: Float64 = np.power(10.0, np.arange(-30, 31) / 6)
"""Factors on depth that are tried; the outermost decades only to see whether the ones inside can be distinguished."""

LARGEST_FACTOR = 1e4
"""Factors from 1 / this to this are reported."""

LEAST_PAIRS = 3
"""The least pairs with enough points seen again; where fewer have, an alternative must stand out from all others."""

MOST_ERROR = {3: 0.02, 4: 0.02, 5: 0.02}
"""The largest error of a convention, by the number of settings that it changes at once: of many combinations of
settings, one fits a little by chance."""

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

MISTAKEN = 0.5
"""A mistake is named if its mend leaves at most this part of the error; the mend is to write the files again."""

MOST_CANDIDATES = 3
"""Alternatives that are named in addition to the best one, where they fit as well."""

HARDLY_MOVES = 0.01
HARDLY_TURNS = 1.0
HARDLY_DEEP = 1.05
"""Limits below which a reason says what frames cannot tell: motion as a share of depth, degrees, and the ratio of
the 90th to the 10th percentile of depth."""


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
        configured = self.configured
        if not any(len(view.u) for view in self.sample.views.values()):
            return "unclear", "no pixel of the sampled frames has valid depth"
        if not configured.has_evidence:
            return "unclear", (
                f"{configured.share:.1%} of the sampled points ({configured.points}) are seen again by another frame:"
                " too few to tell whether depth and poses agree"
            )
        return None

    def _unexplained(self) -> tuple[State, str] | None:
        configured = self.configured
        if (
            configured.error > HOPELESS_ERROR
            and configured.share >= HOPELESS_SHARE
            and configured.points >= HOPELESS_POINTS
        ):
            return "unsound", (
                f"depth reprojects with {configured.error:.0%} error, and no other convention explains it; do poses,"
                " depth and intrinsics belong together, frame by frame?"
            )
        if configured.error > GOOD:
            return "unclear", (
                f"depth reprojects with {configured.error:.1%} error, and no other convention explains it; are poses"
                " and depth this imprecise?"
            )
        return None

    def _in_agreement(self) -> tuple[State, str]:
        configured = self.configured
        text = f"depth reprojects with {configured.error:.2%} median error, {configured.share:.0%} co-visible"
        if all(self._is_undetermined(fit) for fit in self._single_changes() if _is_of_poses(fit, configured)):
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
        measured = min([fit, *self._measured_scale(fit)], key=lambda candidate: candidate.error)
        factor = self.reading.usual_factor(measured.convention.factor, fit.convention.depth)
        (rounded,) = self.sample.fits(fit.convention, np.array([factor]))
        return measured if measured.clearly_beats(rounded) else rounded

    def _may_refute(self, fit: Fit) -> bool:
        """Return whether a fit meets those conditions for refuting the configured one that are cheap to check."""
        configured, factor = self.configured, fit.convention.factor
        size = max(factor, 1 / factor)
        if fit is configured or not fit.has_evidence or fit.share < LEAST_OF_OTHER * configured.share:
            return False
        if not configured.has_evidence and _one_hypothesis(fit, configured):
            return False
        if factor != 1 and not LEAST_SCALE_ERROR <= size <= 1.001 * LARGEST_FACTOR:
            return False
        limit = GOOD if configured.has_evidence else STRIKING
        return fit.clearly_beats(configured) and fit.error <= min(limit, self._limit(fit))

    def _limit(self, fit: Fit) -> float:
        """Return the largest error with which a fit refutes: the less, the more it changes at once."""
        return MOST_ERROR.get(self._changes(fit)[0], GOOD)

    def _is_confirmed(self, fit: Fit) -> bool:
        if fit.convention.factor != 1 and not self._scale_is_told(fit):
            return False
        won = falls(self.sample.by_pair(fit.convention), self.sample.by_pair())
        has_enough = self.configured.has_evidence and won.count >= LEAST_PAIRS
        return won.wins if has_enough else self._stands_out(fit)

    def _scale_is_told(self, fit: Fit) -> bool:
        """Return whether depth ten times as long and as short fits clearly worse: not where the camera hardly moves."""
        scaled = self.sample.fits(fit.convention, fit.convention.factor * np.array([0.1, 10]))
        return all(fit.clearly_beats(other) for other in scaled)

    def _stands_out(self, fit: Fit) -> bool:
        """Return whether every convention with another motion between the frames fits far worse."""
        near = (other for other in self.fits if other.has_evidence and other.error * CONTRAST < fit.error)
        same_depth = (
            dataclasses.replace(
                near_fit, convention=dataclasses.replace(near_fit.convention, depth=fit.convention.depth)
            )
            for near_fit in near
        )
        return all(_one_hypothesis(fit, other) or self._moves_alike(fit, other) for other in same_depth)

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
        coarse = self.sample.fits(near.convention, near.convention.factor * np.power(10.0, np.arange(-12, 13) / 72))
        best = min(coarse, key=lambda fit: (math.isnan(fit.error), fit.error)).convention
        fine = self.sample.fits(best, best.factor * np.power(10.0, np.arange(-10, 11) / 720))
        return [fit for fit in (*coarse, *fine) if fit.convention != near.convention]

    def _refuted(self, best: Fit) -> Verdict:
        configured, lines = self.configured, self.reading.lines(best.convention)
        if configured.has_evidence:
            evidence = f"depth reprojects with {configured.error:.1%} error as configured, but with"
        else:
            evidence = f"{configured.share:.1%} of the points are seen again as configured; depth reprojects with"
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
    unscaled = np.array([1.0])
    for convention in alternatives(sample.configured, reading.ratios):
        known_camera = convention.ratio == (1.0, 1.0)
        factors = (FINE if thorough or convention == sample.configured else DECADES) if known_camera else unscaled
        yield from sample.fits(convention, factors)


def _one_hypothesis(fit: Fit, other: Fit) -> bool:
    """Return whether two conventions differ in no more than how exactly the unit of depth is known."""
    a, b = fit.convention, other.convention
    return 1 / SCALE_APART < a.factor / b.factor < SCALE_APART and set(a.differs_in(b)) <= {"factor"}


def _is_of_poses(fit: Fit, other: Fit) -> bool:
    """Return whether a fit differs from another one in what the poses mean, or in the unit."""
    return set(fit.convention.differs_in(other.convention)) <= {"pose", "axes", "factor"}


def shifts_and_turns(sample: Sample) -> tuple[Float64, Float64]:
    """Return for each pair how far the camera moves, as a share of the depth, and turns, in degrees."""
    motions = sample.motions(sample.configured)
    depth = _typical(sample, lambda depths: float(np.median(depths)))
    shifts = np.array([np.linalg.norm(t) / depth for _, t in motions])
    cosines = np.array([(np.trace(R) - 1) / 2 for R, _ in motions])
    return shifts, np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))


def _typical(sample: Sample, measure: Callable[[Float64], float]) -> float:
    """Return the median over the views of a measure of their sampled depths, or NaN without depths."""
    values = [measure(view.depth[view.v, view.u].astype(np.float64)) for view in sample.views.values() if len(view.u)]
    return float(np.median(values)) if values else math.nan


def _reason(sample: Sample) -> str:
    """Return why frames may not tell conventions apart, as far as their motion and depth show it."""
    shifts, turns = shifts_and_turns(sample)
    spread = _typical(sample, lambda depths: float(np.divide(*np.percentile(depths, (90, 10)))))
    reasons = {
        "the camera hardly moves": shifts.max() < HARDLY_MOVES,
        "the camera hardly turns": turns.max() < HARDLY_TURNS,
        "all depths are similar": spread < HARDLY_DEEP,
    }
    return " and ".join(reason for reason, holds in reasons.items() if holds)


def with_mistakes(verdict: Verdict, sample: Sample) -> Verdict:
    """Return the verdict, or that the files hold a mistake, where depth agrees far better without it."""
    if not sample.views or not sample.pairs or not verdict.fits:
        return verdict
    now, best = verdict.fits[0][1], ranked(CAMERAS, sample)[0]
    evident = [other for _, other in verdict.fits if other.has_evidence]
    if not best.fit.has_evidence or best.fit.error > GOOD or not all(map(best.fit.clearly_beats, evident)):
        return verdict
    if now.has_evidence and (len(sample.pairs) < LEAST_PAIRS or not best.is_right(sample, now, MISTAKEN)):
        return verdict
    mistake, error = best.hypothesis, f"reprojects with {now.error:.1%} error"
    agrees = error if now.has_evidence else "hardly reprojects at all"
    text = (
        f"{mistake.name}, as it seems: depth {agrees}, but with {best.fit.error:.2%} without this mistake;"
        f" {mistake.mend}"
    )
    fits = (verdict.fits[0], (f"without {mistake.name}", best.fit), *verdict.fits[1:])
    return dataclasses.replace(verdict.refuted(text), fits=fits)
