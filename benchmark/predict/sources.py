"""Image files to predict on, and which scenes of a dataset."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from semstab.backbones import Image
from semstab.datasets.formats.disk import natural
from semstab.datasets.formats.images import COLOR_SUFFIXES, read_color
from semstab.datasets.views.resampling import Labels, Scores
from semstab.errors import ConfigError, DataError
from semstab.model.frames import Frame


class ImageFiles:
    """Image files by a pattern such as 'flight/*.png', in natural order.

    Raises DataError where none fits, or two have one name.
    """

    labels_like_depth = False

    def __init__(self, pattern: str) -> None:
        found = [Path(path) for path in glob.glob(str(Path(pattern).expanduser()), recursive=True)]  # noqa: PTH207
        files = sorted((path for path in found if path.suffix.lower() in COLOR_SUFFIXES), key=lambda p: natural(str(p)))
        if not files:
            raise DataError(f"{pattern}: no image of {', '.join(COLOR_SUFFIXES)} fits; quote the pattern in the shell")
        stems = [path.stem for path in files]
        if repeated := [path for path in files if stems.count(path.stem) > 1]:
            raise DataError(f"{repeated[0]}: {repeated[1]} has the same name; predict them one folder after the other")
        self.name = files[0].parent.resolve().name
        self._files = files

    def __len__(self) -> int:
        """Number of files."""
        return len(self._files)

    def image(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB. Raises DataError that names the file."""
        return read_color(self._files[index])

    def image_name(self, index: int) -> str:
        """The file's name without suffix."""
        return self._files[index].stem

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Nothing: what is missing was not found."""
        return []

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame | None:
        """None: single images have no depth."""
        return None

    def view(self, index: int, shape: tuple[int, int]) -> Frame | None:
        """None: single images have no depth."""
        return None


def chosen(names: Sequence[str] | None, known: Sequence[str], where: str) -> Sequence[str]:
    """The named scenes, all where none are named. Raises ConfigError for one that is not there."""
    if lost := [name for name in names or () if name not in known]:
        raise ConfigError(f"{where}: no scene '{lost[0]}'; there is {', '.join(known)}")
    return list(dict.fromkeys(names)) if names is not None else known
