"""Stability in the world: by scene, by persistence, by class, and of the backbones in one taxonomy."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.config import SHARED
from semstab.metrics import macro_mean, split_last
from semstab.model.measures import measures
from semstab.model.records import Record, Result
from semstab.model.results import Means, TableSummary
from semstab.outputs.averages import ENOUGH, by_backbone, pooled
from semstab.outputs.tables.table import Column, Group, Row, Table

VOXELS = Column("voxels", "Voxels", 0)
SHARE = Column("share_percent", "Voxels (%)", 2)
SBD_OVER = "Means of SBD (bits) run over the voxels seen twice or more."


def of_measures(*, compared: bool = False, prefix: str = "", over: str = "") -> list[Column]:
    """A column a measure: the paper prints more decimals where it compares."""
    return [Column.of(measure, compared=compared, prefix=prefix, over=over) for measure in measures()]


def scenes(result: Result) -> list[Table]:
    """The multi-scene table: each scene, then totals and macro means (paper, Multi-Scene Voxel-Level Stability)."""
    records = result.select()
    if not records:
        return []
    columns = (
        Column("scene", "Scene"),
        VOXELS,
        Column("points", "Sampled Points", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(),
    )
    groups = tuple(
        Group(name, tuple(_scene_row(record) for record in rows), _scene_total(rows) if len(rows) > 1 else None)
        for name, rows in by_backbone(records).items()
    )
    caption = (
        f"{settings(records)} A scene's numbers are means over its voxels. Total / Mean: total voxels and points,"
        f" macro means of the rest, in which each scene counts once. {SBD_OVER}"
    )
    return [Table("scenes", "Stability by scene", caption, columns, groups)]


def persistence(result: Result) -> list[Table]:
    """The persistence strata, the voxels of all scenes pooled (paper, Observation Persistence)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("persistence", "Persistence"), VOXELS, SHARE, *of_measures())
    groups = []
    for name, own in by_backbone(records).items():
        together = pooled(own)
        rows = (*together.strata, *together.well_seen)
        groups.append(Group(name, tuple(_means_row(row) for row in rows), _means_row(together.recurrent)))
    caption = (
        f"{settings(records)} Pooled: the means run over the voxels of all scenes together. The last row is the"
        " recurrent voxels. A voxel seen once has no SBD, and where its pixels agree VSS = 1 and no entropy."
    )
    if any(split_last([record.summary.table for record in own]) for own in by_backbone(records).values()):
        caption += " Where most voxels are in the last stratum, it follows in parts."
    return [Table("persistence", "Stability by observation persistence", caption, columns, tuple(groups))]


def classes(result: Result) -> list[Table]:
    """The dominant classes, the voxels of all scenes pooled (paper, Class-wise Stability)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("class", "Class"), VOXELS, *of_measures(), Column("note", "Note"))
    groups = tuple(
        Group(name, tuple(_class_row(row) for row in pooled(rows).classes))
        for name, rows in by_backbone(records).items()
    )
    caption = (
        f"{settings(records)} Pooled: the means run over the voxels of all scenes that the class dominates."
        f" {SBD_OVER} Rare: fewer than {ENOUGH:,} voxels, too few to compare."
    )
    return [Table("classes", "Stability by dominant class", caption, columns, groups)]


def cross_backbone(result: Result) -> list[Table]:
    """The backbones in one taxonomy: all voxels and the recurrent ones (paper, Cross-Backbone Temporal Stability)."""
    records = comparable(result)
    if not records:
        return []
    columns = (Column("over", "Means over"), VOXELS, SHARE, *of_measures(compared=True))
    groups = tuple(Group(name, _comparison_rows(rows)) for name, rows in by_backbone(records).items())
    caption = (
        f"{settings(records)} Macro: each scene counts once. Pooled: the voxels of all scenes together; compare the"
        f" recurrent voxels (OP>=3) with the pooled row, and their share between backbones. {SBD_OVER}"
    )
    return [Table("cross_backbone", "Backbones in one taxonomy", caption, columns, groups)]


def comparable(result: Result) -> tuple[Record, ...]:
    """Records of several backbones in one taxonomy: those fused for it, else the base ones where they share theirs."""
    records = result.select(SHARED) or result.select()
    several = len(by_backbone(records)) > 1
    return records if several and len({record.summary.taxonomy for record in records}) == 1 else ()


def settings(records: Sequence[Record]) -> str:
    """What the units have in common, as a sentence."""
    sizes = sorted({record.summary.table.voxel_size for record in records})
    spaces = dict.fromkeys(f"{record.summary.taxonomy} (K = {record.summary.table.K})" for record in records)
    return f"Voxels of {', '.join(f'{size:g}' for size in sizes)} m, taxonomy {', '.join(spaces)}."


def _scene_row(record: Record) -> Row:
    table = record.summary.table
    return record.unit.scene, table.voxels, table.points, table.mean_op, *table.means.of_all()


def _scene_total(records: Sequence[Record]) -> Row:
    tables = [record.summary.table for record in records]
    return (
        "Total / Mean",
        sum(table.voxels for table in tables),
        sum(table.points for table in tables),
        macro_mean([table.mean_op for table in tables]),
        *_macro(tables),
    )


def _macro(tables: Sequence[TableSummary]) -> list[float]:
    """The macro mean of each measure."""
    return [macro_mean([table[measure] for table in tables]) for measure in measures()]


def _means_row(row: Means) -> Row:
    return row.name, row.voxels, 100 * row.share, *row.means.of_all()


def _class_row(row: Means) -> Row:
    note = "" if row.voxels >= ENOUGH else "rare" if row.voxels else "absent"
    return row.name, row.voxels, *row.means.of_all(), note


def _comparison_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    tables, together = [record.summary.table for record in records], pooled(records)
    return (
        ("all voxels, macro", together.voxels, 100.0, *_macro(tables)),
        ("all voxels, pooled", *_means_row(together.every)[1:]),
        ("OP>=3, pooled", *_means_row(together.recurrent)[1:]),
    )
