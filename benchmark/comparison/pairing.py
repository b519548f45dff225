"""What runs have in common on a scene: observations, voxels, cubes of space, or nothing; and what that leaves out."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semstab.comparison.runs import Entry
from semstab.core.types import THIS_SCENE, Int64, Mask, Scope
from semstab.metrics.agreement import observations, rows_of, shared_rows
from semstab.model.contrast import Basis, ComparedObservations, MapCoverage
from semstab.model.events import Events
from semstab.model.measures import sbd
from semstab.model.records import Record
from semstab.model.tiles import Tiles, side_by_side
from semstab.model.voxels import VoxelTable
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import ClusterSums
from semstab.statistics.correctness import join_truth
from semstab.statistics.drift import expected_sbd, streams
from semstab.statistics.model_comparison import Region, Regions, coverage_of, held, repeated_rows, truth_at
from semstab.statistics.observations import CellObservations
from semstab.statistics.paired_differences import compared_observations

NEAR = 1e-3
"""Metres within which cameras of the same frame lie."""

MOST = 1 << 22
"""Voxels that are in memory at a time: of more common ones a sample is compared, and shown."""

SAMPLED = "of {millions:.3g} million common voxels 1 in {n} is compared, by a hash of its location"
SHOWN = "figures and the recording show the voxels that changed, and 1 in {n} of the others"

FEW = 0.1
"""A part of a map's voxels below which it is said how few are in common."""

BY_CUBES = (
    "compared are sums in the same cubes of space, each map with all its voxels; what needs them voxel by voxel is"
)
BY_CUBES += " left out: the locations that got worse"
OTHER_SIZES = f"voxels of {{sizes}}: {BY_CUBES}, and what depends on their size (alpha, PSA, VSS, SBD, coverage, ECE)"


OBSERVATIONS_DECIDED = (
    "labels stand beside scores: each observation is reduced to its largest class; the share of the ceiling and"
    " alpha between frames, which forgive what a score leaves open, are left out"
)
NOT_DECIDED = "labels stand beside scores, and common observations are not known: of agreement nothing can be compared"


@dataclass(frozen=True, eq=False)
class Common:
    """Runs on a scene, as far as they can be held against each other.

    sums    of each run, of the common locations; for `cubes` and `flights` of its whole map
    mixed   whether labels stand beside scores
    tables  of the common locations; none for `cubes` and `flights`
    logs    of these tables, where observations are in common
    label   (n,) the true class of each of their voxels, -1 where it is not known; None without ground truth
    observations   what the common observations are
    regions where there are voxels: the whole maps if they were made of the same frames and are all of labels or all of
            scores, else `tables`, location by location, with the ground truth
    shown   the part of them that figures show beside those that changed
    scope   of the intervals, where frames tell
    sizes_differ, frames_differ  whether voxels do, and the frames of runs that are paired on observations
    same_frames  whether frames are paired; None where the sums tell
    """

    basis: Basis
    notes: tuple[str, ...]
    sums: tuple[ClusterSums, ...]
    mixed: bool = False
    tables: tuple[VoxelTable, ...] = ()
    logs: tuple[Events, ...] = ()
    label: Int64 | None = None
    observations: ComparedObservations | None = None
    regions: Regions | None = None
    coverage: tuple[MapCoverage, ...] = ()
    same_frames: bool | None = None
    sizes_differ: bool = False
    frames_differ: bool = False
    shown: float = 1.0
    scope: Scope = THIS_SCENE

    def among(self, where: Mask) -> tuple[ClusterSums, ...]:
        """The sums of some of the common locations (n,)."""
        return tuple(
            _sums(rows_of(table, where), _some(log, where), None if self.label is None else self.label[where])
            for table, log in zip(self.tables, self.logs or (None,) * len(self.tables), strict=True)
        )


def pair(entries: Sequence[Entry], names: Sequence[str], scope: Scope = THIS_SCENE) -> Common:
    """The most that all runs of a scene have in common. Raises DataError where a file of a run cannot be read."""
    result = _paired(entries, names)
    mixed = len({entry.summary.reduced is None for entry in entries}) > 1
    notes = (OBSERVATIONS_DECIDED if result.basis == "observations" else NOT_DECIDED,) if mixed else ()
    return replace(result, scope=scope, mixed=mixed, notes=(*result.notes, *notes))


