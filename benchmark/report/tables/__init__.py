"""Make the tables of a run or a study: CSV, Markdown and LaTeX are rounded as in the paper, JSON has full precision."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from semstab.core.files import keep_only, write_json, write_text
from semstab.data.records import Result
from semstab.errors import ConfigError
from semstab.report.filter_study import of_interest
from semstab.report.tables.backends import agreement, compared, fusion, fusion_correctness
from semstab.report.tables.correctness import ceiling, correctness, correlogram
from semstab.report.tables.features import feature_places, features
from semstab.report.tables.filters import filter_tables
from semstab.report.tables.flicker import flicker
from semstab.report.tables.paper import paper
from semstab.report.tables.prompts import prompts
from semstab.report.tables.sensitivity import reduced, sensitivity
from semstab.report.tables.stability import classes, cross_model, overview, persistence, scenes
from semstab.report.tables.statistics import (
    class_agreement,
    drift,
    frames,
    merges,
    ranges,
    temporal_agreement,
    uncertainty,
    verdicts,
)
from semstab.report.tables.table import TEXT_WRITERS, Cell, Column, Group, Table, to_csv, to_json, to_latex, to_markdown
from semstab.report.tables.video_measures import video_measures

__all__ = [
    "FORMATS",
    "Cell",
    "Column",
    "Group",
    "Table",
    "tables",
    "to_csv",
    "to_json",
    "to_latex",
    "to_markdown",
    "write_run_tables",
    "write_table_file",
    "write_tables",
]

BUILDERS = (
    overview, paper, verdicts, flicker, video_measures, scenes, persistence, classes, temporal_agreement, correlogram,
    class_agreement, merges, prompts, features, feature_places, ranges, drift, frames, uncertainty, ceiling,
    correctness, cross_model, sensitivity, reduced, fusion, fusion_correctness, compared, agreement,
)  # fmt: skip
"""The functions that make tables, in the paper's order; without numbers for its tables a function returns none."""

OF_IMAGES = (flicker, video_measures, frames)
"""Functions of tables that also have rows for videos, which have no map."""

WRITTEN = (
    "filters", "findings", "overview", "verdicts", "features", "prompts", "scenes", "persistence", "classes",
    "class_agreement", "temporal_agreement", "flicker", "ranges", "frames", "correctness", "video_measures",
    "sensitivity", "fusion", "agreement",
)  # fmt: skip
"""The beginnings of the names of the tables that a run writes, the most wanted first; `show` has the others."""

MOST_WRITTEN = 12

FORMATS = (*(f".{suffix}" for suffix in TEXT_WRITERS), ".json")
"""The suffixes of files that hold tables."""


def tables(result: Result) -> list[Table]:
    """Return every table that the study has records for, in the paper's order."""
    relevant = of_interest(result)
    maps = relevant.maps
    built = (table for build in BUILDERS for table in build(relevant if build in OF_IMAGES else maps))
    made = [*filter_tables(result), *built]
    words = f" Benchmark {result.benchmark}." if result.benchmark else ""
    if n := len(result.failures):
        words += f" Without {n} unit{'' if n == 1 else 's'} that failed."
    return [dataclasses.replace(table, caption=table.caption + words, benchmark=result.benchmark) for table in made]


def write_run_tables(result: Result, folder: str | Path) -> list[Path]:
    """Write the tables that users of a run open, at most MOST_WRITTEN, as `write_tables` does; return the paths."""
    made = tables(result)
    selected = dict.fromkeys(table.name for name in WRITTEN for table in made if table.name.startswith(name))
    names = [*selected][:MOST_WRITTEN]
    return write_tables([table for table in made if table.name in names], folder)


def write_tables(made: Sequence[Table], folder: str | Path) -> list[Path]:
    """Write FOLDER/tables/NAME.csv of each table, and tables.json with all; remove other tables; return the paths."""
    target = Path(folder) / "tables"
    written = [write_table_file([table], target / f"{table.name}.csv") for table in made]
    written.append(write_table_file(made, target / "tables.json"))
    keep_only(written, target)
    return written


def write_table_file(made: Sequence[Table], path: Path) -> Path:
    """Write tables into one file, in the format of its suffix: .csv (one table), .json (by name), .md, .tex.

    Raises:
        ConfigError: If there is no such format, or several tables in a CSV file.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path}: tables are written as {', '.join(FORMATS)}")
    if path.suffix == ".csv" and len(made) != 1:
        raise ConfigError(f"{path}: a CSV file has one table; choose one of {', '.join(table.name for table in made)}")
    if path.suffix == ".json":
        write_json(path, {table.name: to_json(table) for table in made})
    else:
        write_text(path, "\n".join(map(TEXT_WRITERS[path.suffix[1:]], made)))
    return path
