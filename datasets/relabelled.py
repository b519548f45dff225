"""A scene that gives other labels to the frames of another scene."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from semstab.core.types import Float32, Float64, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.datasets.scene import Filtering, Scene


class RelabelledScene(Scene):
    """A scene whose labels differ from the labels of another scene, and whose other parts are that scene's.

    A subclass overrides what it changes.
    """

    def __init__(self, inner: Scene) -> None:
        for name in Scene.__annotations__:
            setattr(self, name, getattr(inner, name))
        self._inner = inner

    def __len__(self) -> int:
        return len(self._inner)

    def label_space(self, model: str) -> LabelSpace:
        """Return the classes of a label source of the inner scene."""
        return self._inner.label_space(model)

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return a frame of the inner scene."""
        return self._inner.frame(index, model, color=color)

    def digest(self, indices: list[int], model: str) -> str:
        """Return the inner scene's hash of the content behind those frames."""
        return self._inner.digest(indices, model)

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return short hashes of the frame's depth, pose and camera."""
        return self._inner.fingerprints(index)

    def distances(self, model: str) -> Float64 | None:
        """Return distances (K, K) between the classes of a model."""
        return self._inner.distances(model)

    @property
    def timestamps(self) -> Float64 | None:
        """Time stamps of the inner scene, if any."""
        return self._inner.timestamps

    def require_one_size(self, indices: Sequence[int]) -> None:
        """Raise DataError if depth images of these frames are of a size that the intrinsics are not for."""
        self._inner.require_one_size(indices)

    def tracked(self, index: int) -> bool:
        """Return whether the frame has a pose."""
        return self._inner.tracked(index)

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame."""
        return self._inner.missing(index, sources, color=color)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which the inner scene's files are read, by name of option."""
        return self._inner.settings

    @property
    def depth_scale(self) -> float | None:
        """Units of stored depth in a metre."""
        return self._inner.depth_scale

    def frame_name(self, index: int) -> str:
        """Return the name of a frame for people."""
        return self._inner.frame_name(index)

    def filtering(self, model: str) -> Filtering:
        """Return the filters of a label source."""
        return self._inner.filtering(model)

    def prediction_seconds(self, index: int, model: str) -> float:
        """Return the seconds of a model's prediction on a frame, or NaN if its labels are read from files."""
        return self._inner.prediction_seconds(index, model)

    def reading(self, indices: Sequence[int], model: str) -> contextlib.AbstractContextManager[None]:
        """Return a block in which these frames are going to be read."""
        return self._inner.reading(indices, model)

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels."""
        return self._inner.geometry(index, color=color)

    def depth(self, index: int) -> Float32:
        """Return depth (H, W) float32 in metres along the optical axis."""
        return self._inner.depth(index)

    def T_wc(self, index: int) -> Float64:
        """Return pose (4, 4) camera-to-world in metres."""
        return self._inner.T_wc(index)

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Return the intrinsics of the frame's depth image, of shape (H, W); pixels."""
        return self._inner.intrinsics(index, shape)

    def color(self, index: int) -> UInt8 | None:
        """Return the colour (H, W, 3) uint8 RGB, or None for a frame without colour."""
        return self._inner.color(index)

    def image(self, index: int) -> UInt8:
        """Return the image (H, W, 3) uint8 RGB that models predict on."""
        return self._inner.image(index)

    def image_name(self, index: int) -> str:
        """Return the name of the frame's files, without suffix."""
        return self._inner.image_name(index)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with labels (H, W) or scores (H, W, K) that were predicted on its image."""
        return self._inner.predicted(index, labels=labels, scores=scores)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return depth and pose at the pixels of the colour image, of shape (H, W)."""
        return self._inner.view(index, shape)
