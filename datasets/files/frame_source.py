"""Where one frame of a sequence of files comes from: what a reader lists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from semstab.datasets.views.cameras import Camera
from semstab.datasets.views.lenses import Lens
from semstab.datasets.views.poses import Poses


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
