"""Datasets behind one base class: a dataset has scenes, a scene yields frames with the labels of a model.

Examples:
    >>> city = semstab.datasets.open_dataset("city", {"width": 160, "height": 90})
    >>> scene = city.scene("scene0")
    >>> scene.frame(0, "sim-steady").shape
    (90, 160)
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from semstab.config import DatasetConfig, validated
from semstab.core.registry import Registration, Registry
from semstab.data.records import is_run
from semstab.datasets.scene import GROUND_TRUTH, Dataset, Filtering, Scene
from semstab.errors import ConfigError, DataError

__all__ = [
    "GROUND_TRUTH",
    "REGISTRY",
    "Dataset",
    "Filtering",
    "Scene",
    "open_dataset",
    "options_model",
    "reader",
    "recognise",
    "resolved",
]

REGISTRY = Registry(
    "dataset",
    {
        "predicted": Registration(
            "semstab.predict.dataset:PredictedDataset",
            "used by --predict: labels that a model makes",
        ),
        "vocabularies": Registration(
            "semstab.predict.vocabulary_dataset:VocabularyDataset",
            "used by --vocabulary: labels from a model's features",
        ),
        "frames": Registration("semstab.online.frames:Frames", "frames from a Python program, by semstab.fuse"),
        "city": Registration(
            "semstab.datasets.city:City",
            "built in: simulated drone flights over a made city",
        ),
        "posed_folder": Registration(
            "semstab.datasets.posed_folder:PosedFolder",
            "a folder of frames: depth/, pose/, labels/MODEL/",
        ),
        "uavid3d": Registration(
            "semstab.datasets.uavid3d:Uavid3d",
            "UAVid-3D-Scenes: drone scenes with metric depth",
        ),
        "scannet": Registration("semstab.datasets.scannet:ScanNet", "ScanNet as its SensReader exports it"),
        "replica": Registration("semstab.datasets.replica:Replica", "Replica as NICE-SLAM or Semantic-NeRF export it"),
        "tum": Registration("semstab.datasets.tum:Tum", "TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt"),
        "seven_scenes": Registration(
            "semstab.datasets.seven_scenes:SevenScenes", "7-Scenes: frame-NNNNNN.depth.png, ..."
        ),
        "transforms_json": Registration(
            "semstab.datasets.transforms_json:TransformsJson",
            "transforms.json of nerfstudio or instant-ngp, depth",
        ),
        "colmap": Registration("semstab.datasets.colmap:Colmap", "COLMAP models, text or binary, with depth maps"),
        "odm": Registration("semstab.datasets.odm:Odm", "OpenDroneMap and OpenSfM projects, with mesh or DSM"),
        "metashape": Registration(
            "semstab.datasets.metashape:Metashape", "Agisoft Metashape cameras (XML), with mesh or DEM"
        ),
        "pix4d": Registration("semstab.datasets.pix4d:Pix4d", "Pix4Dmapper cameras (params), with mesh or DSM"),
        "realitycapture": Registration(
            "semstab.datasets.realitycapture:RealityCapture",
            "RealityCapture, RealityScan cameras (CSV), with mesh",
        ),
        "uavscenes": Registration("semstab.datasets.uavscenes:UavScenes", "UAVScenes: drone flights over four places"),
        "bag": Registration(
            "semstab.datasets.bag:Bag",
            "ROS bags with colour, depth, camera info and poses",
            "pip install 'semstab[bags]'",
            ("rosbags",),
        ),
        "bag_scans": Registration(
            "semstab.datasets.bag.scans:BagScans",
            "ROS bags with LiDAR clouds (PointCloud2) and poses",
            "pip install 'semstab[bags]'",
            ("rosbags",),
        ),
        "stray_scanner": Registration(
            "semstab.datasets.stray_scanner:StrayScanner", "recordings of the app Stray Scanner"
        ),
        "polycam": Registration("semstab.datasets.polycam:Polycam", "raw data of the app Polycam: keyframes/"),
        "record3d": Registration("semstab.datasets.record3d:Record3D", "EXR and JPG sequences of the app Record3D"),
        "arkitscenes": Registration("semstab.datasets.arkitscenes:ArkitScenes", "ARKitScenes raw data"),
        "tartanair": Registration("semstab.datasets.tartanair:TartanAir", "TartanAir: simulated flights, NED poses"),
        "syndrone": Registration("semstab.datasets.syndrone:Syndrone", "Syndrone: flights simulated by CARLA"),
        "carla": Registration("semstab.datasets.carla:Carla", "CARLA camera images as it saves them, KITTI-CARLA"),
        "airsim": Registration("semstab.datasets.airsim:AirSim", "AirSim recordings: airsim_rec.txt and images/"),
        "hypersim": Registration(
            "semstab.datasets.hypersim:Hypersim",
            "Hypersim: rendered rooms, classes of NYU40",
            "pip install 'semstab[midair]'",
            ("h5py",),
        ),
        "habitat": Registration("semstab.datasets.habitat:Habitat", "walks that Habitat rendered, with GT_Pose.txt"),
        "virtual_kitti": Registration(
            "semstab.datasets.virtual_kitti:VirtualKitti", "Virtual KITTI 2: KITTI's sequences, rendered"
        ),
        "midair": Registration(
            "semstab.datasets.midair:MidAir",
            "Mid-Air: flights simulated low over land",
            "pip install 'semstab[midair]'",
            ("h5py",),
        ),
        "semantickitti": Registration(
            "semstab.datasets.semantickitti:SemanticKitti", "SemanticKITTI: LiDAR scans with a class per point"
        ),
        "semantickitti_images": Registration(
            "semstab.datasets.semantickitti_images:SemanticKittiImages",
            "SemanticKITTI: images, depth and classes by LiDAR",
        ),
        "nuscenes": Registration("semstab.datasets.nuscenes:NuScenes", "nuScenes lidarseg: LiDAR key frames"),
        "kitti360": Registration("semstab.datasets.kitti360:Kitti360", "KITTI-360: velodyne scans of the raw data"),
        "kitti360_images": Registration(
            "semstab.datasets.kitti360_images:Kitti360Images",
            "KITTI-360: rectified images, depth of LiDAR points",
        ),
        "points_folder": Registration(
            "semstab.datasets.points_folder:PointsFolder",
            "a folder of scans: points/, pose/, labels/MODEL/",
        ),
        "hololens": Registration(
            "semstab.datasets.hololens:HoloLens", "DeepVideoMVS and HoloLens: poses.txt and K.txt"
        ),
        "video": Registration("semstab.datasets.video:Video", "images without depth and poses: a video or a folder"),
    },
)


def reader(name: str) -> type[Dataset]:
    """Return the class of a dataset, by its name or as FILE.py:NAME.

    Raises:
        ConfigError: If the name is not known, or the class is no dataset, or lacks a method or its options.
        MissingDependencyError: If a package that it needs is not installed.
    """
    cls = REGISTRY.load(name)
    if not (isinstance(cls, type) and issubclass(cls, Dataset)):
        raise ConfigError(f"dataset '{name}': is no subclass of semstab.datasets.Dataset (docs/tutorials/extend.md)")
    lacking = sorted(cls.__abstractmethods__) + ([] if hasattr(cls, "Options") else ["Options"])
    if lacking:
        raise ConfigError(f"dataset '{name}': lacks {', '.join(lacking)} (docs/tutorials/extend.md)")
    return cls


def options_model(name: str) -> type[BaseModel]:
    """Return the pydantic model of a dataset's options."""
    return reader(name).Options


