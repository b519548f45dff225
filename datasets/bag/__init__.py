"""ROS bags: ROS 1 .bag, and rosbag2 of sqlite3 or MCAP, with depth, colour, camera info and poses on their topics.

Sources: docs.ros.org (sensor_msgs, tf2_msgs, nav_msgs, geometry_msgs); REP 103, 104 and 105. Read by rosbags.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from semstab.core.types import Float64
from semstab.data.frames import Intrinsics
from semstab.datasets.bag.finding import OfBags
from semstab.datasets.bag.index import Content, Int64, read_once
from semstab.datasets.bag.messages import Messages, TopicFolder
from semstab.datasets.bag.options import BagOptions
from semstab.datasets.bag.reading import NANOSECONDS, seconds
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, FrameSource
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.files.scene import FileScene
from semstab.datasets.files.surfaces import Surface
from semstab.datasets.formats.images import MILLIMETRES
from semstab.datasets.geometry.cameras import Camera, mutual_nearest
from semstab.datasets.geometry.lenses import Lens
from semstab.errors import DataError

logger = logging.getLogger("semstab")


class Bag(OfBags, FileDataset[BagOptions]):
    """{name} is the stamp of the colour image, 1305031102.175304000, or of the depth image without colour.

    Names of label maps may also have the stamp with six digits, or in whole nanoseconds. Label maps are in the folder
    that has the bag's name without its suffix: run/labels/MODEL/ next to run.bag.
    """

    Options: type[BaseModel] = BagOptions

    def __init__(self, options: BagOptions) -> None:
        self._opened: dict[Path, Recorded] = {}
        super().__init__(options)

    @property
    def folders(self) -> list[Path]:
        """The bags."""
        return list(self.bags.values())

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each depth image with a colour image; its pose is NaN without a pose before and after it.

        Raises:
            DataError: If the bag lacks a part, is damaged, or nothing fits together in time.
        """
        bag = self.open_bag(folder)
        self._opened[folder] = recorded = Recorded(read_once(bag, self.options), self.options)
        return recorded.frames()

    def opened(
        self, entry: SceneEntry, frames: Sequence[FrameSource], options: FileOptions, surface: Surface | None
    ) -> FileScene:
        """Return the scene of a bag, which says on which topics its parts are."""
        recorded = self._opened.pop(entry.folder)
        labels = recorded.label_folders
        scene = FileScene(entry, frames, options, surface=surface, folders=recorded.messages, label_folders=labels)
        scene.sources = tuple(recorded.sources)
        return scene


