"""Benchmarks with a name and a version: data, settings, and hashes of the geometry that their numbers rest on."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from semstab.config import (
    Config,
    DatasetConfig,
    Exclusion,
    FrameSelection,
    Settings,
    merge,
    nearest,
    read_yaml,
    validated,
)
from semstab.configure import load_config, predicted_config, shipped_benchmarks
from semstab.core.prefetch import prefetch
from semstab.data.labels import LabelSpace
from semstab.datasets import GROUND_TRUTH, Scene, open_dataset, reader
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.geometry import Spots, few_rows, geometry_file, load_geometry, spots_of
from semstab.pixels.preparation import leave_out
from semstab.predict.predictor import PredictorConfig
from semstab.task import Task, frame_indices, read

Number = Literal["alpha", "flicker", "accuracy", "miou", "wrong_of_consistent"]
"""The numbers of a headline; flicker does not follow from sums, so that runs have it, and the table does not."""

WITHOUT_NUMBERS = {"description", "get", "license", "citation", "superseded_by"}
"""Fields that may change in a version: texts, from which no number follows."""


IN_A_RUN = (
    "scenes", "frames", "scene_frames", "taxonomy", "voxel_size", "pixel_stride", "exclude", "critical_classes",
    "statistics",
)  # fmt: skip
"""The settings of a run that a definition fixes, in addition to its dataset."""


class Benchmark(Settings):
    """A definition: with the same labels everybody gets the same numbers from it.

    Its file is NAME@VERSION.yaml. What numbers follow from is frozen once a version is published.

    Examples:
        >>> city = load_benchmark("city")
        >>> city.id, city.scenes
        ('city@1', ('scene0', 'scene1', 'scene2', 'scene3', 'scene4'))
    """

    file: str | None = Field(None, exclude=True, description="the file, of a definition that does not ship")
    id: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*@[1-9][0-9]{0,3}$", description="NAME@VERSION, as its file")
    description: str = Field(min_length=1, description="one line")
    get: str = Field("", description="how to get the data, one line; empty for built-in data")
    license: str = Field(min_length=1, description="licence of the data")
    citation: str = Field(min_length=1, description="whom users of the data cite")
    superseded_by: str | None = Field(None, description="the version to use instead of this one")
    dataset: DatasetConfig = Field(description="dataset and its options, without paths")
    scenes: tuple[str, ...] = Field(min_length=1, description="the scenes, each counts once")
    flights: dict[str, tuple[str, ...]] = Field({}, description="scenes that are the same place flown again, by place")
    frames: FrameSelection = Field(FrameSelection(), description="frames that are fused")
    scene_frames: dict[str, FrameSelection] = Field({}, description="frames of single scenes, instead of `frames`")
    taxonomy: str | None = Field(None, description="label space to fuse in; by default the label space of the labels")
    voxel_size: float = Field(ge=1e-3, le=1e3, description="edge, metres")
    voxel_sizes: tuple[float, ...] = Field((), description="further edges, metres, at which the maps are fused as well")
    pixel_stride: int = Field(1, ge=1, description="use every n-th pixel of each axis")
    exclude: Exclusion = Field(Exclusion(), description="classes and pixels that are left out")
    critical_classes: tuple[str, ...] = Field((), description="classes of the verdict")
    statistics: bool = Field(False, description="also accuracy, with ground truth")
    measures: tuple[Number, ...] = Field(("alpha",), min_length=1, description="of the headline; the first one ranks")
    digests: dict[str, str] | None = Field(
        None, description="short hashes of each frame's depth and pose, by scene; null where nobody had the data yet"
    )

    @property
    def name(self) -> str:
        """Its name without the version."""
        return self.id.partition("@")[0]

    @property
    def version(self) -> int:
        """Its version."""
        return int(self.id.partition("@")[2])

    @property
    def digest(self) -> str:
        """Return a hash of all that its numbers follow from, the classes of its taxonomy and the data among it."""
        content = self.model_dump(mode="json", exclude=WITHOUT_NUMBERS, exclude_defaults=True)
        if self.taxonomy is not None:
            content["classes"] = LabelSpace.load(self.taxonomy).classes
        return _hash(content)

    def places(self) -> tuple[str, ...]:
        """Return the place of each scene: scenes that are one place flown again count as one together."""
        place_of = {scene: place for place, scenes in self.flights.items() for scene in scenes}
        return tuple(place_of.get(scene, scene) for scene in self.scenes)

    def configured(
        self,
        data: Path | None = None,
        labels: Path | None = None,
        predictors: Sequence[PredictorConfig] = (),
        models: Sequence[str] | None = None,
        taxonomy: str | None = None,
    ) -> Config:
        """Return the settings of a run of it.

        Args:
            data: Folder of its data; None for built-in data.
            labels: Folder of label maps, SCENE/MODEL/NAME below it; the data's own by default.
            predictors: Models that predict, instead of label maps.
            models: Names of label sources; all by default.
            taxonomy: The classes of its taxonomy, with the names that the labels have for them among the members.

        Raises:
            ConfigError: For a folder that is missing, or not wanted, or a taxonomy of other classes.
        """
        content: dict[str, Any] = self.model_dump(mode="json", include={*IN_A_RUN})
        content |= {"name": self.id, "description": self.description, "dataset": self._dataset(data, labels)}
        content["benchmark"] = {"id": self.id, "digest": self.digest, "file": self.file}
        content["truth"] = self.statistics
        if taxonomy is not None:
            classes, space = self._classes, LabelSpace.load(taxonomy)
            if classes != space.classes:
                raise ConfigError(f"{taxonomy}: its classes are not those of {self.id}: {', '.join(classes) or 'any'}")
            ignored = LabelSpace.load(self.taxonomy).ignored if self.taxonomy is not None else ()
            if lost := [name for name in ignored if name not in space.ignored]:
                raise ConfigError(f"{taxonomy}: {self.id} ignores {', '.join(lost)}; add them to 'ignored'")
            content["taxonomy"] = taxonomy
        if self.voxel_sizes:
            content["sweeps"] = {"voxel_size": [*self.voxel_sizes]}
        if models is not None:
            content["models"] = [*models]
        if labels is not None and predictors:
            raise ConfigError("--labels and --predict: label maps are read or predicted; leave one out")
        return predicted_config(predictors, None, content) if predictors else load_config(content)

    @property
    def is_sparse(self) -> bool:
        """Return whether its images have depth at the points of a LiDAR alone."""
        return reader(self.dataset.name).depth_is_sparse

    def changed(self, config: Config) -> list[str]:
        """Return the settings of a run that are not those of the definition."""
        defined, configured = (settings.model_dump(mode="json", include={*IN_A_RUN}) for settings in (self, config))
        if config.taxonomy is not None and LabelSpace.load(config.taxonomy).classes == self._classes:
            defined["taxonomy"] = config.taxonomy
        return [name for name, value in configured.items() if value != defined[name]]

    @property
    def _classes(self) -> tuple[str, ...]:
        return () if self.taxonomy is None else LabelSpace.load(self.taxonomy).classes

    def _dataset(self, data: Path | None, labels: Path | None = None) -> dict[str, Any]:
        """Return the dataset with the paths of this machine."""
        built_in = not self.get
        if data is None and not built_in:
            raise ConfigError(f"{self.id}: name the folder of its data with --data; {self.get}")
        if built_in and (data is not None or labels is not None):
            raise ConfigError(f"{self.id}: its data is built in; leave out --data and --labels, and choose --predict")
        paths = {"root": data, "labels_root": labels}
        options = {name: str(path.absolute()) for name, path in paths.items() if path is not None}
        return merge(self.dataset.model_dump(mode="json"), {"options": options})

    def open_scenes(self, data: Path | None = None) -> dict[str, Scene]:
        """Open its scenes; no image is read.

        Raises:
            ConfigError, DataError: If a scene is not there.
        """
        content = self._dataset(data)
        dataset = open_dataset(content["name"], content["options"])
        for scene in self.scenes:
            if scene not in dataset.scenes:
                raise DataError(f"{data}: {self.id} has a scene '{scene}'; {nearest(scene, dataset.scenes)}")
        return {scene: dataset.scene(scene) for scene in self.scenes}

    def require_data(self, data: Path | None = None) -> None:
        """Compare the depth, the poses and the frames of the data with those of the definition; labels do not count.

        Raises:
            ConfigError, DataError: With the first file that differs.
        """
        if self.digests is None:
            return
        for name, scene in self.open_scenes(data).items():
            digests, indices = self.digests.get(name, "").split(), self.selected(scene)
            for (index, hashes), expected in zip(self._hashes(scene, indices), digests, strict=False):
                for (what, hashed), stated in zip(hashes.items(), expected.split("-"), strict=True):
                    if hashed != stated:
                        raise DataError(f"{name}: {what} differs from that of {self.id} (frame {index}); {self._again}")
            if len(indices) != len(digests):
                raise DataError(
                    f"{name}: {len(indices)} frames are selected, but {self.id} has {len(digests)}; {self._again}"
                )

    @functools.cached_property
    def geometry(self) -> Mapping[str, Spots]:
        """Its spots by scene.

        Raises:
            DataError: If it has none, so that results cannot be checked.
        """
        self.require_geometry()
        path = geometry_file(self.path)
        scenes = load_geometry(path, self.data_digest)
        if {*scenes} != {*self.scenes}:
            raise DataError(f"{path}: it is of other scenes than {self.id}; write it with scripts/benchmark_digests.py")
        return scenes

    def require_geometry(self) -> None:
        """Raise DataError where the spots of its scenes are not known, so that results of it cannot be checked."""
        if self.digests is None or not geometry_file(self.path).is_file():
            raise DataError(
                f"{self.id}: the spots of its scenes are not known, so that results of it cannot be checked; run"
                " scripts/benchmark_digests.py on its data"
            )

    @property
    def path(self) -> Path:
        """Its file."""
        return shipped_benchmarks()[self.id] if self.file is None else Path(self.file)

    @property
    def data_digest(self) -> str:
        """A hash of the hashes of its data."""
        return _hash(self.digests)

    def geometry_of(self, data: Path | None = None) -> dict[str, Spots]:
        """Return the spots of its scenes, from its data."""
        return few_rows({name: self._spots(scene) for name, scene in self.open_scenes(data).items()})

    def _spots(self, scene: Scene) -> Spots:
        indices = self.selected(scene)
        geometry = (
            leave_out(fetched.item, (), masks=self.exclude.masks).every(self.pixel_stride)
            for fetched in prefetch(scene.geometry, indices)
        )
        sources = [*((GROUND_TRUTH,) if scene.ground_truth else ()), *scene.models]
        source = scene.label_space(sources[0]) if sources else LabelSpace.load(str(self.taxonomy))
        target = source if self.taxonomy is None else LabelSpace.load(self.taxonomy)
        truth = None
        if scene.ground_truth:
            task = Task(scene, GROUND_TRUTH, indices, source.mapping_to(target), (), exclude=self.exclude)
            truth = (fetched.item for fetched in prefetch(lambda k: read(task, k, self.pixel_stride), indices))
        return spots_of(geometry, truth, target.classes)

    @property
    def _again(self) -> str:
        return f"it is another copy of the data: {self.get}" if self.get else "this semstab draws another city"

    def selected(self, scene: Scene) -> list[int]:
        """Return the indices of its frames of a scene."""
        return frame_indices(scene, Config(frames=self.scene_frames.get(scene.name, self.frames)))

    def digests_of(self, data: Path | None = None) -> dict[str, str]:
        """Return the hashes of the data as a definition states them."""
        return {
            name: " ".join("-".join(hashes.values()) for _, hashes in self._hashes(scene, self.selected(scene)))
            for name, scene in self.open_scenes(data).items()
        }

    @staticmethod
    def _hashes(scene: Scene, indices: Sequence[int]) -> Iterator[tuple[int, Mapping[str, str]]]:
        """Yield frames of a scene with their hashes, in order."""
        for index, fetched in zip(indices, prefetch(scene.fingerprints, indices), strict=True):
            yield index, fetched.item


def _hash(content: Any) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def load_benchmark(source: str | Path) -> Benchmark:
    """Return a benchmark that ships with semstab, NAME@VERSION or NAME for the last version, or that of a YAML file.

    Raises:
        ConfigError: For an unknown one.
    """
    text = str(source)
    if text.endswith((".yaml", ".yml")):
        path = Path(text)
        return validated(Benchmark, read_yaml(path) | {"id": path.stem, "file": str(path.absolute())}, f"{path}: ")
    shipped = shipped_benchmarks()
    if text not in shipped and (versions := [name for name in shipped if name.partition("@")[0] == text]):
        text = versions[-1]
    if text not in shipped:
        raise ConfigError(f"'{source}' is neither a benchmark that ships nor a .yaml file; {nearest(text, [*shipped])}")
    return validated(Benchmark, read_yaml(shipped[text]) | {"id": text}, f"{text}.yaml: ")
