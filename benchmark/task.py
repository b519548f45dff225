"""A model on a scene: its frames, the mapping of its labels to rows of evidence, and a frame of it, ready to fuse."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semstab.config import Config, Exclusion, Part, Perturbation, as_range, nearest
from semstab.core.types import Float64, Mask
from semstab.data.distances import distances_of
from semstab.data.features import OF_FEATURES
from semstab.data.frames import Frame
from semstab.data.labels import LabelMapping, LabelSpace
from semstab.data.results import UnitName
from semstab.datasets import GROUND_TRUTH, Scene, open_dataset
from semstab.datasets.scene import Selected, select_frames
from semstab.errors import ConfigError, DataError
from semstab.pixels.preparation import keep_largest, leave_out, perturb


@dataclass(frozen=True, eq=False)
class Task:
    """A model on a scene: its frames, and the mapping of its labels to rows of evidence.

    Attributes:
        indices: Indices of the frames, ascending; a range for evenly spaced frames.
        top_k: Number of the largest scores of a pixel that are fused; all by default.
        left_out: Number of selected frames without a file or a pose.
        apart: Backends whose maps need not agree with the maps of the other backends of a plan.
    """

    scene: Scene
    model: str
    indices: Sequence[int]
    mapping: LabelMapping
    backends: tuple[str, ...]
    perturbation: Perturbation | None = None
    exclude: Exclusion = dataclasses.field(default_factory=Exclusion)
    top_k: int | None = None
    left_out: int = 0
    apart: tuple[str, ...] = ()

    @property
    def units(self) -> list[UnitName]:
        """Return one unit for each backend."""
        return [UnitName(self.scene.name, self.model, backend) for backend in self.backends]

    @cached_property
    def digest(self) -> str:
        """Return a hash of the input behind it."""
        return self.scene.digest([*self.indices], self.model)


def class_distances(task: Task, config: Config) -> Float64 | None:
    """Return distances (K, K) between the classes of a run, from the settings, else from the model's own names."""
    target = task.mapping.target
    distances = distances_of(target, config.distances)
    label_space = task.scene.label_space(task.model)
    return task.scene.distances(task.model) if distances is None and label_space == target else distances


def open_scenes(config: Config, run_folder: Path | None = None, *, posed: bool = True) -> dict[str, Scene]:
    """Open the scenes that a configuration selects, by name, for a run in that folder; no image is read.

    Raises:
        ConfigError, DataError: If there is no such scene, its files contradict each other, or it has no depth and poses
            where they must be `posed`.
    """
    dataset = open_dataset(config.dataset.name, config.dataset.options, run_folder)
    names = selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name)
    scenes = {name: dataset.scene(name) for name in names}
    for scene in scenes.values() if posed else ():
        require_posed(scene)
    return scenes


def require_posed(scene: Scene) -> None:
    """Raise ConfigError where frames of a scene have no depth and poses, so that nothing can be fused."""
    if not scene.posed:
        raise ConfigError(
            f"{scene.name}: a video, without depth and poses; `semstab-bench run --dataset video` measures its flicker,"
            " all else needs a map"
        )


def tasks_of(scene: Scene, config: Config, others: Sequence[str] = ()) -> Iterator[Task]:
    """Yield the configuration's models on an open scene, checked; no image is read.

    Frames are those that have labels of all of them, and of the label sources `others`: models that are compared are
    fused from the same frames.
    """
    names = models_of(scene, config)
    if not names:
        if scene.unread is not None:
            raise DataError(scene.unread)
        searched = f"searched {', '.join(scene.label_paths)}; " if scene.label_paths else ""
        what, instead = "label maps", "add them, or predict them: --predict colour-clusters, or --predict FILE.py:NAME"
        if scene.of_scans:
            what, instead = "labels of its scans", "add those of a model"
        if scene.ground_truth:
            instead += f", or measure the ground truth: --model {GROUND_TRUTH}"
        raise DataError(f"{scene.name}: there are no {what}; {searched}{instead}")
    frames = _chosen_frames(scene, config, [*dict.fromkeys((*names, *others))])
    indices = as_range(frames.indices)
    for model in names:
        source = scene.label_space(model)
        keeps = config.taxonomy is None or source == OF_FEATURES  # which has no classes to map
        target = source if keeps else LabelSpace.load(str(config.taxonomy))
        mapping = source.mapping_to(target)
        distances_of(target, config.distances)  # a file that cannot be used is named before any frame is read
        predicted = [*dict.fromkeys((*source.classes, *target.classes))]
        for setting, classes in (("classes", target.classes), ("predicted_classes", predicted)):
            for name in getattr(config.exclude, setting):
                if name not in classes and not (setting == "predicted_classes" and mapping.positions_of([name])):
                    raise ConfigError(f"{scene.name}: exclude.{setting}: no class '{name}'; {nearest(name, classes)}")
        fused_by = tuple(backend.name for backend in config.fused_by() if applies(backend, scene.name, model))
        yield Task(
            scene, model, indices, mapping, fused_by, config.perturbation, config.exclude, config.top_k,
            frames.left_out,
        )  # fmt: skip


