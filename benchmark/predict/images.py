"""What a model predicts on, whatever it is: colour images in order."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from semstab.datasets.views.resampling import Labels, Scores
from semstab.model.frames import Frame

Image = npt.NDArray[np.uint8]


class ImageSequence(Protocol):
    """Colour images in order, such as every `semstab.datasets.Scene`. `image` may be called from several threads."""

    name: str
    labels_like_depth: bool

    def __len__(self) -> int:
        """Number of images."""
        ...

    def image(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB. Raises DataError that names the file, or says that there is no colour."""
        ...

    def image_name(self, index: int) -> str:
        """What the files of its prediction are called, without suffix."""
        ...

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Files that the frame lacks, its image among them where colour is asked for."""
        ...

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame | None:
        """The frame with what was predicted on its image, at the depth's pixels; None where there is no depth."""
        ...


def first_images(sequence: ImageSequence, count: int) -> list[Image]:
    """The first images of a sequence that are there, to which a model is fitted whatever frames are selected."""
    there = (index for index in range(len(sequence)) if not sequence.missing(index, color=True))
    return [sequence.image(index) for index in itertools.islice(there, count)]
