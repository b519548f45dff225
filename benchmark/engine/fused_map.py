"""The end of a map: its tables, without what is left out, checked against the reference in parallel."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from semstab.backends.numpy_reference import NumpySample, in_sample
from semstab.core.process import Stopwatch, trim_malloc
from semstab.core.types import Float64
from semstab.data.events import Events
from semstab.data.evidence import stretches
from semstab.data.measures import RECURRENT, dominant, vss
from semstab.data.results import Agreement, UnitName
from semstab.data.voxels import VoxelTable
from semstab.engine.live_maps import LiveMap
from semstab.errors import DataError
from semstab.metrics import compare
from semstab.metrics.agreement import rows_of
from semstab.statistics.agreement import alpha_sums

SMALL = 1 << 30
"""A process with fewer bytes keeps freed memory for the next table, but between tiles: there memory is short."""


class FusedMap(NamedTuple):
    """A map at its end, without the locations whose fused class is left out; reduced: `reduced_sums`, or empty.

    It is checked against the reference in parallel with the statistics.
    """

    table: VoxelTable
    events: Events | None
    truth: VoxelTable | None
    reduced: Float64
    checked: Future[Agreement] | None


def fused_map(live: LiveMap, watch: Stopwatch) -> FusedMap:
    """Return the tables of a map, whose backend is let go: the statistics have its memory."""
    assert live.backend is not None
    config, classes = live.config, live.task.mapping.target.classes
    live.remember_room()
    with watch("table"):
        table = replace(live.backend.table(), classes=classes)
        _check_evidence(table, live.name)
        events = live.backend.events() if config.statistics or config.events else None
        truth = None if live.truth is None else replace(live.truth.table(), classes=classes)
        reduced = np.zeros(0) if live.hard is None else reduced_sums(_left(live, live.hard.table())[0])
        live.backend = live.truth = live.hard = None
    checked = None
    if live.reference is not None:
        checked = live.background.submit(partial(_checked, live, table, live.reference, watch))
    trim_malloc(least=SMALL if live.work.tile is None else 0)
    events = None if events is None else replace(events, classes=classes)
    return FusedMap(*_left(live, table, events), truth, reduced, checked)


OF_OP = 1e-6
"""Largest difference of a voxel's summed evidence from its OP or weight, divided by that."""


def _check_evidence(table: VoxelTable, name: UnitName) -> None:
    """Raise DataError where a backend's evidence of a voxel does not sum to its OP, or to the weight that it states."""
    stated, what = (table.op, "OP") if table.weight is None else (table.weight, "weight")
    starts, _, weight = table.evidence.entries
    for rows in stretches(len(table)):
        first, op = starts[rows], stated[rows]
        total, filled = np.zeros(len(op)), starts[rows.start + 1 : rows.stop + 1] > first
        total[filled] = np.add.reduceat(weight[: starts[rows.stop]], first[filled]) if filled.any() else 0.0
        wrong = np.flatnonzero(~((np.abs(total - op) <= OF_OP * op) & (op > 0)))
        if len(wrong):
            row = rows.start + wrong[0]
            voxel = ", ".join(str(axis[row]) for axis in (table.ix, table.iy, table.iz))
            raise DataError(
                f"{name.scene}, {name.model}: backend '{name.backend}': the evidence of voxel ({voxel}) sums to"
                f" {total[wrong[0]]:g}, and its {what} is {op[wrong[0]]:g}; add one distribution over the classes for"
                " each frame that sees a voxel, or state in the column `weight` what a row sums to"
                " (semstab.testing.BackendConformance finds the mistake)"
            )


def _left(live: LiveMap, table: VoxelTable, events: Events | None = None) -> tuple[VoxelTable, Events | None]:
    """Return the map and its log without the locations whose fused class is left out."""
    if not live.left_out:
        return table, events
    keep = np.flatnonzero(~np.isin(dominant(table), live.left_out))
    return table.rows(keep), None if events is None else events.rows(keep)


def _checked(live: LiveMap, table: VoxelTable, reference: NumpySample, watch: Stopwatch) -> Agreement:
    with watch("reference"):
        expected, one_in = replace(reference.table(), classes=table.classes), reference.one_in
        some_in = [in_sample(np.stack([table.ix[s], table.iy[s], table.iz[s]]), one_in) for s in stretches(len(table))]
        sampled_table = rows_of(table, np.concatenate(some_in))
        units = (live.name, replace(live.name, backend="numpy"))
        return replace(compare(sampled_table, expected, units, tolerance=live.config.tolerance), one_in=one_in)


def reduced_sums(table: VoxelTable) -> Float64:
    """Return the sums over voxels of a map of labels that soft scores were reduced to."""
    values, recurrent = vss(table), table.op >= RECURRENT
    means = [values.sum(), len(values), values[recurrent].sum(), np.count_nonzero(recurrent)]
    return np.concatenate([means, alpha_sums(table)])
