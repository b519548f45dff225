"""From a map and its log to the sums by frame and cube of space, in one pass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.matching import voxel_keys
from semstab.model.measures import dominant, entropy, vss
from semstab.model.results import RECURRENT
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import ONE_HOT, psa
from semstab.statistics.sampling.influence import MOST_CELLS, MOST_CLASSES, MOST_GROUPS, InfluenceSums, layout
from semstab.statistics.steady import steady

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]


def influence_sums(
    table: VoxelTable, events: Events | None = None, true_label: Int64 | None = None, *, edge: float | None = None
) -> InfluenceSums:
    """The sums of a map; without its log each place counts as a whole, and the frames are not known.

    true_label (n,) is the true class of each voxel, -1 where it is not known; `edge` the cubes' edge in metres, a power
    of 2, where several maps are to have the same: else the smallest that leaves at most MOST_CELLS.
    """
    again = np.flatnonzero(table.op >= 2)
    edge = cell_edge(table) if edge is None else edge
    at = np.floor((table.index[again] + 0.5) * (table.voxel_size / edge)).astype(np.int64)
    (key,) = voxel_keys(at)
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    if events is None:
        step, frames = 0, np.array([-1])
        sums = _sums_of_table(table, again, of, len(first), true_label)[:, None]
    else:
        step = _step(events.frame)
        frames, group = np.unique(events.frame // step, return_inverse=True)
        sums = _sums_of_log(table, events, again, of, len(first), group, len(frames), true_label)
    cell, frame = np.nonzero(sums[:, :, layout(table.K, truth=False)["observations"].start])
    return InfluenceSums(
        cell=at[first[cell]].astype(np.int32),
        frame=frames[frame].astype(np.int32),
        columns=sums[cell, frame],
        edge=edge,
        step=step,
        voxel_size=table.voxel_size,
        K=table.K,
        classes=table.classes,
        truth=true_label is not None,
    )


def cell_edge(table: VoxelTable) -> float:
    """The smallest power of 2, in metres and no smaller than a voxel, that leaves at most MOST_CELLS cubes."""
    index = table.index[table.op >= 2].astype(np.float64) + 0.5
    edge = 2.0 ** math.ceil(math.log2(table.voxel_size) - 1e-9)
    cells = np.floor(index * (table.voxel_size / edge)).astype(np.int64)
    while len(cells := cells[np.unique(voxel_keys(cells)[0], return_index=True)[1]]) > MOST_CELLS:
        cells, edge = cells // 2, 2 * edge
    return edge


def _step(frame: npt.NDArray[np.int32]) -> int:
    step, distinct = 1, np.unique(frame)
    while len(distinct) > MOST_GROUPS:
        step, distinct = 2 * step, np.unique(distinct // 2)
    return step


def _sums_of_log(
    table: VoxelTable,
    events: Events,
    again: Int64,
    of: Int64,
    cells: int,
    group: Int64,
    groups: int,
    true_label: Int64 | None,
) -> Float64:
    """(cells, groups, C) by the compiled pass."""
    from semstab.statistics.kernels import in_chunks
    from semstab.statistics.sampling import loops

    columns = layout(table.K, truth=true_label is not None)
    sums = np.zeros((cells, groups, max(part.stop for part in columns.values())))
    order = again[np.argsort(of, kind="stable")]
    bounds = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=cells))])
    truth = np.full(len(table), -1) if true_label is None else true_label
    likely = np.zeros(len(table)) if true_label is None else np.nan_to_num(steady(table))
    options = (table.K <= MOST_CLASSES, true_label is not None)
    in_chunks(
        loops.add_influences,
        order,
        bounds,
        events.starts,
        table.op,
        events.evidence.entries,
        table.K,
        group,
        truth,
        likely,
        *options,
        sums,
    )
    return sums


def _sums_of_table(table: VoxelTable, again: Int64, of: Int64, cells: int, true_label: Int64 | None) -> Float64:
    """(cells, C) from the voxels' rows alone; sums by class are NaN for evidence that is not one-hot."""
    T, e = table.op[again].astype(np.float64), table.evidence[again]
    agreement, recurrent = psa(table)[again], (table.op[again] >= RECURRENT).astype(np.float64)
    twice = np.where(T == 2, T, 0.0)
    values: dict[str, npt.NDArray[Any]] = {
        "voxels": np.ones(len(T)), "psa": agreement, "observations": T, "agreeing": T * agreement,
        "own": table.self_sum[again], "twice": twice, "twice_agreeing": twice * agreement, "recurrent": recurrent,
        "vss": recurrent * vss(table)[again], "entropy": entropy(table)[again], "evidence": e,
    }  # fmt: skip
    if table.K <= MOST_CLASSES:
        one_hot = (np.abs(table.self_sum - table.op) <= ONE_HOT * table.op)[again].all()
        squares = e if one_hot else np.full_like(e, np.nan)
        values["class_own"] = squares
        values["class_apart"] = 2 * ((T[:, None] - 1) * e - e**2 + squares) / (T[:, None] - 1)
    if true_label is not None:
        label = true_label[again]
        known, right = label >= 0, label == dominant(table)[again]
        stable = known * np.nan_to_num(steady(table))[again] * recurrent
        looks = np.take_along_axis(e, np.maximum(label, 0)[:, None], axis=1)[:, 0]
        values |= {
            "known": known, "right": known & right, "looks": known * T, "looks_right": known * looks,
            "stable": stable, "stable_wrong": stable * ~right,
        }  # fmt: skip
        if table.K <= MOST_CLASSES:
            true = (label[:, None] == np.arange(table.K)).astype(np.float64)
            values |= {"class_known": true, "class_right": true * right[:, None]}
    names = layout(table.K, truth=true_label is not None)
    columns = np.concatenate([np.asarray(values[name], float).reshape(len(T), -1) for name in names], axis=1)
    return np.stack([np.bincount(of, weights=column, minlength=cells) for column in columns.T], axis=1)
