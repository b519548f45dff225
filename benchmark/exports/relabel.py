"""Project the fused labels back into the frames: label maps of a new source, such as pseudo-labels to train with."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.backends.shared.association import Observations, back_project, observe
from semstab.config import nearest
from semstab.core.files import write_json
from semstab.core.prefetch import SizedCache, prefetch
from semstab.core.types import Float64, Int64, Mask, UInt8, UInt16
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.data.measures import dominant
from semstab.data.records import Record
from semstab.data.tiles import AT_HAND, TileIndex, Tiles
from semstab.data.voxels import VoxelTable
from semstab.engine.folder import SETTINGS, load_result, model_of
from semstab.engine.units import make_plan
from semstab.errors import ConfigError, DataError
from semstab.exports.join import NONE, VoxelLookup
from semstab.metrics import CATEGORIES, categories
from semstab.metrics.agreement import rows_of
from semstab.predict.folder import NO_FOLDER_NAME, PredictionFolder, names_a_folder
from semstab.settings import load_config
from semstab.statistics import psa
from semstab.statistics.acceptance import AcceptanceThresholds
from semstab.task import Task, read, truth_task

# A pixel of a frame gets the class of the map where its voxel meets the criteria.

UNSEEN, UNSTABLE = -1, -2
"""The marks of a pixel without a class: no depth or no voxel there; a voxel that fails the criteria."""

DECIMALS = 9
"""The decimals of evidence without a frame's own vote, so that no rounding error decides a tie."""


@dataclass(frozen=True)
class Belief:
    """The criteria that a voxel must meet.

    Attributes:
        min_op: Number of frames that must see a voxel.
        min_psa: Share of its pairs of frames that must agree; a voxel seen once has no pair.
        categories: Categories that a voxel may be in, any where none is named.
        leave_one_out: True to leave the frame's own vote out; another frame must then see the voxel. Drift stays that
            of all votes: it depends on their order.
        thresholds: Thresholds whose evidence the label must have.

    Raises:
        ConfigError: For an unknown category, and values out of range.

    Examples:
        >>> belief = semstab.Belief(min_op=3, min_psa=0.8, categories=("stable",))
        >>> semstab.relabel("run:sim-steady", "fused", belief=belief).frames
        24
    """

    min_op: int = 1
    min_psa: float = 0.0
    categories: tuple[str, ...] = ()
    leave_one_out: bool = False
    thresholds: AcceptanceThresholds | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_psa <= 1:
            raise ConfigError(f"min_psa = {self.min_psa:g}: agreement lies between 0 and 1")
        for name in self.categories:
            if name not in CATEGORIES:
                raise ConfigError(f"no category '{name}'; {nearest(name, CATEGORIES)}")

    def of(self, table: VoxelTable) -> Mask:
        """Return a mask (n,) of the voxels that meet the criteria."""
        believed = table.op >= max(self.min_op, 1)
        if self.min_psa > 0:
            believed &= np.nan_to_num(psa(table), nan=-1.0) >= self.min_psa
        if self.categories:
            with np.errstate(invalid="ignore"):  # the belief of no vote
                believed &= np.isin(categories(table), [CATEGORIES.index(name) for name in self.categories])
        if self.thresholds is not None:
            believed &= self.thresholds.decide(table) >= 0
        return believed

    def settings(self) -> dict[str, object]:
        """Return the criteria for JSON."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return own | {"thresholds": None if self.thresholds is None else self.thresholds.model_dump(by_alias=True)}


class FusedLabels:
    """A lookup of the classes of a map that a frame sees; the latest tiles stay in memory."""

    def __init__(self, tiles: Tiles[VoxelTable], belief: Belief, num_classes: int) -> None:
        self._tiles, self._belief, self._K = tiles, belief, num_classes
        self._lookups: SizedCache[TileIndex, VoxelLookup] = SizedCache(
            lambda tile: VoxelLookup(self._tiles[tile]), lambda lookup: len(lookup.table), AT_HAND
        )

    def of(self, frame: Frame, pixel_stride: int = 1) -> Int64:
        """Return (H, W) rows 0..K-1 of the map's classes, UNSEEN or UNSTABLE, whatever the frame's own labels are.

        The frame is one of those that were fused, with every pixel_stride-th pixel of each axis.
        """
        everywhere = dataclasses.replace(frame, labels=np.zeros(frame.shape, np.uint8), scores=None)
        points = back_project(everywhere).T
        labels, fused = np.full(len(points), UNSEEN), np.full(frame.shape, UNSEEN)
        own = (
            observe(frame.every(pixel_stride), self._tiles.voxel_size, self._K) if self._belief.leave_one_out else None
        )
        for tile, pixels in self._tiles.holding(points):
            labels[pixels] = self._labels(self._lookups[tile], points[pixels], own)
        fused[everywhere.valid] = labels
        return fused

    def _labels(self, lookup: VoxelLookup, points: Float64, own: Observations | None) -> Int64:
        """Return the classes (n,) of points in a tile."""
        voxel = lookup.rows(points)
        met = voxel != NONE
        rows, inverse = np.unique(voxel[met], return_inverse=True)
        seen = rows_of(lookup.table, rows)
        if own is not None:
            seen = _without(own, lookup, seen, rows)
        label = np.where(self._belief.of(seen), dominant(seen), UNSTABLE)
        labels = np.full(len(points), UNSEEN)
        labels[met] = label[inverse]
        return labels


def _without(own: Observations, lookup: VoxelLookup, seen: VoxelTable, rows: Int64) -> VoxelTable:
    """Return the voxels of a tile that a frame sees, `rows` of it, without the frame's own vote."""
    centers = np.add(own.index, 0.5, dtype=np.float64) * seen.voxel_size
    seen_rows = lookup.rows(centers)
    here = seen_rows != NONE
    at = np.searchsorted(rows, seen_rows[here])
    evidence, op, self_sum = seen.evidence[:], seen.op.copy(), seen.self_sum.copy()
    evidence[at] = np.abs(np.round(evidence[at] - own.s_bar[here], DECIMALS))
    op[at] -= 1
    self_sum[at] -= (own.s_bar[here] ** 2).sum(axis=1)
    return dataclasses.replace(seen, evidence=Evidence.of(evidence), op=op, self_sum=self_sum)


