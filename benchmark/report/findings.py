"""The paper's four findings, each computed from a study's records: is it shown, and by which numbers?"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from semstab.model.measures import SBD, VSS
from semstab.model.records import Result
from semstab.model.statistics import Estimate
from semstab.report.averages import ENOUGH, Level, Pooled, Sweep, complete_scenes, describe, levels, pooled

VISIBLE_VSS = 10.0 ** -VSS.digits[0]
"""A difference of VSS counts from one unit of the last decimal of the paper's main tables on."""

VISIBLE_SBD = 10.0 ** -SBD.digits[0]
"""Likewise for SBD."""

VISIBLE_SHARE = 0.0001
"""Likewise for shares, which the paper prints in percent with two decimals."""

HARDLY = 0.5
"""Recurrent VSS 'hardly moves' where it moves by less than half of what aggregate VSS does; in the paper, by a quarter
(0.8544 to 0.8446 against 0.9805 to 0.9400)."""

ASSOCIATION = ("voxel_size", "depth_noise", "translation_noise", "rotation_noise")
"""The sweeps of the third finding. Drift is left out: it bends the map slowly, so that successive frames still meet."""


class Answer(enum.Enum):
    """What the records say of a claim."""

    SHOWN = "shown"
    NOT_SHOWN = "not shown"
    UNTESTED = "cannot be tested"


@dataclass(frozen=True)
class ClaimResult:
    """What one test says: the numbers that the verdict rests on, and why it is not 'shown', where it is not."""

    verdict: Answer
    numbers: str = ""
    why: str = ""


@dataclass(frozen=True)
class ClaimTest:
    """A test of a claim on the voxels of one backbone, pooled over scenes and on each scene by itself.

    condition  what was swept, where something was
    scenes     in how many scenes it shows, of how many where it can be tested
    """

    backbone: str
    outcome: ClaimResult
    condition: str = ""
    scenes: tuple[int, int] = (0, 0)

    @property
    def verdict(self) -> Answer:
        """Of its outcome."""
        return self.outcome.verdict


@dataclass(frozen=True)
class Finding:
    """A claim of the paper with the evidence for and against it.

    rule    when a test counts as shown
    caveat  what the finding does not say
    """

    name: str
    claim: str
    rule: str
    evidence: tuple[ClaimTest, ...]
    caveat: str = ""

    @property
    def counts(self) -> tuple[int, int]:
        """In how many tests it shows, of how many that can be made."""
        return _count([row.outcome for row in self.evidence])

    @property
    def said(self) -> str:
        """The verdict in words, with how many tests show it where some do and others do not."""
        shown, tested = self.counts
        return f"shown in {shown} of {tested} tests" if 0 < shown < tested else self.verdict.value

    @property
    def verdict(self) -> Answer:
        """Shown where every test that can be made shows it."""
        shown, tested = self.counts
        if not tested:
            return Answer.UNTESTED
        return Answer.SHOWN if shown == tested else Answer.NOT_SHOWN


def findings(result: Result) -> tuple[Finding, ...]:
    """The four findings, in the paper's order."""
    return (_disagreement(result), _drift(result), _association(result), _sampling(result))


# --- Recurrent voxels disagree more than the aggregate says -----------------------------------------------------------


def _disagreement(result: Result) -> Finding:
    return Finding(
        "disagreement",
        "Recurrent voxels disagree more than the aggregate says.",
        f"VSS of the voxels with OP>=3 lies at least {VISIBLE_VSS} below that of all voxels, and two frames agree less"
        " often on these places than on those that two frames saw, beyond the 95 % interval: of a coin they would not.",
        tuple(_base_evidence(result, backbone, more_disagreement) for backbone in result.backbones),
    )


