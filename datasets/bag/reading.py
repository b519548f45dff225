"""ROS bags: their topics, every message once in order, and single messages read when they are wanted.

Formats: wiki.ros.org/Bags/Format/2.0; rosbag2 of sqlite3 and MCAP (mcap.dev/spec). All are read by the library rosbags.
The messages are of ROS's own types, whose fields are those of each distribution; what else a bag holds is not parsed.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import os
import re
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semstab.errors import DataError, MissingDependencyError, summarize_error

INSTALL = "pip install 'semstab[bags]'"
SUFFIXES = (".bag", ".mcap", ".db3")
METADATA = "metadata.yaml"
"""The file that makes a folder a rosbag2."""

REPAIR = {
    ".bag": "record it to its end, or 'rosbag reindex'",
    ".mcap": "record it to its end, or 'mcap recover'",
    ".db3": "record it to its end, or 'ros2 bag reindex'",
}
SAME_TYPE = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
"""Types of messages that have the bytes of another one."""

QUOTED = re.compile(r"\w*(?:Error)?\(('[^']*'),?\)")
"""An exception, or its arguments, in a message: KeyError('version')."""

TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms"
"""The definition of tf2_msgs/TFMessage, which rosbags does not have for ROS 1."""


@functools.cache
def messages_of(first: bool) -> Any:
    """Return the types of messages of ROS 1, or of ROS 2: rosbags compiles what reads a type, once for all bags."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.LATEST)
    if first:
        store.register(get_types_from_msg(TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
    return store


NANOSECONDS = 10**9
MOST_LISTED = 12


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its name, or a folder with a metadata.yaml and bags in it."""
    if path.suffix.lower() in SUFFIXES and path.is_file():
        return True
    return path.is_dir() and (path / METADATA).is_file() and any(f"{suffix}" in _endings(path) for suffix in SUFFIXES)


def _endings(folder: Path) -> set[str]:
    """Return the suffixes of a folder's files; the suffix of a compressed file is the suffix before '.zstd'."""
    names = (name.lower().removesuffix(".zstd") for name in os.listdir(folder))  # noqa: PTH208  names, not paths
    return {os.path.splitext(name)[1] for name in names}  # noqa: PTH122


SPLIT = re.compile(r"(.*?)(?:_?\d{4}(?:-\d{2}){5})?_(\d{1,6})")
"""The name of a part of a recording: NAME_3, or of ROS 1 NAME_2024-05-31-10-15-00_3."""

MOST_BETWEEN = 5 * NANOSECONDS
"""The next part of a recording begins within this number of nanoseconds after the end of the part before."""

MOST_OVERLAP = NANOSECONDS
"""The next part of a recording may begin this number of nanoseconds before the end of the part before."""


def recordings(paths: Sequence[Path]) -> list[list[Path]]:
    """Return the files of a folder that are one recording each: the parts of one that was split are together.

    Parts are numbered, each goes on in time where the one before ends, and they have topics in common.
    """
    groups: dict[tuple[str, str], dict[int, Path]] = {}
    sequences: list[list[Path]] = []
    for path in paths:
        match = SPLIT.fullmatch(path.stem)
        if match is None:
            sequences.append([path])
        else:
            groups.setdefault((match[1], path.suffix.lower()), {}).setdefault(int(match[2]), path)
    for numbered in groups.values():
        for number in sorted(numbered):
            before = numbered.get(number - 1)
            if before is not None and sequences[-1][-1] == before and _goes_on(before, numbered[number]):
                sequences[-1].append(numbered[number])
            else:
                sequences.append([numbered[number]])
    grouped = {path for group in sequences for path in group}
    return sequences + [[path] for path in paths if path not in grouped]


def _goes_on(first: Path, second: Path) -> bool:
    """Return whether the second file goes on where the first one ends; not if one cannot be read."""
    try:
        (_, end, topics), (start, _, next_topics) = (_extent(path) for path in (first, second))
    except (DataError, MissingDependencyError):
        return False
    return -MOST_OVERLAP <= start - end <= MOST_BETWEEN and bool(topics & next_topics)


def _extent(path: Path) -> tuple[int, int, set[str]]:
    """Return the bag times of the first and the last message, and the topics that have any."""
    bag = OpenBag(path)
    return bag.start, bag.end, {topic.name for topic in bag.topics.values() if topic.count}


@dataclass(frozen=True)
class Topic:
    """A topic: its name, the type of its messages without '/msg/', sensor_msgs/Image, and how many there are."""

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True)
class MessagePosition:
    """Where a message is: the nanoseconds of its bag time, and how many of its topic come before it at that time."""

    time: int
    rank: int = 0


class OpenBag:
    """One bag, which is opened once; several threads may read from it.

    Args:
        path: The file, or the folder of a rosbag2.
        parts: The files of a recording that was split, in the order of time; `path` is the first.

    Attributes:
        path: The same.
        topics: Its topics by name, in their order.

    Raises:
        DataError: If it is no whole bag, in one line.
        MissingDependencyError: If rosbags is not installed.
    """

    def __init__(self, path: Path, parts: Sequence[Path] = ()) -> None:
        self.path = path
        self._lock = threading.Lock()
        first = path.suffix.lower() == ".bag" and path.is_file()
        try:
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
        except ImportError as error:
            raise MissingDependencyError(f"{path}: bags need rosbags ({summarize_error(error)}); {INSTALL}") from error
        with self._one_line():
            self._deserialize = messages_of(first).deserialize_ros1 if first else messages_of(first).deserialize_cdr
        self._readers: list[Any] = []
        for part in parts or (path,):
            with self._one_line(path=part):
                reader: Any = Reader1(part) if first else Reader2(part)
                reader.open()
                weakref.finalize(self, reader.close)
                self._readers.append(reader)
        with self._one_line():
            self._connections: dict[str, list[tuple[Any, Any]]] = {}
            for owner, connection in ((opened, link) for opened in self._readers for link in opened.connections):
                if not isinstance(connection.topic, str):  # a database holds any type in any column
                    raise DataError(f"{path}: damaged: a topic is called {connection.topic!r}; record the bag again")
                self._connections.setdefault(connection.topic, []).append((owner, connection))
            self.topics: Mapping[str, Topic] = {
                name: Topic(
                    name, links[0][1].msgtype.replace("/msg/", "/"), sum(int(link.msgcount) for _, link in links)
                )
                for name, links in self._connections.items()
            }

    @property
    def start(self) -> int:
        """The bag time of the first message, nanoseconds."""
        return min(int(reader.start_time) for reader in self._readers)

    @property
    def end(self) -> int:
        """The bag time after the last message, nanoseconds."""
        return max(int(reader.end_time) for reader in self._readers)

    def of_types(self, *types: str) -> list[str]:
        """Return the topics of messages of these types that have any message, by name."""
        return sorted(topic.name for topic in self.topics.values() if topic.type in types and topic.count)

    def listed(self) -> str:
        """Return its topics, with their types, in one line."""
        short = [f"{topic.name} {topic.type.rpartition('/')[2]} ({topic.count})" for topic in self.topics.values()]
        more = f", {len(short) - MOST_LISTED} more" if len(short) > MOST_LISTED else ""
        return ", ".join(short[:MOST_LISTED]) + more or "none"

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, MessagePosition, Any]]:
        """Yield topic, place and message of all messages of the topics, in order of bag time, each read once.

        Raises:
            DataError: If the bag is damaged there.
        """
        ranks: dict[str, MessagePosition] = {}
        for name, time, raw, kind in self._raw(topics):
            before = ranks.get(name)
            place = ranks[name] = MessagePosition(
                time, before.rank + 1 if before is not None and before.time == time else 0
            )
            with self._one_line(f"{name} at {seconds(time)}"):
                message = self._deserialize(raw, kind)
            yield name, place, message

    def first(self, topic: str) -> Any:
        """Return the first message of a topic, or None without messages. Raises DataError."""
        return next((message for _, _, message in self.messages([topic])), None)

    def message(self, topic: str, place: MessagePosition) -> Any:
        """Return one message of a topic.

        Raises:
            DataError: If it is damaged.
        """
        with self._lock, self._one_line(f"{topic} at {seconds(place.time)}"):
            messages = self._messages([topic], start=place.time, stop=place.time + 1)
            connection, _, raw = next(itertools.islice(messages, place.rank, None), (None, 0, b""))
            if connection is None:
                raise DataError(
                    f"{self.path}: {topic} has no message at {seconds(place.time)} any more; it has changed"
                )
        with self._one_line(f"{topic} at {seconds(place.time)}"):
            return self._deserialize(raw, SAME_TYPE.get(connection.msgtype, connection.msgtype))

    def _raw(self, topics: Sequence[str]) -> Iterator[tuple[str, int, bytes, str]]:
        with self._lock, self._one_line():
            messages = self._messages(topics)
        while True:
            with self._lock, self._one_line():
                item = next(messages, None)
            if item is None:
                return
            connection, time, raw = item
            yield connection.topic, time, raw, SAME_TYPE.get(connection.msgtype, connection.msgtype)

    def _messages(self, topics: Sequence[str], **times: int) -> Iterator[tuple[Any, int, bytes]]:
        """Return connection, time and bytes of the messages of topics, in order of bag time over all parts."""
        connections = [pair for name in topics for pair in self._connections.get(name, ())]
        streams = []
        for reader in self._readers:
            of_reader = [connection for owner, connection in connections if owner is reader]
            streams += [reader.messages(of_reader, **times)] if of_reader else []
        return heapq.merge(*streams, key=lambda item: item[1]) if len(streams) > 1 else iter(*streams or [()])

    @contextmanager
    def _one_line(self, what: str = "", path: Path | None = None) -> Iterator[None]:
        """Turn what rosbags raises for a damaged bag into DataError."""
        try:
            yield
        except DataError:
            raise
        except Exception as error:
            where = f"{path or self.path}{f', {what}' if what else ''}"
            why = QUOTED.sub(r"\1", summarize_error(error)).rstrip(".")
            if isinstance(error, MemoryError):
                why = "a length in it is damaged, or the memory does not suffice for a chunk"
            endings = _endings(self.path) if self.path.is_dir() else {self.path.suffix.lower()}
            suffix = next((end for end in SUFFIXES if end in endings), ".db3")
            raise DataError(f"{where}: not a whole bag ({why}); {REPAIR[suffix]}") from error


def seconds(time: int) -> str:
    """Return nanoseconds as seconds with all nine digits.

    >>> seconds(1305031102175304000)
    '1305031102.175304000'
    """
    return f"{time // NANOSECONDS}.{time % NANOSECONDS:09d}"


def stamp_of(message: Any) -> int:
    """Return the nanoseconds of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
