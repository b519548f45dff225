"""The common data of runs on a scene: observations, voxels, cubes of space, or nothing; and the data left out."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semstab.comparison.entries import Entry
from semstab.comparison.observations import SharedObservations, compared_observations
from semstab.comparison.voxels import Region, Regions, common_voxels, coverage_of, held, share_of
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
from semstab.statistics.observations import SpotObservations, numbered_as_one_flight

NEAR = 1e-3
"""Largest distance in metres between cameras of the same frame."""

ALIKE = 1.25
"""Largest ratio of the footprints of runs that took the same pixels: depth may be filtered in another way."""

SAMPLED = "1 in {n} of the {millions:.3g} million common voxels is compared, chosen by a hash of its location"
SHOWN = "figures and the recording show the voxels that changed, and 1 in {n} of the others"

FEW = 0.1
"""Share of common voxels of a map below which a note reports it."""

OTHER_PIXELS = (
    "the runs took other pixels of the frames (pixel_stride): the pixels that each left without a label are not"
    " compared"
)
OTHER_OBSERVATIONS = (
    "the runs are of other frames, or one stored no observations: alpha is of each run's own observations, and not"
    " paired"
)
BY_CUBES = (
    "sums in the same cubes of space are compared, each map with all its voxels; numbers that need pairs of voxels are"
)
BY_CUBES += " left out: the areas that got worse"
OTHER_SIZES = f"voxels of {{sizes}}: {BY_CUBES}, and measures that depend on their size (PSA, VSS, SBD, coverage, ECE)"


OF_IMAGES = "a video has no depth and no poses: flicker alone is compared, frame by frame"

LABELS_AND_SCORES = (
    "labels are compared with scores: alpha, and numbers of right fused labels, are of the likeliest classes; other"
    " measures, which depend on how scores spread their evidence, are left out"
)


@dataclass(frozen=True, eq=False)
class Common:
    """Runs on a scene, as far as they can be compared.

    Attributes:
        sums: Sums of each run for the common locations; for `cubes` and `flights` of its whole map.
        mixed: True if labels are compared with scores.
        tables: Tables of the common locations; none for `cubes` and `flights`.
        logs: Logs of the common observations of spots, if the runs have any.
        label: (n,) the true class of each of their voxels, -1 for an unknown class; None without ground truth.
        observations: The comparison of the common observations.
        regions: The whole maps with the ground truth, if the runs have voxels of the same frames, all of labels or all
            of scores.
        shown: The share of the unchanged voxels that figures show with those that changed.
        scope: Scope of the intervals, if the frames suffice for it.
        sizes_differ, frames_differ: True if voxel sizes differ, or the frames of runs that are paired on observations.
        same_frames: True if frames are paired; None if the sums show it.
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
    """Return the largest common data of all runs of a scene.

    Raises:
        DataError: If a file of a run cannot be read.
    """
    result = _paired(entries, names)
    mixed = len({entry.record.reduced is None for entry in entries}) > 1
    regions = None if mixed or result.frames_differ else result.regions
    notes = (LABELS_AND_SCORES,) if mixed else ()
    return replace(result, scope=scope, mixed=mixed, regions=regions, notes=(*result.notes, *notes))


def _paired(entries: Sequence[Entry], names: Sequence[str]) -> Common:
    if not all(entry.sums.layout for entry in entries):
        return Common("images", (OF_IMAGES,), tuple(entry.sums for entry in entries))
    if note := other_frame_of_reference(entries):
        return _apart(entries, note)
    if len(sizes := {entry.record.map_summary.voxel_size for entry in entries}) > 1:
        note = OTHER_SIZES.format(sizes=" and ".join(f"{size:g} m" for size in sorted(sizes)))
        return replace(_of_whole_maps("cubes", note, entries), sizes_differ=True)
    if note := _no_voxels(entries):
        return _of_whole_maps("cubes", note, entries)
    records = [entry.with_voxels("a comparison by voxels") for entry in entries]
    maps = [Tiles.open(file, VoxelTable) for record in records if (file := record.voxels_file) is not None]
    regions = partial(_regions, names, maps, _truth(records))
    covered = coverage_of(names, [held(region.tables) for region in regions()])
    if not any(row.common_share for row in covered):
        return _apart(entries, "the maps have no voxel in common: their locations or frames of reference differ")
    result = _with_observations(_by_voxels(entries, regions), names, records)
    displayed_share = share_of(min(row.voxels for row in covered))
    notes = (
        *result.notes,
        *_notes(covered),
        *((SHOWN.format(n=round(1 / displayed_share)),) if displayed_share < 1 else ()),
    )
    return replace(result, notes=notes, regions=result.regions or regions, coverage=covered, shown=displayed_share)


