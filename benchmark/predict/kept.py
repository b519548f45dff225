"""What a model said, kept on disk: several filters over one model let it look at each image once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from semstab.backbones import Backbone, Image, Prediction, image_digest
from semstab.backbones.wrapped import Wrapped
from semstab.model.frames import Frame
from semstab.predict.images import shown_digest
from semstab.runtime.array_files import read_arrays, write_arrays
from semstab.runtime.files import content_key


class Kept(Wrapped):
    """A backbone that looks its predictions up in a folder, by its identity and the image, and leaves new ones there.

    It has no memory of images before (`sequential`). Files of one folder may be read and written by several processes.
    """

    def __init__(self, inner: Backbone, folder: Path) -> None:
        super().__init__(inner)
        self._folder = folder
        self._fitted_to: list[str] = []

    def fit(self, images: Sequence[Image]) -> Self:
        """See `Backbone`."""
        fitted = super().fit(images)
        fitted._fitted_to = [image_digest(image) for image in images]
        return fitted

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`."""
        frames = [[frame] for frame in geometry] or [[]] * len(images)
        return [self._one(image, scores, frame) for image, frame in zip(images, frames, strict=True)]

    def _one(self, image: Image, scores: bool, frame: Sequence[Frame]) -> Prediction:
        """Scores are kept wherever there are some: whoever asks later may want them."""
        file = self._folder / f"{self._key(image, frame)}.npz"
        there = read_arrays(file)
        if there is None:
            (prediction,) = self.ask([image], self.gives_scores, frame)
            held: dict[str, Any] = {"labels": prediction.labels}
            held |= {"scores": prediction.scores} if self.gives_scores else {}
            write_arrays(file, held, packed=False)
            return prediction if scores else Prediction(prediction.labels)
        return Prediction(there["labels"], there["scores"] if scores else None)

    def _key(self, image: Image, frame: Sequence[Frame]) -> str:
        seen = {"fitted": self._fitted_to, "shown": shown_digest(image, frame)}
        return content_key({"model": self.identity(), **seen})
