"""ROS bags with clouds: ROS 1 .bag, and rosbag2 of sqlite3 or MCAP, with PointCloud2 and poses on their topics.

Sources: docs.ros.org (sensor_msgs, tf2_msgs, nav_msgs, geometry_msgs); REP 103 and 105. Read by rosbags.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from semstab.datasets.bag.clouds import CLOUD, classes_of, field_of, label_field_of, points_of, size_of
from semstab.datasets.bag.finding import OfBags
from semstab.datasets.bag.images import npy
from semstab.datasets.bag.index import Arrivals, TopicIndex
from semstab.datasets.bag.messages import Messages, TopicFolder, topic_path
from semstab.datasets.bag.options import PoseOptions
from semstab.datasets.bag.poses import POSES, TF, TF_TYPE, SensorPoses
from semstab.datasets.bag.reading import NANOSECONDS, OpenBag, seconds
from semstab.datasets.bag.topics import has_depth, require
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.scans import ScanDataset, ScanOptions, ScanScene, ScanSource
from semstab.datasets.formats.disk import decode_array
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.transforms import bare
from semstab.errors import DataError, MissingDependencyError

logger = logging.getLogger("semstab")


class BagScanOptions(PoseOptions, ScanOptions):
    """Options with the defaults of ROS: topics, frames and fields that are not named are found."""

    root: Path = Field(description="a bag, or the folder above bags")
    points: str | None = Field(None, description="topic of clouds, PointCloud2")
    label_field: str | None = Field(None, description="field of the class of each point; '' for none")
    label_source: str | None = Field(
        None, description="name of the label source that this field is, gt for the ground truth; the field's if not set"
    )
    sensor_frame: str | None = Field(None, description="frame of the sensor in /tf, if not the header's")
    up_axis: opt.UpAxis = "z"


class BagScans(OfBags, ScanDataset[BagScanOptions]):
    """{name} is the stamp of the cloud in whole nanoseconds, 1305031102175304000.

    Names of predictions may also have the stamp in seconds, with nine digits or six. Predictions are in the folder that
    has the bag's name without its suffix: run/labels/MODEL/ next to run.bag.
    """

    Options: type[BaseModel] = BagScanOptions
    labels = ("labels/{model}/{name}",)

    def __init__(self, options: BagScanOptions) -> None:
        self._opened: dict[Path, RecordedScans] = {}
        super().__init__(options)

    @property
    def folders(self) -> list[Path]:
        """The bags.

        Raises:
            DataError: If the first one with depth or clouds has depth, so that `bag` reads it, or none has clouds.
        """
        bags = list(self.bags.values())
        if not next((holds for path in bags if (holds := _holds_clouds(path)) is not None), False):
            raise DataError(f"{self.options.root}: no bag with clouds, and without depth")
        return bags

    def scans(self, entry: SceneEntry) -> list[ScanSource]:
        """Return a scan for each cloud with points; its pose is NaN without a pose before and after it.

        Raises:
            DataError: If the bag lacks a part, or is damaged.
        """
        bag = self.open_bag(entry.folder)
        self._opened[entry.folder] = recorded = RecordedScans(bag, self.options)
        return recorded.scans

    def opened(self, entry: SceneEntry, scans: Sequence[ScanSource]) -> ScanScene:
        """Return the scene of a bag, which says on which topics its parts are."""
        recorded = self._opened.pop(entry.folder)
        scene = ScanScene(self, entry, scans, recorded.messages, recorded.labels)
        scene.sources = tuple(recorded.sources)
        return scene

    def points(self, path: Path, read: Read) -> npt.NDArray[np.floating[Any]]:
        """Return x, y, z of a cloud."""
        return decode_array(path, read(path), "points")


def _holds_clouds(path: Path) -> bool | None:
    """Return True for a bag of clouds, False for a bag with depth, None for a bag without both or one not readable."""
    try:
        bag = OpenBag(path)
        if has_depth(bag):
            return False
    except (DataError, MissingDependencyError):
        return None
    return True if bag.of_types(CLOUD) else None


class RecordedScans:
    """The scans of a bag, found in one pass that keeps no point.

    Attributes:
        messages: Its clouds as files, and their field of classes.
        labels: The folder of these classes, by the label source that they are.
        scans: The scans, in the order of their stamps.
        sources: Where each part comes from, in words.

    Raises:
        DataError: If the bag lacks a part or is damaged, or no cloud has a pose.
    """

    def __init__(self, bag: OpenBag, options: BagScanOptions) -> None:
        self._bag, self._options = bag, options
        self._topic, other_topics = _topic_of(bag, options)
        if (first := bag.first(self._topic)) is None:
            raise DataError(f"{bag.path}, {self._topic}: holds no message that can be read; record the bag again")
        self._field = self._field_of(first)
        self._frame = options.sensor_frame or bare(first.header.frame_id)
        self._poses = SensorPoses(bag, options, "sensor", "clouds")
        stream = self._stream()
        names = [str(stamp) for stamp in stream.stamps.tolist()]
        self.sources = [f"points   {self._topic} of {self._frame}, classes: {self._field or 'no field'}"]
        places, folder = [stream.place(k) for k in range(len(stream))], topic_path(bag, self._topic)
        folders = [TopicFolder(folder, self._topic, ".npy", lambda cloud, where: npy(points_of(cloud, where)), places)]
        self.labels: dict[str, Path] = {}
        if field := self._field:
            class_folder = Path(f"{folder}.{field}")
            self.labels = {options.label_source or field: class_folder}
            folders.append(
                TopicFolder(
                    class_folder, self._topic, ".npy", lambda cloud, where: npy(classes_of(cloud, field, where)), places
                )
            )
        self.messages = Messages(bag, folders, names)
        self.scans = self._scans(stream, names)
        self.sources += stream.notes(self._topic)
        if other_topics:
            self.sources.append(f"others   {', '.join(other_topics)} (set points)")

    def _field_of(self, first: Any) -> str | None:
        """Return the field of classes; raises DataError if an option names one that is not there."""
        field_name = self._options.label_field
        if field_name:
            field_of(first, field_name, f"{self._bag.path}, {self._topic}, option label_field")
        return label_field_of(first) if field_name is None else field_name or None

    def _stream(self) -> TopicIndex:
        """Return the clouds that have points, and read the poses."""
        arrivals, empty = Arrivals(self._topic, self._options.stamps), 0
        for topic, place, message in self._bag.messages(sorted({self._topic, *self._poses.topics})):
            if topic != self._topic:
                self._poses.add(topic, place.time, message)
            elif size_of(message):
                arrivals.add(place, message)
            else:
                empty += 1
        if empty:
            logger.warning("%s: %d clouds of %s have no point; left out", self._bag.path, empty, self._topic)
        return arrivals.stream(self._bag.path)

    def _scans(self, stream: TopicIndex, names: Sequence[str]) -> list[ScanSource]:
        if not names:
            return []
        stamps, folder = stream.stamps.tolist(), topic_path(self._bag, self._topic)
        poses, summary = self._poses.around(stamps, self._frame, "scan")
        self.sources.append(summary)
        return [
            ScanSource(
                name, folder / f"{name}.npy", pose, self._bag.path, stamp / NANOSECONDS,
                (seconds(stamp), seconds(stamp)[:-3]),
            )
            for name, stamp, pose in zip(names, stamps, poses, strict=True)
        ]  # fmt: skip


def _topic_of(bag: OpenBag, options: BagScanOptions) -> tuple[str, list[str]]:
    """Return the topic of clouds that is named, else one with classes, else that of most clouds; and the others.

    Raises:
        DataError: If there is none, or there are no poses, with the topics that there are.
    """
    pose = None if options.pose == TF else options.pose
    for name, topic, types in (("points", options.points, (CLOUD,)), ("pose", pose, tuple(POSES))):
        if topic is not None:
            require(bag, name, topic, types)
    clouds = bag.of_types(CLOUD)
    lacks = [] if clouds else [f"clouds ({CLOUD})"]
    if options.trajectory is None and not bag.of_types(*TF_TYPE, *POSES):
        lacks.append("poses")
    if lacks:
        raise DataError(
            f"{bag.path}: holds no {' and no '.join(lacks)}; record these, too, or write its scans as a points_folder"
            f" (docs/datasets.md); its topics: {bag.listed()}"
        )
    chosen = options.points or min(
        clouds, key=lambda name: (not _has_classes(bag, name), -bag.topics[name].count, name)
    )
    return chosen, [name for name in clouds if name != chosen]


def _has_classes(bag: OpenBag, topic: str) -> bool:
    first = bag.first(topic)
    return first is not None and label_field_of(first) is not None
