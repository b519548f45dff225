"""The fusion implementations: the same frames through every backend, and how far each moves the measures."""

from __future__ import annotations

from semstab.averages import Pooled, pooled
from semstab.config import BACKENDS
from semstab.records import Record, Result
from semstab.results import Agreement
from semstab.tables.stability import SBD_OVER, settings
from semstab.tables.table import Column, Group, Row, Table

DIFFERENCE = "Difference to the first"
LARGEST = "Largest difference"
_QUANTITIES = (("op", "OP"), ("vss", "VSS"), ("sbd", "SBD"), ("entropy", "Entropy"), ("evidence", "Evidence"))
COLUMNS = (
    Column("backend", "Backend"),
    Column("voxels", "Voxels", 0),
    Column("mean_op", "Mean OP", 2),
    Column("vss", "VSS", 4, "higher"),
    Column("sbd", "SBD", 4, "lower"),
    Column("entropy", "Entropy", 4, "lower"),
    Column("recurrent_percent", "OP>=3 (%)", 2),
    Column("fuse_ms_per_frame", "ms a frame", 1, "lower"),
    Column("delta_voxels", "Voxels", 0, signed=True, over=DIFFERENCE),
    Column("delta_mean_op", "OP", 2, signed=True, over=DIFFERENCE),
    Column("delta_vss", "VSS", 4, signed=True, over=DIFFERENCE),
    Column("delta_sbd", "SBD", 4, signed=True, over=DIFFERENCE),
    Column("delta_entropy", "Entropy", 4, signed=True, over=DIFFERENCE),
)


def fusion(result: Result) -> list[Table]:
    """Each backend beside the base one, over the scenes that every backend fused."""
    groups = tuple(group for name in result.backbones if (group := _group(result, name)) is not None)
    if not groups:
        return []
    caption = (
        f"{settings(result.select())} Pooled: the means run over the voxels of all scenes together; ms a frame is the"
        f" macro mean. The base backend stands first. {SBD_OVER}"
    )
    return [Table("fusion", "Fusion implementations", caption, COLUMNS, groups)]


def agreement(result: Result) -> list[Table]:
    """How far each backend's map agrees with the base one's, voxel by voxel."""
    if not result.agreement:
        return []
    columns = (
        Column("scene", "Scene"),
        Column("backbone", "Backbone"),
        Column("only_in_one", "Voxels in one only", 0),
        *(Column(f"max_{name}", header, 0, scientific=True, over=LARGEST) for name, header in _QUANTITIES),
        Column("verdict", "Verdict"),
    )
    pairs = dict.fromkeys(row.backends for row in result.agreement)
    groups = tuple(
        Group(" and ".join(pair), tuple(_agreement_row(row) for row in result.agreement if row.backends == pair))
        for pair in pairs
    )
    caption = "The same frames through two backends: the largest difference of any voxel that both maps have."
    return [Table("agreement", "Agreement of the fusion implementations", caption, columns, groups, "backends")]


def _agreement_row(row: Agreement) -> Row:
    largest = (row.differences[name].max for name, _ in _QUANTITIES)
    return row.scene, row.backbone, sum(row.only_in), *largest, "agree" if row.agrees else "disagree"


def _group(result: Result, backbone: str) -> Group | None:
    others = result.select(BACKENDS, backbone=backbone)
    by_backend: dict[str, dict[str, Record]] = {}
    for record in (*result.select(backbone=backbone), *others):
        by_backend.setdefault(record.unit.backend, {})[record.unit.scene] = record
    scenes = set.intersection(*(set(rows) for rows in by_backend.values()))
    if not others or not scenes:
        return None
    means = {name: pooled([row for scene, row in rows.items() if scene in scenes]) for name, rows in by_backend.items()}
    base = means[result.backend]
    return Group(backbone, tuple(_row(name, mean, base) for name, mean in means.items()))


def _row(backend: str, mean: Pooled, base: Pooled) -> Row:
    return (
        backend,
        mean.voxels,
        mean.mean_op,
        mean.every.vss,
        mean.every.sbd,
        mean.every.entropy,
        100 * mean.recurrent.share,
        mean.fuse_ms_per_frame,
        mean.voxels - base.voxels,
        mean.mean_op - base.mean_op,
        mean.every.vss - base.every.vss,
        mean.every.sbd - base.every.sbd,
        mean.every.entropy - base.every.entropy,
    )
