"""Datasets behind one protocol: a dataset has scenes, a scene yields frames with the labels of a backbone."""

from __future__ import annotations

from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from semstab.frames import Frame
from semstab.labels import LabelSpace
from semstab.registry import Entry, Registry

GROUND_TRUTH = "gt"
"""The name under which a scene's ground truth labels are selected like a backbone's."""

REGISTRY = Registry(
    "dataset",
    {
        "city": Entry(
            "semstab.datasets.city:City",
            "the built-in scene: a simulated UAV flight over a procedural city, with simulated backbones",
        ),
        "posed_folder": Entry(
            "semstab.datasets.posed_folder:PosedFolder",
            "folders depth/, pose/, labels/BACKBONE/ and intrinsics.txt, one file a frame",
        ),
        "predicted": Entry(
            "semstab.predict.live:PredictedDataset",
            "another dataset with labels that models make while it is fused: `run --predict`",
        ),
        "uavid3d": Entry(
            "semstab.datasets.uavid3d:Uavid3d",
            "UAVid-3D-Scenes: UAV scenes with metric depth; every path and format is an option",
        ),
        "scannet": Entry("semstab.datasets.scannet:ScanNet", "ScanNet as its SensReader exports it"),
        "replica": Entry("semstab.datasets.replica:Replica", "Replica in the export of NICE-SLAM or Semantic-NeRF"),
        "tum": Entry("semstab.datasets.tum:Tum", "TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt by time stamp"),
        "seven_scenes": Entry("semstab.datasets.seven_scenes:SevenScenes", "7-Scenes: frame-NNNNNN.depth.png, ..."),
        "transforms_json": Entry(
            "semstab.datasets.transforms_json:TransformsJson",
            "transforms.json of nerfstudio or instant-ngp, with depth maps",
        ),
        "colmap": Entry("semstab.datasets.colmap:Colmap", "COLMAP models, text or binary, with depth maps"),
        "tartanair": Entry("semstab.datasets.tartanair:TartanAir", "TartanAir: simulated flights, NED poses"),
        "hololens": Entry("semstab.datasets.hololens:HoloLens", "DeepVideoMVS and HoloLens: poses.txt and K.txt"),
    },
)


class Scene(Protocol):
    """One sequence. Opening it reads no image; `frame` decodes one, and may be called from several threads at once.

    name          the scene's name, usable in a file name
    backbones     names of the label sources, without the ground truth
    ground_truth  whether `frame(i, "gt")` works too
    up            (3,) unit vector of the world's up axis, or None where it is not known
    """

    name: str
    backbones: tuple[str, ...]
    ground_truth: bool
    up: npt.NDArray[np.float64] | None

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def label_space(self, backbone: str) -> LabelSpace:
        """The classes of that backbone's label maps or scores."""
        ...

    def frame(self, index: int, backbone: str, *, color: bool = True) -> Frame:
        """Frame 0 <= index < len, with that backbone's labels or scores in its own label space.

        Without `color` a scene may leave colour out, where that saves time.

        Raises DataError that names the file.
        """
        ...

    def digest(self, indices: list[int], backbone: str) -> str:
        """A hash of the content behind those frames: the same digest means the same numbers."""
        ...


@runtime_checkable
class Timed(Protocol):
    """A scene that knows when its frames were taken, so that they can be chosen by time."""

    @property
    def timestamps(self) -> npt.NDArray[np.float64] | None:
        """(len,) seconds on the scene's own clock, ascending; None where it has none. Reads no image."""
        ...


@runtime_checkable
class Tracked(Protocol):
    """A scene whose tracking may have been lost in some frames, which are left out then."""

    def tracked(self, index: int) -> bool:
        """Whether the frame has a pose. Reads no image."""
        ...


@runtime_checkable
class Regional(Protocol):
    """A scene that also has maps of regions without classes: `frame` reads them by name, nothing fuses them."""

    regions: tuple[str, ...]


class Dataset(Protocol):
    """A set of scenes. Its class has `Options`, a pydantic model, and is made with an instance of it."""

    Options: type[BaseModel]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order."""
        ...

    def scene(self, name: str) -> Scene:
        """Open one. Raises DataError where its files are missing or contradict each other."""
        ...


def options_model(name: str) -> type[BaseModel]:
    """The pydantic model of a dataset's options."""
    return cast("type[BaseModel]", REGISTRY.load(name).Options)


def open_dataset(name: str, options: dict[str, Any] | BaseModel) -> Dataset:
    """Open a dataset by name with its options. Raises ConfigError, DataError or MissingDependencyError."""
    cls = REGISTRY.load(name)
    validated = options if isinstance(options, BaseModel) else cls.Options.model_validate(options)
    return cast(Dataset, cls(validated))