class Recorded:
    """The frames of a bag whose content is known: which messages belong together, and what each frame is read with.

    Attributes:
        messages: Its image messages as files.
        label_folders: The folders of these that are label maps, by label source.
        sources: Where each part comes from, in words.

    Raises:
        DataError: If nothing fits together in time, or there is no pose.
    """

    def __init__(self, content: Content, options: BagOptions) -> None:
        self._content = content
        self._options = options
        chosen, streams = content.chosen, content.streams
        primary = chosen.depth or chosen.color
        assert primary is not None
        self._seen = primary
        self.sources: list[str] = []
        if chosen.color is not None and chosen.color.frame != primary.frame:
            logger.warning(
                "%s: depth is of the frame '%s', colour of '%s': labels are looked up as if both saw from one point;"
                " set depth to a topic that is registered to colour",
                content.bag.path, primary.frame, chosen.color.frame,
            )  # fmt: skip
        primary_rows, named_rows = self._pairs()
        name_stream = streams[(chosen.color or primary).topic]
        self._stamps = streams[primary.topic].stamps[primary_rows]
        self._names = [seconds(int(stamp)) for stamp in name_stream.stamps[named_rows]]
        self._poses = self._posed()
        bag, folders = content.bag, []
        if chosen.depth is not None:
            places = [streams[chosen.depth.topic].place(k) for k in primary_rows]
            folders.append(TopicFolder.of_images(bag, chosen.depth, places, color=False))
        if chosen.color is not None:
            folders.append(
                TopicFolder.of_images(bag, chosen.color, [name_stream.place(k) for k in named_rows], color=True)
            )
        for source, images in chosen.labels.items():
            stream = streams[images.topic]
            near = stream.near(name_stream.stamps[named_rows], options.max_difference)
            label_places = [None if k is None else stream.place(k) for k in near]
            folders.append(TopicFolder.of_images(bag, images, label_places, color=False))
            count = len(near) - near.count(None)
            self.sources.append(f"labels   {source}: {images}, of {count} of {len(primary_rows)} frames")
        self.messages = Messages(bag, folders, self._names)
        self.label_folders = {source: self.messages.folder(images) for source, images in chosen.labels.items()}
        self.sources += [text for topic, stream in streams.items() for text in stream.notes(topic)]
        if chosen.others:
            self.sources.append(f"others   {', '.join(chosen.others)} (set depth, color)")

    def _pairs(self) -> tuple[Int64, Int64]:
        """Return the frames, by the number of the depth image and of the colour image, or of the only one twice."""
        bag, chosen, limit = self._content.bag, self._content.chosen, self._options.max_difference
        depth, color = chosen.depth, chosen.color
        base = self._content.streams[self._seen.topic]
        self.sources.append(
            f"depth    {depth or 'cast at the surface'}, camera {chosen.depth_info or 'of the options'}"
        )
        self.sources.append(f"colour   {color or 'none'}{f', camera {chosen.color_info}' if chosen.color_info else ''}")
        if depth is None or color is None:
            return np.arange(len(base)), np.arange(len(base))
        other, start = self._content.streams[color.topic], int(base.stamps[0])
        partners = mutual_nearest(base.since(start), other.since(start), limit).astype(np.int64)
        paired = np.flatnonzero(partners >= 0)
        if not len(paired):
            raise DataError(
                f"{bag.path}: no image of {depth.topic} is within {limit:g} s of one of {color.topic}; set"
                " max_difference, or stamps: bag"
            )
        counts = f"{len(paired)} of {len(base)} depth and {len(other)} colour images are within {limit:g} s"
        self.sources.append(f"frames   {counts}")
        if len(paired) < len(base):
            logger.warning(
                "%s: %d depth images have no colour image within %g s (max_difference); left out",
                bag.path, len(base) - len(paired), limit,
            )  # fmt: skip
        return paired, partners[paired]

    def _posed(self) -> Float64:
        """Return (n, 4, 4) poses of the frames, NaN for a frame without a pose."""
        frame = self._options.camera_frame or self._seen.frame
        poses, summary = self._content.poses.around(self._stamps.tolist(), frame, "frame")
        self.sources.append(summary)
        return poses

    def frames(self) -> list[FrameSource]:
        """Return the frames, in the order of their stamps."""
        return [self._frame(*row) for row in zip(self._names, self._stamps.tolist(), self._poses, strict=True)]

    def _frame(self, name: str, stamp: int, pose: Float64) -> FrameSource:
        chosen, options, messages = self._content.chosen, self._options, self.messages
        camera, lens = self._camera(self._seen.topic, stamp)
        color_camera, color_lens = self._camera(chosen.color.topic, stamp) if chosen.color else (camera, lens)
        image = None if chosen.color is None else messages.file(chosen.color, name)
        on_original = options.labels_on == "original"
        depth = messages.folder(self._seen) / name if chosen.depth is None else messages.file(chosen.depth, name)
        millimetres = chosen.depth is not None and chosen.depth.kind.encoding != "32FC1"
        return FrameSource(
            name=name,
            depth=depth,
            pose_file=self._content.bag.path,
            camera=camera,
            pose=pose,
            label_camera=color_camera if color_camera != camera and color_lens is None else None,
            label_lens=color_lens if on_original else None,
            depth_lens=lens if chosen.depth is not None else None,
            color_lens=color_lens,
            photograph=image,
            aliases=(name[:-3], name.replace(".", "")),
            color=image,
            depth_scale=MILLIMETRES if millimetres else 1.0,
            timestamp=stamp / NANOSECONDS,
        )

    def _camera(self, topic: str, stamp: int) -> tuple[Camera, Lens | None]:
        cameras = self._content.cameras.get(topic)
        if cameras is not None and cameras.cameras and (self._options.intrinsics is None or topic != self._seen.topic):
            return cameras.camera_at(stamp)
        if self._options.intrinsics is None and topic != self._seen.topic:
            return self._camera(self._seen.topic, stamp)  # colour without CameraInfo is taken to be as depth sees it
        if self._options.intrinsics is None:
            raise DataError(
                f"{self._content.bag.path}: no message of the camera info of {topic} can be read; set intrinsics"
            )
        return Camera(Intrinsics(*self._options.intrinsics)), None
