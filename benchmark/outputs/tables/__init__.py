"""The study's tables: CSV, Markdown and LaTeX rounded as the paper's, JSON in full precision."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semstab.model.records import Result
from semstab.outputs.remedies import of_interest
from semstab.outputs.tables.comparison import comparison
from semstab.outputs.tables.correctness import ceiling, correctness, rules
from semstab.outputs.tables.fusion import agreement, compared, fusion
from semstab.outputs.tables.glance import glance
from semstab.outputs.tables.image_space import flicker
from semstab.outputs.tables.looks import correlogram
from semstab.outputs.tables.remedies import remedy_tables
from semstab.outputs.tables.sensitivity import sensitivity
from semstab.outputs.tables.stability import classes, cross_backbone, persistence, scenes
from semstab.outputs.tables.statistics import class_agreement, drift, temporal_agreement, uncertainty, verdicts
from semstab.outputs.tables.table import Cell, Column, Group, Table
from semstab.outputs.tables.writers import TEXT_WRITERS, to_csv, to_json, to_latex, to_markdown
from semstab.runtime.files import keep_only, write_json, write_text

__all__ = [
    "Cell",
    "Column",
    "Group",
    "Table",
    "save_tables",
    "tables",
    "to_csv",
    "to_json",
    "to_latex",
    "to_markdown",
    "write_tables",
]

BUILDERS = (
    glance, verdicts, flicker, scenes, persistence, classes, temporal_agreement, correlogram, class_agreement, drift,
    uncertainty, ceiling, correctness, cross_backbone, comparison, rules, sensitivity, fusion, compared, agreement,
)  # fmt: skip
"""In the paper's order, the statistics with what they belong to; each makes none where the study has nothing for it."""


def tables(result: Result) -> list[Table]:
    """Every table that the study has records for, in the paper's order."""
    shown = of_interest(result)
    return [*remedy_tables(result), *(table for build in BUILDERS for table in build(shown))]


def write_tables(result: Result, folder: str | Path) -> list[Path]:
    """Write FOLDER/tables/NAME.{csv,md,tex,json} for every table, in place of all others there; return the paths."""
    return save_tables(tables(result), folder)


def save_tables(made: Sequence[Table], folder: str | Path) -> list[Path]:
    """The same of tables that are made already."""
    written = []
    for table in made:
        stem = Path(folder) / "tables" / table.name
        for suffix, write in TEXT_WRITERS.items():
            written.append(stem.with_suffix(f".{suffix}"))
            write_text(written[-1], write(table))
        written.append(stem.with_suffix(".json"))
        write_json(written[-1], to_json(table))
    keep_only(written, Path(folder) / "tables")
    return written
