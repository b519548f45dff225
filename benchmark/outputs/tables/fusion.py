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


def compared(result: Result) -> list[Table]:
    """Where a backend that associates pixels and voxels in another way leaves the base one's map."""
    if not result.compared:
        return []
    titles = {"op": "OP", **{measure.key: measure.title for measure in measures() if not measure.lowest_op > 1}}
    columns = (
        Column("scene", "Scene"),
        Column("backbone", "Backbone"),
        Column("first_only_percent", "in the first only (%)", 1, over="Voxels"),
        Column("other_only_percent", "in the other only (%)", 1, over="Voxels"),
        Column("relabelled_percent", "Other label (%)", 2),
        *(Column(f"mean_{name}", header, 4, over="Mean difference") for name, header in titles.items()),
    )
    pairs = dict.fromkeys(row.backends for row in result.compared)
    groups = tuple(
        Group(" and ".join(pair), tuple(_compared_row(row, titles) for row in result.compared if row.backends == pair))
        for pair in pairs
    )
    caption = (
        "The same frames through code that associates pixels and voxels in another way, and need not agree. Labels and"
        " differences, which have no sign, are of the voxels that both maps have."
    )
    return [Table("fusion_compared", "Where fusion implementations differ", caption, columns, groups, "backends")]


def _compared_row(row: Agreement, names: Iterable[str]) -> Row:
    shares = (100 * only / max(1, n) for only, n in zip(row.only_in, row.voxels, strict=True))
    means = (row.differences[name].mean for name in names)
    return row.scene, row.backbone, *shares, 100 * row.differences["label"].mean, *means


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
    if one_in := {row.one_in for row in result.agreement} - {1}:
        caption += f" Against the numpy reference one voxel in {max(one_in)} was compared, drawn at random."
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
