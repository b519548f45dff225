"""Make the tables of stability in the world: by model, by scene, by persistence, by class, and in one taxonomy."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.config import SHARED
from semstab.data.measures import SBD, VSS, measures
from semstab.data.records import Record, Result
from semstab.data.results import Means, TableSummary
from semstab.metrics import macro_mean, split_last
from semstab.report.means import ENOUGH, by_model, pooled
from semstab.report.tables.table import ALL_VOXELS, OF_ROW, Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA

VOXELS = Column("voxels", "Voxels", 0)
SHARE = Column("share_percent", "Voxels (%)", 2)
SBD_OVER = "Means of SBD (bits) run over the voxels seen twice or more."


def of_measures(*, over: str, compared: bool = False) -> list[Column]:
    """Return a column for each measure under its population `over`; the paper prints more decimals to compare."""
    return [Column.for_quantity(measure, compared=compared, over=over) for measure in measures()]


def settings(records: Sequence[Record]) -> str:
    """Return the voxel sizes and taxonomies of the units, as a sentence."""
    sizes = sorted({record.map_summary.voxel_size for record in records})
    spaces = dict.fromkeys(f"{record.taxonomy} (K = {record.map_summary.K})" for record in records)
    return f"Voxels measure {', '.join(f'{size:g}' for size in sizes)} m; the taxonomy is {', '.join(spaces)}."


def comparable(result: Result) -> tuple[Record, ...]:
    """Return records of several models in one taxonomy.

    They are the records fused for it, else the base records if these share a taxonomy.
    """
    records = result.select(SHARED) or result.select()
    several = len(by_model(records)) > 1
    return records if several and len({record.taxonomy for record in records}) == 1 else ()


# The overview of the models has alpha, the means of all voxels and of the recurrent ones, and their share.

_HEADLINES = (VSS, SBD)
"""The two measures of the paper: an overview has no room for all."""

_COLUMNS = (
    Column("model", "Model"),
    Column.for_quantity(ALPHA),
    Column("once_percent", "Seen once (%)", 2),
    Column("recurrent_percent", "OP>=3 (%)", 2),
    *(Column.for_quantity(measure, over=ALL_VOXELS) for measure in _HEADLINES),
    *(Column.for_quantity(measure, over="OP>=3") for measure in _HEADLINES),
    Column("flicker_percent", "Pixel flicker (%)", 2, "lower"),
    Column("compensated_flicker_percent", "Flicker (%)", 2, "lower"),
)


def overview(result: Result) -> list[Table]:
    """Return one row for each model."""
    records = result.select()
    if not records:
        return []
    rows = tuple(_row(name, of_model) for name, of_model in by_model(records).items())
    caption = (
        f"{settings(records)} The means are pooled over the voxels of all scenes; alpha and flicker are macro means of"
        f" the scenes; pixel flicker includes the camera's motion. {SBD_OVER}"
    )
    return [Table("overview", "Overview", caption, _COLUMNS, (Group("", rows),), by="")]


def _row(model: str, records: Sequence[Record]) -> Row:
    voxels = pooled(records)
    return (
        model,
        voxels.alpha.value,
        100 * voxels.once,
        100 * voxels.recurrent.share,
        *(voxels.every[measure] for measure in _HEADLINES),
        *(voxels.recurrent[measure] for measure in _HEADLINES),
        macro_mean([record.image_space.flicker_percent for record in records]),
        macro_mean([record.image_space.compensated_flicker_percent for record in records]),
    )


def scenes(result: Result) -> list[Table]:
    """Return the multi-scene table.

    It has each scene, then totals and macro means (paper, Multi-Scene Voxel-Level Stability).
    """
    records = result.select()
    if not records:
        return []
    columns = (
        Column("scene", "Scene"),
        VOXELS,
        Column("points", "Sampled Points", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(over=ALL_VOXELS),
    )
    groups = tuple(
        Group(name, tuple(_scene_row(record) for record in rows), _scene_total(rows) if len(rows) > 1 else None)
        for name, rows in by_model(records).items()
    )
    caption = (
        f"{settings(records)} A scene's numbers are means over its voxels. Total / Mean has the total voxels and"
        f" points, and macro means of the rest, in which each scene counts once. {SBD_OVER}"
    )
    return [Table("scenes", "Stability by scene", caption, columns, groups)]


def _scene_row(record: Record) -> Row:
    table = record.map_summary
    return record.unit.scene, table.voxels, table.points, table.mean_op, *table.means.of_all()


def _scene_total(records: Sequence[Record]) -> Row:
    tables = [record.map_summary for record in records]
    return (
        "Total / Mean",
        sum(table.voxels for table in tables),
        sum(table.points for table in tables),
        macro_mean([table.mean_op for table in tables]),
        *_macro(tables),
    )


def _macro(tables: Sequence[TableSummary]) -> list[float]:
    """Return the macro mean of each measure."""
    return [macro_mean([table[measure] for table in tables]) for measure in measures()]


def persistence(result: Result) -> list[Table]:
    """Return the persistence strata, the voxels of all scenes pooled (paper, Observation Persistence)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("persistence", "Persistence"), VOXELS, SHARE, *of_measures(over=OF_ROW))
    groups = []
    for name, of_model in by_model(records).items():
        together = pooled(of_model)
        rows = (*together.strata, *together.well_seen)
        groups.append(Group(name, tuple(_means_row(row) for row in rows), _means_row(together.recurrent)))
    caption = (
        f"{settings(records)} The means are pooled: they run over the voxels of all scenes together. The last row is"
        " the recurrent voxels. A voxel seen once has no SBD; if its pixels agree, its VSS is 1 and its entropy is 0."
    )
    if any(split_last([record.map_summary for record in of_model]) for of_model in by_model(records).values()):
        caption += " If most voxels are in the last stratum, its parts follow."
    return [Table("persistence", "Stability by observation persistence", caption, columns, tuple(groups))]


