"""What a model predicts on: image files, or the colour images of a dataset's scenes."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from semstab.config import DatasetConfig
from semstab.datasets import GROUND_TRUTH, Dataset, Scene, open_dataset
from semstab.datasets.disk import natural
from semstab.datasets.images import COLOR_SUFFIXES, read_color
from semstab.datasets.same_view import Labels, Scores, fitted
from semstab.errors import ConfigError, DataError
from semstab.frames import Frame

Image = npt.NDArray[np.uint8]


class ImageSequence(Protocol):
    """Colour images in order. `image` may be called from several threads at once."""

    name: str

    def __len__(self) -> int:
        """Number of images."""
        ...

    def image(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB. Raises DataError that names the file, or says that there is no colour."""
        ...

    def image_name(self, index: int) -> str:
        """What the files of its prediction are called, without suffix."""
        ...


class ImageScene(ImageSequence, Protocol):
    """A scene that shows its images without labels, and takes a prediction in their place."""

    ground_truth: bool
    up: npt.NDArray[np.float64] | None

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """The frame with labels (H, W) or scores (H, W, K) of its colour image at the depth's pixels; no colour."""
        ...

    def scene(self) -> Scene:
        """The scene itself, for its ground truth and its time stamps."""
        ...


@runtime_checkable
class Pictured(Protocol):
    """A scene whose images can be read without labels, as `PosedScene` and `FileScene`.

    labels_like_depth  whether its label files have the pixels of the depth, not those of the image
    """

    labels_like_depth: bool

    def color(self, index: int) -> Image | None:
        """Colour (H, W, 3) uint8 RGB, None where the frame has none."""
        ...

    def image_name(self, index: int) -> str:
        """The name that the frame's files share."""
        ...

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """As `ImageScene.predicted`."""
        ...


@runtime_checkable
class ImageDataset(Protocol):
    """A dataset whose scenes can be opened for prediction, whatever label maps there are or lack, as `PosedFolder`."""

    def images(self, name: str) -> Any:
        """A scene that is `Pictured`. Raises what `Dataset.scene` raises, and where it has no colour images."""
        ...


class ImageFiles:
    """Image files by a pattern such as 'flight/*.png', in natural order.

    Raises DataError where none fits, or two have one name.
    """

    def __init__(self, pattern: str) -> None:
        found = [Path(path) for path in glob.glob(str(Path(pattern).expanduser()), recursive=True)]  # noqa: PTH207
        files = sorted((path for path in found if path.suffix.lower() in COLOR_SUFFIXES), key=lambda p: natural(str(p)))
        if not files:
            raise DataError(f"{pattern}: no image of {', '.join(COLOR_SUFFIXES)} fits; quote the pattern in the shell")
        stems = [path.stem for path in files]
        if repeated := [path for path in files if stems.count(path.stem) > 1]:
            raise DataError(f"{repeated[0]}: {repeated[1]} has the same name; predict them one folder after the other")
        self.name = files[0].parent.resolve().name
        self._files = files

    def __len__(self) -> int:
        """Number of files."""
        return len(self._files)

    def image(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB. Raises DataError that names the file."""
        return read_color(self._files[index])

    def image_name(self, index: int) -> str:
        """The file's name without suffix."""
        return self._files[index].stem


class SceneImages:
    """The images of a scene: read without labels where it can, else with labels that are put aside.

    Raises ConfigError for a scene that has no labels and shows nothing without them.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._pictured = scene if isinstance(scene, Pictured) else None
        self._source = GROUND_TRUTH if scene.ground_truth else next(iter(scene.backbones), None)
        if self._pictured is None and self._source is None:
            raise ConfigError(f"{scene.name}: its dataset shows no image without labels; convert it to a posed_folder")
        self.name = scene.name
        self.ground_truth = scene.ground_truth
        self.up = scene.up

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._scene)

    def scene(self) -> Scene:
        """The scene itself."""
        return self._scene

    def image(self, index: int) -> Image:
        """The frame's colour. Raises DataError where it has none."""
        color = self._labelled(index).color if self._pictured is None else self._pictured.color(index)
        if color is None:
            raise DataError(f"{self.name}, {self.image_name(index)}: the frame has no colour image to predict on")
        return color

    def image_name(self, index: int) -> str:
        """The name of the frame's files, else its number."""
        return f"{index:06d}" if self._pictured is None else self._pictured.image_name(index)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """See `ImageScene`. Raises DataError where image and depth do not show the same view."""
        if self._pictured is not None:
            return self._pictured.predicted(index, labels=labels, scores=scores)
        frame = self._labelled(index)
        labels, scores = fitted(labels, scores, frame.shape, f"{self.name}, {self.image_name(index)}")
        return dataclasses.replace(frame, labels=labels, scores=scores, color=None)

    @property
    def labels_like_depth(self) -> bool:
        """Whether its label files have the pixels of the depth, not those of the image."""
        return self._pictured is None or self._pictured.labels_like_depth

    def _labelled(self, index: int) -> Frame:
        assert self._source is not None
        return self._scene.frame(index, self._source)


class ImageScenes:
    """The scenes of a dataset as image scenes, each opened when it is asked for."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        return self._dataset.scenes

    def images(self, name: str) -> SceneImages:
        """Open one."""
        dataset = self._dataset
        return SceneImages(dataset.images(name) if isinstance(dataset, ImageDataset) else dataset.scene(name))


def open_images(config: DatasetConfig | None = None, options: BaseModel | None = None) -> ImageScenes:
    """The dataset of a configuration, opened for prediction. Raises ConfigError, DataError, MissingDependencyError."""
    config = config or DatasetConfig()
    return ImageScenes(open_dataset(config.name, options or config.options))


def chosen(names: Sequence[str] | None, known: Sequence[str], where: str) -> Sequence[str]:
    """The named scenes, all where none are named. Raises ConfigError for one that is not there."""
    if lost := [name for name in names or () if name not in known]:
        raise ConfigError(f"{where}: no scene '{lost[0]}'; there is {', '.join(known)}")
    return list(dict.fromkeys(names)) if names is not None else known
