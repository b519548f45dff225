"""Differences between runs: each measure with its interval, the scope of the interval, and its p-value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.comparison.caution import cautions
from semstab.comparison.entries import Entry, Flicker, RunHandle, shared_scenes
from semstab.comparison.locations import VoxelChanges, worse_areas
from semstab.comparison.pairing import Common, joint_class, pair
from semstab.comparison.quantities import (
    BY_CLASS,
    COVERAGE,
    FLICKER,
    HEADLINES,
    IN_SUMS,
    IOU,
    ONE_AGAINST_ALL,
    PRECISION,
    RECALL,
    quantities,
)
from semstab.core.types import THESE_FRAMES, THIS_SCENE, Int64, Scope
from semstab.data.contrast import Against, Compared, Contrast, RunComparison, SceneComparison
from semstab.data.measures import Measure, Quantity, mean
from semstab.data.results import slug
from semstab.data.statistics import CONFIDENCE, UNKNOWN, Interval
from semstab.data.voxels import VoxelTable
from semstab.metrics import macro_mean
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import ALPHA, ratio_of
from semstab.statistics.cluster_sums import ClusterSums, functional, value
from semstab.statistics.correctness import ACCURACY, MIOU
from semstab.statistics.intervals import (
    coverage,
    difference,
    difference_over_frames,
    estimate,
    mean_of,
    mean_over_frames,
    no_difference,
    scope_of,
    standard_error,
    unpaired,
)

OF_ANY_SIZE = OF_LIKELIEST = (ALPHA, ACCURACY, MIOU, RECALL, PRECISION, IOU)
"""Measures that hardly depend on the size of voxels, and need no more than the likeliest classes of scores."""

LEAST_VOXELS = 50
"""Least number of voxels of a class that is compared."""

SIGNIFICANCE = 0.05
"""Corrected p-value below which a difference is claimed."""


def contrasts(common: Common, base: Entry, other: Entry, number: int) -> tuple[Contrast, ...]:
    """Return all contrasts of a scene, in the order of `quantities`.

    `number` is the other run's among the runs.
    """
    result = {row.measure: row for row in _rows(common, base, other, number)}
    return tuple(result[quantity.name] for quantity in quantities() if quantity.name in result)


def by_class(common: Common, base: Entry, number: int) -> tuple[Contrast, ...]:
    """Return the contrasts of each class: against all others, or of the locations of the class.

    The locations follow from the ground truth, or else from all runs together, so that no run chooses its own.
    """
    if common.basis == "images":
        return ()
    names = base.classes or tuple(str(k) for k in range(base.sums.K))
    of_locations = list(_of_locations(common, names, number)) if common.tables else []
    rows = [*_against_all(common, names, number), *of_locations]
    order = {quantity.name: rank for rank, quantity in enumerate(BY_CLASS)}
    return tuple(sorted(rows, key=lambda row: (names.index(row.of), order[row.measure])))


def over_scenes(result: Sequence[Sequence[Contrast]]) -> tuple[Contrast, ...]:
    """Return the macro mean of each measure (and class) over scenes that have an interval of it, or else a value."""
    groups: dict[tuple[str, str], list[Contrast]] = {}
    for row in (row for rows in result for row in rows):
        groups.setdefault((row.measure, row.of), []).append(row)
    means = []
    for (measure, of), group in groups.items():
        rows = [row for row in group if not math.isnan(row.difference.low)] or group
        base, other = macro_mean([row.base for row in rows]), macro_mean([row.other for row in rows])
        means.append(Contrast(measure, of, base, other, mean_of([row.difference for row in rows]), math.nan, ""))
    return tuple(means)


def corrected(lists: Sequence[Sequence[Contrast]]) -> list[tuple[Contrast, ...]]:
    """Return lists with corrected p-values, and the change that each shows.

    The test is of alpha over all classes: it is corrected for the runs alone, descriptive numbers for all of them.
    """
    rows = [row for contrasts in lists for row in contrasts]
    p_values = np.array([row.difference.p_value for row in rows])
    tested = np.array([row.measure == ALPHA.name and not row.of for row in rows], bool)
    for family in (tested, ~tested):
        p_values[family] = holm(p_values[family].tolist())
    of_rows = iter(p_values.tolist())
    better = {quantity.name: quantity.sign for quantity in (*quantities(), *BY_CLASS)}
    return [tuple(_with_change(row, next(of_rows), better[row.measure]) for row in contrasts) for contrasts in lists]


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number.

    Rejecting those <= q limits the chance of any false rejection to q (Holm 1979).

    >>> [round(value, 2) for value in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    corrected = [float("nan")] * len(p)
    tested = sorted((p_value, i) for i, p_value in enumerate(p) if not np.isnan(p_value))
    highest = 0.0
    for rank, (p_value, i) in enumerate(tested):
        highest = max(highest, min(1.0, p_value * (len(tested) - rank)))
        corrected[i] = highest
    return corrected


def _with_change(row: Contrast, p_holm: float, sign: float) -> Contrast:
    is_significant = p_holm < SIGNIFICANCE and row.difference.decided
    gain = -sign * row.difference.value
    return dataclasses.replace(row, p_holm=p_holm, change=("better" if gain > 0 else "worse") if is_significant else "")


# --- One scene --------------------------------------------------------------------------------------------------------


def _rows(common: Common, base: Entry, other: Entry, number: int) -> Iterator[Contrast]:
    for quantity in IN_SUMS:
        if _comparable(quantity, common):
            yield from _row(quantity, common.sums[0], common.sums[number], common)
    if common.basis not in ("flights", "images") and not common.sizes_differ:
        before, after = base.sums.without_truth(), other.sums.without_truth()
        change = sums_difference(COVERAGE.key, after, before, same_frames=common.same_frames)
        yield Contrast(COVERAGE.name, "", 1.0, 1 + change.value, change, math.nan, "")
    if base.flicker and (base.flicker.keys() == other.flicker.keys() or common.same_frames is False):
        yield _flicker(base.flicker, other.flicker, paired=common.same_frames is not False)
    done = {quantity.key for quantity in (*HEADLINES, *IN_SUMS)}
    for quantity in quantities():
        if isinstance(quantity, Measure) and quantity.key not in done and common.tables and not common.mixed:
            yield _of_voxels(quantity, common.tables[0], common.tables[number], common.sums[0].edge)


def _comparable(quantity: Quantity, common: Common) -> bool:
    """Return whether a quantity is fair to the voxel sizes, and to the labels and scores, that are compared."""
    return quantity in OF_ANY_SIZE or not (common.sizes_differ or common.mixed)


def _row(
    quantity: Quantity, base: ClusterSums, other: ClusterSums, common: Common, k: int | None = None, of: str = ""
) -> Iterator[Contrast]:
    key = quantity.key
    before, after = value(base, key, k), value(other, key, k)
    if not (math.isnan(before) and math.isnan(after)):
        scopes = [scope_of(sums, key=key, k=k) for sums in (base, other)]
        scope = THESE_FRAMES if THESE_FRAMES in scopes else common.scope
        apart = common.basis == "flights"
        change = sums_difference(key, other, base, k, scope=scope, same_frames=common.same_frames, apart=apart)
        yield Contrast(quantity.name, of, before, after, change, math.nan, "")


def sums_difference(
    key: str,
    new: ClusterSums,
    base: ClusterSums,
    k: int | None = None,
    *,
    scope: Scope = THIS_SCENE,
    same_frames: bool | None = None,
    apart: bool = False,
    level: float = CONFIDENCE,
) -> Interval:
    """Return a number of one run's sums less another's, or its coverage of the other's voxels, with its interval.

    - `same_frames`: False for another flight; by default the sums show it
    - `apart`: the runs have nothing in common: their errors are independent
    - `level`: level of the interval
    """
    if new.truth != base.truth:
        new, base = new.without_truth(), base.without_truth()
    if key == COVERAGE.key:
        return _with_p_value(coverage(new, base, level, same_frames=same_frames))
    number = functional(key, k)
    scope = THESE_FRAMES if number.of_space_alone else scope
    if apart:
        return unpaired(estimate(new, key, k, scope, level), estimate(base, key, k, scope, level))
    result, most = difference(new, base, key, k, scope, same_frames=same_frames, level=level), number.high - number.low
    return dataclasses.replace(result, low=max(result.low, -most), high=min(result.high, most))


def flicker_difference(new: Flicker, base: Flicker, *, paired: bool = True, level: float = CONFIDENCE) -> Interval:
    """Return the mean flicker of one run less another's, by frame where both have the same ones."""
    if paired and len(new.keys() & base.keys()) > 1:
        return _with_p_value(difference_over_frames(new, base, level))
    means = [mean_over_frames(np.array([*flicker]), np.array([*flicker.values()]), level) for flicker in (new, base)]
    return unpaired(means[0], means[1])


