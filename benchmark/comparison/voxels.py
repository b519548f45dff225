"""The voxels that all of several maps hold, tile by tile, and how much of each map they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Int64, Mask
from semstab.data.contrast import MapCoverage
from semstab.data.events import Events
from semstab.data.measures import RECURRENT
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import shared_rows
from semstab.statistics.drift import streams

Tables = Mapping[str, VoxelTable]


def held(tables: Tables) -> Int64:
    """Return (M, 6): each map's (part's) voxels, observations, repeated and recurrent voxels, common ones, own ones."""
    common = len(shared_rows(*tables.values())[0])
    rows = []
    for name, table in tables.items():
        elsewhere = np.zeros(len(table), dtype=np.bool_)
        for other in (t for n, t in tables.items() if n != name):
            elsewhere[shared_rows(table, other)[0]] = True
        often = [np.count_nonzero(table.op >= least) for least in (2, RECURRENT)]
        rows.append([len(table), table.op.sum(dtype=np.int64), *often, common, np.count_nonzero(~elsewhere)])
    return np.array(rows, dtype=np.int64)


def coverage_of(names: Sequence[str], parts: Sequence[Int64]) -> tuple[MapCoverage, ...]:
    """Return coverage of the maps by what their parts have, see `held`."""
    return tuple(
        MapCoverage(
            model=name,
            voxels=n,
            observations=observations,
            mean_op=observations / n if n else math.nan,
            repeated=repeated,
            recurrent=recurrent,
            common_share=common / n if n else math.nan,
            alone=alone,
        )
        for name, (n, observations, repeated, recurrent, common, alone) in zip(
            names, np.sum(parts, axis=0).tolist(), strict=True
        )
    )


def repeated_rows(tables: Tables) -> list[Int64]:
    """Return rows of the voxels that every map saw twice or more, one array per map, in the same order of voxels."""
    rows = shared_rows(*tables.values())
    again = np.all([table.op[r] >= 2 for table, r in zip(tables.values(), rows, strict=True)], axis=0)
    return [r[again] for r in rows]


@dataclass(frozen=True, eq=False)
class Region:
    """Several models' maps of a scene, or a part of it, their logs, and the ground truth; share: of all voxels."""

    tables: Tables
    events: Mapping[str, Events] | None = None
    truth: VoxelTable | None = None
    share: float = 1.0


Regions = Callable[[], Iterable[Region]]
"""A function that yields the regions of a scene at each call: none stays in memory."""


MOST = 1 << 22
"""Most voxels in memory at a time: of more common voxels a sample is compared."""


def share_of(voxels: int) -> float:
    """Return the largest power of 1/2 whose product with the number of voxels is at most MOST."""
    return 1.0 if voxels <= MOST else 2.0 ** -math.ceil(math.log2(voxels / MOST))


def in_share(table: VoxelTable, share: float) -> Mask:
    """Return the mask (n,) of voxels in the sample that is this share of all, by a hash of their index."""
    if share >= 1:
        return np.ones(len(table), np.bool_)
    in_sample: Mask = streams(table, slice(None), 0) >> np.uint64(11) < np.uint64(share * 2**53)
    return in_sample


def common_voxels(regions: Regions) -> Region:
    """Return the voxels that every map saw twice or more, with logs and ground truth, or a sample of very many."""
    count = sum(len(repeated_rows(region.tables)[0]) for region in regions())
    share, parts = share_of(count), list[Region]()
    for region in regions():
        tables, logs, rows = {}, {}, repeated_rows(region.tables)
        in_sample = in_share(next(iter(region.tables.values())).rows(rows[0]), share)
        for (name, table), table_rows in zip(region.tables.items(), rows, strict=True):
            tables[name] = table.rows(table_rows[in_sample])
            if region.events is not None:
                logs[name] = region.events[name].rows(table_rows[in_sample])
        first, truth = next(iter(tables.values())), region.truth
        true = None if truth is None else truth.rows(shared_rows(truth, first)[0])
        parts.append(Region(tables, logs or None, true))
    tables = {name: VoxelTable.joined([part.tables[name] for part in parts]) for name in parts[0].tables}
    events = [part.events for part in parts if part.events is not None]
    truths = [part.truth for part in parts if part.truth is not None]
    return Region(
        tables,
        {name: Events.joined([log[name] for log in events]) for name in tables} if events else None,
        VoxelTable.joined(truths) if truths else None,
        share,
    )
