"""The statistics as plain text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from semstab.model.contrast import BackboneComparison, CommonLooks, PairedDifference
from semstab.model.measures import SBD, measures
from semstab.model.statistics import (
    NEXT_FLIGHT,
    CeilingShare,
    DriftTests,
    Estimate,
    Flipping,
    LagBin,
    MapStatistics,
    RuleOutcome,
)
from semstab.statistics.agreement import ALPHA, KAPPA
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU
from semstab.statistics.model_comparison import compared

Row = tuple[str, Estimate | float, str]
Cell = str | float
WIDTH = 80
BELOW: Any = {"initial_indent": " " * 6, "subsequent_indent": " " * 6}
THIN = 0.1
"""Part of the weights in strata that hardly overlap, from which on it is said."""


def lines(found: MapStatistics) -> list[str]:
    """What `describe` says of a map."""
    repeated, blocks = found.repeated, found.blocks
    head = [
        *textwrap.wrap(found.verdict.line, WIDTH),
        "",
        f"{repeated.voxels} of {found.voxels} voxels seen twice or more, in {blocks.count} cubes of space",
        *textwrap.wrap(
            f"intervals at 95 %, for this map; errors depend on each other within blocks of {blocks.size:.4g} m", WIDTH
        ),
        "",
        f"{'':<34}{'value':>9}   {'interval':<20}",
    ]
    sections = (_agreement, _judged, _drift, _uncertainty, _geometry, _correctness)
    rows = [row for section in sections for row in section(found)]
    return [*head, *(line for row in rows for line in _laid_out(*row)), *_tables(found)]


def comparison_lines(found: BackboneComparison) -> list[str]:
    """What `compare_backbones` says of several."""
    paired = found.paired
    out = [
        f"{paired.voxels} voxels that all saw twice or more; {paired.blocks} blocks of {paired.block_size:.4g} m",
        "",
        *_table(
            ("backbone", "voxels", "observations", "mean_op", "repeated", "common_share"),
            [(r.backbone, r.voxels, r.observations, r.mean_op, r.repeated, r.common_share) for r in found.coverage],
        ),
        "",
        f"{'difference on common voxels':<34}{'value':>9}   {'interval':<20}{'p (Holm)':>10}",
    ]
    for r in paired.differences:
        out += _laid_out(f"{r.measure}: {r.a} - {r.b}", r.difference, _tested(r))
    if found.looks is not None:
        out += ["", *_looks(found.looks), ""]
    if found.standardised.thin > THIN:
        out.append(f"standardised: {found.standardised.thin:.0%} of the weight is in strata that hardly overlap")
    for quantity in compared(truth=False):
        own = {name: found.standardised.of(quantity, name) for name in found.backbones}
        if quantity.key in found.standardised.values:
            out += [_line(f"{quantity.key}, standardised: {name}", value) for name, value in own.items()]
    for ranking in paired.rankings:
        order = (f"{r.rank}. {r.backbone} (first in {_share(r.best)})" for r in ranking.ranks)
        out += textwrap.wrap(f"by {ranking.measure}: {', '.join(order)}", WIDTH, subsequent_indent="  ")
    if (rules := found.fusion_rules) is not None:
        changed = [measure for measure, changes in rules.order_changes.items() if changes]
        out.append(f"another fusion rule changes the order by: {', '.join(changed) or 'no measure'}")
    return out


def _tested(row: PairedDifference) -> str:
    answers = row.undecided or row.question
    return answers if math.isnan(row.p_holm) else f"{_p('p', row.p_holm)}, {answers}"


def _looks(found: CommonLooks) -> list[str]:
    """What was compared, and what the order owes to what was left out."""
    reduced = "; labels beside scores: each look reduced to its largest class" if found.decided else ""
    rows = [(r.backbone, r.missing, r.psa_low, r.psa_high, r.alpha) for r in found.ignored]
    depends = "depends" if found.depends else "does not depend"
    return [
        *textwrap.wrap(
            f"compared on {found.observations} looks at {found.voxels} voxels that all labelled{reduced}", WIDTH
        ),
        *_table(("backbone", "left out", "PSA at least", "at most", "alpha, left out as a class"), rows),
        f"the order {depends} on what was left out",
    ]


def _agreement(found: MapStatistics) -> list[Row]:
    return [
        ("pairwise agreement (PSA)", found.agreement.psa, ""),
        ("Fleiss' kappa", found.agreement.kappa, ""),
        ("Krippendorff's alpha", found.agreement.alpha, ""),
        ("VSS", found.agreement.vss, ""),
        *([] if found.flipping is None else [("places that flip", found.flipping.share, _between(found.flipping))]),
        ("two looks differ within a frame", found.agreement.within, ""),
        ("  and between frames", found.agreement.between, ""),
        ("alpha between frames", found.agreement.alpha_between, ""),
        ("  each place counting once", found.agreement.voxel_weighted, ""),
        *([] if found.ceiling_share is None else _reach(found.ceiling_share)),
        *([] if found.correlogram is None else _standard(found.correlogram.standard)),
    ]


def _between(flips: Flipping) -> str:
    return f"{flips.part:.0%} of it between {flips.a} and {flips.b}" if flips.a else ""


def _judged(found: MapStatistics) -> list[Row]:
    """What may be said of the next flight, if anything."""
    judged = found.headline
    rows = {
        "PSA": judged.psa,
        "alpha": judged.alpha,
        "alpha between frames": judged.alpha_between,
        "VSS at OP >= 3": judged.vss,
        "accuracy": judged.accuracy,
        "wrong of the stable places": judged.wrong_of_stable,
    }
    return [(name, own, "the next flight") for name, own in rows.items() if own.question == NEXT_FLIGHT]


def _reach(reach: CeilingShare) -> list[Row]:
    return [
        ("alpha b.f., sampled voxels", reach.alpha, ""),
        ("  its ceiling", reach.ceiling, f"of {reach.by}"),
        ("  share reached", reach.share, ""),
        *(
            (f"  {row.name}"[:34], row.share, f"{row.locations:.0f} places")
            for row in reach.classes
            if row.counts_for_verdict
        ),
    ]


def _standard(found: LagBin) -> list[Row]:
    alpha, known = found.alpha, not math.isnan(found.ceiling)
    ceiling = f"ceiling {found.ceiling:.2f}; {found.pairs} pairs; {alpha.undecided or alpha.question}" if known else ""
    return [(f"alpha b.f., views {found.low:g} to {found.high:g} deg.", found.alpha, ceiling)]


def _drift(found: MapStatistics) -> list[Row]:
    drift, tests, flips = found.drift, found.drift.tests, found.drift.flips
    rows: list[Row] = [
        ("SBD, bits", drift.sbd, ""),
        ("SBD in random order", drift.null, f"over {drift.voxels} voxels"),
        ("excess drift", drift.excess, "" if tests is None else _order(tests)),
    ]
    if tests is not None:
        trending = f"{tests.trending_voxels} of {tests.tested_voxels} voxels do"
        rows += [
            ("disagreement that goes one way", tests.trend, ""),
            ("  beyond random order", tests.trend_excess, "; ".join(filter(None, (_p("p", tests.trend_p), trending)))),
        ]
    if flips is not None:
        rows += [("flip rate", flips.rate, ""), ("  beyond random order", flips.excess, "")]
    return rows


def _uncertainty(found: MapStatistics) -> list[Row]:
    return [
        ("entropy", found.uncertainty.entropy, ""),
        ("  within frames", found.uncertainty.within, ""),
        ("  between frames", found.uncertainty.between, ""),
    ]


def _geometry(found: MapStatistics) -> list[Row]:
    if found.geometry is None:
        return []
    return [
        ("disagreement 1 - PSA", found.geometry.total, ""),
        ("  of geometry", found.geometry.geometry, ""),
        ("  of the model", found.geometry.model, ""),
    ]


def _correctness(found: MapStatistics) -> list[Row]:
    if found.correctness is None:
        return []
    shares = found.correctness.quadrants
    return [
        ("accuracy", found.correctness.accuracy, ""),
        ("stable, right (OP >= 3)", shares.stable_right, ""),
        ("stable, wrong (OP >= 3)", shares.stable_wrong, ""),
        ("unstable, right (OP >= 3)", shares.unstable_right, ""),
        ("unstable, wrong (OP >= 3)", shares.unstable_wrong, ""),
        ("wrong among the stable", shares.wrong_of_stable, ""),
    ]


def _tables(found: MapStatistics) -> Iterable[str]:
    yield from ("", *_strata(found))
    if found.correctness is not None:
        strata = [(r.name, r.voxels, r.accuracy, r.miou, r.ece, r.brier) for r in found.correctness.strata]
        yield from ("", *_table(("name", "voxels", *(q.key for q in (ACCURACY, MIOU, ECE, BRIER))), strata))
    classes = [(r.name, r.observations, r.kappa, r.alpha) for r in found.agreement.classes]
    yield from ("", *_table(("name", "observations", KAPPA.key, ALPHA.key), classes))
    if found.fusion_rules:
        yield from ("", *_rules(found.fusion_rules, known=found.correctness is not None))


def _strata(found: MapStatistics) -> list[str]:
    keys = ("OP", "voxels", "psa", "SBD", "SBD in random order", "entropy: within", "between")
    rows: list[Sequence[Cell]] = [
        (r.name, r.voxels, r.psa, r.means[SBD], r.sbd_null, r.entropy_within, r.entropy_between) for r in found.strata
    ]
    return _table(keys, rows)


def _rules(outcomes: Sequence[RuleOutcome], *, known: bool) -> list[str]:
    """How right each rule is only where that is known."""
    keys = ("rule", *(measure.key for measure in measures()), "relabelled", ACCURACY.key, ECE.key)
    rows: list[Sequence[Cell]] = [
        (r.rule, *r.values.means.of_all(), r.relabelled_share, r.values.accuracy, r.values.ece) for r in outcomes
    ]
    return _table(keys, rows) if known else _table(keys[:-2], [row[:-2] for row in rows])


def _table(keys: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[str]:
    cells = [keys, *([_cell(cell) for cell in row] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(keys))]
    first, *rest = widths
    return [
        f"{line[0]:<{first}}" + "".join(f"  {cell:>{width}}" for cell, width in zip(line[1:], rest, strict=True))
        for line in cells
    ]


def _cell(value: Cell) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.0f}" if abs(value) >= 1000 else f"{value:z.4f}"
    return str(value)


def _line(name: str, estimate: Estimate | float, note: str = "") -> str:
    if not isinstance(estimate, Estimate):
        return f"{name:<34}{_cell(estimate):>9}   {'':<20}{note}".rstrip()
    interval = f"{_cell(estimate.low)} to {_cell(estimate.high)}"
    return f"{name:<34}{_cell(estimate.value):>9}   {interval:<20}{note}".rstrip()


def _laid_out(name: str, estimate: Estimate | float, note: str) -> list[str]:
    """A row; what does not fit beside its numbers stands below them."""
    line = _line(name, estimate, note)
    return [line] if len(line) <= WIDTH else [_line(name, estimate), *textwrap.wrap(note, WIDTH, **BELOW)]


def _order(tests: DriftTests) -> str:
    """The p-value of the scene's SBD, and what was put in other orders for it."""
    if math.isnan(tests.sbd_p):
        return "no p: places are seen too shortly, or errors last too long"
    return f"{_p('p', tests.sbd_p)}: {tests.stretches} stretches of time in other orders"


def _p(name: str, value: float) -> str:
    return "" if math.isnan(value) else f"{name} = {value:.3g}"


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0%} of resamples"