def resolved(config: DatasetConfig) -> DatasetConfig:
    """Return the dataset with every default of its options filled in, paths absolute.

    Raises:
        ConfigError: For a dataset or an option that cannot be used.
    """
    model = options_model(config.name)
    title = getattr(model, "title", f"dataset '{config.name}', options")
    options = validated(model, config.options, f"{title}: ")
    paths = {key: value.absolute() for key, value in options if isinstance(value, Path)}
    return config.model_copy(update={"options": options.model_copy(update=paths).model_dump(mode="json")})


def open_dataset(name: str, options: dict[str, Any] | BaseModel, run_folder: Path | None = None) -> Dataset:
    """Open a dataset by name with its options, for the run in `run_folder`, if any.

    Raises:
        ConfigError: If the name or an option cannot be used.
        DataError: If the data cannot be read.
        MissingDependencyError: If a package that it needs is not installed.
    """
    cls: Any = reader(name)
    title = getattr(cls.Options, "title", f"dataset '{name}', options")
    checked = options if isinstance(options, BaseModel) else validated(cls.Options, options, f"{title}: ")
    dataset: Dataset = cls(checked)
    dataset.run_folder = run_folder
    return dataset


RECOGNISED = (
    "odm", "metashape", "pix4d", "realitycapture", "uavscenes", "hololens", "tum", "seven_scenes", "replica",
    "scannet", "semantickitti", "nuscenes", "kitti360", "tartanair", "stray_scanner", "polycam", "record3d",
    "arkitscenes", "airsim", "carla", "syndrone", "midair", "hypersim", "habitat", "virtual_kitti", "transforms_json",
    "colmap", "bag_scans", "bag", "posed_folder", "points_folder",
)  # fmt: skip
"""Formats that a folder is recognised as: the one whose scenes lie highest, of these the first."""