def more_disagreement(voxels: Pooled) -> ClaimResult:
    """Is VSS of the recurrent voxels lower than that of all?"""
    if voxels.recurrent.voxels < ENOUGH:
        return _untested(f"{voxels.recurrent.voxels:,} voxels have OP>=3; {ENOUGH:,} are needed.")
    every, recurrent, beyond = voxels.every[VSS], voxels.recurrent[VSS], voxels.disagreement
    if math.isnan(beyond.low):
        return _untested("Too few places were seen by two frames, and by more, to tell it from a coin.")
    return _outcome(
        f"VSS {recurrent:.4f} for OP>=3 against {every:.4f} over all voxels: {100 * (1 - recurrent):.1f}% of the"
        f" evidence disagrees, not {100 * (1 - every):.1f}%. From OP=2 to OP>=3 PSA"
        f" {_way(beyond, 'falls', 'rises')}.",
        [
            *([] if every - recurrent >= VISIBLE_VSS else ["The recurrent voxels agree as well as all voxels do."]),
            *(
                []
                if beyond.low > 0
                else ["A coin tossed as often would show it: two frames agree no less often there."]
            ),
        ],
    )


# --- Mean SBD falls with OP -------------------------------------------------------------------------------------------


def _drift(result: Result) -> Finding:
    return Finding(
        "drift",
        "Mean SBD falls with OP.",
        f"Mean SBD falls by at least {VISIBLE_SBD} bits from each stratum of OP to the next, strata of fewer than"
        f" {ENOUGH:,} voxels left out, and with OP>=3 it is lower than in random order, beyond the 95 % interval.",
        tuple(_base_evidence(result, backbone, falling_drift) for backbone in result.backbones),
        "The fall alone shows nothing: the t-th observation moves the mean of t of them by about 1/t, so that SBD falls"
        " with OP for observations in random order, of a coin, as well.",
    )


def falling_drift(voxels: Pooled) -> ClaimResult:
    """Does mean SBD fall from each stratum to the next?"""
    strata = [row for row in voxels.strata if row.defined(SBD) >= ENOUGH]
    if len(strata) < 2:
        return _untested(f"Fewer than two strata of OP have {ENOUGH:,} voxels with an SBD.")
    if math.isnan(voxels.drift_below_null.low):
        return _untested("What a random order of the observations gives is not known; ask for statistics.")
    why = [f"No fall from {a.name} to {b.name}." for a, b in pairwise(strata) if a[SBD] - b[SBD] < VISIBLE_SBD]
    if not voxels.drift_below_null.low > 0:
        why.append("A coin tossed as often would show it: in random order SBD is no higher.")
    return _outcome(
        f"SBD {', '.join(f'{row[SBD]:.4f} at {row.name}' for row in strata)};"
        f" {_way(voxels.drift_below_null, 'lower', 'higher')} than in random order for OP>=3.",
        why,
    )


# --- Finer voxels and geometric noise raise aggregate VSS while lowering the recurrent share --------------------------


def _association(result: Result) -> Finding:
    return Finding(
        "association",
        "Finer voxels and geometric noise raise aggregate VSS while lowering the share of recurrent voxels.",
        "Against the coarsest voxels, or the undisturbed geometry, each other level has a VSS over all voxels at least"
        f" {VISIBLE_VSS} higher and a share with OP>=3 at least {100 * VISIBLE_SHARE:g} points lower; and VSS is"
        " higher, beyond the 95 % interval, than the VSS that the reference has at each OP would make it there.",
        _sweep_evidence(result, ASSOCIATION, less_association, "neither voxel size nor noise"),
    )


