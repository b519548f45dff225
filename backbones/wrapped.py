"""A backbone around another one: what filters, taxonomies and votes are made of."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

from semstab.backbones import Backbone, Image, Prediction, ask
from semstab.model.frames import Frame


class Wrapped(Backbone):
    """Another backbone, with something done to what it says; all that is not overridden is the inner one's.

    Where it leaves scores as they are, it may set `streams` to the inner one's. What a sequence leaves behind belongs
    into attributes that `reset` makes anew: copies for other sequences (`fit`) share them until then.
    """

    def __init__(self, inner: Backbone) -> None:
        self.inner = inner
        self.label_space = inner.label_space
        self.gives_scores = inner.gives_scores
        self.fit_frames = inner.fit_frames
        self.sequential = inner.sequential
        self.wants_geometry = inner.wants_geometry

    def fit(self, images: Sequence[Image]) -> Self:
        """A copy around the inner backbone adapted to the sequence."""
        fitted = copy.copy(self)
        fitted.inner = self.inner.fit(images)
        return fitted

    def reset(self) -> None:
        """Forget all images."""
        if self.inner.sequential:
            self.inner.reset()

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`."""
        return self.ask(images, scores, geometry)

    def ask(self, images: Sequence[Image], scores: bool, geometry: Sequence[Frame]) -> list[Prediction]:
        """What the inner backbone says; it is told the geometry where it wants it."""
        inner = geometry if self.inner.wants_geometry else ()
        return ask(self.inner, images, scores=scores, geometry=inner)

    def identity(self) -> dict[str, Any]:
        """That of the inner backbone."""
        return self.inner.identity()
