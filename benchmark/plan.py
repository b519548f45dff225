"""The plan of a run: what its configuration selects, opened and checked before the first image is read."""

from __future__ import annotations

import dataclasses
import difflib
import importlib.resources
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from semstab.backends import create
from semstab.config import Config, Exclusion, Perturbation, merge, read_yaml
from semstab.datasets import GROUND_TRUTH, Scene, open_dataset, resolved
from semstab.datasets.selection import Selected, select_frames
from semstab.errors import ConfigError, DataError
from semstab.exclusion import leave_out
from semstab.frames import Frame
from semstab.labels import LabelMapping, LabelSpace
from semstab.perturbation import perturb
from semstab.predict.live import NAME as PREDICTED
from semstab.predict.predictor import PredictorConfig
from semstab.results import Unit


@dataclass(frozen=True, eq=False)
class Task:
    """A backbone on a scene: which frames, and how its labels become rows of evidence.

    left_out  how many frames were selected but lack a file or a pose
    """

    scene: Scene
    backbone: str
    indices: list[int]
    mapping: LabelMapping
    backends: tuple[str, ...]
    perturbation: Perturbation | None = None
    exclude: Exclusion = dataclasses.field(default_factory=Exclusion)
    left_out: int = 0

    @property
    def units(self) -> list[Unit]:
        """One a backend."""
        return [Unit(self.scene.name, self.backbone, backend) for backend in self.backends]

    @cached_property
    def digest(self) -> str:
        """A hash of the input behind it."""
        return self.scene.digest(self.indices, self.backbone)


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything that a run will do, checked before the first image is read."""

    config: Config
    tasks: tuple[Task, ...]

    def last_of(self, scene: Scene) -> Task:
        """The last task of a scene."""
        return [task for task in self.tasks if task.scene is scene][-1]


def load_config(path: str | Path | None = None, overrides: Mapping[str, Any] | None = None) -> Config:
    """The configuration of a file with overrides on top, over what ships for its dataset in configs/datasets/."""
    content = merge(read_yaml(path) if path is not None else {}, overrides or {})
    return Config.build(merge(dataset_defaults(content), content), str(path or "configuration"))


def predicted_config(
    predictors: Sequence[PredictorConfig], path: str | Path | None, overrides: Mapping[str, Any]
) -> Config:
    """The configuration of a file with overrides on top, its dataset's labels replaced by predictions.

    Without a list of backbones in `overrides` all predictors are used.
    """
    content = merge(read_yaml(path) if path is not None else {}, overrides)
    inner = content.pop("dataset", {"name": "city"})
    content["backbones"] = overrides.get("backbones")
    content["dataset"] = {
        "name": PREDICTED,
        "options": {"dataset": inner, "backbones": [predictor.model_dump(mode="json") for predictor in predictors]},
    }
    return load_config(None, content)


def dataset_defaults(content: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that ship for the dataset which the content names, or for the built-in one."""
    dataset = content.get("dataset")
    name = dataset.get("name") if isinstance(dataset, Mapping) else dataset
    shipped = importlib.resources.files("semstab.configs") / "datasets" / f"{name or 'city'}.yaml"
    return read_yaml(Path(str(shipped))) if shipped.is_file() else {}


def resolve(config: Config) -> Config:
    """The configuration with every default of its dataset's options filled in, paths absolute."""
    return config.model_copy(update={"dataset": resolved(config.dataset)})


def make_plan(config: Config) -> Plan:
    """Open what the configuration selects and check that it fits together; no image is read."""
    for backend in config.fused_by():  # an engine that is missing is said before anything is computed
        create(backend.name, voxel_size=config.voxel_size, num_classes=2, **backend.options)
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    names = selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name)
    tasks = [task for name in names for task in tasks_of(dataset.scene(name), config)]
    return Plan(config, tuple(tasks))


