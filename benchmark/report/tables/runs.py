"""Many runs at a glance: one row for each model and scene of each run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from semstab.data.measures import SBD, VSS
from semstab.data.records import Record, Result, is_run
from semstab.data.statistics import CONFIDENCE
from semstab.engine.folder import load_result
from semstab.errors import ConfigError
from semstab.report.means import ENOUGH
from semstab.report.tables.statistics import SCENE
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA
from semstab.statistics.correctness import MIOU

COLUMNS = (
    SCENE, Column("model", "Model"), Column("verdict", "Verdict"), Column("probability_percent", "Probability (%)", 0),
    Column.for_quantity(ALPHA), Column("scope", "For"), Column("agree_percent", "Agree (%)", 1, "higher"),
    Column("flicker_percent", "Flicker (%)", 1, "lower"),
    Column.for_quantity(VSS), Column.for_quantity(SBD), Column.for_quantity(MIOU),
    Column("voxel_size", "Voxel (m)", 3), Column("frames", "Frames", 0),
)  # fmt: skip


def found_runs(words: list[Path]) -> dict[str, Result]:
    """Return the finished runs that folders are, or hold, by the shortest names that tell them apart.

    Raises:
        ConfigError: If a folder is no run and holds none, or a run is named twice.
        DataError: As `load_result` does.
    """
    folders: list[Path] = []
    for word in words:
        run_folders = (
            [word] if is_run(word) else sorted(path for path in word.glob("*") if is_run(path)) if word.is_dir() else []
        )
        if not run_folders:
            raise ConfigError(f"{word}: there is no finished run here; give folders of --out, or the folder above them")
        folders += run_folders
    resolved = [folder.resolve() for folder in folders]
    if repeated := next(
        (folder for folder, path in zip(folders, resolved, strict=True) if resolved.count(path) > 1), None
    ):
        raise ConfigError(f"{repeated}: is named twice")
    depth = 1
    while len({path.parts[-depth:] for path in resolved}) < len(resolved):
        depth += 1
    return {"/".join(path.parts[-depth:]): load_result(folder) for path, folder in zip(resolved, folders, strict=True)}


def runs_table(results: Mapping[str, Result]) -> Table:
    """Return one row for each model and scene of each run, at its own settings."""
    caption = (
        "Each row is a model on a scene at the settings of its run; runs differ in what else varies, and only `compare`"
        f" says whether two differ. VSS and SBD are means over voxels with OP >= 3, if a map has {ENOUGH:,} or more."
        f" Brackets hold the interval of alpha at {CONFIDENCE:.0%}, that of the verdict; one for these frames alone"
        " says nothing of another flight, and looks surer than it is."
    )
    groups = tuple(Group(name, tuple(map(_row, result.select()))) for name, result in results.items())
    return Table("runs", "Runs", caption, COLUMNS, groups, "run")


def _row(record: Record) -> Row:
    statistics, unknown = record.statistics, math.nan
    recurrent = record.map_summary.recurrent
    means = [recurrent[measure] if recurrent.voxels >= ENOUGH else unknown for measure in (VSS, SBD)]
    verdict = None if statistics is None else statistics.verdict
    headline = None if statistics is None else statistics.headline
    correct = None if statistics is None else statistics.correctness
    return (
        record.unit.scene, record.unit.model, "" if verdict is None else verdict.decisive,
        unknown if verdict is None else 100 * verdict.decisive_probability,
        unknown if headline is None else headline.alpha,
        "" if headline is None else headline.alpha.scope,
        unknown if statistics is None else 100 * statistics.agreeing, record.image_space.compensated_flicker_percent,
        *means, unknown if correct is None else correct.miou_op2, record.map_summary.voxel_size, record.frames,
    )  # fmt: skip
