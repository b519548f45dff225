"""The grid of a study: which unit each point of each sweep is, and what its numbers depend on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from semstab.backends import create
from semstab.config import BackendConfig, Config, FrameSelection, Perturbation, merge
from semstab.datasets import Scene, open_dataset
from semstab.errors import ConfigError
from semstab.plan import Task, frame_indices, selected, tasks_of
from semstab.results import Unit
from semstab.study.config import Noise, Part, StudyConfig
from semstab.study.jobs import Request
from semstab.study.results import BACKENDS, BASE, REGIONS, SHARED, Variation

FORMAT = 1
"""Part of every key: raise it with any change of the numbers that a unit's settings and input lead to."""

NOT_IN_KEYS = (
    "dataset", "scenes", "backbones", "backends", "check", "tolerance", "taxonomy", "frames", "events",
    "check_geometry", "memory_gb",
)  # fmt: skip
"""Settings that change no number of a unit, or whose meaning stands in its key: the digest of the input, which frames
and classes they select, which backend."""

NOISES = tuple(name for name in Perturbation.model_fields if name != "seed")

Change = Callable[[Config], Config]
"""What a variation does to the settings of a base unit."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A point of a sweep on a scene and a backbone: the unit behind it, and what is wanted of it.

    config       the unit's settings as a run's: one scene, one backbone, one backend
    task         the unit, opened and checked
    identity     hash of the settings that its numbers depend on; cells that share it are one unit
    image_space  whether its stability in image coordinates is wanted
    voxels       whether its voxels are kept
    """

    variation: Variation
    config: Config
    task: Task
    identity: str
    image_space: bool
    voxels: bool

    @property
    def unit(self) -> Unit:
        """Its scene, backbone and backend."""
        return self.task.units[0]

    @property
    def digest(self) -> str:
        """A hash of its input."""
        return self.task.digest

    def parts(self) -> list[str]:
        """What its unit's file must have."""
        wanted = {"summary": True, "image_space": self.image_space}
        return [name for name, is_wanted in wanted.items() if is_wanted]

    def request(self) -> Request:
        """What a job is told of it."""
        return Request(self.identity, self.config, self.image_space, self.voxels)


@dataclass(frozen=True, eq=False)
class RegionCell:
    """A label source of regions without classes on a scene; config and identity are as in `Cell`."""

    config: Config
    scene: Scene
    backbone: str
    identity: str
    image_space: bool = False
    voxels: bool = False

    @property
    def variation(self) -> Variation:
        """It is varied in nothing."""
        return Variation(REGIONS)

    @property
    def unit(self) -> Unit:
        """Its scene and backbone; no backend fuses it."""
        return Unit(self.scene.name, self.backbone, "none")

    def parts(self) -> list[str]:
        """What its unit's file must have."""
        return ["regions"]

    @property
    def digest(self) -> str:
        """A hash of its input."""
        return self.scene.digest(frame_indices(self.scene, self.config, [self.backbone]), self.backbone)

    def request(self) -> Request:
        """What a job is told of it."""
        return Request(self.identity, self.config, regions=True)


@dataclass(frozen=True, eq=False)
class Grid:
    """All that a study computes, in order."""

    cells: tuple[Cell, ...]
    regions: tuple[RegionCell, ...]

    def every(self) -> list[Cell | RegionCell]:
        """The cells, then the regions."""
        return [*self.cells, *self.regions]

    def units(self) -> dict[str, Cell | RegionCell]:
        """Each unit once, by its identity, with all that is wanted of it in any cell."""
        units: dict[str, Cell | RegionCell] = {cell.identity: cell for cell in self.regions}
        for cell in self.cells:
            known = units.get(cell.identity, cell)
            units[cell.identity] = dataclasses.replace(
                known, image_space=known.image_space or cell.image_space, voxels=known.voxels or cell.voxels
            )
        return units


def make_grid(config: StudyConfig) -> Grid:
    """Every cell of a study, sweep by sweep, checked; no image is read.

    Raises ConfigError, DataError or MissingDependencyError where something does not fit together.
    """
    for backend in (config.backend, *config.backends.values):  # an engine that is missing is said before all else
        create(backend.name, voxel_size=config.voxel_size, num_classes=2, **backend.options)
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    names = selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name)
    _check_names(config.scene_frames, names, "scene_frames")
    scenes = {name: dataset.scene(name) for name in names}
    base = tuple(_base_cells(config, scenes))
    return Grid((*base, *_varied_cells(config, base, scenes)), tuple(_region_cells(config, scenes)))


def _base_cells(config: StudyConfig, scenes: Mapping[str, Scene]) -> Iterator[Cell]:
    for name, scene in scenes.items():
        settings = config.base(name)
        if settings.backbones is None:
            fused = [backbone for backbone in scene.backbones if backbone not in config.region_maps]
            settings = settings.model_copy(update={"backbones": fused})
        for task in tasks_of(scene, settings):
            one = settings.model_copy(update={"backbones": [task.backbone]})
            yield Cell(Variation(BASE), one, task, identity(one, task), image_space=True, voxels=True)


