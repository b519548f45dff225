"""What runs have in common on a scene: looks, voxels, cubes of space, or nothing; and what that leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from semstab.comparison.opening import Entry
from semstab.metrics.matching import observations, rows_of
from semstab.model.measures import sbd
from semstab.model.records import Record
from semstab.model.statistics.comparison import CommonLooks, MapCoverage
from semstab.model.statistics.contrast import Basis
from semstab.model.voxels import Events, VoxelTable
from semstab.statistics.correctness import join_truth
from semstab.statistics.looks import Looks
from semstab.statistics.looks.ignored import common_looks
from semstab.statistics.order.drift import expected_sbd
from semstab.statistics.sampling import InfluenceSums, influence_sums
from semstab.statistics.versus.comparison import coverage, repeated_rows

Int64 = npt.NDArray[np.int64]

NEAR = 1e-3
"""Metres within which cameras of the same frame lie."""

FEW = 0.1
"""A part of a map's voxels below which it is said how few are in common."""

BY_CUBES = (
    "compared are sums in the same cubes of space, each map with all its voxels; what needs them voxel by voxel is"
)
BY_CUBES += " left out: the places that got worse"
OTHER_SIZES = f"voxels of {{sizes}}: {BY_CUBES}, and what depends on their size (alpha, PSA, VSS, SBD, coverage, ECE)"


LOOKS_DECIDED = "labels stand beside scores: each look is reduced to its largest class; the share of the ceiling and"
LOOKS_DECIDED += " alpha between frames, which forgive what a score leaves open, are left out"
NOT_DECIDED = "labels stand beside scores, and common looks are not known: of agreement nothing can be compared"


@dataclass(frozen=True, eq=False)
class Common:
    """Runs on a scene, as far as they can be held against each other.

    sums    of each run, of the common places; for `cubes` and `flights` of its whole map
    mixed   whether labels stand beside scores
    tables  of the common places; none for `cubes` and `flights`
    logs    of these tables, where looks are in common
    label   (n,) the true class of each of their voxels, -1 where it is not known; None without ground truth
    looks   what the common looks are
    maps    where there are voxels: the whole maps if they were made of the same frames and are all of labels or all of
            scores, else `tables`; and truth, the map of the ground truth
    sizes_differ, frames_differ  whether voxels do, and the frames of runs that are paired on looks
    same_frames  whether frames are paired; None where the sums tell
    """

    basis: Basis
    remarks: tuple[str, ...]
    sums: tuple[InfluenceSums, ...]
    mixed: bool = False
    tables: tuple[VoxelTable, ...] = ()
    logs: tuple[Events, ...] = ()
    label: Int64 | None = None
    looks: CommonLooks | None = None
    maps: tuple[VoxelTable, ...] = ()
    truth: VoxelTable | None = None
    coverage: tuple[MapCoverage, ...] = ()
    same_frames: bool | None = None
    sizes_differ: bool = False
    frames_differ: bool = False

    def among(self, where: npt.NDArray[np.bool_]) -> tuple[InfluenceSums, ...]:
        """The sums of some of the common places (n,)."""
        return tuple(
            _sums(rows_of(table, where), _some(log, where), None if self.label is None else self.label[where])
            for table, log in zip(self.tables, self.logs or (None,) * len(self.tables), strict=True)
        )


def pair(entries: Sequence[Entry], names: Sequence[str]) -> Common:
    """The most that all runs of a scene have in common. Raises DataError where a file of a run cannot be read."""
    found = _paired(entries, names)
    mixed = len({entry.summary.reduced is None for entry in entries}) > 1
    told = (LOOKS_DECIDED if found.basis == "looks" else NOT_DECIDED,) if mixed else ()
    return replace(found, mixed=mixed, remarks=(*found.remarks, *told))


def _paired(entries: Sequence[Entry], names: Sequence[str]) -> Common:
    if remark := _other_frame_of_reference(entries):
        return _apart(entries, remark)
    if len(sizes := {entry.summary.table.voxel_size for entry in entries}) > 1:
        remark = OTHER_SIZES.format(sizes=" and ".join(f"{size:g} m" for size in sorted(sizes)))
        return replace(_of_whole_maps("cubes", remark, entries), sizes_differ=True)
    if remark := _no_voxels(entries):
        return _of_whole_maps("cubes", remark, entries)
    records = [entry.with_voxels("a comparison by voxels") for entry in entries]
    maps = {name: record.table() for name, record in zip(names, records, strict=True)}
    covered = coverage(maps)
    if not any(row.common_share for row in covered):
        return _apart(entries, "the maps have no voxel in common: other places, or other frames of reference")
    truth = _truth(records)
    found = _by_looks(records, maps, truth) or _by_voxels(maps, truth)
    remarks = (*found.remarks, *_remarks(covered))
    return replace(found, remarks=remarks, maps=found.maps or tuple(maps.values()), truth=truth, coverage=covered)


# --- What is in common ------------------------------------------------------------------------------------------------


