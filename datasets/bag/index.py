"""Index of a bag from one pass: stamps and places of images, cameras over time, and poses. No pixel is kept."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.datasets.bag.cameras import camera_of, is_rectified
from semstab.datasets.bag.options import BagOptions
from semstab.datasets.bag.poses import SensorPoses
from semstab.datasets.bag.reading import NANOSECONDS, MessagePosition, OpenBag, stamp_of
from semstab.datasets.bag.topics import ChosenTopics, ImageTopic, choose
from semstab.datasets.geometry.cameras import Camera, nearest
from semstab.datasets.geometry.lenses import Lens
from semstab.errors import DataError

Int64 = npt.NDArray[np.int64]


class TopicIndex:
    """The messages of a topic in the order of their stamps; of equal stamps the first that was recorded.

    Attributes:
        stamps: (n,) nanoseconds, ascending.
        unsorted: How many messages came after one with a later stamp.
        repeated: How many have the stamp of another one, and are left out.
    """

    def __init__(self, stamps: array[int], times: array[int], ranks: array[int]) -> None:
        all_stamps = np.frombuffer(stamps, dtype=np.int64)
        order = np.argsort(all_stamps, kind="stable")
        order = order[np.append(True, np.diff(all_stamps[order]) > 0)[: len(order)]]
        self.stamps: Int64 = all_stamps[order]
        self.unsorted = int(np.count_nonzero(np.diff(all_stamps) < 0))
        self.repeated = len(all_stamps) - len(order)
        self._times: Int64 = np.frombuffer(times, dtype=np.int64)[order]
        self._ranks: Int64 = np.frombuffer(ranks, dtype=np.int64)[order]

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamps)

    def place(self, k: int) -> MessagePosition:
        """Return where in the bag a message is."""
        return MessagePosition(int(self._times[k]), int(self._ranks[k]))

    def since(self, start: int) -> Float64:
        """Return (n,) seconds since a stamp."""
        return (self.stamps - start) / NANOSECONDS

    def near(self, stamps: Int64, max_difference: float) -> list[int | None]:
        """Return for each stamp the message nearest to it, or None if `max_difference` seconds hold no message."""
        if not len(self):
            return [None] * len(stamps)
        requested = (stamps - self.stamps[0]) / NANOSECONDS
        message_times = self.since(int(self.stamps[0]))
        rows = nearest(requested, message_times)
        close = np.abs(message_times[rows] - requested) <= max_difference
        return [int(k) if is_close else None for k, is_close in zip(rows, close, strict=True)]

    def notes(self, topic: str) -> Iterator[str]:
        """Yield a line for each thing that is not in order."""
        if self.unsorted:
            yield f"order    {topic}: {self.unsorted} messages come after a later stamp; sorted"
        if self.repeated:
            yield f"order    {topic}: {self.repeated} messages have the stamp of another one; left out"


class Arrivals:
    """Stamps and places of the messages of a topic, as they come.

    Args:
        topic: The topic.
        stamps: Whose time a message has: its header's, or the bag's.
    """

    def __init__(self, topic: str, stamps: Literal["header", "bag"]) -> None:
        self._topic, self._by_bag = topic, stamps == "bag"
        self._stamps, self._times, self._ranks = array("q"), array("q"), array("q")

    def add(self, place: MessagePosition, message: Any) -> None:
        """Add a message."""
        self._stamps.append(place.time if self._by_bag else stamp_of(message))
        self._times.append(place.time)
        self._ranks.append(place.rank)

    def stream(self, path: Path) -> TopicIndex:
        """Return them in order; raises DataError, with the path of the bag, if no header has a stamp."""
        if not self._by_bag and len(self._stamps) > 1 and not any(self._stamps):
            raise DataError(f"{path}: all stamps in the headers of {self._topic} are 0; set stamps: bag")
        return TopicIndex(self._stamps, self._times, self._ranks)


@dataclass
class Cameras:
    """The cameras of a topic of CameraInfo over time; one that does not change is there once."""

    stamps: list[int] = field(default_factory=list)
    cameras: list[tuple[Camera, Lens | None]] = field(default_factory=list)

    def add(self, stamp: int, camera: tuple[Camera, Lens | None]) -> None:
        """Add the camera from a stamp on."""
        if not self.cameras or self.cameras[-1] != camera:
            self.stamps.append(stamp)
            self.cameras.append(camera)

    def camera_at(self, stamp: int) -> tuple[Camera, Lens | None]:
        """Return the last camera that was said until a stamp, else the first one."""
        return self.cameras[max(int(np.searchsorted(self.stamps, stamp, side="right")) - 1, 0)]


@dataclass(frozen=True)
class Content:
    """A bag, the topics that are read, its image messages by topic, its poses, and its cameras by images."""

    bag: OpenBag
    chosen: ChosenTopics
    streams: dict[str, TopicIndex]
    poses: SensorPoses
    cameras: dict[str, Cameras]


def read_once(bag: OpenBag, options: BagOptions) -> Content:
    """Read all that a scene needs but pixels, in one pass.

    Raises:
        DataError: If the bag lacks a part or is damaged.
    """
    chosen, poses = choose(bag, options), SensorPoses(bag, options)
    pictures = {
        picture.topic: picture
        for picture in (chosen.depth, chosen.color, *chosen.labels.values())
        if picture is not None
    }
    arrivals = {topic: Arrivals(topic, options.stamps) for topic in pictures}
    infos = [(chosen.depth_info, chosen.depth or chosen.color), (chosen.color_info, chosen.color)]
    cameras = {images.topic: Cameras() for _, images in infos if images is not None}
    topics = {*pictures, *poses.topics, *(info for info, _ in infos if info is not None)}
    for topic, place, message in bag.messages(sorted(topics)):
        if topic in pictures:
            arrivals[topic].add(place, message)
        elif topic in poses.topics:
            poses.add(topic, place.time, message)
        for info, images in infos:
            if topic == info and images is not None:
                stamp = place.time if options.stamps == "bag" else stamp_of(message)
                cameras[images.topic].add(stamp, _camera(bag, options, topic, message, images))
    streams = {topic: arrival.stream(bag.path) for topic, arrival in arrivals.items()}
    return Content(bag, chosen, streams, poses, cameras)


def _camera(
    bag: OpenBag, options: BagOptions, topic: str, message: object, images: ImageTopic
) -> tuple[Camera, Lens | None]:
    rectified = is_rectified(images.base) if options.rectified is None else options.rectified
    return camera_of(message, f"{bag.path}, {topic}", rectified=rectified)