POINTS = {
    "LiDAR scans in KITTI's layout": "velodyne/*.bin",
    "point clouds": "*.pcd",
    "point clouds (LAS)": "*.la[sz]",
}
"""Points in a layout that no reader has, by its name: a pattern of its files."""

FILES = (".bag", ".mcap", ".db3")
"""Suffixes of files that are a scene each."""

SHORT = 60
"""The longest description of a format that is told where a folder is recognised as one, in characters."""

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
"""Suffixes of video files."""


def recognise(root: Path) -> tuple[str, str]:
    """Return the dataset that a folder of scenes, or a file, belongs to, and the reason in words.

    Raises:
        DataError: If it is none; of an empty folder it is a `posed_folder`, whose reader says what is missing, with the
            nearest formats, and the files that these miss.
    """
    if root.is_file() and root.suffix.lower() in VIDEOS:
        return "video", "a video file: flicker in the image alone"
    if root.is_file() and root.suffix.lower() not in FILES:
        raise DataError(
            f"{root}: a file, but no bag ({', '.join(FILES)}) and no video ({', '.join(VIDEOS)}); give the folder of a"
            " scene, or above scenes"
        )
    if is_run(root):
        raise DataError(f"{root}: a finished run, no scene; semstab-bench show {root} says what it found")
    near, fits = list[tuple[float, str]](), list[tuple[int, int, str, str]]()
    for rank, name in enumerate(RECOGNISED):
        cls: Any = REGISTRY.load(name)
        try:
            folders = cls(cls.Options(root=root)).folders
        except DataError:
            marks = re.findall(r"[\w.]+/(?:[\w./]+)?|\w+\.(?:txt|json)", cls.contents)
            lacks = [mark for mark in marks if not (root / mark).exists()]
            if len(lacks) < len(marks):
                near.append((len(lacks) / len(marks), f"{name} (without {', '.join(lacks)})"))
        else:
            deep = min(len(folder.relative_to(root).parts) for folder in folders)
            count = f"{len(folders)} scene{'s' if len(folders) > 1 else ''}"
            what = f"{cls.contents}; " if len(cls.contents) <= SHORT else ""
            fits.append((deep, rank, name, f"{what}{count}"))
    if fits:
        return min(fits)[2:]
    listed = " or ".join(text for _, text in sorted(near)[:3])
    _refuse_points(root, listed)
    _refuse_videos(root, listed)
    if not near:
        return "posed_folder", ""
    raise DataError(f"{root}: no format is recognised; the nearest are {listed}; name it with --dataset NAME")


def _refuse_points(root: Path, nearest: str) -> None:
    """Raise DataError where a folder holds points in a layout that no reader has."""
    for what, pattern in POINTS.items():
        for depth in range(4):
            if (file := next(root.glob("*/" * depth + pattern), None)) is not None:
                where = file.parent.relative_to(root.parent)
                raise DataError(
                    f"{root}: holds {what} ({where}), in no layout of scans that is read"
                    f"{f', the nearest is {nearest}' if nearest else ''}; lay them out as one, with poses"
                    " (docs/datasets.md#scans), or, where a camera was beside, make depth images of them"
                    " (docs/tutorials/lidar-camera.md)"
                )


def _refuse_videos(root: Path, nearest: str) -> None:
    """Raise DataError where a folder holds images or video files alone."""
    video: Any = REGISTRY.load("video")
    try:
        video(video.Options(root=root))
    except DataError:
        return
    near = f" (the nearest are {nearest}; name it with --dataset NAME)" if nearest else ""
    raise DataError(
        f"{root}: holds images, without the depth and poses of a format that is recognised{near}; --dataset video"
        " measures their flicker without a map"
    )