def labels_of(fused: Int64, ids: Sequence[int]) -> UInt8 | UInt16:
    """Return the label map of fused rows: the ids of the classes, or the ignore id."""
    at = np.where(fused < 0, len(ids), fused)
    if max(ids) < IGNORE_8BIT:
        return np.array([*ids, IGNORE_8BIT], np.uint8)[at]
    return np.array([*ids, IGNORE_16BIT], np.uint16)[at]


# The effect of relabelling: pixels confirmed, changed and dropped, and accuracy where there is ground truth.


@dataclass(frozen=True)
class Accuracy:
    """The accuracy and mean IoU of a number of pixels with ground truth."""

    pixels: int
    accuracy: float
    miou: float

    @classmethod
    def of(cls, confusion: Int64) -> Accuracy:
        """Return the accuracy of pixels (K, K) by true and given class; a class without pixels does not count."""
        right, n = confusion.diagonal(), int(confusion.sum())
        union = confusion.sum(axis=0) + confusion.sum(axis=1) - right
        there = union > 0
        miou = float((right[there] / union[there]).mean()) if there.any() else math.nan
        return cls(n, float(right.sum() / n) if n else math.nan, miou)


@dataclass(frozen=True)
class Correctness:
    """The accuracy of labels by ground truth, before and after: on all pixels, and on those with a label in both.

    Attributes:
        all_before, all_after: Accuracy on all pixels with such a label.
        before, after: Accuracy on the same pixels, those that have a label before and after.
    """

    all_before: Accuracy
    before: Accuracy
    after: Accuracy
    all_after: Accuracy


