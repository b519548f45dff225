"""The result of videos without depth and poses: flicker by model and scene, and frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy.typing as npt

from semstab.core.types import Mask, UInt8
from semstab.data.records import ImageSpace, VideoMeasures
from semstab.data.results import slug
from semstab.data.statistics import OutlyingFrames


@dataclass(frozen=True)
class VideoRow:
    """The numbers of a frame; NaN where one is not defined.

    Attributes:
        frame: Its index.
        timestamp: Seconds.
        flicker_percent: Share of the pixels whose label is another one than in the frame before.
        compensated_flicker_percent: The same with the motion between the images removed.
        compensated_share: co-visible share: pixels that the frame before shows, of the labelled ones, 0 to 1.
        lone_percent: Share of the pixels seen before and after at which the frame alone has another label.
        outlying: Whether the frame stands out.
        name: The frame's name.
    """

    frame: int
    timestamp: float
    flicker_percent: float
    compensated_flicker_percent: float
    compensated_share: float
    lone_percent: float
    outlying: bool
    name: str


@dataclass(frozen=True, eq=False)
class LonePicture:
    """A frame as a small picture, with the pixels at which it stands alone.

    Attributes:
        frame: Its index.
        labels: (h, w) rows 0..K-1, and above where a pixel has none.
        alone: (h, w) pixels whose label differs from that of each other frame, which all see the same surface point.
        color: (h, w, 3) its image; None where there is none.
    """

    __pydantic_config__: ClassVar = {"arbitrary_types_allowed": True}  # JSON of a record holds no pictures

    frame: int
    labels: npt.NDArray[Any]
    alone: Mask
    color: UInt8 | None


@dataclass(frozen=True)
class VideoRecord:
    """A model on a video.

    Attributes:
        scene, model: Their names.
        frames: Number of frames; `size` is (width, height) of an image, `classes` the names of the classes.
        image_space: Flicker, and video consistency.
        video_measures: VC and TC as published, where they were asked for.
        outlying: Frames that stand alone more often than the others do.
        largest_class, largest_share: The class of most labelled pixels, and its share of them, 0 to 1.
        effective_classes: 1 / sum of the squares of the classes' shares: 1 where all pixels are of one class.
        input: Digest of the images and labels.
        rows: The numbers of each frame.
        pictures: Those that stand out most, as pictures.
        colors: (K, 3) of the classes.
    """

    scene: str
    model: str
    frames: int
    size: tuple[int, int]
    classes: tuple[str, ...]
    image_space: ImageSpace
    outlying: OutlyingFrames
    video_measures: VideoMeasures | None
    largest_class: str
    largest_share: float
    effective_classes: float
    input: str
    rows: tuple[VideoRow, ...] = field(repr=False, default=())
    pictures: tuple[LonePicture, ...] = field(repr=False, default=())
    colors: tuple[tuple[int, int, int], ...] = field(repr=False, default=())

    @property
    def slug(self) -> str:
        """Its scene and model as the name of a file."""
        return slug(self.scene, self.model)


@dataclass(frozen=True)
class VideoResult:
    """The models on all videos of a run.

    Attributes:
        records: One of each model on each video.
        manifest: Where the numbers come from.
    """

    records: tuple[VideoRecord, ...]
    manifest: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of the videos."""
        return tuple(dict.fromkeys(record.scene for record in self.records))

    @property
    def models(self) -> tuple[str, ...]:
        """The names of the models."""
        return tuple(dict.fromkeys(record.model for record in self.records))

    def of(self, model: str) -> list[VideoRecord]:
        """Return the records of a model."""
        return [record for record in self.records if record.model == model]