def less_association(sweep: Sweep, found: Sequence[Level]) -> ClaimResult:
    """Does VSS rise and the recurrent share fall wherever fewer observations meet?"""
    if sweep.noise and all(level.value for level in found):
        return _untested("There is no undisturbed level (0) to compare with.")
    if len(found) < 2:
        return _untested("There is one level only.")
    reference, *others = found if sweep.noise else reversed(found)
    recurrent = reference.mean(lambda p: p.recurrent.voxels)
    if recurrent < ENOUGH:
        return _untested(f"At {_values(sweep, [reference])} {recurrent:,.0f} voxels have OP>=3; {ENOUGH:,} are needed.")
    lower = [level for level in others if _vss(level) - _vss(reference) < VISIBLE_VSS]
    denser = [level for level in others if _share(reference) - _share(level) < VISIBLE_SHARE]
    rises = ", ".join(f"{_vss(level) - _vss(reference):+.4f} at {_values(sweep, [level])}" for level in lower)
    why = [f"VSS hardly rises or falls: {rises}."] if lower else []
    if same := [level for level in others if level not in lower and not _beyond_op(reference, level) > 0]:
        why.append(
            f"At {_values(sweep, same)} a coin would show it: VSS rises no more than fewer observations make it."
        )
    if denser:
        why.append(f"The share does not fall at {_values(sweep, denser)}.")
    if denser and sweep.noise:
        pixels = reference.mean(lambda p: p.pixels)
        why.append(
            f"A voxel takes {pixels:.1f} pixels of a frame that sees it: the more they are, the more noise spreads a"
            " surface over further voxels without emptying any."
        )
    ordered = (reference, *others)
    vss = " → ".join(f"{_vss(level):.4f}" for level in ordered)
    share = " → ".join(f"{100 * _share(level):.2f}" for level in ordered)
    return _outcome(f"{_values(sweep, ordered, ' → ')}: VSS {vss}; OP>=3 {share}%.", why)


# --- Denser sampling lowers aggregate VSS while recurrent VSS hardly moves --------------------------------------------


def _sampling(result: Result) -> Finding:
    return Finding(
        "sampling",
        "Denser sampling lowers aggregate VSS while recurrent VSS hardly moves.",
        f"From the fewest to the most frames VSS over all voxels falls by at least {VISIBLE_VSS}, and VSS of the voxels"
        f" with OP>=3 moves by at most {HARDLY:g} times as much; levels with fewer than {ENOUGH:,} recurrent voxels do"
        " not count; and it falls, beyond the 95 % interval, to less than the VSS that the fewest frames have at each"
        " OP would make it.",
        _sweep_evidence(result, ("frame_count",), denser_sampling, "not the number of frames"),
        "The largest share of a few observations overestimates, of three as well as of two: VSS for OP>=3 falls a"
        " little with more frames even where the predictions stay the same.",
    )


def denser_sampling(sweep: Sweep, found: Sequence[Level]) -> ClaimResult:
    """Does aggregate VSS fall with more frames, and recurrent VSS move much less?"""
    found = [level for level in found if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH]
    if len(found) < 2:
        return _untested(f"Fewer than two levels have {ENOUGH:,} recurrent voxels.")
    first, last = found[0], found[-1]
    fall, move = _vss(first) - _vss(last), abs(_recurrent_vss(first) - _recurrent_vss(last))
    numbers = (
        f"{_values(sweep, (first, last), ' → ')}: VSS over all voxels {_vss(first):.4f} → {_vss(last):.4f}, for OP>=3"
        f" {_recurrent_vss(first):.4f} → {_recurrent_vss(last):.4f}; OP>=3 {100 * _share(first):.2f} →"
        f" {100 * _share(last):.2f}%."
    )
    if fall < VISIBLE_VSS:
        return _outcome(numbers, ["VSS over all voxels does not fall."])
    moves = f"VSS for OP>=3 moves by {move:.4f}, more than {HARDLY:g} times the {fall:.4f} over all voxels."
    why = [moves] if move > HARDLY * fall else []
    if not _beyond_op(first, last, sign=-1) > 0:
        why.append("A coin would show it: VSS falls no more than more observations make it.")
    return _outcome(numbers, why)


# --- Parts ------------------------------------------------------------------------------------------------------------


def _base_evidence(result: Result, backbone: str, test: Callable[[Pooled], ClaimResult]) -> ClaimTest:
    records = result.select(backbone=backbone)
    return _evidence(backbone, test(pooled(records)), [test(pooled([record])) for record in records])


