"""Datasets behind one base class: a dataset has scenes, a scene yields frames with the labels of a backbone."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from pydantic import BaseModel

from semstab.config import DatasetConfig, validated
from semstab.core.registry import Entry, Registry
from semstab.datasets.scene import GROUND_TRUTH, Dataset, Filtering, Scene

__all__ = ["GROUND_TRUTH", "REGISTRY", "Dataset", "Filtering", "Scene", "open_dataset", "options_model", "resolved"]

REGISTRY = Registry(
    "dataset",
    {
        "predicted": Entry(
            "semstab.predict.live:PredictedDataset",
            "another dataset with labels that models make while it is fused: `run --predict`",
        ),
        "frames": Entry("semstab.online.frames:Frames", "frames that a Python program gives to `semstab.fuse`"),
        "city": Entry(
            "semstab.datasets.city:City",
            "the built-in scene: a simulated UAV flight over a procedural city, with simulated backbones",
        ),
        "posed_folder": Entry(
            "semstab.datasets.posed_folder:PosedFolder",
            "folders depth/, pose/, labels/BACKBONE/ and intrinsics.txt, one file a frame",
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
        "odm": Entry("semstab.datasets.odm:Odm", "projects of OpenDroneMap and OpenSfM, depth from their mesh or DSM"),
        "tartanair": Entry("semstab.datasets.tartanair:TartanAir", "TartanAir: simulated flights, NED poses"),
        "hololens": Entry("semstab.datasets.hololens:HoloLens", "DeepVideoMVS and HoloLens: poses.txt and K.txt"),
    },
)


def options_model(name: str) -> type[BaseModel]:
    """Return the pydantic model of a dataset's options."""
    return cast("type[BaseModel]", REGISTRY.load(name).Options)


def resolved(config: DatasetConfig) -> DatasetConfig:
    """Return the dataset with every default of its options filled in, paths absolute.

    Raises ConfigError for a dataset or an option that cannot be used.
    """
    options = validated(options_model(config.name), config.options, f"dataset '{config.name}', options: ")
    paths = {key: value.absolute() for key, value in options if isinstance(value, Path)}
    return config.model_copy(update={"options": options.model_copy(update=paths).model_dump(mode="json")})


def open_dataset(name: str, options: dict[str, Any] | BaseModel) -> Dataset:
    """Open a dataset by name with its options. Raises ConfigError, DataError or MissingDependencyError."""
    cls = REGISTRY.load(name)
    validated = options if isinstance(options, BaseModel) else cls.Options.model_validate(options)
    return cast("Dataset", cls(validated))
