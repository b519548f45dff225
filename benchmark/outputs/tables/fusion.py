"""The fusion implementations: the same frames through every backend, and how far each moves the measures."""

from __future__ import annotations

from collections.abc import Iterable

from semstab.config import BACKENDS
from semstab.model.measures import measures
from semstab.model.records import Record, Result
from semstab.model.results import Agreement
from semstab.outputs.averages import Pooled, pooled
from semstab.outputs.tables.stability import SBD_OVER, of_measures, settings
from semstab.outputs.tables.table import Column, Group, Row, Table

DIFFERENCE = "Difference to the first"
LARGEST = "Largest difference"


def fusion(result: Result) -> list[Table]:
    """Each backend beside the base one, over the scenes that every backend fused."""
    groups = tuple(group for name in result.backbones if (group := _group(result, name)) is not None)
    if not groups:
        return []
    columns = (
        Column("backend", "Backend"),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(compared=True),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        Column("fuse_ms_per_frame", "ms a frame", 1, "lower"),
        Column("delta_voxels", "Voxels", 0, signed=True, over=DIFFERENCE),
        Column("delta_mean_op", "OP", 2, signed=True, over=DIFFERENCE),
        *(Column(f"delta_{m.key}", m.title, m.digits[1], signed=True, over=DIFFERENCE) for m in measures()),
    )
    caption = (
        f"{settings(result.select())} Pooled: the means run over the voxels of all scenes together; ms a frame is the"
        f" macro mean. The base backend stands first. {SBD_OVER}"
    )
    return [Table("fusion", "Fusion implementations", caption, columns, groups)]


def agreement(result: Result) -> list[Table]:
    """How far each backend's map agrees with the base one's, voxel by voxel."""
    if not result.agreement:
        return []
    titles = {"op": "OP", **{measure.key: measure.title for measure in measures()}, "evidence": "Evidence"}
    columns = (
        Column("scene", "Scene"),
        Column("backbone", "Backbone"),
        Column("only_in_one", "Voxels in one only", 0),
        *(Column(f"max_{name}", header, 0, scientific=True, over=LARGEST) for name, header in titles.items()),
        Column("verdict", "Verdict"),
    )
    pairs = dict.fromkeys(row.backends for row in result.agreement)
    rows = [(row.backends, _agreement_row(row, titles)) for row in result.agreement]
    groups = tuple(Group(" and ".join(pair), tuple(row for of, row in rows if of == pair)) for pair in pairs)
    caption = "The same frames through two backends: the largest difference of any voxel that both maps have."
    return [Table("agreement", "Agreement of the fusion implementations", caption, columns, groups, "backends")]


def _agreement_row(row: Agreement, names: Iterable[str]) -> Row:
    largest = (row.differences[name].max for name in names)
    return row.scene, row.backbone, sum(row.only_in), *largest, "agree" if row.agrees else "disagree"


def _group(result: Result, backbone: str) -> Group | None:
    others = result.select(BACKENDS, backbone=backbone)
    by_backend: dict[str, dict[str, Record]] = {}
    for record in (*result.select(backbone=backbone), *others):
        by_backend.setdefault(record.unit.backend, {})[record.unit.scene] = record
    scenes = set.intersection(*(set(rows) for rows in by_backend.values()))
    if not others or not scenes:
        return None
    found = {name: pooled([row for scene, row in rows.items() if scene in scenes]) for name, rows in by_backend.items()}
    base = found[result.backend]
    return Group(backbone, tuple(_row(name, mean, base) for name, mean in found.items()))


def _row(backend: str, mean: Pooled, base: Pooled) -> Row:
    return (
        backend,
        mean.voxels,
        mean.mean_op,
        *mean.every.means.of_all(),
        100 * mean.recurrent.share,
        mean.fuse_ms_per_frame,
        mean.voxels - base.voxels,
        mean.mean_op - base.mean_op,
        *(mean.every[measure] - base.every[measure] for measure in measures()),
    )