def _truth(records: Sequence[Record]) -> Tiles[VoxelTable] | None:
    files = [file for record in records if (file := record.truth_file) is not None and file.exists()]
    return Tiles.open(files[0], VoxelTable) if files else None


def _regions(
    names: Sequence[str], maps: Sequence[Tiles[VoxelTable]], truth: Tiles[VoxelTable] | None
) -> Iterator[Region]:
    """Yield the maps of runs tile by tile, or whole, with the ground truth, if it has their classes."""
    for region in side_by_side([*maps, *([] if truth is None else [truth])]):
        tables, true = region[: len(maps)], region[len(maps) :]
        region_truth = true[0] if true and true[0].classes == tables[0].classes else None
        yield Region(dict(zip(names, tables, strict=True)), None, region_truth)


def joint_class(tables: Iterable[VoxelTable]) -> Int64:
    """Return the dominant class (n,) of the same voxels in several maps, each map with the same weight."""
    first, *rest = (table.summing_to_op() for table in tables)
    beliefs = first.evidence[:] / first.op[:, None]
    for other in rest:
        beliefs = beliefs + other.evidence[:] / other.op[:, None]
    label: Int64 = beliefs.round(9).argmax(axis=1)
    return label


# --- Common data ------------------------------------------------------------------------------------------------------


def _by_voxels(entries: Sequence[Entry], regions: Regions) -> Common:
    """Return the voxels that all saw twice or more, or a sample of very many. Alpha is of each run's own spots."""
    common = common_voxels(regions)
    tables, share = tuple(common.tables.values()), common.share
    label = None if common.truth is None else join_truth(tables[0], common.truth).label
    sums = tuple(
        replace(_sums(table, label), answers=entry.sums.answers) for table, entry in zip(tables, entries, strict=True)
    )
    millions = len(tables[0]) / share / 1e6
    sampled = () if share == 1 else (SAMPLED.format(millions=millions, n=round(1 / share)),)
    return Common("voxels", sampled, sums, False, tables, (), label)


def _with_observations(common: Common, names: Sequence[str], records: Sequence[Record]) -> Common:
    """Add alpha of the observations that all made, or of each run's own where they cannot be paired."""
    samples = _observations_of_the_same_frames(records)
    if not samples:
        return replace(common, notes=(OTHER_OBSERVATIONS, *common.notes), same_frames=False, frames_differ=True)
    shared, pixels = _compared(names, samples)
    spots = shared.sums.values()
    sums = (replace(part, answers=of.answers) for part, of in zip(common.sums, spots, strict=True))
    notes, logs = _fewer_frames(samples), tuple(shared.logs.values())
    return replace(
        common, basis="observations", notes=(*common.notes, *notes, *pixels), sums=tuple(sums), logs=logs,
        observations=shared.compared, frames_differ=bool(notes),
    )  # fmt: skip


def _observations_of_the_same_frames(records: Sequence[Record]) -> list[SpotObservations]:
    """Return the sampled observations of runs; none where one run has none, or other frames."""
    files = [file for record in records if (file := record.observations_file) is not None and file.is_file()]
    samples = numbered_as_one_flight([SpotObservations.load(file) for file in files]) if files else []
    return samples if len(samples) == len(records) and _same_frames(samples) else []


def _compared(names: Iterable[str], samples: Sequence[SpotObservations]) -> tuple[SharedObservations, tuple[str, ...]]:
    """Return the observations that all runs made, and notes on them.

    Where their pixels have different sizes, the pixels that a run left without a label are unknown.
    """
    shared = compared_observations(dict(zip(names, samples, strict=True)))
    footprints = [float(np.median(sample.views.footprint)) if len(sample.views) else math.nan for sample in samples]
    if not max(footprints) > ALIKE * min(footprints):
        return shared, ()
    compared = replace(shared.compared, ignored=(), order_ignored=shared.compared.order, bounded=True)
    return replace(shared, compared=compared), (OTHER_PIXELS,)


