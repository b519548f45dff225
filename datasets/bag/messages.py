"""Messages of a bag as files that are read from it whenever they are wanted."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semstab.datasets.bag.images import content
from semstab.datasets.bag.reading import MessagePosition, OpenBag
from semstab.datasets.bag.topics import ImageTopic
from semstab.datasets.files.options import Folders
from semstab.datasets.formats.disk import digest

Content = Callable[[Any, str], bytes]
"""The content of the file that a message is, whose name is given for errors."""


@dataclass(frozen=True)
class TopicFolder:
    """A topic as a folder of files.

    Attributes:
        path: The folder.
        topic: The topic.
        suffix: Suffix of the files.
        content: Returns a file's content.
        places: The place of each frame's message, if any.
    """

    path: Path
    topic: str
    suffix: str
    content: Content
    places: Sequence[MessagePosition | None]

    @classmethod
    def of_images(
        cls, bag: OpenBag, images: ImageTopic, places: Sequence[MessagePosition | None], *, color: bool
    ) -> TopicFolder:
        """Return the folder of the images of a topic, those of `color` as RGB."""

        def read(message: Any, where: str) -> bytes:
            return content(message, images.kind, where, color=color)

        return cls(topic_path(bag, images.topic), images.topic, images.kind.suffix, read, places)


def topic_path(bag: OpenBag, topic: str) -> Path:
    """Return the folder that a topic of a bag is."""
    return Path(f"{bag.path}:{topic}")


class Messages(Folders):
    """The messages of a bag as the files BAG:TOPIC/FRAME.png, and the files of real folders.

    Args:
        bag: The bag.
        folders: Its topics.
        frames: The names of the frames.
    """

    def __init__(self, bag: OpenBag, folders: Sequence[TopicFolder], frames: Sequence[str]) -> None:
        super().__init__()
        topics = [folder.topic for folder in folders]
        self._shared = {topic for topic in topics if topics.count(topic) > 1}
        self._last = threading.local()
        self._bag = bag
        self._topics = {str(folder.path): folder for folder in folders}
        self._index: Mapping[str, int] = {name: k for k, name in enumerate(frames)}

    def folder(self, images: ImageTopic) -> Path:
        """Return the folder of the images of a topic."""
        return topic_path(self._bag, images.topic)

    def file(self, images: ImageTopic, frame: str) -> Path:
        """Return the file of a frame's image."""
        return self.folder(images) / f"{frame}{images.kind.suffix}"

    def has(self, path: Path) -> bool:
        """Return whether there is such a message, or file."""
        if os.path.dirname(path) in self._topics:  # noqa: PTH120  as quick as a look-up of each frame must be
            return self._locate(path) is not None
        return super().has(path)

    def read(self, path: Path) -> bytes:
        """Return the content of the file that a message is, or of a file.

        Raises:
            DataError: If it is damaged.
        """
        if (location := self._locate(path)) is None:
            return super().read(path)
        folder, place = location
        return folder.content(self._message(folder.topic, place), str(path))

    def digest(self, path: Path) -> bytes:
        """Return a hash of the same."""
        return super().digest(path) if self._locate(path) is None else digest(self.read(path))

    def _message(self, topic: str, place: MessagePosition) -> Any:
        """Return a message; of a topic that is several folders each thread keeps its last one for the next file."""
        if topic not in self._shared:
            return self._bag.message(topic, place)
        if getattr(self._last, "key", None) != (topic, place):
            self._last.message, self._last.key = self._bag.message(topic, place), (topic, place)
        return self._last.message

    def _locate(self, path: Path) -> tuple[TopicFolder, MessagePosition] | None:
        folder, name = os.path.split(path)
        topic = self._topics.get(folder)
        if topic is None:
            return None
        frame, suffix = os.path.splitext(name)  # noqa: PTH122
        index = self._index.get(frame) if suffix == topic.suffix else None
        place = None if index is None else topic.places[index]
        return None if place is None else (topic, place)
