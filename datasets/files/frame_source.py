"""Where one frame of a sequence of files comes from: what a reader lists."""

from __future__ import annotations

import functools
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.files.options import inside_text
from semstab.datasets.geometry.cameras import Camera, Poses
from semstab.datasets.geometry.lenses import Lens


@dataclass(frozen=True, eq=False)
class FrameSource:
    """Where one frame comes from.

    name          what path templates call it
    depth         the file
    pose_file     the file that holds its pose, or all poses
    camera        of the depth image
    pose          (4, 4) in the dataset's convention, where it is not in a file of its own
    label_camera  of the images that label maps belong to, where that is another one
    label_lens    the same where they are distorted photographs
    color_lens    of the colour image, where that is distorted
    photograph    the distorted photograph, where label maps belong to it
    aliases       other names that its label maps may have
    color         the file that it has, or would have; None where that is not known
    depth_scale   units in a metre, where the dataset's own files say so
    timestamp     seconds
    """

    name: str
    depth: Path
    pose_file: Path
    camera: Camera
    pose: Poses | None = None
    label_camera: Camera | None = None
    label_lens: Lens | None = None
    color_lens: Lens | None = None
    photograph: Path | None = None
    aliases: tuple[str, ...] = ()
    color: Path | None = None
    depth_scale: float | None = None
    timestamp: float | None = None

    @property
    def called(self) -> tuple[str, ...]:
        """The names that its label maps may have, its own first."""
        return self.name, *self.aliases


# The frames of a sequence as text and numbers: as objects, each would take two kilobytes.

AT_HAND = 64
"""Sources that are kept as they were made last: a frame is asked for several times while it is read."""

POSE = 16


@dataclass(frozen=True)
class Around:
    """What frames alike have before and after the part of a path that is a frame's own.

    named  whether that part is the frame's name; None: there is none
    """

    before: str
    after: str = ""
    named: bool | None = True


@dataclass(frozen=True)
class Shared:
    """What frames have in common: see `FrameSource`. posed: whether a pose came with them; timed: a time stamp."""

    depth: Around
    pose_file: Around
    color: Around | None
    photograph: Around | None
    aliases: tuple[Around, ...]
    camera: Camera
    label_camera: Camera | None
    label_lens: Lens | None
    color_lens: Lens | None
    depth_scale: float | None
    posed: bool
    timed: bool


class FrameTable(Sequence[FrameSource]):
    """The sources of frames, made again when they are asked for.

    Raises DataError, with the file of its pose, for a name that cannot be part of a path.
    """

    def __init__(self, frames: Iterable[FrameSource], folder: Path) -> None:
        self._text = bytearray()
        self._ends, self._kinds = array("q", [0]), array("i")
        self._times, self._poses = array("d"), array("d")
        kinds: dict[Shared, int] = {}
        for frame in frames:
            inside_text(folder, frame.name, str(frame.pose_file))  # files of predictions are called so
            shared, own = _apart(frame)
            self._text += "\0".join((frame.name, *own)).encode("utf-8", "surrogatepass")
            self._ends.append(len(self._text))
            self._kinds.append(kinds.setdefault(shared, len(kinds)))
            if frame.pose is not None:
                self._poses.extend([np.nan] * (POSE * len(self) - POSE - len(self._poses)))
                self._poses.extend(np.asarray(frame.pose, dtype=np.float64).ravel())
            if frame.timestamp is not None:
                self._times.extend([np.nan] * (len(self) - 1 - len(self._times)))
                self._times.append(frame.timestamp)
        self._shared = tuple(kinds)
        self._source = functools.lru_cache(maxsize=AT_HAND)(self._made)

    def __len__(self) -> int:
        return len(self._kinds)

    @overload
    def __getitem__(self, at: int) -> FrameSource: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[FrameSource]: ...
    def __getitem__(self, at: int | slice) -> FrameSource | Sequence[FrameSource]:
        """The source of a frame, or of some."""
        some = range(len(self))[at]
        return self._source(some) if isinstance(some, int) else [self._source(k) for k in some]

    @property
    def names(self) -> Iterator[str]:
        """What path templates call each frame."""
        return (self._words(k)[0] for k in range(len(self)))

    @property
    def times(self) -> Float64 | None:
        """(len,) seconds of each frame; None where one has none."""
        return np.array(self._times) if all(shared.timed for shared in self._shared) else None

    @property
    def distorted(self) -> bool:
        """Whether label maps of some frames are those of distorted photographs."""
        return any(shared.label_lens is not None for shared in self._shared)

    def _words(self, k: int) -> list[str]:
        return self._text[self._ends[k] : self._ends[k + 1]].decode("utf-8", "surrogatepass").split("\0")

    def _made(self, k: int) -> FrameSource:
        shared = self._shared[self._kinds[k]]
        name, *own = self._words(k)
        rest = iter(own)

        def text(around: Around) -> str:
            part = "" if around.named is None else name if around.named else next(rest)
            return f"{around.before}{part}{around.after}"

        return FrameSource(  # its texts in the order in which `_apart` takes them
            name,
            depth=Path(text(shared.depth)),
            pose_file=Path(text(shared.pose_file)),
            color=None if shared.color is None else Path(text(shared.color)),
            photograph=None if shared.photograph is None else Path(text(shared.photograph)),
            aliases=tuple(map(text, shared.aliases)),
            camera=shared.camera,
            pose=self._pose(k) if shared.posed else None,
            label_camera=shared.label_camera,
            label_lens=shared.label_lens,
            color_lens=shared.color_lens,
            depth_scale=shared.depth_scale,
            timestamp=self._times[k] if shared.timed else None,
        )

    def _pose(self, k: int) -> Poses:
        return np.array(self._poses[POSE * k : POSE * (k + 1)]).reshape(4, 4)


def _apart(frame: FrameSource) -> tuple[Shared, list[str]]:
    """What a frame shares with others, and the parts of its paths that are its own, but for its name."""
    own: list[str] = []

    def around(text: str, stem: tuple[int, int]) -> Around:
        before, found, after = text.rpartition(frame.name) if frame.name else (text, "", "")
        if found:
            return Around(before, after)
        first, last = stem
        own.append(text[first:last])
        return Around(text[:first], text[last:], named=False)

    def of(path: Path) -> Around:
        text = str(path)
        return around(text, (len(text) - len(path.name), len(text) - len(path.suffix)))

    posed = frame.pose is not None
    shared = Shared(
        depth=of(frame.depth),
        pose_file=Around(str(frame.pose_file), named=None) if posed else of(frame.pose_file),
        color=None if frame.color is None else of(frame.color),
        photograph=None if frame.photograph is None else of(frame.photograph),
        aliases=tuple(around(alias, (0, len(alias))) for alias in frame.aliases),
        camera=frame.camera,
        label_camera=frame.label_camera,
        label_lens=frame.label_lens,
        color_lens=frame.color_lens,
        depth_scale=frame.depth_scale,
        posed=posed,
        timed=frame.timestamp is not None,
    )
    return shared, own
