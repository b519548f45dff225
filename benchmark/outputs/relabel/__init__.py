"""Fused labels back into the frames: label maps of a new source, such as pseudo-labels to train with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.views.resampling import Labels
from semstab.engine.evaluation import truth_task
from semstab.engine.folder import SETTINGS, load_result
from semstab.engine.units import make_plan
from semstab.errors import DataError
from semstab.model.frames import Frame
from semstab.model.records import Record
from semstab.model.voxels import VoxelTable
from semstab.model.voxels.tiles import Tiles
from semstab.outputs.relabel.fused_labels import Belief, FusedLabels, labels_of
from semstab.outputs.relabel.report import Relabelled, Tally
from semstab.predict.disk.folder import PredictionFolder
from semstab.runtime.files import write_json
from semstab.runtime.prefetch import prefetch
from semstab.settings import load_config
from semstab.task import Task, read

__all__ = ["Belief", "Relabelled", "relabel"]

REPORT = "relabelled.json"
Progress = Callable[[str, int, int], None]


def relabel(
    run: str | Path,
    out: str | Path,
    *,
    belief: Belief | None = None,
    scene: str | None = None,
    backbone: str | None = None,
    backend: str | None = None,
    name: str | None = None,
    overwrite: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> Relabelled:
    """Look up the fused class of every pixel of every frame of a unit, and write the maps to OUT/labels/NAME.

    scene, backbone, backend  which unit; may be left out where there is one, and for the base backend
    name  of the new source, BACKBONE-fused where not given; its classes stand beside its maps
    belief  which voxels count; the pixels of others are ignored, as are those without depth

    Raises ConfigError, and DataError where the data is no longer what was fused, or its label maps cannot have the
    depth's pixels.
    """
    result = load_result(run)
    record = result.record(scene=scene, backbone=backbone, backend=backend)
    task, pixel_stride = _task(Path(run), record, result.manifest["inputs"])
    chosen, name = belief or Belief(), name or f"{record.unit.backbone}-fused"
    settings = {"unit": record.key, "backend": record.unit.backend, **chosen.settings()}
    space = task.mapping.target
    folder = PredictionFolder(
        Path(out) / "labels" / name, "labels", settings, {"name": name}, space, overwrite=overwrite
    )
    if record.voxels_file is None:
        raise DataError(f"{run}: kept no voxels of {record.unit.slug}; run it again")
    tally, truth = Tally(len(space)), truth_task(task)
    fused = FusedLabels(Tiles.open(record.voxels_file, VoxelTable), chosen, len(space))

    def work(index: int) -> _Work:
        frame = read(task, index)
        return _Work(frame, fused.of(frame, pixel_stride), None if truth is None else _known(truth, index))

    for done, fetched in enumerate(prefetch(work, task.indices), start=1):
        each = fetched.item
        maps = labels_of(each.fused, space.ids)
        if done == 1:
            _require_same_pixels(task, each.frame.index, maps)
        folder.write(task.scene.image_name(each.frame.index), record.key, maps, 0.0)
        tally.add(each.frame, each.fused, each.truth)
        progress(f"{task.scene.name} · {name}", done, len(task.indices))
    folder.save()
    report = Relabelled(
        task.scene.name, task.backbone, name, str(folder.path), len(task.indices), **tally.counts,
        leave_own_out=chosen.leave_own_out, correctness=tally.correctness(),
    )  # fmt: skip
    write_json(folder.path / REPORT, {**dataclasses.asdict(report), "belief": chosen.settings()})
    return report


@dataclass(frozen=True, eq=False)
class _Work:
    """A frame as it was fused, its fused rows (H, W), and its ground truth."""

    frame: Frame
    fused: npt.NDArray[np.int64]
    truth: Frame | None


def _task(run: Path, record: Record, fused: Mapping[str, str]) -> tuple[Task, int]:
    """The unit as it was fused, from inputs of these digests, and its pixel stride.

    Raises DataError where its data has changed since.
    """
    plan = make_plan(load_config(run / SETTINGS))
    scene, backbone = record.unit.scene, record.unit.backbone
    task = next((task for task in plan.tasks if (task.scene.name, task.backbone) == (scene, backbone)), None)
    if task is None or task.digest != fused.get(f"{scene}/{backbone}"):
        raise DataError(f"{run}: the data of {scene}, {backbone} is not what was fused; run it again")
    return task, plan.config.pixel_stride


def _known(truth: Task, index: int) -> Frame | None:
    """A frame with its ground truth, where it has any."""
    try:
        return read(truth, index)
    except DataError:
        return None


def _require_same_pixels(task: Task, index: int, maps: Labels) -> None:
    """Raise DataError where a label map of the depth's pixels would be read as one of the image's."""
    if not np.array_equal(task.scene.predicted(index, labels=maps).predicted, maps):
        raise DataError(
            f"{task.scene.name}: its label maps have the pixels of the image, not those of the depth; convert it"
            " (semstab-bench convert), and run and relabel the posed folder"
        )
