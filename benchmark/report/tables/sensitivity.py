"""Make the tables of the same data with other settings: sweeps, and soft scores reduced to labels."""

from __future__ import annotations

import math
from collections.abc import Callable

from semstab.data.measures import VSS, measures
from semstab.data.records import Record, Result
from semstab.report.means import (
    ENOUGH,
    Level,
    Pooled,
    Sweep,
    by_model,
    complete_scenes,
    levels,
    over_all,
    over_recurrent,
    swept,
)
from semstab.report.tables.stability import SBD_OVER, of_measures
from semstab.report.tables.table import ALL_VOXELS, Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA, PSA, VOXEL_ALPHA

# The sensitivity sweeps: means of all voxels and of the recurrent ones side by side, with their share.


def sensitivity(result: Result) -> list[Table]:
    """Return one table for each sweep (paper, Sensitivity to World-Space Association)."""
    return [_table(result, sweep) for sweep in swept(result)]


AGREEMENT = (
    " PSA, alpha and SBD excess are macro means of the scenes, of the voxels seen twice or more. PSA is the share of"
    " pairs of frames that agree about a voxel. Alpha is the agreement of two views at the same spot beyond chance. SBD"
    " excess is SBD minus the SBD of the same observations in random order (bits). These three do not depend on how"
    " often a voxel was seen, but the set of voxels seen twice changes along the sweep."
)
_AGREEMENT: tuple[Callable[[Pooled], float], ...] = (
    lambda p: p.psa.value,
    lambda p: p.alpha.value,
    lambda p: p.excess_drift,
)


def _table(result: Result, sweep: Sweep) -> Table:
    models = [name for name in result.models if complete_scenes(result, sweep.name, name)]
    by_model = {name: levels(result, sweep.name, name) for name in models}
    assessed = any(level.assessed for of_model in by_model.values() for level in of_model)
    agreement = (
        *(Column.for_quantity(quantity, compared=True) for quantity in (PSA, ALPHA)),
        Column("sbd_excess_op2", "SBD excess (OP>=2)", 4, signed=True),
    )
    columns = (
        Column("value", sweep.header),
        Column("repeats", "Repeats", 0),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        *of_measures(compared=True, over=ALL_VOXELS),
        *of_measures(compared=True, over="OP>=3"),
        *(agreement if assessed else ()),
        Column("note", "Note"),
    )
    groups = tuple(
        Group(name, tuple(_sweep_row(sweep, level, assessed=assessed) for level in of_model))
        for name, of_model in by_model.items()
    )
    scenes = dict.fromkeys(scene for name in models for scene in complete_scenes(result, sweep.name, name))
    caption = (
        f"The means are pooled: they run over the voxels of all scenes together ({', '.join(scenes)}); ± is the"
        f" standard deviation over the repeats, each with a seed of its own. {SBD_OVER} The note 'few' marks fewer than"
        f" {ENOUGH:,} recurrent voxels."
    )
    if assessed:
        caption += AGREEMENT
    return Table(f"sensitivity_{sweep.name}", f"Sensitivity to {sweep.title}", caption, columns, groups)


def _sweep_row(sweep: Sweep, level: Level, *, assessed: bool) -> Row:
    spread = level.spread if len(level.repeats) > 1 else level.mean
    return (
        sweep.text(level.value),
        len(level.repeats),
        level.mean(lambda p: p.voxels),
        level.mean(lambda p: p.mean_op),
        spread(lambda p: 100 * p.recurrent.share),
        *(spread(over_all(measure)) for measure in measures()),
        *(spread(over_recurrent(measure)) for measure in measures()),
        *([spread(take) for take in _AGREEMENT] if assessed else []),
        "" if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH else "few",
    )


# The same map with soft scores reduced to labels.


def reduced(result: Result) -> list[Table]:
    """Return numbers that compare hard labels with soft scores, which are reduced to each pixel's likeliest class."""
    records = result.select()
    if len({record.reduced is None for record in records}) < 2:
        return []
    columns = (
        Column("scene", "Scene"),
        Column("vss_all", "VSS, all voxels", VSS.digits[0], VSS.better),
        Column.for_quantity(VSS),
        Column.for_quantity(VOXEL_ALPHA),
    )
    groups = tuple(
        Group(name, tuple(_reduced_row(record) for record in rows)) for name, rows in by_model(records).items()
    )
    caption = (
        "VSS, entropy and voxel alpha do not compare hard labels with soft scores, because scores spread their"
        " evidence; alpha is of the likeliest classes. Here scores are reduced to each pixel's likeliest class; labels"
        " are unchanged."
    )
    return [Table("reduced", "Labels and reduced scores", caption, columns, groups)]


def _reduced_row(record: Record) -> Row:
    reduced, table, statistics = record.reduced, record.map_summary, record.statistics
    if reduced is not None:
        return record.unit.scene, reduced.vss_all, reduced.vss_op3, reduced.voxel_alpha_op2
    alpha = math.nan if statistics is None else statistics.agreement.voxel_alpha_op2.value
    return record.unit.scene, table[VSS], table.recurrent[VSS], alpha