@dataclass(frozen=True)
class Relabelled:
    """The numbers of pixels of a relabelled source, whose maps are in `folder`.

    Attributes:
        confirmed: Pixels with the same class as before.
        changed: Pixels with another class than before.
        filled: Pixels that had no class.
        unseen: Pixels that had a class, and have no depth or no voxel.
        unstable: Pixels that had a class, and whose voxel fails the criteria.
    """

    scene: str
    model: str
    name: str
    folder: str
    frames: int
    pixels: int
    confirmed: int
    changed: int
    filled: int
    unseen: int
    unstable: int
    leave_one_out: bool = False
    correctness: Correctness | None = None

    def lines(self) -> Iterator[str]:
        """Yield the report, a line each."""
        yield f"{self.scene}, {self.name}: {self.frames} frames in {self.folder}"
        counts = {
            "confirmed": self.confirmed, "changed": self.changed, "filled in": self.filled,
            "dropped without depth or voxel": self.unseen, "dropped by the criteria": self.unstable,
        }  # fmt: skip
        yield f"  of {self.pixels:,} pixels"
        yield from (f"    {n / self.pixels:6.1%} {what}" for what, n in counts.items())
        if self.correctness is not None:
            c = self.correctness
            yield f"  where both have a label and ground truth, {c.after.pixels:,} pixels:"
            yield f"    accuracy {c.before.accuracy:.3f} before, {c.after.accuracy:.3f} after"
            yield f"    mean IoU {c.before.miou:.3f} before, {c.after.miou:.3f} after"
        if not self.leave_one_out:
            yield "  do not assess the stability of these maps: a voxel has one class in all of them"


class Tally:
    """A count of pixels, frame by frame."""

    def __init__(self, K: int) -> None:
        self._K = K
        self.counts = dict.fromkeys(("pixels", "confirmed", "changed", "filled", "unseen", "unstable"), 0)
        self._confusion = {name: np.zeros((K, K), np.int64) for name in ("all_before", "before", "after", "all_after")}

    def add(self, own: Frame, fused: Int64, truth: Frame | None) -> None:
        """Count the pixels of a frame, its fused rows (H, W), and its ground truth in the same classes."""
        before = np.where(own.predicted == own.ignore_id, UNSEEN, own.predicted.astype(np.int64))
        had, has = before >= 0, fused >= 0
        masks = {
            "pixels": np.ones(fused.shape, np.bool_),
            "confirmed": had & has & (before == fused),
            "changed": had & has & (before != fused),
            "filled": ~had & has,
            "unseen": had & (fused == UNSEEN),
            "unstable": had & (fused == UNSTABLE),
        }
        for name, mask in masks.items():
            self.counts[name] += int(np.count_nonzero(mask))
        if truth is None or truth.shape != fused.shape:
            return
        true, known = truth.predicted.astype(np.int64), truth.predicted != truth.ignore_id
        compared = {
            "all_before": (before, known & had),
            "before": (before, known & had & has),
            "after": (fused, known & had & has),
            "all_after": (fused, known & has),
        }
        for name, (given, mask) in compared.items():
            pairs = true[mask] * self._K + given[mask]
            self._confusion[name] += np.bincount(pairs, minlength=self._K**2).reshape(self._K, self._K)

    def correctness(self) -> Correctness | None:
        """Return the accuracies; None where no pixel has ground truth."""
        if not self._confusion["all_before"].any():
            return None
        return Correctness(**{name: Accuracy.of(confusion) for name, confusion in self._confusion.items()})


__all__ = ["Belief", "Relabelled", "relabel"]

REPORT = "relabelled.json"
Progress = Callable[[str, int, int], None]


