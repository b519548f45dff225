"""The plan: scenes x models x backends x variations, which unit each is, and what its numbers depend on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from semstab.backends import by_own_rule, check_options, is_pointwise, keeps_log
from semstab.config import (
    BACKENDS,
    BASE,
    SAMPLE,
    SHARED,
    BackendConfig,
    Config,
    FrameSelection,
    NoiseLevels,
    Part,
    Perturbation,
    Sweeps,
)
from semstab.core.code import Code, is_code
from semstab.data.features import OF_FEATURES
from semstab.data.labels import LabelSpace
from semstab.data.measures import measures
from semstab.data.records import REGIONS, Variation
from semstab.data.results import UnitName
from semstab.data.statistics import CONFIDENCE
from semstab.datasets import GROUND_TRUTH, Scene
from semstab.errors import ConfigError, DataError
from semstab.task import Task, applies, class_distances, frame_indices, open_scenes, selected, tasks_of, truth_task

logger = logging.getLogger("semstab")

NO_MAP = BackendConfig(name="none", check=True)
"""Stands for the backend of units that fuse nothing."""

OF_MAPS = (
    "voxel_size", "backends", "check", "statistics", "events", "tile_size", "scope", "sweeps", "shared_taxonomy",
    "critical_classes", "region_maps", "frame_quality",
)  # fmt: skip
"""Settings that a video, which has no map, does not use."""

FORMAT = 1
"""Part of every key: raise it with any change of the numbers that a unit's settings and input lead to, and with a
setting's default."""

NOT_IN_KEYS = {
    "dataset", "scenes", "models", "region_maps", "backends", "taxonomy", "distances", "frames", "scene_frames",
    "name", "description", "benchmark", "check", "tolerance", "shared_taxonomy", "sweeps", "seed", "events",
}  # fmt: skip
"""Settings that no number of a unit follows from. What the first ones select is in its key: the digest of the input,
frames, classes, the backend. Any other setting is part of the key, unless it has its default."""

OF_REGIONS = {"pixel_stride", "exclude", "perturbation"}
"""The settings that the flicker of regions without classes follows from."""

NOISES = tuple(name for name in Perturbation.model_fields if name != "seed")


@dataclass(frozen=True, eq=False)
class Unit:
    """A model on a scene, fused by a backend under one variation.

    A worker gets it without its task, and opens the task again.

    Attributes:
        name: Its scene, model and backend.
        config: Settings of a run of this unit alone: one scene, one model, one backend, the frames one by one.
        task: The model on the scene, opened and checked.
        identity: Hash of the settings that its numbers depend on; units with the same hash are computed once.
        left_out: Number of selected frames without a file or a pose.
        image_space: Whether its stability in image coordinates is wanted.
        stored: Whether its voxels and its time series are stored.
        assessed: Whether its map gets statistics: one that others are only checked against gets none.
        sampled: Whether its map is checked against the reference on a sample of its voxels.
        fuses: Whether there is a map; a video has none.
    """

    name: UnitName
    variation: Variation
    config: Config
    task: Task
    identity: str
    left_out: int = 0
    image_space: bool = False
    stored: bool = False
    assessed: bool = True
    sampled: bool = False
    fuses: bool = True

    @classmethod
    def from_task(cls, variation: Variation, config: Config, task: Task, identity: str, **wanted: bool) -> Unit:
        """Return the unit of a task at these settings, and what is `wanted` of it, see the attributes."""
        config = config.model_copy(update={"frames": FrameSelection.from_indices(task.indices)})
        return cls(task.units[0], variation, config, task, identity, task.left_out, **wanted)

    def task_on(self, scene: Scene) -> Task:
        """Return its task on its open scene: a worker, which got no task, opens it again."""
        if self.task is not None:
            return self.task
        (task,) = tasks_of(scene, self.config)
        return dataclasses.replace(task, left_out=self.left_out)

    def __getstate__(self) -> dict[str, object]:
        """Leave out the task: an open scene does not travel."""
        return {**self.__dict__, "task": None}

    @property
    def key(self) -> str:
        """Return the key under which it is stored: the hash of its settings, then one of its input."""
        return unit_key(self.identity, self.task.digest)

    @property
    def compares_truth(self) -> bool:
        """Return whether the ground truth of the scene is fused, if there is one, and the labels compared with it."""
        return self.config.truth and self.assessed

    @property
    def regions(self) -> bool:
        """Return whether it is the flicker of regions without classes, and nothing is fused."""
        return self.variation.sweep == REGIONS

    def merged_with(self, other: Unit) -> Unit:
        """Return the same unit as the other one, with what is wanted of either."""
        flags = ("image_space", "stored", "assessed", "sampled")
        return dataclasses.replace(other, **{name: getattr(self, name) or getattr(other, name) for name in flags})


