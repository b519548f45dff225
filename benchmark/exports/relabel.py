"""Project the fused labels back into the frames: label maps of a new source, such as pseudo-labels to train with."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from semstab.configure import require_named_code, settings_of_folder
from semstab.core.files import write_json
from semstab.core.prefetch import prefetch
from semstab.core.types import Int64, UInt8, UInt16
from semstab.data.frames import Frame
from semstab.data.records import Record
from semstab.data.tiles import Tiles
from semstab.data.voxels import VoxelTable
from semstab.engine.folder import load_result, model_of
from semstab.engine.units import make_plan
from semstab.errors import ConfigError, DataError
from semstab.exports.fused_labels import Belief, FusedLabels, labels_of
from semstab.exports.relabel_counts import PixelTally, Relabelled
from semstab.predict.folder import NO_FOLDER_NAME, PredictionFolder, names_a_folder
from semstab.task import Task, read, truth_task

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
    code: Sequence[str] = (),
    progress: Progress = lambda what, done, total: None,
) -> Relabelled:
    """Write the fused class of every pixel of every frame of a unit to OUT/labels/NAME.

    Scans get a .label file each in OUT/predictions/NAME: an id a point. A point without a class has id 0, or 65535 if 0
    is a class.

    Args:
        run: Folder of the run, or FOLDER:MODEL.
        out: Folder that gets labels/NAME.
        belief: The criteria of a voxel; other pixels are ignored, and so are pixels without depth.
        scene: Scene of the unit; not needed with a single scene.
        model: Model of the unit; not needed with a single model.
        backend: Backend of the unit, by default the base backend.
        name: Name of the new source, by default MODEL-fused; its classes are in its folder.
        overwrite: Whether other predictions in the folder are replaced.
        code: Code that the run's settings name and that may run, FILE.py:NAME each; other code is refused.
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
    if record.voxels_file is None:
        why = "the run stored no voxels; run it again" if record.pixels is None else "a video has no map"
        raise DataError(f"{run}: {record.unit.slug}: {why}")
    belief, name = belief or Belief(), name or f"{record.unit.model}-fused"
    with contextlib.ExitStack() as open_parts:
        task, pixel_stride = open_parts.enter_context(task_of(run, record, result.manifest["inputs"], code))
        space = task.mapping.target
        folder = open_parts.enter_context(
            contextlib.closing(_folder(Path(out), name, task, record, belief, overwrite=overwrite))
        )
        fused = FusedLabels(Tiles.open(record.voxels_file, VoxelTable), belief, len(space))
        tally = PixelTally(len(space))
        for done, (frame, rows, true_frame) in enumerate(_fused_frames(task, fused, pixel_stride), start=1):
            _write_map(folder, record.key, task, frame, rows)
            tally.add(frame, rows, true_frame)
            progress(f"{task.scene.name} · {name}", done, len(task.indices))
        folder.require_whole()
        folder.save()
        report = Relabelled(
            task.scene.name, task.model, name, str(folder.path), len(task.indices), **tally.counts,
            leave_one_out=belief.leave_one_out, correctness=tally.correctness(),
        )  # fmt: skip
        write_json(folder.path / REPORT, {**dataclasses.asdict(report), "belief": belief.settings()})
    return report


def _folder(out: Path, name: str, task: Task, record: Record, belief: Belief, *, overwrite: bool) -> PredictionFolder:
    """Return the folder of the label maps, or of the labels of scans."""
    scans = task.scene.of_scans
    path = out / ("predictions" if scans else "labels") / name
    settings = {"unit": record.key, "backend": record.unit.backend, **belief.settings()}
    kind: Literal["points", "labels"] = "points" if scans else "labels"
    return PredictionFolder(path, kind, settings, {"name": name}, task.mapping.target, overwrite=overwrite)


def _fused_frames(task: Task, fused: FusedLabels, pixel_stride: int) -> Iterator[tuple[Frame, Int64, Frame | None]]:
    """Yield each frame of a unit, its fused rows (H, W), and its ground truth, None without."""
    truth = truth_task(task)

    def read_and_fuse(index: int) -> tuple[Frame, Int64, Frame | None]:
        frame, true_frame = read(task, index), None
        if truth is not None:
            with contextlib.suppress(DataError):  # a frame without ground truth
                true_frame = read(truth, index)
        return frame, fused.labels_of(frame, pixel_stride), true_frame

    return (fetched.item for fetched in prefetch(read_and_fuse, task.indices))


def _write_map(folder: PredictionFolder, key: str, task: Task, frame: Frame, rows: Int64) -> None:
    """Write the label map of a frame's fused rows (H, W)."""
    maps = _label_map(rows, task)
    if frame.index == task.indices[0]:
        _require_size_of_depth(task, frame, maps)
    folder.write(task.scene.image_name(frame.index), key, maps, 0.0)


def _label_map(rows: Int64, task: Task) -> UInt8 | UInt16:
    """Return the label map of fused rows (H, W); formats of scans have 0 where a point has no class."""
    ids = task.mapping.target.ids
    maps = labels_of(rows, ids)
    return np.where(rows < 0, maps.dtype.type(0), maps) if task.scene.of_scans and 0 not in ids else maps


def _require_size_of_depth(task: Task, frame: Frame, maps: UInt8 | UInt16) -> None:
    """Raise DataError for a scene that resizes label maps, so that it would read others than those written."""
    if task.scene.of_scans or np.array_equal(task.scene.predicted(frame.index, labels=maps).predicted, maps):
        return
    raise DataError(
        f"{task.scene.name}: its label maps have the pixels of the image, not those of the depth;"
        " convert it (semstab-bench convert), and run and relabel the posed folder"
    )


@contextlib.contextmanager
def task_of(
    run: Path, record: Record, fused: Mapping[str, str], code: Sequence[str] = ()
) -> Iterator[tuple[Task, int]]:
    """Yield the unit as it was fused, from inputs of these digests, and its pixel stride.

    Of the code that the run's settings name only that runs which the user named as `code`, as long as the block lasts.

    Raises:
        ConfigError: If the settings name other code.
        DataError: If its data has changed since.
    """
    with settings_of_folder(run, code) as config:
        require_named_code(run)
        plan = make_plan(config)
        scene, model = record.unit.scene, record.unit.model
        task = next((task for task in plan.tasks if (task.scene.name, task.model) == (scene, model)), None)
        if task is None or task.digest != fused.get(f"{scene}/{model}"):
            raise DataError(f"{run}: the data of {scene}, {model} has changed since it was fused; run it again")
        yield task, plan.config.pixel_stride
