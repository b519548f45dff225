"""What the statistics of a map without log and ground truth are functions of: sums that add up over its parts."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.metrics.summary import STRATA, TableSums
from semstab.model.evidence import stretches
from semstab.model.measures import sbd, vss
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.agreement import class_sums, disagreement, psa
from semstab.statistics.order.drift import expected_sbd
from semstab.statistics.sampling import InfluenceSums, Places, PlaceSums, influence_sums, merged
from semstab.statistics.uncertainty import decompose

Float64 = npt.NDArray[np.float64]
Maps = dict[str, npt.NDArray[Any]]

BY_STRATUM = ("psa", "sbd_null", "sbd_excess", "entropy_within", "entropy_between")
"""Maps of which strata have the mean."""


@dataclass(frozen=True, eq=False)
class MapSums:
    """Those of a map.

    table      sums of the measures
    places     sums over cubes of space, of the voxels with OP >= 2; see `_place_sums`
    strata     (2 * len(BY_STRATUM), strata) sum of each map, and over how many voxels it runs
    classes    (S, K) sums by class, see `class_sums`
    influence  those that intervals and comparisons rest on
    """

    table: TableSums
    places: PlaceSums
    strata: Float64
    classes: Float64
    influence: InfluenceSums

    @classmethod
    def of(
        cls,
        table: VoxelTable,
        edges: Sequence[int] = STRATA,
        *,
        events: Events | None = None,
        true_label: npt.NDArray[np.int64] | None = None,
        null: Float64 | None = None,
    ) -> MapSums:
        """Those of a table, some voxels after the others.

        events      its log, with which null (n,) comes, the SBD of its voxels in random order
        true_label  (n,) the true classes; how likely places are stable only the whole map tells: `StableLooks`
        """
        alone = events is None and true_label is None
        parts = (
            cls._of_few(table.rows(some), None if null is None else null[some], edges, alone=alone)
            for some in stretches(len(table))
        )
        found = functools.reduce(lambda one, other: cls.merged([one, other]), parts)
        if alone:
            return found
        excess = sbd(table) - (expected_sbd(table) if null is None else null)
        by_frame = influence_sums(table, events, true_label, sbd_excess=excess, edge=found.places.edge, likely=None)
        return replace(found, classes=class_sums(table, events), influence=by_frame)

    @classmethod
    def _of_few(cls, table: VoxelTable, null: Float64 | None, edges: Sequence[int], *, alone: bool) -> MapSums:
        """Without what its log or its true classes tell better, unless it is alone."""
        maps = maps_of(table, null=expected_sbd(table) if null is None else null)
        some = table if alone else table.rows(slice(0, 0))
        places = Places(table.index[table.op >= 2], table.voxel_size)
        return cls(
            TableSums.of(table, edges),
            place_sums(table, maps, places),
            stratum_sums(table, maps, edges),
            class_sums(table),
            influence_sums(some, sbd_excess=maps["sbd_excess"][: len(some)], edge=places.edge),
        )

    @classmethod
    def merged(cls, parts: Sequence[MapSums]) -> MapSums:
        """Those of a map from its parts."""
        return cls(
            functools.reduce(operator.add, (part.table for part in parts)),
            PlaceSums.merged([part.places for part in parts]),
            np.sum([part.strata for part in parts], axis=0),
            _class_sums([part.classes for part in parts]),
            merged(*(part.influence for part in parts)),
        )

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All of it by name, as `read` takes it."""
        influence = {f"influence {name}": getattr(self.influence, name) for name in ("cell", "frame", "columns")}
        return {
            **self.table.arrays(),
            **{f"places {name}": value for name, value in self.places.sums.items()},
            **influence,
            "place cells": self.places.cell,
            "strata": self.strata,
            "classes": self.classes,
            "about": np.array([self.places.edge, self.influence.edge, self.influence.step, self.influence.voxel_size]),
            "truth": np.array(self.influence.truth),
        }

    @classmethod
    def read(cls, arrays: Mapping[str, npt.NDArray[Any]], classes: tuple[str, ...]) -> MapSums:
        """From its arrays, and the names of the classes."""
        edge, cube, step, voxel_size = (float(value) for value in arrays["about"])
        places = {name.removeprefix("places "): value for name, value in arrays.items() if name.startswith("places ")}
        cell, frame, columns = (arrays[f"influence {name}"] for name in ("cell", "frame", "columns"))
        K = arrays["classes"].shape[1]
        return cls(
            TableSums.read(arrays),
            PlaceSums(arrays["place cells"], edge, places),
            arrays["strata"],
            arrays["classes"],
            InfluenceSums(cell, frame, columns, cube, int(step), voxel_size, K, classes, bool(arrays["truth"])),
        )


