"""Images that a model predicts on, wherever they are from, in order."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from semstab.data.frames import Frame
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.errors import ConfigError
from semstab.models import Image, Model, image_digest


class ImageSequence(Protocol):
    """Colour images in order, such as every `semstab.datasets.Scene`. `image` may be called from several threads."""

    name: str
    labels_like_depth: bool

    def __len__(self) -> int:
        """Return the number of images."""
        ...

    def image(self, index: int) -> Image:
        """Return (H, W, 3) uint8 RGB.

        Raises:
            DataError: If that fails; the message names the file, or says that there is no colour.
        """
        ...

    def image_name(self, index: int) -> str:
        """Return the name of the files of its prediction, without suffix."""
        ...

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame, its image among them where colour is asked for."""
        ...

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame | None:
        """Return the frame with the predictions on its image, at the depth's pixels.

        The result is None without depth.
        """
        ...

    def view(self, index: int, shape: tuple[int, int]) -> Frame | None:
        """Return depth and pose of the frame at the pixels of its image, of shape (H, W).

        The result is None without depth.
        """
        ...


@dataclass(frozen=True, eq=False)
class Picture:
    """An image of a sequence as a model is shown it.

    Attributes:
        geometry: Geometry for models that want it, at the image's pixels.
        digest: Hash of all that is shown.
    """

    index: int
    name: str
    pixels: Image
    geometry: tuple[Frame, ...]
    digest: str

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps in memory."""
        return self.pixels.nbytes + sum(frame.nbytes for frame in self.geometry)


def picture(sequence: ImageSequence, index: int, model: Model) -> Picture:
    """Return the image of an index as the model is shown it.

    Raises:
        DataError: If that fails; the message names the file, and as `geometry_of`.
    """
    pixels = sequence.image(index)
    geometry = geometry_of(sequence, index, pixels, model)
    return Picture(index, sequence.image_name(index), pixels, geometry, shown_digest(pixels, geometry))


def shown_digest(pixels: Image, geometry: Sequence[Frame]) -> str:
    """Return a hash of an image and of the geometry that is shown with it."""
    digest = image_digest(pixels)
    for frame in geometry:
        hasher = hashlib.blake2b(repr((digest, frame.intrinsics)).encode(), digest_size=16)
        labels = frame.labels if frame.scores is None else frame.scores
        for array in (frame.depth, frame.T_wc, labels):
            hasher.update(np.ascontiguousarray(array).data)
        digest = hasher.hexdigest()
    return digest


def geometry_of(sequence: ImageSequence, index: int, pixels: Image, model: Model) -> tuple[Frame, ...]:
    """Return the frame's depth and pose at the image's pixels for a model that wants it; else nothing.

    Raises:
        ConfigError: If there is none.
    """
    if not model.wants_geometry:
        return ()
    frame = sequence.view(index, (pixels.shape[0], pixels.shape[1]))
    if frame is None:
        raise ConfigError(
            f"{sequence.name}: the model looks at depth and pose, which single images do not have; use --data"
        )
    return (frame,)


def first_images(sequence: ImageSequence, count: int) -> list[Image]:
    """Return the first images of a sequence that are there, to which a model is fitted whatever frames are selected."""
    existing = (index for index in range(len(sequence)) if not sequence.missing(index, color=True))
    return [sequence.image(index) for index in itertools.islice(existing, count)]
