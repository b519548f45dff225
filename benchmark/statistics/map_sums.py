"""What the statistics of a map without log and ground truth are functions of: sums that add up over its parts."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.metrics.summary import STRATA, TableSums, groups_of
from semstab.model.evidence import stretches
from semstab.model.information import by_group
from semstab.model.measures import sbd, vss
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import class_sums, decompose, disagreement, psa
from semstab.statistics.kinds import Kinds
from semstab.statistics.order.drift import expected_sbd
from semstab.statistics.sampling import InfluenceSums, Places, PlaceSums, merged
from semstab.statistics.sampling.collect import FrameGroups, of_log, of_table, with_places

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
        kinds: Kinds,
        edges: Sequence[int] = STRATA,
        *,
        null: Float64 | None = None,
        groups: FrameGroups | None = None,
    ) -> MapSums:
        """Those of a map, some voxels after the others.

        null (n,) is the SBD of one voxel of each kind in random order, which comes with a log, and groups
        of its frames. How likely places are
        stable only the whole map tells: `StableLooks`.
        """
        one, log = kinds.one, kinds.every.log
        alone = log is None and one.truth is None
        parts = (
            cls._of_few(one.table.rows(some), one.places.rows(some), None if null is None else null[some], edges, alone)
            for some in stretches(len(one.table))
        )
        found = functools.reduce(lambda one, other: cls.merged([one, other]), parts)
        if alone:
            return found
        excess = sbd(one.table) - (expected_sbd(one.table) if null is None else null)
        influence = with_places(
            of_table(one.table, one.places, one.label)
            if log is None or one.log is None
            else of_log(one.log, one.places, one.label, groups=groups),
            one.table,
            one.places,
            one.label,
            excess,
        )
        return replace(found, classes=class_sums(one.table, one.log), influence=influence)

    @classmethod
    def _of_few(
        cls, table: VoxelTable, places: Places, null: Float64 | None, edges: Sequence[int], alone: bool
    ) -> MapSums:
        """Without what its log or its true classes tell better, unless it is alone."""
        maps = maps_of(table, null)
        some = slice(None if alone else 0)
        looks = of_table(table.rows(some), places.rows(some))
        return cls(
            TableSums.of(table, edges),
            place_sums(table, maps, places),
            stratum_sums(table, maps, edges),
            class_sums(table),
            with_places(looks, table.rows(some), places.rows(some), None, maps["sbd_excess"][some]),
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


def maps_of(table: VoxelTable, null: Float64 | None = None) -> Maps:
    """Numbers of each voxel (n,) that need nothing but its row; null is its SBD in random order, if a log tells it."""
    null = expected_sbd(table) if null is None else null
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


def place_sums(table: VoxelTable, maps: Maps, places: Places) -> PlaceSums:
    """Over the cubes of the voxels with OP >= 2: what means and agreement beyond chance are functions of."""
    T, op, psa = table.op.astype(np.float64), table.op, maps["psa"]
    sums = places.means(
        {
            "psa": psa,
            "vss": vss(table),
            "sbd": maps["sbd_excess"] + maps["sbd_null"],
            "null": maps["sbd_null"],
            "excess": maps["sbd_excess"],
            "steadier": np.where(op > 2, -maps["sbd_excess"], np.nan),
            "entropy": maps["entropy_within"] + maps["entropy_between"],
            "entropy_within": maps["entropy_within"],
            "entropy_between": maps["entropy_between"],
            "of two": np.where(op == 2, psa, np.nan),
            "of more": np.where(op > 2, psa, np.nan),
            "looks": T,
            "agreeing": T * psa,
            "own": table.self_sum,
            "own of a look": table.self_sum / T,
            **{name: T * maps[f"disagreement_{name}"] for name in ("within", "between")},
        }
    )
    looks, agreeing, own, own_of_look = (
        sums.pop(name)[:, :1] for name in ("looks", "agreeing", "own", "own of a look")
    )
    coin = [sums.pop(name) for name in ("of two", "of more")]
    by_look, by_place = places.sums_by_class(table)
    further = {
        **{name: [sums[name][:, :1], looks] for name in ("within", "between")},
        "coin": coin,
        "kappa": [sums["psa"], by_place],  # as of `kappa_columns`, and of `alpha_columns` twice
        "alpha": [agreeing, looks, own, by_look],
        "each_place": [sums["psa"], own_of_look, by_place],
    }
    return PlaceSums(places.cell, places.edge, sums | {name: np.hstack(parts) for name, parts in further.items()})


def stratum_sums(table: VoxelTable, maps: Maps, edges: Sequence[int]) -> Float64:
    """(2 * len(BY_STRATUM), strata) of maps: their sums, and how often each is defined."""
    values = [maps[name] for name in BY_STRATUM]
    both = by_group(groups_of(table.op, edges), values, len(edges) + 1, table.copies)
    return np.stack(both, axis=-1).reshape(len(edges) + 1, -1).T


def _class_sums(parts: Sequence[Float64]) -> Float64:
    """Where the evidence of one part does not tell how frames agree on a class, that of all does not."""
    total: Float64 = np.sum(parts, axis=0)
    if np.isnan(total).any():
        total[2:5, total[0] > 0] = np.nan
    return total