def maps_of(table: VoxelTable, null: Float64) -> Maps:
    """Numbers of each voxel (n,) that need nothing but its row; null is its SBD expected in random order."""
    within, between = disagreement(table)
    parts = decompose(table)
    return {
        "psa": psa(table),
        "disagreement_within": within,
        "disagreement_between": between,
        "sbd_null": null,
        "sbd_excess": sbd(table) - null,
        "entropy_within": parts.within,
        "entropy_between": parts.between,
    }


def mean_columns(values: Float64) -> Float64:
    """(n, 2): what the mean of values (n,) where they are defined is a function of by its sum."""
    defined = ~np.isnan(values)
    return np.stack([np.where(defined, values, 0.0), defined], axis=1)


def place_sums(table: VoxelTable, maps: Maps, places: Places) -> PlaceSums:
    """Over the cubes of the voxels with OP >= 2: what means and agreement beyond chance are functions of."""
    again = table.op >= 2
    own = {name: values[again] for name, values in maps.items()}
    T, known, op = table.op[again].astype(np.float64), ~np.isnan(own["sbd_null"]), table.op[again]
    means = {
        "psa": own["psa"],
        "vss": vss(table)[again],
        "sbd": np.where(known, sbd(table)[again], np.nan),
        "null": own["sbd_null"],
        "excess": own["sbd_excess"],
        "steadier": np.where(op > 2, -own["sbd_excess"], np.nan),
        "entropy": own["entropy_within"] + own["entropy_between"],
        "entropy_within": own["entropy_within"],
        "entropy_between": own["entropy_between"],
    }
    columns = {name: mean_columns(values) for name, values in means.items()}
    columns |= {name: np.stack([T * own[f"disagreement_{name}"], T], axis=1) for name in ("within", "between")}
    coin = [np.stack([own["psa"] * where, where], axis=1) for where in (op == 2, op > 2)]
    columns["coin"] = np.concatenate(coin, axis=1)
    sums = {name: places.sums(values) for name, values in columns.items()}
    evidence, every, self_sum = table.evidence.take(again), np.ones(len(T)), table.self_sum[again]
    by_look, by_place = places.sums_by_class(evidence, every), places.sums_by_class(evidence, 1 / T)
    further = {
        "kappa": ([own["psa"], every], by_place),  # as of `kappa_columns`, and of `alpha_columns` twice
        "alpha": ([T * own["psa"], T, self_sum], by_look),
        "each_place": ([own["psa"], every, self_sum / T], by_place),
    }
    for name, (values, by_class) in further.items():
        sums[name] = np.concatenate([places.sums(np.stack(values, axis=1)), by_class], axis=1)
    return PlaceSums(places.cell, places.edge, sums)


def stratum_sums(table: VoxelTable, maps: Maps, edges: Sequence[int]) -> Float64:
    """(2 * len(BY_STRATUM), strata) of maps: their sums, and how often each is defined."""
    group, count = np.searchsorted(edges, table.op), len(edges) + 1
    columns = np.concatenate([mean_columns(maps[name]) for name in BY_STRATUM], axis=1)
    return np.stack([np.bincount(group, weights=column, minlength=count) for column in columns.T])


def _class_sums(parts: Sequence[Float64]) -> Float64:
    """Where the evidence of one part does not tell how frames agree on a class, that of all does not."""
    total: Float64 = np.sum(parts, axis=0)
    if np.isnan(total).any():
        total[2:5, total[0] > 0] = np.nan
    return total
