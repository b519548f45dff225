"""A comparison in a terminal of 80 columns."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from semstab.core.console import WIDTH, Console, wrapped
from semstab.data.contrast import RunComparison
from semstab.report.comparison.sentences import differences, notes
from semstab.report.comparison.tables import ALL_SCENES, heading, tables
from semstab.report.tables.table import Table, to_terminal
from semstab.statistics.agreement import ALPHA

SHOWN = {
    "comparison": ("measure", "base", "other", "difference", "p_holm", "change"),
    "comparison_classes": ("class", "worse", "better", ALPHA.name),
    "comparison_areas": ("class", "confused_with", "voxels", "loss", "x", "y", "z"),
}
"""The columns of each table that fit; files have all of them."""

LEGEND = (
    "PSA: share of the pairs of frames that give a voxel one class; SBD excess: SBD minus SBD in random order; ECE:"
    " belief against accuracy; consistent but wrong: share of the voxels whose frames agree on a wrong class; voxel"
    " alpha: alpha of a voxel's frames; coverage: voxels, of the base's; p (Holm): corrected for all measures"
)
"""The meaning of the measures that the screen of a run does not explain."""

LONGEST_NAME = 8
"""The longest names of runs over the columns of their numbers."""


def print_comparison(
    comparison: RunComparison, console: Console, *, verbose: bool = False, out: Path | None = None
) -> None:
    """Print the answer in sentences, the differences and the notes; verbose: also classes and areas.

    Of several scenes, the differences over all of them and the number of areas are printed; verbose: each scene's too.
    `out` is the folder that they were written to.
    """
    briefly = not verbose and len(comparison.scenes) > 1
    for sentence in (
        *differences(comparison, places=not briefly),
        *(f"caution: {text}." for text in comparison.cautions),
    ):
        console.print(sentence, highlight=False, markup=False)
    for table in tables(comparison):
        if table.name == "comparison" or (verbose and table.name in SHOWN):
            displayed = _over_scenes(table) if briefly else table
            fitting = _fitting(displayed.only(*SHOWN[table.name]), comparison)
            text = to_terminal(dataclasses.replace(fitting, caption=""), WIDTH)
            console.print(f"\n{text}", highlight=False, markup=False, soft_wrap=True)
        if table.name == "comparison":
            console.print("\n".join([*wrapped(LEGEND, WIDTH), ""]), highlight=False, markup=False)
    for sentence in notes(comparison):
        console.print("\n".join(wrapped(sentence, console.width)), highlight=False, markup=False)
    more = [
        *([] if verbose else [f"-v: {'scenes, ' if briefly else ''}classes and areas"]),
        *([] if out else ["--out DIR: report.html, tables, maps"]),
    ]
    if more:
        console.print(f"  more     {'; '.join(more)}", highlight=False)


def _over_scenes(table: Table) -> Table:
    """Return the groups over all scenes alone."""
    return dataclasses.replace(table, groups=tuple(g for g in table.groups if g.name.startswith(f"{ALL_SCENES}: ")))


def _fitting(table: Table, comparison: RunComparison) -> Table:
    """Return a table with scenes as groups if the base is compared with one run, and with long names in the title."""
    if len(comparison.runs) == 2:
        pair = heading(comparison, "", comparison.overall[0])
        groups = (dataclasses.replace(group, name=group.name.removesuffix(pair)) for group in table.groups)
        table = dataclasses.replace(table, groups=tuple(groups))
    heads = {column.key: column.header for column in table.columns if column.key in ("base", "other")}
    if max(map(len, heads.values()), default=0) <= LONGEST_NAME:
        return table
    short = {"base": "Base", "other": "Other"}
    columns = (dataclasses.replace(column, header=short.get(column.key, column.header)) for column in table.columns)
    other = f", other: {heads['other']}" if heads["other"] != short["other"] else ""
    return dataclasses.replace(table, title=f"{table.title} (base: {comparison.base}{other})", columns=tuple(columns))