def _means_row(row: Means) -> Row:
    return row.name, row.voxels, 100 * row.share, *row.means.of_all()


def classes(result: Result) -> list[Table]:
    """Return the dominant classes, the voxels of all scenes pooled (paper, Class-wise Stability)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("class", "Class"), VOXELS, *of_measures(over=ALL_VOXELS), Column("note", "Note"))
    groups = tuple(
        Group(name, tuple(_class_row(row) for row in pooled(rows).classes)) for name, rows in by_model(records).items()
    )
    caption = (
        f"{settings(records)} The means are pooled: they run over the voxels of all scenes that the class dominates."
        f" {SBD_OVER} A rare class has fewer than {ENOUGH:,} voxels, too few to compare."
    )
    return [Table("classes", "Stability by dominant class", caption, columns, groups)]


def _class_row(row: Means) -> Row:
    note = "" if row.voxels >= ENOUGH else "rare" if row.voxels else "absent"
    return row.name, row.voxels, *row.means.of_all(), note


def cross_model(result: Result) -> list[Table]:
    """Return the models in one taxonomy.

    The means are over all voxels and over the recurrent ones (paper, Cross-Model Temporal Stability).
    """
    records = comparable(result)
    if not records:
        return []
    columns = (Column("over", "Means over"), VOXELS, SHARE, *of_measures(over=OF_ROW, compared=True))
    groups = tuple(Group(name, _comparison_rows(rows)) for name, rows in by_model(records).items())
    caption = (
        f"{settings(records)} In a macro mean each scene counts once; a pooled mean runs over the voxels of all scenes"
        " together. Compare the recurrent voxels (OP>=3) with the pooled row, and their share between models."
        f" {SBD_OVER}"
    )
    return [Table("cross_model", "Models in one taxonomy", caption, columns, groups)]


def _comparison_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    tables, together = [record.map_summary for record in records], pooled(records)
    return (
        ("all voxels, macro", together.voxels, 100.0, *_macro(tables)),
        ("all voxels, pooled", *_means_row(together.every)[1:]),
        ("OP>=3, pooled", *_means_row(together.recurrent)[1:]),
    )