def _sweep_evidence(
    result: Result, sweeps: Sequence[str], test: Callable[[Sweep, Sequence[Level]], ClaimResult], nothing: str
) -> tuple[ClaimTest, ...]:
    """For each sweep and backbone; one row a backbone that says so where nothing was swept."""
    found = []
    for sweep in (describe(name) for name in sweeps):
        for backbone in result.backbones:
            if scenes := complete_scenes(result, sweep.name, backbone):
                by_scene = [test(sweep, levels(result, sweep.name, backbone, scene)) for scene in scenes]
                together = test(sweep, levels(result, sweep.name, backbone))
                found.append(_evidence(backbone, together, by_scene, sweep.title))
    missing = _untested(f"The study varies {nothing}, or no scene has all levels.")
    return tuple(found) or tuple(ClaimTest(backbone, missing) for backbone in result.backbones)


def _evidence(backbone: str, together: ClaimResult, by_scene: Sequence[ClaimResult], condition: str = "") -> ClaimTest:
    """What the pooled voxels say, unless most scenes by themselves say otherwise: then pooling made it."""
    shown, tested = _count(by_scene)
    if together.verdict is Answer.SHOWN and 2 * shown < tested:
        why = f"The scenes together show it, but by themselves only {shown} of {tested}."
        together = ClaimResult(Answer.NOT_SHOWN, together.numbers, why)
    return ClaimTest(backbone, together, condition, (shown, tested))


def _count(outcomes: Sequence[ClaimResult]) -> tuple[int, int]:
    tested = [outcome.verdict for outcome in outcomes if outcome.verdict is not Answer.UNTESTED]
    return sum(verdict is Answer.SHOWN for verdict in tested), len(tested)


def _outcome(numbers: str, why: Sequence[str]) -> ClaimResult:
    """Shown, unless something speaks against it."""
    return ClaimResult(Answer.NOT_SHOWN if why else Answer.SHOWN, numbers, " ".join(why))


def _untested(why: str) -> ClaimResult:
    return ClaimResult(Answer.UNTESTED, why=why)


def _values(sweep: Sweep, found: Sequence[Level], separator: str = ", ") -> str:
    return f"{separator.join(sweep.text(level.value) for level in found)} {sweep.unit}".strip()


def _beyond_op(reference: Level, level: Level, sign: int = 1) -> float:
    """How much more VSS rises (sign 1) or falls (-1) than the level's OP alone makes it, less what may be noise.

    The OP alone: each stratum with the VSS that it has at the reference, weighted by its share at the level.
    """
    of = [reference.mean(lambda p, k=k: p.strata[k][VSS]) for k in range(len(reference.repeats[0].strata))]  # type: ignore[misc]
    share = [level.mean(lambda p, k=k: p.strata[k].share) for k in range(len(of))]  # type: ignore[misc]
    known = [(vss, part) for vss, part in zip(of, share, strict=True) if part and not math.isnan(vss)]
    expected = sum(vss * part for vss, part in known) / sum(part for _, part in known)
    noise = math.hypot(reference.mean(lambda p: p.vss_error), level.mean(lambda p: p.vss_error))
    return sign * (_vss(level) - expected) - max(noise, VISIBLE_VSS)


def _way(estimate: Estimate, positive: str, negative: str) -> str:
    """Which way it goes and how far; with the interval, of the same sign."""
    value, low, high = (round(end, 4) + 0.0 for end in (estimate.value, estimate.low, estimate.high))
    if value == 0:
        return f"neither {positive} nor {negative} ({low:.4f} to {high:.4f})"
    if value < 0:
        return f"{negative} by {-value:.4f} ({0.0 - high:.4f} to {0.0 - low:.4f})"
    return f"{positive} by {value:.4f} ({low:.4f} to {high:.4f})"


def _vss(level: Level) -> float:
    return level.mean(lambda p: p.every[VSS])


def _share(level: Level) -> float:
    return level.mean(lambda p: p.recurrent.share)


def _recurrent_vss(level: Level) -> float:
    return level.mean(lambda p: p.recurrent[VSS])
