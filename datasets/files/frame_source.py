"""Where one frame of a sequence of files comes from: what a reader lists."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

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


FIELDS = tuple(field.name for field in dataclasses.fields(FrameSource))
PATHS = tuple(FIELDS.index(name) for name in ("depth", "pose_file", "color", "photograph"))


class FrameTable(Sequence[FrameSource]):
    """The sources of a sequence's frames: tuples with paths as text, a third of the memory of the objects.

    Raises DataError, with the file of its pose, for a name that cannot be part of a path.
    """

    def __init__(self, frames: Iterable[FrameSource], folder: Path) -> None:
        self._rows: list[tuple[Any, ...]] = []
        for frame in frames:
            inside_text(folder, frame.name, str(frame.pose_file))  # files of predictions are called so
            values = [getattr(frame, field) for field in FIELDS]
            self._rows.append(tuple(str(value) if isinstance(value, Path) else value for value in values))
        self._source = functools.lru_cache(maxsize=64)(
            self._made
        )  # a frame is asked for several times while it is read

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, at: int) -> FrameSource: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[FrameSource]: ...
    def __getitem__(self, at: int | slice) -> FrameSource | Sequence[FrameSource]:
        """The source of a frame, or those of some."""
        some = range(len(self))[at]
        return self._source(some) if isinstance(some, int) else [self._source(k) for k in some]

    @property
    def names(self) -> list[str]:
        """The names of all frames, as path templates have them."""
        return [row[0] for row in self._rows]

    @property
    def times(self) -> Float64 | None:
        """(len,) seconds of each frame; None where one has none."""
        times = [row[FIELDS.index("timestamp")] for row in self._rows]
        return None if None in times else np.array(times, dtype=np.float64)

    @property
    def distorted(self) -> bool:
        """Whether label maps of some frames are those of distorted photographs."""
        return any(row[FIELDS.index("label_lens")] is not None for row in self._rows)

    def _made(self, k: int) -> FrameSource:
        row = list(self._rows[k])
        for at in PATHS:
            row[at] = None if row[at] is None else Path(row[at])
        return FrameSource(*row)
