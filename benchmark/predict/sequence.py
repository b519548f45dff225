"""A model over a sequence: label maps, scores or regions on disk, resumable, with what they depend on beside them."""

from __future__ import annotations

import contextlib
import importlib.metadata
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semstab.backbones import Backbone, Prediction, image_digest
from semstab.datasets.views.same_view import fitted
from semstab.predict.folder import Kind, PredictionFolder, ScoreType
from semstab.predict.images import Image, ImageSequence, first_images
from semstab.predict.region_series import RegionSeries, region_series
from semstab.runtime.prefetch import prefetch

REPORTED_PACKAGES = ("numpy", "opencv-python-headless", "torch", "transformers", "onnxruntime")


@dataclass(frozen=True)
class SequenceOptions:
    """How a sequence is predicted.

    name        what the predictions are called
    scores      also keep soft scores, in `score_type`
    batch       images that the model sees at once
    threads     threads that decode images ahead
    overwrite   replace predictions of other settings
    command     what was typed, for the manifest
    """

    name: str
    scores: bool = False
    score_type: ScoreType = "float16"
    batch: int = 1
    threads: int | None = None
    overwrite: bool = False
    command: Sequence[str] = ()


@dataclass(frozen=True)
class SequenceReport:
    """What was done: where it is, how many frames, how fast.

    folders        that were written
    predicted      frames that the model saw; `kept` ones were there from before
    model_seconds  in the model; `seconds` in all, decoding and writing included
    regions        of a model without classes, what changed from frame to frame
    """

    sequence: str
    folders: tuple[Path, ...]
    predicted: int
    kept: int
    model_seconds: float
    seconds: float
    regions: RegionSeries | None = None

    @property
    def frames_per_second(self) -> float:
        """Of the predicted ones, all included; NaN where there were none."""
        return self.predicted / self.seconds if self.predicted else float("nan")


class PredictionObserver:
    """Watches a prediction; override what is of interest."""

    def sequence_started(self, name: str, frames: int) -> None:
        """A sequence of so many selected frames is begun."""

    def frame_done(self, kept: bool) -> None:
        """One frame further: predicted, or kept from before."""


@dataclass(frozen=True, eq=False)
class _Picture:
    index: int
    name: str
    pixels: Image
    digest: str


def predict_sequence(
    sequence: ImageSequence,
    backbone: Backbone,
    indices: Sequence[int],
    out: Path,
    options: SequenceOptions,
    observers: Sequence[PredictionObserver] = (),
) -> SequenceReport:
    """Predict the images of these indices into out/labels/NAME, and out/scores/NAME; regions into out/regions/NAME.

    A backbone that adapts to a sequence is fitted to the sequence's first images. Frames that an earlier start of the
    same finished are kept; an image whose content changed is predicted again.

    Raises ConfigError where the folder holds other predictions, DataError that names an image; what was finished stays.
    """
    for observer in observers:
        observer.sequence_started(sequence.name, len(indices))
    started = time.perf_counter()
    backbone = backbone.fit(first_images(sequence, backbone.fit_frames))
    work = _Work(sequence, backbone, out, options, observers)
    with contextlib.closing(work):
        for fetched in prefetch(work.picture, indices, threads=options.threads, size=lambda p: p.pixels.nbytes):
            work.take(fetched.item)
        work.flush()
    seconds = time.perf_counter() - started
    series = None
    if backbone.label_space is None:
        series = region_series(sequence, indices, work.folders[0].file)
        series.write(work.folders[0].path / "changes.csv")
    return work.report(seconds, series)


class _Work:
    """The sequence on its way: pictures that wait for a full batch, folders, and counts."""

    def __init__(
        self,
        sequence: ImageSequence,
        backbone: Backbone,
        out: Path,
        options: SequenceOptions,
        observers: Sequence[PredictionObserver],
    ) -> None:
        self.sequence, self.backbone, self.options, self.observers = sequence, backbone, options, observers
        self.folders = _folders(backbone, out, options)
        self._waiting: list[_Picture] = []
        self._predicted = self._kept = 0
        self._model_seconds = 0.0

    def picture(self, index: int) -> _Picture:
        """An image with its name and digest."""
        pixels = self.sequence.image(index)
        return _Picture(index, self.sequence.image_name(index), pixels, image_digest(pixels))

    def take(self, picture: _Picture) -> None:
        """Keep what is finished, predict the rest in batches of one size."""
        if all(folder.has(picture.name, picture.digest) for folder in self.folders):
            self._kept += 1
            self._tell(kept=True)
            return
        if self._waiting and self._waiting[0].pixels.shape != picture.pixels.shape:
            self.flush()
        self._waiting.append(picture)
        if len(self._waiting) >= self.options.batch:
            self.flush()

    def flush(self) -> None:
        """Predict what waits."""
        pictures, self._waiting = self._waiting, []
        if not pictures:
            return
        started = time.perf_counter()
        found = self.backbone.predict([picture.pixels for picture in pictures], scores=self.options.scores)
        seconds = time.perf_counter() - started
        self._model_seconds += seconds
        for picture, prediction in zip(pictures, found, strict=True):
            self._write(picture, prediction, seconds / len(pictures))
            self._predicted += 1
            self._tell(kept=False)

    def close(self) -> None:
        """Say in the manifests what is finished, also after an error or an interruption."""
        for folder in self.folders:
            folder.close()

    def report(self, seconds: float, series: RegionSeries | None) -> SequenceReport:
        """What was done."""
        paths = tuple(folder.path for folder in self.folders)
        return SequenceReport(
            self.sequence.name, paths, self._predicted, self._kept, self._model_seconds, seconds, series
        )

    def _write(self, picture: _Picture, prediction: Prediction, seconds: float) -> None:
        placed = _placed(self.sequence, picture, prediction)
        for folder in self.folders:
            values = placed.scores if folder.kind == "scores" else placed.labels
            assert values is not None
            folder.write(picture.name, picture.digest, values, seconds)

    def _tell(self, kept: bool) -> None:
        for observer in self.observers:
            observer.frame_done(kept)


def _placed(sequence: ImageSequence, picture: _Picture, prediction: Prediction) -> Prediction:
    """The prediction at the pixels that the scene's label files have."""
    frame = sequence.predicted(picture.index, labels=prediction.labels) if sequence.labels_like_depth else None
    if frame is None:
        return prediction
    assert frame.labels is not None
    scores = None if prediction.scores is None else fitted(prediction.scores, frame.shape, picture.name)
    return Prediction(frame.labels, scores)


def _folders(backbone: Backbone, out: Path, options: SequenceOptions) -> list[PredictionFolder]:
    space = backbone.label_space
    about = {"command": list(options.command), "packages": _versions(), "batch": options.batch}
    kinds: list[Kind] = ["regions"] if space is None else ["labels"]
    if options.scores:
        kinds.append("scores")
    return [
        PredictionFolder(
            out / kind / options.name,
            kind,
            backbone.identity(),
            about,
            space,
            score_type=options.score_type,
            overwrite=options.overwrite,
        )
        for kind in kinds
    ]


def _versions() -> dict[str, str | None]:
    """Of the packages that compute; None for those that are not installed."""
    versions: dict[str, Any] = {"semstab": importlib.metadata.version("semstab")}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return versions