def tasks_of(scene: Scene, config: Config) -> Iterator[Task]:
    """The configuration's backbones on an open scene, checked; no image is read."""
    extra = (GROUND_TRUTH,) if scene.ground_truth else ()
    names = selected(config.backbones, scene.backbones, extra, "backbone", scene.name)
    if not names:
        places = f"looked for {', '.join(scene.label_paths)}; " if scene.label_paths else ""
        raise DataError(f"{scene.name}: there are no label maps; {places}add them, or choose with --scene")
    frames = chosen_frames(scene, config, names)
    for backbone in names:
        source = scene.label_space(backbone)
        target = source if config.taxonomy is None else LabelSpace.load(config.taxonomy)
        fused_by = tuple(backend.name for backend in config.fused_by())
        mapping = source.mapping_to(target)
        _require_classes(config.exclude.classes, mapping, scene.name)
        yield Task(
            scene, backbone, frames.indices, mapping, fused_by, config.perturbation, config.exclude, frames.left_out
        )


def _require_classes(names: Sequence[str], mapping: LabelMapping, where: str) -> None:
    for name in names:
        if not mapping.named([name]):
            known = [*dict.fromkeys((*mapping.source.classes, *mapping.target.classes))]
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there is {', '.join(known)}"
            raise ConfigError(f"{where}: exclude.classes: no class '{name}'; {hint}")


def chosen_frames(scene: Scene, config: Config, sources: Sequence[str] = ()) -> Selected:
    """The frames of a scene that the configuration selects, to be read with the labels of these sources.

    Raises ConfigError where there is none, and what `select_frames` raises.
    """
    chosen = select_frames(scene, config.frames, sources)
    if not chosen.indices:
        raise ConfigError(f"{scene.name}: the selection of frames leaves none of its {len(scene)}; mend 'frames'")
    return chosen


def frame_indices(scene: Scene, config: Config, sources: Sequence[str] = ()) -> list[int]:
    """The indices of `chosen_frames`."""
    return chosen_frames(scene, config, sources).indices


def selected(
    wanted: list[str] | None, known: Sequence[str], extra: Sequence[str], kind: str, where: str
) -> Sequence[str]:
    """The wanted names, all known ones where none are named; `extra` ones only by name."""
    for name in wanted or ():
        if name not in (*known, *extra):
            near = difflib.get_close_matches(name, [*known, *extra], n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there is {', '.join([*known, *extra]) or 'none'}"
            raise ConfigError(f"{where}: no {kind} '{name}'; {hint}")
    return list(dict.fromkeys(wanted)) if wanted is not None else known


def read(task: Task, index: int, pixel_stride: int = 1, *, color: bool = False) -> Frame:
    """A frame of the task, ready to fuse; colour only where it is wanted."""
    return prepare(task, task.scene.frame(index, task.backbone, color=color), pixel_stride)


def prepare(task: Task, frame: Frame, pixel_stride: int = 1) -> Frame:
    """The scene's frame without what moves, its labels as rows 0..K-1 of the run's label space, noise, pixel stride."""
    frame = in_label_space(task.mapping, _still(task, frame))
    if task.perturbation is not None:
        frame = perturb(frame, task.perturbation, task.scene.name)
    return frame.every(pixel_stride)


def _still(task: Task, frame: Frame) -> Frame:
    classes = task.mapping.named(task.exclude.classes)
    if frame.labels is not None:
        classes = tuple(task.mapping.source.ids[k] for k in classes)
    return leave_out(frame, classes, masks=task.exclude.masks)


def in_label_space(mapping: LabelMapping, frame: Frame) -> Frame:
    """The frame with its labels as rows 0..K-1 of the mapping's target, or its scores (H, W, K) for them."""
    if frame.labels is not None:
        return dataclasses.replace(frame, labels=mapping.labels(frame.labels, frame.where("labels")))
    assert frame.scores is not None
    return dataclasses.replace(frame, scores=mapping.scores(frame.scores, frame.where("scores")))