def _paired(entries: Sequence[Entry], names: Sequence[str]) -> Common:
    if note := _other_frame_of_reference(entries):
        return _apart(entries, note)
    if len(sizes := {entry.summary.table.voxel_size for entry in entries}) > 1:
        note = OTHER_SIZES.format(sizes=" and ".join(f"{size:g} m" for size in sorted(sizes)))
        return replace(_of_whole_maps("cubes", note, entries), sizes_differ=True)
    if note := _no_voxels(entries):
        return _of_whole_maps("cubes", note, entries)
    records = [entry.with_voxels("a comparison by voxels") for entry in entries]
    maps = [Tiles.open(file, VoxelTable) for record in records if (file := record.voxels_file) is not None]
    regions = partial(_regions, names, maps, _truth(records))
    covered = coverage_of(names, [held(region.tables) for region in regions()])
    if not any(row.common_share for row in covered):
        return _apart(entries, "the maps have no voxel in common: other locations, or other frames of reference")
    result = _by_observations(names, records, regions) or _by_voxels(regions)
    shown = share_of(min(row.voxels for row in covered))
    notes = (*result.notes, *_notes(covered), *((SHOWN.format(n=round(1 / shown)),) if shown < 1 else ()))
    return replace(result, notes=notes, regions=result.regions or regions, coverage=covered, shown=shown)


def _truth(records: Sequence[Record]) -> Tiles[VoxelTable] | None:
    files = [file for record in records if (file := record.truth_file) is not None and file.exists()]
    return Tiles.open(files[0], VoxelTable) if files else None


def _regions(
    names: Sequence[str], maps: Sequence[Tiles[VoxelTable]], truth: Tiles[VoxelTable] | None
) -> Iterator[Region]:
    """The maps of runs tile by tile, or whole, with the ground truth, where it is of their classes."""
    for own in side_by_side([*maps, *([] if truth is None else [truth])]):
        tables, true = own[: len(maps)], own[len(maps) :]
        known = true[0] if true and true[0].classes == tables[0].classes else None
        yield Region(dict(zip(names, tables, strict=True)), None, known)


def share_of(voxels: int) -> float:
    """Which part of so many is at most MOST; a power of 1/2."""
    return 1.0 if voxels <= MOST else 2.0 ** -math.ceil(math.log2(voxels / MOST))


def in_share(table: VoxelTable, share: float) -> Mask:
    """(n,) which voxels are in the sample that is so large a part of all, by a hash of their index."""
    if share >= 1:
        return np.ones(len(table), np.bool_)
    drawn: Mask = streams(table, slice(None), 0) >> np.uint64(11) < np.uint64(share * 2**53)
    return drawn


def joint_class(tables: Iterable[VoxelTable]) -> Int64:
    """The dominant class (n,) of the same voxels in several maps, each counting alike."""
    first, *others = tables
    beliefs = first.evidence[:] / first.op[:, None]
    for other in others:
        beliefs = beliefs + other.evidence[:] / other.op[:, None]
    label: Int64 = beliefs.round(9).argmax(axis=1)
    return label


# --- What is in common ------------------------------------------------------------------------------------------------


def _by_observations(names: Sequence[str], records: Sequence[Record], regions: Regions) -> Common | None:
    """The observations that all made; None where the observations of one were not kept, or are of other frames."""
    files = [file for record in records if (file := record.looks_file) is not None and file.is_file()]
    there = [CellObservations.load(file) for file in files]
    if len(there) < len(records) or not _same_frames(there):
        return None
    shared = compared_observations(dict(zip(names, there, strict=True)))
    tables = tuple(log.table() for log in shared.logs.values())
    if not any(table.op.max(initial=0) >= 2 for table in tables):
        return None
    truth = truth_at(regions, tables[0])
    label = None if truth is None else join_truth(tables[0], truth).label
    logs = tuple(shared.logs.values())
    sums = tuple(_sums(table, log, label) for table, log in zip(tables, logs, strict=True))
    notes = _fewer_frames(there)
    apart = Region(dict(zip(names, tables, strict=True)), None, truth) if notes or shared.found.decided else None
    of_observations = None if apart is None else lambda: [apart]
    own = (tables, logs, label, shared.found, of_observations)
    return Common("observations", notes, sums, False, *own, frames_differ=bool(notes))