def _by_looks(records: Sequence[Record], maps: dict[str, VoxelTable], truth: VoxelTable | None) -> Common | None:
    """The looks that all made; None where the looks of one were not kept, or are of other frames."""
    looks = [_looks_of(record) for record in records]
    there = [own for own in looks if own is not None]
    if len(there) < len(looks) or not _same_frames(there):
        return None
    shared = common_looks(dict(zip(maps, there, strict=True)))
    tables = tuple(log.table() for log in shared.logs.values())
    if not any(table.op.max(initial=0) >= 2 for table in tables):
        return None
    label = None if truth is None else join_truth(tables[0], truth).label
    logs = tuple(shared.logs.values())
    sums = tuple(_sums(table, log, label) for table, log in zip(tables, logs, strict=True))
    remarks = _fewer_frames(there)
    alike = not (remarks or shared.found.decided)
    maps_apart = () if alike else tables
    return Common(
        "looks", remarks, sums, False, tables, logs, label, shared.found, maps_apart, frames_differ=bool(remarks)
    )


def _by_voxels(maps: dict[str, VoxelTable], truth: VoxelTable | None) -> Common:
    """The voxels that all saw twice or more, whatever each saw of them."""
    tables = tuple(table.rows(rows) for table, rows in zip(maps.values(), repeated_rows(maps), strict=True))
    label = None if truth is None else join_truth(tables[0], truth).label
    sums = tuple(_sums(table, None, label) for table in tables)
    remark = "the runs made other looks, of other frames: they are paired on voxels alone, for this map"
    return Common("voxels", (remark,), sums, False, tables, (), label, same_frames=False)


def _apart(entries: Sequence[Entry], reason: str) -> Common:
    remark = f"{reason}: nothing can be paired; each map's own numbers stand beside each other"
    return replace(_of_whole_maps("flights", remark, entries), same_frames=False)


def _of_whole_maps(basis: Basis, remark: str, entries: Sequence[Entry]) -> Common:
    """The sums of the runs' folders; of right and wrong only where all have them."""
    sums = tuple(entry.sums for entry in entries)
    without = [entry.where for entry in entries if not entry.sums.truth]
    if 0 < len(without) < len(entries):
        sums = tuple(own.without_truth() for own in sums)
        untold = f"{without[0]} holds no ground truth (run it with --statistics): nothing about right and wrong"
        return Common(basis, (remark, untold), sums)
    return Common(basis, (remark,), sums)


def _sums(table: VoxelTable, log: Events | None, label: Int64 | None) -> InfluenceSums:
    return influence_sums(table, log, label, sbd_excess=sbd(table) - expected_sbd(table))


def _some(log: Events | None, where: npt.NDArray[np.bool_]) -> Events | None:
    return None if log is None else observations(log, np.flatnonzero(where[log.voxel]))


def _looks_of(record: Record) -> Looks | None:
    file = record.looks_file
    return Looks.load(file) if file is not None and file.is_file() else None


def _same_frames(looks: Sequence[Looks]) -> bool:
    """Whether frames of one index were taken from one place, and most of the shorter flight's are in the others."""
    first, *others = ({view.frame: view.centre for view in own.views} for own in looks)
    for other in others:
        both = first.keys() & other.keys()
        if 2 * len(both) < min(len(first), len(other)):
            return False
        if any(np.abs(first[frame] - other[frame]).max() > NEAR for frame in both):
            return False
    return True


def _fewer_frames(looks: Sequence[Looks]) -> tuple[str, ...]:
    """Where not all of a run's frames are in the others."""
    frames = [{view.frame for view in own.views} for own in looks]
    both = len(frozenset.intersection(*map(frozenset, frames)))
    listed = " and ".join(str(len(own)) for own in frames)
    if both == max(map(len, frames)):
        return ()
    return (
        f"of {listed} frames the {both} that all have are compared; the share of the ceiling and"
        " flicker, which are of all, are left out",
    )


def _truth(records: Sequence[Record]) -> VoxelTable | None:
    """The map of the ground truth, of the first run that fused it."""
    files = [record.truth_file for record in records if record.truth_file is not None and record.truth_file.exists()]
    truth = VoxelTable.load(files[0]) if files else None
    return truth if truth is not None and truth.classes == records[0].table().classes else None


# --- What is not ------------------------------------------------------------------------------------------------------


def _other_frame_of_reference(entries: Sequence[Entry]) -> str:
    """Why coordinates are not those of the same places; empty where they are."""
    first, *others = (entry.georeference for entry in entries)
    for entry, own in zip(entries[1:], others, strict=True):
        if (own is None) != (first is None):
            without = entry if own is None else entries[0]
            return f"{without.where} has no georeference, and the other has one"
        if own is not None and first is not None and own != first:
            what = "coordinate reference systems" if own.crs != first.crs else "offsets of the coordinates"
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


def _remarks(covered: Sequence[MapCoverage]) -> list[str]:
    """Where a map has hardly anything in common with the others."""
    return [
        f"only {row.common_share:.1%} of the voxels of {row.backbone} are in all maps: are the frames of reference the"
        " same?"
        for row in covered
        if row.common_share < FEW
    ]