def unit_key(identity: str, digest: str) -> str:
    """Return the key of a unit: the hash of its settings, then one of its input."""
    return identity + hashlib.blake2b(digest.encode(), digest_size=8).hexdigest()


@dataclass(frozen=True, eq=False)
class Plan:
    """All that a run or a study computes, in order, checked before the first image is read."""

    config: Config
    scenes: Mapping[str, Scene]
    units: tuple[Unit, ...]
    regions: tuple[Unit, ...]

    def every(self) -> list[Unit]:
        """Return the units, then the regions."""
        return [*self.units, *self.regions]

    def distinct(self) -> dict[str, Unit]:
        """Return what is to be computed, by its identity, with all that is wanted of it anywhere."""
        distinct: dict[str, Unit] = {}
        for unit in (*self.regions, *self.units):
            earlier = distinct.get(unit.identity)
            distinct[unit.identity] = unit if earlier is None else unit.merged_with(earlier)
        return distinct

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """Each model on each scene at the base settings, with all backends that fuse it so."""
        backends: dict[tuple[str, str], list[str]] = {}
        for unit in self.units:
            if unit.variation.sweep in (BASE, BACKENDS):
                backends.setdefault((unit.name.scene, unit.name.model), []).append(unit.name.backend)
        not_compared = tuple(backend.name for backend in self.config.fused_by() if not must_agree(backend))
        return tuple(
            dataclasses.replace(
                unit.task, backends=tuple(backends[unit.name.scene, unit.name.model]), apart=not_compared
            )
            for unit in self.units
            if unit.variation.sweep == BASE
        )


def make_plan(config: Config, scenes: Mapping[str, Scene] | None = None) -> Plan:
    """Open what the configuration selects and check that it fits together; no image is read.

    Args:
        config: Resolved settings.
        scenes: Their scenes, where they are open already: what these have read is not read again.

    Raises:
        ConfigError, DataError, MissingDependencyError: If something does not.
    """
    for backend in config.fused_by():  # a missing engine is reported before all else
        if backend != NO_MAP:
            check_options(backend.name, voxel_size=config.voxel_size, num_classes=2, **backend.options)
    scenes = open_scenes(config, posed=False) if scenes is None else scenes
    config = fitting(config, scenes)
    _check_names(config.scene_frames, [*scenes], "scene_frames")
    base = tuple(_base_units(config, scenes))
    units = (*base, *_varied_units(config, base, scenes))
    if [config.check] == [backend.name for backend in config.backends]:
        logger.warning("check: %s is the backend that fuses, so it checks nothing; name another, or null", config.check)
    if config.exclude.predicted_classes:
        logger.warning(
            "exclude.predicted_classes also leaves out pixels predicted so by mistake, which then are no error;"
            " exclude.classes leaves out locations by their fused class"
        )
    return Plan(config, scenes, units, tuple(_planned_regions(config, scenes)))


def fitting(config: Config, scenes: Mapping[str, Scene]) -> Config:
    """Return settings that fit the scenes: without depth and poses nothing is fused, and settings of maps are unset."""
    if all(scene.posed for scene in scenes.values()):
        return config
    default = Config()
    unset = {name: getattr(default, name) for name in OF_MAPS}
    unset |= {"backends": [NO_MAP], "check": None, "check_geometry": False}
    if unused := [name for name in OF_MAPS if getattr(config, name) not in (getattr(default, name), unset[name])]:
        logger.warning("%s: a video has no map, so that this is not used", ", ".join(unused))
    return config.model_copy(update=unset)


def _base_settings(config: Config, scene: str, models: list[str] | None) -> Config:
    noise = config.perturbation
    return config.model_copy(
        update={
            "scenes": [scene],
            "models": models,
            "frames": config.scene_frames.get(scene, config.frames),
            "backends": config.backends[:1],
            "check": None,
            "perturbation": None if noise is None else noise.model_copy(update={"seed": config.seed}),
            "sweeps": Sweeps(),
            "shared_taxonomy": None,
        }
    )


