"""What runs have in common on a scene: observations, voxels, cubes of space, or nothing; and what that leaves out."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semstab.comparison.runs import Entry
from semstab.core.types import THIS_SCENE, Int64, Mask, Scope
from semstab.data.contrast import Basis, ComparedObservations, MapCoverage
from semstab.data.events import Events
from semstab.data.measures import sbd
from semstab.data.records import Record
from semstab.data.tiles import Tiles, side_by_side
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import rows_of
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import ClusterSums
from semstab.statistics.correctness import join_truth
from semstab.statistics.drift import expected_sbd
from semstab.statistics.model_comparison import Region, Regions, common_voxels, coverage_of, held, share_of
from semstab.statistics.observations import CellObservations
from semstab.statistics.paired_differences import SharedObservations, compared_observations

NEAR = 1e-3
"""Metres within which cameras of the same frame lie."""

ALIKE = 1.25
"""Ratio of the footprints of their pixels up to which runs took the same ones: depth may be filtered otherwise."""

SAMPLED = "of {millions:.3g} million common voxels 1 in {n} is compared, by a hash of its location"
SHOWN = "figures and the recording show the voxels that changed, and 1 in {n} of the others"

FEW = 0.1
"""A part of a map's voxels below which it is said how few are in common."""

OTHER_PIXELS = "the runs took other pixels of the frames (pixel_stride): what each left without a label is not compared"
OTHER_OBSERVATIONS = (
    "the runs are of other frames, or one kept no observations: alpha is of each run's own, and not paired"
)
BY_CUBES = (
    "compared are sums in the same cubes of space, each map with all its voxels; what needs them voxel by voxel is"
)
BY_CUBES += " left out: the locations that got worse"
OTHER_SIZES = f"voxels of {{sizes}}: {BY_CUBES}, and what depends on their size (PSA, VSS, SBD, coverage, ECE)"


LABELS_AND_SCORES = (
    "labels stand beside scores: alpha, and what is right of the fused labels, are of the likeliest classes; the rest,"
    " which spreads the evidence of scores, is left out"
)


@dataclass(frozen=True, eq=False)
class Common:
    """Runs on a scene, as far as they can be held against each other.

    Attributes:
        sums: Of each run, of the common locations; for `cubes` and `flights` of its whole map.
        mixed: Whether labels stand beside scores.
        tables: Of the common locations; none for `cubes` and `flights`.
        logs: Of the common observations of cells, where there are some.
        label: (n,) the true class of each of their voxels, -1 where it is not known; None without ground truth.
        observations: What the common observations are.
        regions: Where there are voxels of the same frames, all of labels or all of scores: the whole maps with the
            ground truth.
        shown: The part of them that figures show beside those that changed.
        scope: Of the intervals, where frames tell.
        sizes_differ, frames_differ: Whether voxels do, and the frames of runs that are paired on observations.
        same_frames: Whether frames are paired; None where the sums tell.
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
        """Return the sums of some of the common locations (n,)."""
        label = None if self.label is None else self.label[where]
        return tuple(_sums(rows_of(table, where), label) for table in self.tables)


def pair(entries: Sequence[Entry], names: Sequence[str], scope: Scope = THIS_SCENE) -> Common:
    """Return the most that all runs of a scene have in common.

    Raises:
        DataError: If a file of a run cannot be read.
    """
    result = _paired(entries, names)
    mixed = len({entry.summary.reduced is None for entry in entries}) > 1
    regions = None if mixed or result.frames_differ else result.regions
    notes = (LABELS_AND_SCORES,) if mixed else ()
    return replace(result, scope=scope, mixed=mixed, regions=regions, notes=(*result.notes, *notes))


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
    result = _with_observations(_by_voxels(entries, regions), names, records)
    shown = share_of(min(row.voxels for row in covered))
    notes = (*result.notes, *_notes(covered), *((SHOWN.format(n=round(1 / shown)),) if shown < 1 else ()))
    return replace(result, notes=notes, regions=result.regions or regions, coverage=covered, shown=shown)


def _truth(records: Sequence[Record]) -> Tiles[VoxelTable] | None:
    files = [file for record in records if (file := record.truth_file) is not None and file.exists()]
    return Tiles.open(files[0], VoxelTable) if files else None


def _regions(
    names: Sequence[str], maps: Sequence[Tiles[VoxelTable]], truth: Tiles[VoxelTable] | None
) -> Iterator[Region]:
    """Yield the maps of runs tile by tile, or whole, with the ground truth, where it is of their classes."""
    for own in side_by_side([*maps, *([] if truth is None else [truth])]):
        tables, true = own[: len(maps)], own[len(maps) :]
        known = true[0] if true and true[0].classes == tables[0].classes else None
        yield Region(dict(zip(names, tables, strict=True)), None, known)


def joint_class(tables: Iterable[VoxelTable]) -> Int64:
    """Return the dominant class (n,) of the same voxels in several maps, each counting alike."""
    first, *others = tables
    beliefs = first.evidence[:] / first.op[:, None]
    for other in others:
        beliefs = beliefs + other.evidence[:] / other.op[:, None]
    label: Int64 = beliefs.round(9).argmax(axis=1)
    return label


# --- What is in common ------------------------------------------------------------------------------------------------


def _by_voxels(entries: Sequence[Entry], regions: Regions) -> Common:
    """Return the voxels that all saw twice or more; of very many a sample. Alpha is of each run's own observations."""
    common = common_voxels(regions)
    tables, share = tuple(common.tables.values()), common.share
    label = None if common.truth is None else join_truth(tables[0], common.truth).label
    sums = tuple(
        replace(_sums(table, label), fine=entry.sums.fine, coarse=entry.sums.coarse)
        for table, entry in zip(tables, entries, strict=True)
    )
    millions = len(tables[0]) / share / 1e6
    sampled = () if share == 1 else (SAMPLED.format(millions=millions, n=round(1 / share)),)
    return Common("voxels", sampled, sums, False, tables, (), label)


