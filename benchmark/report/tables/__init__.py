"""Make the study's tables: CSV, Markdown and LaTeX are rounded as in the paper, JSON has full precision."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from semstab.core.files import keep_only, write_json, write_text
from semstab.data.records import Result
from semstab.report.filter_study import of_interest
from semstab.report.tables.backends import agreement, compared, fusion
from semstab.report.tables.correctness import ceiling, correctness, correlogram
from semstab.report.tables.filters import filter_tables
from semstab.report.tables.flicker import flicker
from semstab.report.tables.paper import paper
from semstab.report.tables.sensitivity import reduced, sensitivity, voxel_sizes
from semstab.report.tables.stability import classes, cross_model, overview, persistence, scenes
from semstab.report.tables.statistics import (
    class_agreement,
    drift,
    frames,
    ranges,
    temporal_agreement,
    uncertainty,
    verdicts,
)
from semstab.report.tables.table import TEXT_WRITERS, Cell, Column, Group, Table, to_csv, to_json, to_latex, to_markdown
from semstab.report.tables.video_measures import video_measures

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
    overview, paper, verdicts, flicker, video_measures, scenes, persistence, classes, temporal_agreement, correlogram,
    class_agreement, ranges, drift, frames, uncertainty, ceiling, correctness, cross_model, sensitivity,
    voxel_sizes, reduced, fusion, compared, agreement,
)  # fmt: skip
"""The functions that make tables, in the paper's order; without numbers for its tables a function returns none."""


def tables(result: Result) -> list[Table]:
    """Return every table that the study has records for, in the paper's order."""
    shown = of_interest(result)
    made = [*filter_tables(result), *(table for build in BUILDERS for table in build(shown))]
    words = f" Benchmark {result.benchmark}." if result.benchmark else ""
    if n := len(result.failures):
        words += f" Without {n} unit{'' if n == 1 else 's'} that failed."
    return [dataclasses.replace(table, caption=table.caption + words, benchmark=result.benchmark) for table in made]


def write_tables(result: Result, folder: str | Path) -> list[Path]:
    """Write FOLDER/tables/NAME.{csv,md,tex,json} for every table, remove all other tables; return the paths."""
    return save_tables(tables(result), folder)


def save_tables(made: Sequence[Table], folder: str | Path) -> list[Path]:
    """Write tables that are made already, as `write_tables` does; return the paths."""
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