def on_common_observations(
    entries: Mapping[str, Entry],
) -> tuple[list[Entry], ComparedObservations, tuple[str, ...]] | None:
    """Return entries of runs whose alpha is of common observations, their comparison, and notes.

    None if nothing can be paired on observations: alpha is then over each run's own observations.
    """
    runs = [*entries.values()]
    if other_frame_of_reference(runs) or _no_voxels(runs):
        return None
    samples = _observations_of_the_same_frames([entry.record for entry in runs])
    if not samples:
        return None
    shared, notes = _compared(entries, samples)
    if not shared.compared.observations:
        return None
    alike = [
        replace(entry, small=(replace(entry.sums, answers=of.answers), entry.flicker))
        for entry, of in zip(runs, shared.sums.values(), strict=True)
    ]
    return alike, shared.compared, notes


def _apart(entries: Sequence[Entry], reason: str) -> Common:
    note = f"{reason}: nothing can be paired; the numbers of each map are shown side by side"
    return replace(_of_whole_maps("flights", note, entries), same_frames=False)


def _of_whole_maps(basis: Basis, note: str, entries: Sequence[Entry]) -> Common:
    """Return the sums of the runs' folders; sums of right and wrong only where all have them."""
    sums = tuple(entry.sums for entry in entries)
    without = [entry.where for entry in entries if not entry.sums.truth]
    if 0 < len(without) < len(entries):
        sums = tuple(part.without_truth() for part in sums)
        missing = f"{without[0]} holds no ground truth (run it without --no-truth): correctness is not compared"
        return Common(basis, (note, missing), sums)
    return Common(basis, (note,), sums)


def _sums(table: VoxelTable, label: Int64 | None) -> ClusterSums:
    return cluster_sums_of(table, None, label, sbd_excess=sbd(table) - expected_sbd(table))


def _same_frames(observations: Sequence[SpotObservations]) -> bool:
    """Return whether frames of one index were taken from one position, and flights share most frames."""
    first, *rest = (sample.views for sample in observations)
    for other in rest:
        _, one, same = np.intersect1d(first.frame, other.frame, return_indices=True)
        if 2 * len(one) < min(len(first), len(other)):
            return False
        if np.abs(first.centre[one] - other.centre[same]).max(initial=0.0) > NEAR:
            return False
    return True


def _fewer_frames(observations: Sequence[SpotObservations]) -> tuple[str, ...]:
    """Return a note where a run left out frames that others have."""
    if len({sample.frames for sample in observations}) == 1:
        return ()
    num_common = len(functools.reduce(np.intersect1d, [sample.views.frame for sample in observations]))
    listed = " and ".join(str(sample.frames) for sample in observations)
    return (f"the runs fused {listed} frames: alpha is of the {num_common} views that all have; flicker is left out",)


# --- Reasons against pairing ------------------------------------------------------------------------------------------


def other_frame_of_reference(entries: Sequence[Entry]) -> str:
    """Return why coordinates do not show the same locations; empty where they do."""
    first, *rest = (entry.georeference for entry in entries)
    for entry, views in zip(entries[1:], rest, strict=True):
        if (views is None) != (first is None):
            without = entry if views is None else entries[0]
            return f"{without.where} has no georeference, and the other has one"
        if views is not None and first is not None and views != first:
            differing = "coordinate reference systems" if views.crs != first.crs else "frames of the coordinates"
            return f"the {differing} of {entries[0].where} and {entry.where} differ"
    return ""


def _no_voxels(entries: Sequence[Entry]) -> str:
    """Return why no voxels can be paired; '' if voxels can be paired."""
    for entry in entries:
        if entry.is_small:
            return f"{entry.where} is a small summary, without voxels: {BY_CUBES}"
        if entry.record.voxels_file is None or not entry.record.voxels_file.exists():
            return f"{entry.where} has no voxels: {BY_CUBES}"
    return ""


def _notes(covered: Sequence[MapCoverage]) -> list[str]:
    return [
        f"only {row.common_share:.1%} of the voxels of {row.model} are in all maps: are the frames of reference the"
        " same?"
        for row in covered
        if row.common_share < FEW
    ]