def models_of(scene: Scene, config: Config) -> Sequence[str]:
    """Return the label sources that a configuration selects; raises ConfigError for one that is not there."""
    for name in config.models or ():
        if name in scene.replaced and name not in (*scene.models, *scene.by_name):
            raise ConfigError(
                f"{scene.name}: label maps of '{name}' are there, but --predict stands for them; read them, too, by"
                f" --predict stored,source={name}"
            )
    return selected(config.models, scene.models, scene.by_name, "model", scene.name)


def applies(part: Part, scene: str, model: str) -> bool:
    """Return whether a part of the configuration takes in that model on that scene."""
    return scene in (part.scenes or [scene]) and model in (part.models or [model])


def _chosen_frames(scene: Scene, config: Config, sources: Sequence[str]) -> Selected:
    chosen = select_frames(scene, config.frames, sources)
    if not chosen.indices:
        raise ConfigError(f"{scene.name}: the selection of frames leaves none of its {len(scene)}; change 'frames'")
    return chosen


def frame_indices(scene: Scene, config: Config, sources: Sequence[str] = ()) -> list[int]:
    """Return the frames of a scene that the configuration selects, to be read with the labels of these sources.

    Raises:
        ConfigError: If there is none, and what `select_frames` raises.
    """
    return _chosen_frames(scene, config, sources).indices


def selected(
    wanted: list[str] | None, available: Sequence[str], extra: Sequence[str], kind: str, where: str
) -> Sequence[str]:
    """Return the wanted names, by default all known names; `extra` names must be named."""
    for name in wanted or ():
        if name not in (*available, *extra):
            raise ConfigError(f"{where}: no {kind} '{name}'; {nearest(name, [*available, *extra])}")
    return list(dict.fromkeys(wanted)) if wanted is not None else available


def read(task: Task, index: int, pixel_stride: int = 1, *, color: bool = False) -> Frame:
    """Return a frame of the task, ready to fuse, with colour if `color`."""
    return prepare(task, task.scene.frame(index, task.model, color=color), pixel_stride)


def prepare(task: Task, frame: Frame, pixel_stride: int = 1) -> Frame:
    """Return a scene's frame, ready to fuse: no moving things, rows 0..K-1 of the label space, noise, pixel stride."""
    classes = task.mapping.positions_of(task.exclude.predicted_classes)
    if frame.labels is not None:
        classes = tuple(task.mapping.source.ids[k] for k in classes)
    frame = leave_out(frame, classes, masks=task.exclude.masks)
    frame = _in_label_space(task.mapping, dataclasses.replace(frame, unlabelled=_unlabelled(frame)))
    if task.top_k is not None:
        if frame.scores is None and task.model != GROUND_TRUTH:
            raise ConfigError(
                f"{task.scene.name}: top_k keeps the largest scores of a pixel, but {task.model} has label maps;"
                " leave it out, or choose models with scores"
            )
        frame = frame if frame.scores is None else keep_largest(frame, task.top_k)
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(pixel_stride)


def _unlabelled(frame: Frame) -> Mask | None:
    """Return (H, W) the pixels with depth to which the model gave no label, or None if every pixel has a label.

    Classes that the run's taxonomy leaves out count as labels, and so do pixels that were left out because they move.
    """
    none: Mask = frame.predicted == frame.ignore_id
    if not none.any():
        return None
    none &= (frame.depth > 0) & (frame.depth < np.inf)
    return none if frame.left_out is None else none & ~frame.left_out


def _in_label_space(mapping: LabelMapping, frame: Frame) -> Frame:
    """Return the frame with its labels as rows 0..K-1 of the mapping's target, or its scores (H, W, K) for them."""
    if frame.labels is not None:
        return dataclasses.replace(frame, labels=mapping.labels(frame.labels, frame.where("labels")))
    assert frame.scores is not None
    return dataclasses.replace(frame, scores=mapping.scores(frame.scores, frame.where("scores")))


def truth_task(task: Task) -> Task | None:
    """Return the ground truth in the unit's label space, or None if it is missing or does not map to this space."""
    if not task.scene.ground_truth or task.model == GROUND_TRUTH:
        return None
    try:
        mapping = task.scene.label_space(GROUND_TRUTH).mapping_to(task.mapping.target)
    except ConfigError:
        return None
    return dataclasses.replace(task, model=GROUND_TRUTH, mapping=mapping)
