"""Image messages of a bag as files that are read from it whenever they are wanted."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from semstab.datasets.bag.images import content
from semstab.datasets.bag.reading import OpenBag, Place
from semstab.datasets.bag.topics import Images
from semstab.datasets.files.options import Folders
from semstab.datasets.formats.disk import digest


@dataclass(frozen=True)
class Folder:
    """A topic as a folder: its images, whether they are colour, and the place of each frame's message, if any."""

    images: Images
    color: bool
    places: Sequence[Place | None]


class Messages(Folders):
    """The messages of a bag as the files BAG:TOPIC/FRAME.png, and the files of real folders.

    Args:
        bag: The bag.
        folders: Its topics.
        frames: The names of the frames.
    """

    def __init__(self, bag: OpenBag, folders: Sequence[Folder], frames: Sequence[str]) -> None:
        super().__init__()
        self._bag = bag
        self._topics = {str(self.folder(each.images)): each for each in folders}
        self._index: Mapping[str, int] = {name: k for k, name in enumerate(frames)}

    def folder(self, images: Images) -> Path:
        """Return the folder of the images of a topic."""
        return Path(f"{self._bag.path}:{images.topic}")

    def file(self, images: Images, frame: str) -> Path:
        """Return the file of a frame's image."""
        return self.folder(images) / f"{frame}{images.kind.suffix}"

    def has(self, path: Path) -> bool:
        """Return whether there is such a message, or file."""
        if os.path.dirname(path) in self._topics:  # noqa: PTH120  as quick as a look-up of each frame must be
            return self._found(path) is not None
        return super().has(path)

    def read(self, path: Path) -> bytes:
        """Return the content of the file that a message is, or of a file.

        Raises:
            DataError: If it is damaged.
        """
        if (found := self._found(path)) is None:
            return super().read(path)
        topic, place = found
        message = self._bag.message(topic.images.topic, place)
        return content(message, topic.images.kind, str(path), color=topic.color)

    def digest(self, path: Path) -> bytes:
        """Return a hash of the same."""
        return super().digest(path) if self._found(path) is None else digest(self.read(path))

    def _found(self, path: Path) -> tuple[Folder, Place] | None:
        folder, name = os.path.split(path)
        topic = self._topics.get(folder)
        if topic is None:
            return None
        frame, suffix = os.path.splitext(name)  # noqa: PTH122
        at = self._index.get(frame) if suffix == topic.images.kind.suffix else None
        place = None if at is None else topic.places[at]
        return None if place is None else (topic, place)