def relabel(
    run: str | Path,
    out: str | Path,
    *,
    belief: Belief | None = None,
    scene: str | None = None,
    model: str | None = None,
    backend: str | None = None,
    name: str | None = None,
    overwrite: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> Relabelled:
    """Write the fused class of every pixel of every frame of a unit to OUT/labels/NAME.

    Of scans it is a .label file of each in OUT/predictions/NAME: an id a point, where it has none 0, or 65535 where 0
    is a class.

    Args:
        run: Folder of the run, or FOLDER:MODEL.
        out: Folder that gets labels/NAME.
        belief: The criteria of a voxel; other pixels are ignored, as are those without depth.
        scene: Scene of the unit; may be left out where there is one.
        model: Model of the unit; may be left out where there is one.
        backend: Backend of the unit, the base backend where not given.
        name: Name of the new source, MODEL-fused where not given; its classes are in its folder.
        overwrite: Whether other predictions in the folder are replaced.
        progress: A function that is called with the task, the number of finished frames, and the number of all frames.

    Returns:
        The folder that was written, and the numbers of pixels that were confirmed, changed and filled.

    Raises:
        ConfigError, DataError: If the data has changed since it was fused, or its label maps cannot have the depth's
            pixels.

    Examples:
        >>> made = semstab.relabel("run:sim-flicker", "fused", name="calm")
        >>> made.changed > 0
        True
    """
    if name is not None and not names_a_folder(name):
        raise ConfigError(f"name {name!r}: {NO_FOLDER_NAME}")
    run, model = model_of(run, model)
    result = load_result(run)
    record = result.record(scene=scene, model=model, backend=backend)
    task, pixel_stride = task_of(run, record, result.manifest["inputs"])
    chosen, name = belief or Belief(), name or f"{record.unit.model}-fused"
    settings = {"unit": record.key, "backend": record.unit.backend, **chosen.settings()}
    space = task.mapping.target
    scans = task.scene.of_scans
    path = Path(out) / ("predictions" if scans else "labels") / name
    folder = PredictionFolder(
        path, "points" if scans else "labels", settings, {"name": name}, space, overwrite=overwrite
    )
    if record.voxels_file is None:
        raise DataError(f"{run}: the run stored no voxels of {record.unit.slug}; run it again")
    tally, truth = Tally(len(space)), truth_task(task)
    fused = FusedLabels(Tiles.open(record.voxels_file, VoxelTable), chosen, len(space))

    def read_and_fuse(index: int) -> tuple[Frame, Int64, Frame | None]:
        frame = read(task, index)
        known = None
        if truth is not None:
            with contextlib.suppress(DataError):  # a frame without ground truth
                known = read(truth, index)
        return frame, fused.of(frame, pixel_stride), known

    with contextlib.closing(folder):
        for done, fetched in enumerate(prefetch(read_and_fuse, task.indices), start=1):
            frame, rows, known = fetched.item
            maps = labels_of(rows, space.ids)
            if scans and 0 not in space.ids:  # formats of scans have 0 where a point has no class
                maps = np.where(rows < 0, maps.dtype.type(0), maps)
            if (
                done == 1
                and not scans
                and not np.array_equal(task.scene.predicted(frame.index, labels=maps).predicted, maps)
            ):
                raise DataError(
                    f"{task.scene.name}: its label maps have the pixels of the image, not those of the depth;"
                    " convert it (semstab-bench convert), and run and relabel the posed folder"
                )
            folder.write(task.scene.image_name(frame.index), record.key, maps, 0.0)
            tally.add(frame, rows, known)
            progress(f"{task.scene.name} · {name}", done, len(task.indices))
        folder.require_whole()
        folder.save()
        report = Relabelled(
            task.scene.name, task.model, name, str(folder.path), len(task.indices), **tally.counts,
            leave_one_out=chosen.leave_one_out, correctness=tally.correctness(),
        )  # fmt: skip
        write_json(folder.path / REPORT, {**dataclasses.asdict(report), "belief": chosen.settings()})
    return report


def task_of(run: Path, record: Record, fused: Mapping[str, str]) -> tuple[Task, int]:
    """Return the unit as it was fused, from inputs of these digests, and its pixel stride.

    Raises:
        DataError: If its data has changed since.
    """
    plan = make_plan(load_config(run / SETTINGS))
    scene, model = record.unit.scene, record.unit.model
    task = next((task for task in plan.tasks if (task.scene.name, task.model) == (scene, model)), None)
    if task is None or task.digest != fused.get(f"{scene}/{model}"):
        raise DataError(f"{run}: the data of {scene}, {model} has changed since it was fused; run it again")
    return task, plan.config.pixel_stride
