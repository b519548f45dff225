"""The statistics as plain text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from semstab.measures import measures

Row = tuple[str, Any, str]
WIDTH = 80


def lines(summary: Mapping[str, Any]) -> list[str]:
    """The content that `describe` returns, in lines."""
    repeated, blocks = summary["repeated"], summary["blocks"]
    head = [
        *textwrap.wrap(summary["verdict"]["line"], WIDTH),
        "",
        f"{repeated['voxels']} of {summary['voxels']} voxels seen twice or more; intervals at 95 % from"
        f" {blocks['count']} blocks of {blocks['size']:.4g} m",
        "",
        f"{'':<34}{'value':>9}   {'interval':<20}",
    ]
    rows = [*_agreement(summary), *_drift(summary), *_uncertainty(summary), *_geometry(summary), *_correctness(summary)]
    return [*head, *(_line(*row) for row in rows), *_tables(summary)]


def comparison_lines(content: Mapping[str, Any]) -> list[str]:
    """The content that `compare_backbones` returns, in lines."""
    paired = content["paired"]
    out = [
        f"{paired['voxels']} voxels that all saw twice or more; {paired['blocks']} blocks of"
        f" {paired['block_size']:.4g} m",
        "",
        *_table(content["coverage"], ("backbone", "voxels", "observations", "mean_op", "repeated", "common_share")),
        "",
        f"{'difference on common voxels':<34}{'value':>9}   {'interval':<20}{'p (Holm)':>10}",
    ]
    out += [
        _line(f"{row['measure']}: {row['a']} - {row['b']}", row["difference"], _p("p", row["p_holm"]))
        for row in paired["differences"]
    ]
    for measure, values in content["standardised"]["values"].items():
        out += [_line(f"{measure}, standardised: {name}", value) for name, value in values.items()]
    for ranking in paired["rankings"]:
        order = (f"{r['rank']}. {r['backbone']} (first in {_share(r['best'])})" for r in ranking["ranks"])
        out.append(f"by {ranking['measure']}: {', '.join(order)}")
    if rules := content["fusion_rules"]:
        changed = [measure for measure, changes in rules["order_changes"].items() if changes]
        out.append(f"another fusion rule changes the order by: {', '.join(changed) or 'no measure'}")
    return out


def _agreement(summary: Mapping[str, Any]) -> list[Row]:
    found = summary["agreement"]
    return [
        ("pairwise agreement (PSA)", found["psa"], ""),
        ("Fleiss' kappa", found["kappa"], ""),
        ("Krippendorff's alpha", found["alpha"], ""),
        ("VSS", found["vss"], ""),
    ]


def _drift(summary: Mapping[str, Any]) -> list[Row]:
    drift = summary["drift"]
    tests, flips = drift["tests"] or {}, drift["flips"]
    rows: list[Row] = [
        ("SBD, bits", drift["sbd"], ""),
        ("SBD in random order", drift["null"], ""),
        ("excess drift", drift["excess"], _p("p", tests.get("sbd_p", math.nan))),
    ]
    if tests:
        found = f"{tests['drifting_voxels']} of {tests['tested_voxels']} voxels drift"
        rows += [
            ("disagreement that goes one way", tests["trend"], ""),
            ("  beyond random order", tests["trend_excess"], f"{_p('p', tests['trend_p'])}; {found}"),
        ]
    if flips:
        rows += [("flip rate", flips["rate"], ""), ("  beyond random order", flips["excess"], "")]
    return rows


def _uncertainty(summary: Mapping[str, Any]) -> list[Row]:
    found = summary["uncertainty"]
    return [
        ("entropy", found["entropy"], ""),
        ("  within frames", found["within"], ""),
        ("  between frames", found["between"], ""),
    ]


def _geometry(summary: Mapping[str, Any]) -> list[Row]:
    found = summary["geometry"]
    if not found:
        return []
    return [
        ("disagreement 1 - PSA", found["total"], ""),
        ("  of geometry", found["geometry"], ""),
        ("  of the model", found["model"], ""),
    ]


def _correctness(summary: Mapping[str, Any]) -> list[Row]:
    found = summary["correctness"]
    if not found:
        return []
    quadrants = found["quadrants"]
    names = ("stable_right", "stable_wrong", "unstable_right", "unstable_wrong")
    return [
        ("accuracy", found["accuracy"], ""),
        *((f"{name.replace('_', ', ')} (OP >= 3)", quadrants[name], "") for name in names),
        ("wrong among the stable", quadrants["wrong_of_stable"], ""),
    ]


def _tables(summary: Mapping[str, Any]) -> Iterable[str]:
    yield from (
        "",
        *_table(
            summary["strata"],
            ("name", "voxels", "psa", *(m.key for m in measures()), "sbd_null", "entropy_within", "entropy_between"),
        ),
    )
    if found := summary["correctness"]:
        yield from ("", *_table(found["strata"], ("name", "voxels", "accuracy", "miou", "ece", "brier")))
    yield from ("", *_table(summary["agreement"]["classes"], ("name", "observations", "kappa", "alpha")))
    if rules := summary["fusion_rules"]:
        yield from ("", *_table(rules, [key for key in rules[0] if key not in ("miou", "brier")]))


def _table(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[str]:
    cells = [keys, *([_cell(row[key]) for key in keys] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(keys))]
    first, *rest = widths
    return [
        f"{line[0]:<{first}}" + "".join(f"  {cell:>{width}}" for cell, width in zip(line[1:], rest, strict=True))
        for line in cells
    ]


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.0f}" if abs(value) >= 1000 else f"{value:z.4f}"
    return str(value)


def _line(name: str, estimate: Any, note: str = "") -> str:
    if not isinstance(estimate, Mapping):
        return f"{name:<34}{_cell(estimate):>9}   {'':<20}{note}".rstrip()
    interval = f"{_cell(estimate['low'])} to {_cell(estimate['high'])}"
    return f"{name:<34}{_cell(estimate['value']):>9}   {interval:<20}{note}".rstrip()


def _p(name: str, value: float) -> str:
    return "" if math.isnan(value) else f"{name} = {value:.3g}"


def _share(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0%} of resamples"