def _with_observations(common: Common, names: Sequence[str], records: Sequence[Record]) -> Common:
    """Add alpha of the observations that all made; of each run's own where they cannot be paired."""
    there = _observations_of_the_same_frames(records)
    if not there:
        return replace(common, notes=(OTHER_OBSERVATIONS, *common.notes), same_frames=False, frames_differ=True)
    shared, pixels = _compared(names, there)
    cells = shared.sums.values()
    sums = (replace(own, fine=of.fine, coarse=of.coarse) for own, of in zip(common.sums, cells, strict=True))
    notes, logs = _fewer_frames(there), tuple(shared.logs.values())
    return replace(
        common, basis="observations", notes=(*common.notes, *notes, *pixels), sums=tuple(sums), logs=logs,
        observations=shared.compared, frames_differ=bool(notes),
    )  # fmt: skip


def _observations_of_the_same_frames(records: Sequence[Record]) -> list[CellObservations]:
    """Return the sampled observations of runs; none where one's were not kept, or are of other frames."""
    files = [file for record in records if (file := record.observations_file) is not None and file.is_file()]
    there = [CellObservations.load(file) for file in files]
    return there if len(there) == len(records) and _same_frames(there) else []


def _compared(names: Iterable[str], there: Sequence[CellObservations]) -> tuple[SharedObservations, tuple[str, ...]]:
    """Return the observations that all runs made, and what has to be known of them.

    Where their pixels are not of one size it cannot be told which of them a run left without a label.
    """
    shared = compared_observations(dict(zip(names, there, strict=True)))
    footprints = [float(np.median(own.views.footprint)) if len(own.views) else math.nan for own in there]
    if not max(footprints) > ALIKE * min(footprints):
        return shared, ()
    compared = replace(shared.compared, ignored=(), order_ignored=shared.compared.order, bounded=True)
    return replace(shared, compared=compared), (OTHER_PIXELS,)


def on_common_observations(
    entries: Mapping[str, Entry],
) -> tuple[list[Entry], ComparedObservations, tuple[str, ...]] | None:
    """Return entries of runs whose alpha is of common observations, what these are, and notes.

    None where nothing can be paired on observations: alpha is then of each run's own.
    """
    own = [*entries.values()]
    if _other_frame_of_reference(own) or _no_voxels(own):
        return None
    there = _observations_of_the_same_frames([entry.record for entry in own if entry.record is not None])
    if not there:
        return None
    shared, notes = _compared(entries, there)
    if not shared.compared.observations:
        return None
    alike = [
        replace(entry, small=(replace(entry.sums, fine=of.fine, coarse=of.coarse), entry.flicker))
        for entry, of in zip(own, shared.sums.values(), strict=True)
    ]
    return alike, shared.compared, notes


def _apart(entries: Sequence[Entry], reason: str) -> Common:
    note = f"{reason}: nothing can be paired; each map's own numbers stand beside each other"
    return replace(_of_whole_maps("flights", note, entries), same_frames=False)


def _of_whole_maps(basis: Basis, note: str, entries: Sequence[Entry]) -> Common:
    """Return the sums of the runs' folders; of right and wrong only where all have them."""
    sums = tuple(entry.sums for entry in entries)
    without = [entry.where for entry in entries if not entry.sums.truth]
    if 0 < len(without) < len(entries):
        sums = tuple(own.without_truth() for own in sums)
        untold = f"{without[0]} holds no ground truth (run it with --statistics): nothing about right and wrong"
        return Common(basis, (note, untold), sums)
    return Common(basis, (note,), sums)


def _sums(table: VoxelTable, label: Int64 | None) -> ClusterSums:
    return cluster_sums_of(table, None, label, sbd_excess=sbd(table) - expected_sbd(table))


def _same_frames(observations: Sequence[CellObservations]) -> bool:
    """Return whether frames of one index were taken from one place, and flights share most frames."""
    first, *others = (own.views for own in observations)
    for other in others:
        _, one, same = np.intersect1d(first.frame, other.frame, return_indices=True)
        if 2 * len(one) < min(len(first), len(other)):
            return False
        if np.abs(first.centre[one] - other.centre[same]).max(initial=0.0) > NEAR:
            return False
    return True


def _fewer_frames(observations: Sequence[CellObservations]) -> tuple[str, ...]:
    """Return where a run left out frames that others have."""
    if len({own.frames for own in observations}) == 1:
        return ()
    both = len(functools.reduce(np.intersect1d, [own.views.frame for own in observations]))
    listed = " and ".join(str(own.frames) for own in observations)
    return (f"the runs fused {listed} frames: alpha is of the {both} views that all have; flicker is left out",)


# --- What is not ------------------------------------------------------------------------------------------------------


def _other_frame_of_reference(entries: Sequence[Entry]) -> str:
    """Return why coordinates are not those of the same locations; empty where they are."""
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
    """Return why there are no voxels to pair; empty where there are."""
    for entry in entries:
        if entry.record is None:
            return f"{entry.where} is a small summary, without voxels: {BY_CUBES}"
        if entry.record.voxels_file is None or not entry.record.voxels_file.exists():
            return f"{entry.where} kept no voxels: {BY_CUBES}"
    return ""


def _notes(covered: Sequence[MapCoverage]) -> list[str]:
    return [
        f"only {row.common_share:.1%} of the voxels of {row.model} are in all maps: are the frames of reference the"
        " same?"
        for row in covered
        if row.common_share < FEW
    ]