def _flicker(base: Flicker, other: Flicker, *, paired: bool) -> Contrast:
    frames = base.keys() & other.keys() if paired else set()
    before, after = (
        mean(np.array([flicker[frame] for frame in (frames if len(frames) > 1 else flicker)]))
        for flicker in (base, other)
    )
    return Contrast(FLICKER.name, "", before, after, flicker_difference(other, base, paired=paired), math.nan, "")


def _of_voxels(measure: Measure, base: VoxelTable, other: VoxelTable, edge: float) -> Contrast:
    """Return the mean of a measure over its population in both maps, by its differences voxel by voxel."""
    before, after = measure.of(base), measure.of(other)
    defined = ~np.isnan(before) & ~np.isnan(after) & (base.op >= measure.op) & (other.op >= measure.op)
    if not defined.any():
        return Contrast(measure.name, "", math.nan, math.nan, UNKNOWN, math.nan, "")
    cubes, columns = Cubes.from_table(base, edge, where=defined), np.stack([after - before, defined], axis=1)
    before, after = before[defined], after[defined]
    change = cubes.estimate(columns, ratio_of, (-measure.largest, measure.largest), "plain")
    result = no_difference(change) if np.array_equal(before, after) else _with_p_value(change)
    return Contrast(measure.name, "", mean(before), mean(after), result, math.nan, "")