def _base_units(config: Config, scenes: Mapping[str, Scene]) -> Iterator[Unit]:
    for name, scene in scenes.items():
        fused = config.models
        if fused is None:
            fused = [model for model in scene.models if model not in config.region_maps]
        settings, others = _base_settings(config, name, fused), list[str]()
        for task in tasks_of(scene, settings):
            _check_classes(config.critical_classes, task)
            model_settings = settings.model_copy(update={"models": [task.model]})
            if config.truth and scene.ground_truth and task.model != GROUND_TRUTH and truth_task(task) is None:
                target = task.mapping.target
                if target == OF_FEATURES:
                    logger.info("%s: features of %s are not compared with the ground truth", name, task.model)
                else:
                    others.append(target.name)
            sampled = _is_sampled(config, config.backends[0])
            if config.video_measures == "dis" and scene.missing(task.indices[0], color=True):
                raise ConfigError(f"{name}: there are no images for optical flow; use --video-measures depth")
            if not scene.posed:
                _check_video(config, task)
            flags = {"image_space": True, "stored": True, "sampled": sampled}
            flags |= {"assessed": scene.posed, "fuses": scene.posed}
            yield Unit.from_task(Variation(BASE), model_settings, task, identity(model_settings, task), **flags)
        if others:
            first, *more = dict.fromkeys(others)
            logger.warning(
                "%s: labels are not compared with the ground truth, as %s has classes that %s has not; list them under"
                " its ignored, or among members",
                name, scene.label_space(GROUND_TRUTH).name, f"{first} and {len(more)} more" if more else first,
            )  # fmt: skip


def _check_video(config: Config, task: Task) -> None:
    if config.video_measures == "depth":
        raise DataError(f"{task.scene.name}: a video has no depth; use --video-measures dis")
    if len(task.indices) < 2:
        raise DataError(f"{task.scene.name}: a single frame is selected; flicker takes two; change 'frames'")


def _is_sampled(config: Config, backend: BackendConfig) -> bool:
    """Return whether what that backend fuses is checked against a sample: not the reference itself."""
    return config.check == SAMPLE and by_own_rule(backend.name) != "numpy" and must_agree(backend)


def must_agree(backend: BackendConfig) -> bool:
    """Return whether it must agree with the others: as it is configured, or else if it associates pixel by pixel."""
    return is_pointwise(backend.name) if backend.check is None else backend.check


def _check_classes(critical: Sequence[str], task: Task) -> None:
    space = task.mapping.target
    for name in critical:
        if name not in space.classes:
            raise ConfigError(f"critical_classes: '{name}' is no class of {space.name}: {', '.join(space.classes)}")


def _planned_regions(config: Config, scenes: Mapping[str, Scene]) -> Iterator[Unit]:
    space = LabelSpace("regions", ("region", "none"))  # regions have no classes, but a label space has two
    for name, scene in scenes.items():
        for model in selected(config.region_maps, scene.models, scene.regions, "region map", name):
            settings = _base_settings(config, name, [model])
            frames = frame_indices(scene, settings, [model])
            task = Task(scene, model, frames, space.mapping_to(space), ("none",))
            content = settings.model_dump(mode="json", include=OF_REGIONS, exclude_defaults=True)
            key = _hash(content, {"regions": [name, model], "frames": frames})
            yield Unit.from_task(Variation(REGIONS), settings, task, key, fuses=False)


def _varied_units(config: Config, base: Sequence[Unit], scenes: Mapping[str, Scene]) -> Iterator[Unit]:
    compared: dict[str, list[str]] = {}
    for unit in base:
        compared.setdefault(unit.name.scene, []).append(unit.name.model)
    for variation, part, value in _variations(config):
        for unit in _restricted(base, part, variation.sweep):
            settings = _base_settings(config, unit.name.scene, [unit.name.model])
            varied = settings.model_copy(update=_changed_settings(config, variation, value, settings))
            (task,) = tasks_of(scenes[unit.name.scene], varied, compared[unit.name.scene])
            _check_count(variation, task)
            compares_backends, (backend, *_) = variation.sweep == BACKENDS, varied.backends
            reference = compares_backends and backend.name not in [
                base_backend.name for base_backend in config.backends
            ]
            assessed = varied.statistics or not reference
            sampled = compares_backends and _is_sampled(config, backend)
            flags = {"stored": compares_backends, "assessed": assessed, "sampled": sampled}
            yield Unit.from_task(variation, varied, task, identity(varied, task), **flags)