def _region_cells(config: StudyConfig, scenes: Mapping[str, Scene]) -> Iterator[RegionCell]:
    for name, scene in scenes.items():
        for backbone in selected(config.region_maps, scene.backbones, scene.regions, "region map", name):
            settings = config.base(name).model_copy(update={"backbones": [backbone]})
            unit, frames = [name, backbone], frame_indices(scene, settings, [backbone])
            fused_only = {"voxel_size", "strata", "statistics"}
            yield RegionCell(
                settings, scene, backbone, _hash(settings, {"regions": unit, "frames": frames}, fused_only)
            )


def _varied_cells(config: StudyConfig, base: Sequence[Cell], scenes: Mapping[str, Scene]) -> Iterator[Cell]:
    for variation, part, change in _variations(config):
        for cell in _restricted(base, part, variation.sweep):
            varied = change(cell.config)
            (task,) = tasks_of(scenes[cell.unit.scene], varied)
            _check_count(variation, task)
            voxels = variation.sweep == BACKENDS
            yield Cell(variation, varied, task, identity(varied, task), image_space=False, voxels=voxels)


def _variations(config: StudyConfig) -> Iterator[tuple[Variation, Part, Change]]:
    """Each point of each sweep, where it applies, and what it changes."""
    if config.shared_taxonomy is not None:
        yield Variation(SHARED), Part(), partial(_changed, {"taxonomy": config.shared_taxonomy})
    for sweep, part in config.sweeps.given():
        for value in part.values:
            repeats = part.repeats if isinstance(part, Noise) and value else 1
            for repeat in range(repeats):
                yield Variation(sweep, value, repeat), part, _change(sweep, value, config.seed + repeat)
    for backend in config.backends.values:
        yield Variation(BACKENDS), config.backends, partial(_fused_by, backend)


def _change(sweep: str, value: float, seed: int) -> Change:
    if sweep == "frame_count":
        return partial(_evenly_sampled, int(value))
    if sweep in NOISES:
        return partial(_changed, {"perturbation": {sweep: value, "seed": seed}})
    return partial(_changed, {sweep: value})


def _changed(settings: Mapping[str, Any], base: Config) -> Config:
    changed = Config.build(merge(base.model_dump(mode="json"), settings), "study")
    return changed.model_copy(update={"memory_gb": base.memory_gb})  # of no number, so it is not dumped


def _fused_by(backend: BackendConfig, base: Config) -> Config:
    """By another backend, whose map is compared with the base one: that one's statistics are enough."""
    named = BackendConfig(name=backend.name, options=backend.options)
    return base.model_copy(update={"backends": [named], "statistics": False})


def _evenly_sampled(count: int, base: Config) -> Config:
    """`count` frames, evenly spaced over the extent of the base's: from its start to its stop, or over its list."""
    extent = base.frames.model_dump(include={"start", "stop", "from_time", "to_time"})
    even = FrameSelection(**extent, spacing="even", count=count)
    if (listed := base.frames.list) is not None:
        even = FrameSelection(list=[listed[k] for k in even.indices(len(listed))])
    return base.model_copy(update={"frames": even})


def _check_count(variation: Variation, task: Task) -> None:
    """Fewer frames than asked for would pass for another sampling density."""
    selected = len(task.indices) + task.left_out  # what lacks a pose or a file is left out, and said so
    if variation.sweep == "frame_count" and selected != variation.value:
        raise ConfigError(
            f"sweeps.frame_count: {task.scene.name} has {len(task.indices)} frames over the extent of the base ones,"
            f" not {variation.value}; leave it out with 'scenes', or widen 'frames'"
        )


def identity(config: Config, task: Task) -> str:
    """Hash of the settings that a unit's numbers depend on, beside its input."""
    mapping = task.mapping
    content = {
        "unit": dataclasses.asdict(task.units[0]),
        "options": config.backends[0].options,
        "frames": task.indices,
        "taxonomy": [mapping.target.name, mapping.target.classes, mapping.source.ids, mapping.rows],
    }
    return _hash(config, content)


def _hash(config: Config, content: Mapping[str, Any], without: Iterable[str] = ()) -> str:
    settings = config.model_dump(mode="json", exclude={*NOT_IN_KEYS, *without})
    text = json.dumps([FORMAT, settings, content], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _restricted(base: Sequence[Cell], part: Part, name: str) -> list[Cell]:
    """The base cells of the scenes and backbones that a part names."""
    _check_names(part.scenes, [cell.unit.scene for cell in base], f"{name}.scenes")
    _check_names(part.backbones, [cell.unit.backbone for cell in base], f"{name}.backbones")
    return [
        cell
        for cell in base
        if (part.scenes is None or cell.unit.scene in part.scenes)
        and (part.backbones is None or cell.unit.backbone in part.backbones)
    ]


def _check_names(wanted: Iterable[str] | None, known: Sequence[str], where: str) -> None:
    for name in wanted or ():
        if name not in known:
            raise ConfigError(f"{where}: '{name}' is not among the study's {', '.join(dict.fromkeys(known))}")