def _with_p_value(interval: Interval) -> Interval:
    """Return the interval with the p-value that the number is 0."""
    from scipy import special

    error = standard_error(interval)
    if not error > 0:
        return interval
    degrees = interval.degrees if interval.degrees > 0 else math.inf
    return dataclasses.replace(interval, p_value=float(2 * special.stdtr(degrees, -abs(interval.value) / error)))


# --- By class ---------------------------------------------------------------------------------------------------------


def _against_all(common: Common, names: Sequence[str], number: int) -> Iterator[Contrast]:
    for quantity in ONE_AGAINST_ALL:
        before, after = common.sums[0], common.sums[number]
        if not _comparable(quantity, common):
            continue
        for k, name in enumerate(names):
            mean_op = before["observations"].sum() / max(before["voxels"].sum(), 1e-9)
            if before["evidence"][:, k].sum() >= LEAST_VOXELS * mean_op:  # evidence of LEAST_VOXELS voxels
                yield from _row(quantity, before, after, common, k, name)


def _of_locations(common: Common, names: Sequence[str], number: int) -> Iterator[Contrast]:
    labels = class_of_locations(common)
    comparable = [
        quantity for quantity in BY_CLASS if quantity not in ONE_AGAINST_ALL and _comparable(quantity, common)
    ]
    for k, name in enumerate(names):
        where = labels == k
        if np.count_nonzero(where) < LEAST_VOXELS:
            continue
        sums = common.among(where)
        for quantity in comparable:
            yield from _row(quantity, sums[0], sums[number], common, of=name)


def class_of_locations(common: Common) -> Int64:
    """Return the class (n,) of each common location: the true one, or that of all runs together; -1 if unknown."""
    return common.label if common.label is not None else joint_class(common.tables)


# Each run is compared with the first one, scene by scene and over all scenes.

SCHEMA = 1
COLUMNS = "columns"
"""Folder of the files SCENE__BASE__RUN.parquet: the changes in each voxel."""

Up = tuple[float, float, float]
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class ComparisonData:
    """The result of a comparison, and the data of its figures and files.

    Attributes:
        changes: Changes in each voxel, by scene and run, where voxels could be paired.
        up: The up axis of each scene, if it is known.
    """

    result: RunComparison
    changes: Mapping[tuple[str, str], VoxelChanges]
    up: Mapping[str, Up]