def _variations(config: Config) -> Iterator[tuple[Variation, Part, Any]]:
    """Yield each point of each sweep, the part of the configuration that it applies to, and its value.

    Points that change the taxonomy or the backend come last.
    """
    if config.shared_taxonomy is not None:
        yield Variation(SHARED), Part(), config.shared_taxonomy
    for sweep, part in config.sweeps.given():
        for value in part.values:
            for repeat in range(part.repeats if isinstance(part, NoiseLevels) and value else 1):
                yield Variation(sweep, float(value), repeat), part, value
    for backend in config.fused_by()[1:]:
        yield Variation(BACKENDS), backend, backend


def _changed_settings(config: Config, variation: Variation, value: Any, base: Config) -> dict[str, Any]:
    sweep = variation.sweep
    if sweep == BACKENDS:  # its map is compared with the base one, whose statistics are enough where they are full
        logged = next((backend.name for backend in config.fused_by() if keeps_log(backend.name)), None)
        backend = BackendConfig(name=value.name, code=value.code, options=value.options)
        return {"backends": [backend], "statistics": config.statistics and value.name == logged}
    if sweep == "frame_count":
        return {"frames": _evenly_sampled(int(value), base)}
    if sweep in NOISES:
        update = {sweep: value, "seed": config.seed + variation.repeat}
        disturbed = (base.perturbation or Perturbation()).model_copy(update=update)
        return {"perturbation": disturbed if disturbed.adds_noise else None, "seed": disturbed.seed}
    return {"taxonomy" if sweep == SHARED else sweep: value}


def _evenly_sampled(count: int, base: Config) -> FrameSelection:
    """Return `count` frames, evenly spaced over the extent of the base's.

    The extent is that from its start to its stop, or that of its list.
    """
    extent = base.frames.model_dump(include={"start", "stop", "from_time", "to_time"})
    even, listed = FrameSelection(**extent, spacing="even", count=count), base.frames.list
    return even if listed is None else FrameSelection(list=[listed[k] for k in even.indices(len(listed))])


def _check_count(variation: Variation, task: Task) -> None:
    """Check that a sweep got all frames that it asks for: fewer would pass for another sampling density."""
    chosen = len(task.indices) + task.left_out  # frames without a pose or a file are left out, which is reported
    if variation.sweep == "frame_count" and chosen != variation.value:
        raise ConfigError(
            f"sweeps.frame_count: {task.scene.name} has {len(task.indices)} frames over the extent of the base ones,"
            f" not {variation.value}; leave it out with 'scenes', or widen 'frames'"
        )


def identity(config: Config, task: Task) -> str:
    """Return the hash of the settings that a unit's numbers depend on in addition to its input."""
    mapping, filtering = task.mapping, task.scene.filtering(task.model)
    rule, reader = config.backends[0].options.get("rule"), config.dataset.name
    content: dict[str, Any] = {
        "unit": dataclasses.asdict(task.units[0]),
        "options": config.backends[0].options,
        **({"rule": Code.load(rule, "rule").digest} if isinstance(rule, str) and is_code(rule) else {}),
        **({} if config.backends[0].code is None else {"code": Code.load(config.backends[0].code, "backend").digest}),
        **({"reader": Code.load(reader, "dataset").digest} if is_code(reader) else {}),
        "frames": [*task.indices],
        "taxonomy": [mapping.target.name, mapping.target.classes, mapping.source.ids, mapping.rows],
    }
    if (distances := class_distances(task, config)) is not None:
        content["distances"] = distances.tolist()
    truth = truth_task(task) if config.truth else None
    compared = {} if truth is None else {"truth": truth.mapping.rows}
    unfiltered = {"beside": filtering.model} if config.frame_quality else {}
    settings = config.model_dump(mode="json", exclude=NOT_IN_KEYS, exclude_defaults=True)
    return _hash(settings, content | compared | unfiltered)


def _hash(settings: Mapping[str, Any], content: Mapping[str, Any]) -> str:
    measured = [measure.key for measure in measures()]
    text = json.dumps([FORMAT, CONFIDENCE, measured, settings, content], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _restricted(base: Sequence[Unit], part: Part, name: str) -> list[Unit]:
    _check_names(part.scenes, [unit.name.scene for unit in base], f"{name}.scenes")
    _check_names(part.models, [unit.name.model for unit in base], f"{name}.models")
    return [unit for unit in base if applies(part, unit.name.scene, unit.name.model)]


def _check_names(names: Iterable[str] | None, available: Sequence[str], where: str) -> None:
    for name in names or ():
        if name not in available:
            raise ConfigError(f"{where}: '{name}' is not among {', '.join(dict.fromkeys(available))}")
