"""The sensitivity sweeps: what all voxels say and what the recurrent ones say, side by side with their share."""

from __future__ import annotations

from semstab.model.measures import SBD, VSS, measures
from semstab.model.records import Result
from semstab.outputs.averages import ENOUGH, Level, Sweep, complete_scenes, levels, over_all, over_recurrent, swept
from semstab.outputs.tables.stability import SBD_OVER, of_measures
from semstab.outputs.tables.table import Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA, PSA


def sensitivity(result: Result) -> list[Table]:
    """One table a sweep (paper, Sensitivity to World-Space Association), and one with what thinning does not change."""
    found = [(_table(result, sweep), _agreement_table(result, sweep)) for sweep in swept(result)]
    return [table for pair in found for table in pair if table is not None]


def _table(result: Result, sweep: Sweep) -> Table:
    columns = (
        Column("value", sweep.header),
        Column("repeats", "Repeats", 0),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        *of_measures(compared=True, over="All voxels"),
        *of_measures(compared=True, prefix="recurrent_", over="OP>=3"),
        Column("note", "Note"),
    )
    backbones = [name for name in result.backbones if complete_scenes(result, sweep.name, name)]
    groups = tuple(
        Group(name, tuple(_row(sweep, level) for level in levels(result, sweep.name, name))) for name in backbones
    )
    scenes = dict.fromkeys(scene for name in backbones for scene in complete_scenes(result, sweep.name, name))
    caption = (
        f"Pooled: the means run over the voxels of all scenes together ({', '.join(scenes)}); ± is the standard"
        f" deviation over the repeats, each with a seed of its own. {SBD_OVER} Few: fewer than {ENOUGH:,} recurrent"
        " voxels."
    )
    return Table(f"sensitivity_{sweep.name}", f"Sensitivity to {sweep.title}", caption, columns, groups)


def _agreement_table(result: Result, sweep: Sweep) -> Table | None:
    """None where the units have no statistics, as in studies of earlier versions."""
    columns = (
        Column("value", sweep.header),
        Column("mean_op", "Mean OP", 2),
        Column("vss", "VSS, all voxels", VSS.digits[1], VSS.better),
        *(Column.of(quantity, compared=True) for quantity in (SBD, PSA, ALPHA)),
        Column("sbd_excess", "SBD excess", 4, signed=True),
    )
    by_backbone = {name: levels(result, sweep.name, name) for name in result.backbones}
    found = {name: rows for name, rows in by_backbone.items() if any(level.judged for level in rows)}
    if not found:
        return None
    groups = tuple(Group(name, tuple(_agreement_row(sweep, level) for level in rows)) for name, rows in found.items())
    caption = (
        "VSS is pooled over the voxels of all scenes; the rest is of those seen twice or more, macro means of the"
        " scenes. PSA: share of pairs of frames that agree about a voxel; alpha: Krippendorff's, the same beyond"
        " chance; SBD excess: SBD less what the same observations give in random order (bits). These three do not"
        " depend on how often a voxel was seen; which voxels were seen twice still changes along the sweep. ± is the"
        " standard deviation over the repeats."
    )
    title = f"Agreement against {sweep.title}"
    return Table(f"sensitivity_agreement_{sweep.name}", title, caption, columns, groups)


def _agreement_row(sweep: Sweep, level: Level) -> Row:
    spread = level.spread if len(level.repeats) > 1 else level.mean
    return (
        sweep.text(level.value),
        level.mean(lambda p: p.mean_op),
        spread(over_all(VSS)),
        spread(lambda p: p.drift.value),
        spread(lambda p: p.psa.value),
        spread(lambda p: p.alpha.value),
        spread(lambda p: p.excess_drift),
    )


def _row(sweep: Sweep, level: Level) -> Row:
    spread = level.spread if len(level.repeats) > 1 else level.mean
    return (
        sweep.text(level.value),
        len(level.repeats),
        level.mean(lambda p: p.voxels),
        level.mean(lambda p: p.mean_op),
        spread(lambda p: 100 * p.recurrent.share),
        *(spread(over_all(measure)) for measure in measures()),
        *(spread(over_recurrent(measure)) for measure in measures()),
        "" if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH else "few",
    )