def differences_of(
    handles: Sequence[RunHandle], progress: Progress = lambda what: None, scope: Scope = THIS_SCENE
) -> ComparisonData:
    """Compare opened runs with the first one for a scope; `progress` is called with each step.

    Raises:
        ConfigError: If a run has features and no labels.
        DataError: As `shared_scenes` and `pair` do.
    """
    for handle in handles:
        handle.require_labels()
    scenes: list[SceneComparison] = []
    changes: dict[tuple[str, str], VoxelChanges] = {}
    for scene in shared_scenes(handles):
        progress(scene)
        rows, scene_changes = _scene(scene, handles, scope)
        scenes.append(rows)
        changes |= {(scene, name): change for name, change in scene_changes.items()}
    result = RunComparison(
        schema=SCHEMA,
        base=handles[0].name,
        runs=tuple(
            Compared(
                handle.name,
                handle.source,
                handle.model,
                uninformative=all(handle.scenes[row.scene].caveat.startswith("uninformative") for row in scenes),
            )
            for handle in handles
        ),
        overall=(overall := _over_all(scenes)),
        scenes=tuple(scenes),
        cautions=tuple(dict.fromkeys(text for against in overall for text in _cautions(handles, against, scenes))),
    )
    ups = {scene: up for handle in reversed(handles) for scene, entry in handle.scenes.items() if (up := entry.up)}
    return ComparisonData(result, changes, ups)


def _cautions(handles: Sequence[RunHandle], against: Against, scenes: Sequence[SceneComparison]) -> Iterator[str]:
    base, other = handles[0], next(handle for handle in handles if handle.name == against.other)
    entries = [(base.scenes[scene.scene], other.scenes[scene.scene]) for scene in scenes]
    return cautions((base.name, other.name), entries, against.contrasts)


def _scene(scene: str, runs: Sequence[RunHandle], scope: Scope) -> tuple[SceneComparison, dict[str, VoxelChanges]]:
    entries, names = [run.scenes[scene] for run in runs], [run.name for run in runs]
    common = pair(entries, names, scope)
    numbers = range(1, len(entries))
    everything = corrected([contrasts(common, entries[0], entries[n], n) for n in numbers])
    classes = corrected([by_class(common, entries[0], n) for n in numbers])
    against, changes = [], {}
    for n, of_all, of_classes in zip(numbers, everything, classes, strict=True):
        result = Against(names[n], of_all, of_classes)
        if common.regions is not None:
            worse, name_frames = worse_areas(common, n), entries[n].with_names
            changes[names[n]] = worse.changes
            result = dataclasses.replace(
                result,
                compared=worse.changes.compared,
                worse=worse.changes.worse,
                better=worse.changes.better,
                areas=tuple(dataclasses.replace(area, frames=name_frames(area.frames)) for area in worse.areas),
                top_frames=name_frames(worse.top_frames),
                columns=Path(COLUMNS) / f"{slug(scene, names[0], names[n])}.parquet",
            )
        against.append(result)
    caveats = [f"{name} is {text}" for name, entry in zip(names, entries, strict=True) if (text := entry.caveat)]
    return _scene_comparison(scene, common, tuple(caveats), tuple(against)), changes


def _scene_comparison(
    scene: str, common: Common, caveats: tuple[str, ...], against: tuple[Against, ...]
) -> SceneComparison:
    frames = min((sums.frame_count for sums in common.sums), default=0)
    voxels = len(common.tables[0]) if common.tables else 0
    voxels = int((common.tables[0].op >= 2).sum()) if voxels else 0
    return SceneComparison(
        scene, common.basis, (*caveats, *common.notes), voxels, frames, common.coverage, common.observations, against
    )


def _over_all(scenes: Sequence[SceneComparison]) -> tuple[Against, ...]:
    """Return macro means; for one scene its own results."""
    if len(scenes) == 1:
        return tuple(Against(against.other, against.contrasts, against.by_class) for against in scenes[0].against)
    runs = list(zip(*(scene.against for scene in scenes), strict=True))
    everything = corrected([over_scenes([against.contrasts for against in run]) for run in runs])
    classes = corrected([over_scenes([against.by_class for against in run]) for run in runs])
    return tuple(
        Against(run[0].other, of_all, of_classes, *(sum(getattr(against, name) for against in run) for name in _COUNTS))
        for run, of_all, of_classes in zip(runs, everything, classes, strict=True)
    )


_COUNTS = ("compared", "worse", "better")