def _by_voxels(regions: Regions) -> Common:
    """The voxels that all saw twice or more, whatever each saw of them; of very many a sample."""
    common = sum(len(repeated_rows(region.tables)[0]) for region in regions())
    share, parts, truths = share_of(common), [], []
    for region in regions():
        pairs = zip(region.tables.values(), repeated_rows(region.tables), strict=True)
        own = [table.rows(rows) for table, rows in pairs]
        drawn = in_share(own[0], share)
        parts.append([table.rows(drawn) for table in own])
        if region.truth is not None:
            truths.append(region.truth.rows(shared_rows(region.truth, parts[-1][0])[0]))
    tables = tuple(VoxelTable.joined(own) for own in zip(*parts, strict=True))
    label = join_truth(tables[0], VoxelTable.joined(truths)).label if truths else None
    sums = tuple(_sums(table, None, label) for table in tables)
    note = "the runs made other observations, of other frames: they are paired on voxels alone, for these frames"
    sampled = () if share == 1 else (SAMPLED.format(millions=common / 1e6, n=round(1 / share)),)
    return Common("voxels", (note, *sampled), sums, False, tables, (), label, same_frames=False)


def _apart(entries: Sequence[Entry], reason: str) -> Common:
    note = f"{reason}: nothing can be paired; each map's own numbers stand beside each other"
    return replace(_of_whole_maps("flights", note, entries), same_frames=False)


def _of_whole_maps(basis: Basis, note: str, entries: Sequence[Entry]) -> Common:
    """The sums of the runs' folders; of right and wrong only where all have them."""
    sums = tuple(entry.sums for entry in entries)
    without = [entry.where for entry in entries if not entry.sums.truth]
    if 0 < len(without) < len(entries):
        sums = tuple(own.without_truth() for own in sums)
        untold = f"{without[0]} holds no ground truth (run it with --statistics): nothing about right and wrong"
        return Common(basis, (note, untold), sums)
    return Common(basis, (note,), sums)


def _sums(table: VoxelTable, log: Events | None, label: Int64 | None) -> ClusterSums:
    return cluster_sums_of(table, log, label, sbd_excess=sbd(table) - expected_sbd(table))


def _some(log: Events | None, where: Mask) -> Events | None:
    return None if log is None else observations(log, np.flatnonzero(where[log.voxel]))


def _same_frames(observations: Sequence[CellObservations]) -> bool:
    """Whether frames of one index were taken from one location, and most of the shorter flight's are in the others."""
    first, *others = (own.views for own in observations)
    for other in others:
        _, one, same = np.intersect1d(first.frame, other.frame, return_indices=True)
        if 2 * len(one) < min(len(first), len(other)):
            return False
        if np.abs(first.centre[one] - other.centre[same]).max(initial=0.0) > NEAR:
            return False
    return True


def _fewer_frames(observations: Sequence[CellObservations]) -> tuple[str, ...]:
    """Where not all of a run's frames are in the others."""
    frames = [own.views.frame for own in observations]
    both = len(functools.reduce(np.intersect1d, frames))
    listed = " and ".join(str(len(own)) for own in frames)
    if both == max(map(len, frames)):
        return ()
    return (
        f"of {listed} frames the {both} that all have are compared; the share of the ceiling and"
        " flicker, which are of all, are left out",
    )


# --- What is not ------------------------------------------------------------------------------------------------------


def _other_frame_of_reference(entries: Sequence[Entry]) -> str:
    """Why coordinates are not those of the same locations; empty where they are."""
    first, *others = (entry.georeference for entry in entries)
    for entry, own in zip(entries[1:], others, strict=True):
        if (own is None) != (first is None):
            without = entry if own is None else entries[0]
            return f"{without.where} has no georeference, and the other has one"
        if own is not None and first is not None and own != first:
            what = "coordinate reference systems" if own.crs != first.crs else "frames of the coordinates"
            return f"the {what} of {entries[0].where} and {entry.where} differ"
    return ""


def _no_voxels(entries: Sequence[Entry]) -> str:
    """Why there are no voxels to pair; empty where there are."""
    for entry in entries:
        if entry.record is None:
            return f"{entry.where} is a small summary, without voxels: {BY_CUBES}"
        if entry.record.voxels_file is None or not entry.record.voxels_file.exists():
            return f"{entry.where} kept no voxels: {BY_CUBES}"
    return ""


def _notes(covered: Sequence[MapCoverage]) -> list[str]:
    return [
        f"only {row.common_share:.1%} of the voxels of {row.backbone} are in all maps: are the frames of reference the"
        " same?"
        for row in covered
        if row.common_share < FEW
    ]
