"""The backbones at a glance: what all voxels say, what the recurrent ones say, and how many there are."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.metrics import macro_mean
from semstab.model.measures import SBD, VSS
from semstab.model.records import Record, Result
from semstab.outputs.averages import by_backbone, pooled
from semstab.outputs.tables.stability import SBD_OVER, settings
from semstab.outputs.tables.table import Column, Group, Row, Table

_HEADLINES = (VSS, SBD)
"""The paper's two: a glance is no place for all."""

_COLUMNS = (
    Column("backbone", "Backbone"),
    Column("once_percent", "Seen once (%)", 2),
    Column("recurrent_percent", "OP>=3 (%)", 2),
    *(Column.of(measure, over="All voxels") for measure in _HEADLINES),
    *(Column.of(measure, prefix="recurrent_", over="OP>=3") for measure in _HEADLINES),
    Column("flicker_percent", "plain (%)", 2, "lower", over="Flicker"),
    Column("compensated_flicker_percent", "compensated (%)", 2, "lower", over="Flicker"),
)


def glance(result: Result) -> list[Table]:
    """One row a backbone."""
    records = result.select()
    if not records:
        return []
    rows = tuple(_row(name, found) for name, found in by_backbone(records).items())
    caption = (
        f"{settings(records)} Pooled over the voxels of all scenes; flicker is the macro mean of the scenes,"
        f" compensated for camera motion in the last column. {SBD_OVER}"
    )
    return [Table("glance", "Backbones at a glance", caption, _COLUMNS, (Group("", rows),), by="")]


def _row(backbone: str, records: Sequence[Record]) -> Row:
    voxels = pooled(records)
    return (
        backbone,
        100 * voxels.once,
        100 * voxels.recurrent.share,
        *(voxels.every[measure] for measure in _HEADLINES),
        *(voxels.recurrent[measure] for measure in _HEADLINES),
        macro_mean([record.image_space.flicker_percent for record in records]),
        macro_mean([record.image_space.compensated_flicker_percent for record in records]),
    )
