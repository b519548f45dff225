"""A model over a sequence: label maps, scores or regions on disk, resumable, with a manifest of what they depend on."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

from semstab.core.files import content_key, csv_text, write_text
from semstab.core.prefetch import prefetch
from semstab.core.versions import version_of
from semstab.datasets.formats.images import read_labels
from semstab.metrics import RegionChange, macro_mean, matched_region_flicker
from semstab.metrics.flicker import compensated_regions
from semstab.models import Model, Streamed, ask, streamed
from semstab.predict.folder import Kind, PredictionFolder, ScoreType, largest_only, resized
from semstab.predict.images import ImageSequence, Picture, first_images, picture

# The series of a sequence: how much regions without classes change from frame to frame.

COLUMNS = ("previous", "frame", *(field.name for field in fields(RegionChange)))


@dataclass(frozen=True)
class RegionSeries:
    """One change a pair of successive frames: at the same pixel coordinates, and without camera motion.

    Attributes:
        frames: Names, one more than there are changes.
        plain: Previous and current map as they are.
        compensated: The previous map warped by depth and pose; empty where these are not known.
    """

    frames: tuple[str, ...]
    plain: tuple[RegionChange, ...]
    compensated: tuple[RegionChange, ...]

    @property
    def flicker_percent(self) -> float:
        """Mean over the pairs; NaN without pairs."""
        return macro_mean([change.flicker_percent for change in self.plain])

    @property
    def compensated_flicker_percent(self) -> float:
        """Mean over the pairs without camera motion; NaN if the motion is unknown."""
        return macro_mean([change.flicker_percent for change in self.compensated])

    def write(self, path: Path) -> None:
        """Write one row a pair and kind, as CSV; an undefined number is an empty field."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("kind", *COLUMNS))
        for kind, changes in (("plain", self.plain), ("compensated", self.compensated)):
            for (before, now), change in zip(itertools.pairwise(self.frames), changes, strict=False):
                cells = ["" if value != value else value for value in asdict(change).values()]  # noqa: PLR0124  NaN
                writer.writerow((kind, csv_text(before), csv_text(now), *cells))
        write_text(path, text.getvalue())


def region_series(sequence: ImageSequence, indices: Sequence[int], file: Callable[[str], Path]) -> RegionSeries:
    """Compare the region maps of successive frames, which `file` finds by a frame's name."""
    names = tuple(sequence.image_name(index) for index in indices)
    plain, compensated = [], []
    for (a, b), (before, now) in zip(itertools.pairwise(indices), itertools.pairwise(names), strict=True):
        previous, current = read_labels(file(before)), read_labels(file(now))
        if previous.shape != current.shape:
            continue
        plain.append(matched_region_flicker(previous, current))
        source, target = sequence.predicted(a, labels=previous), sequence.predicted(b, labels=current)
        if source is not None and target is not None:
            compensated.append(compensated_regions(source, target)[0])
    return RegionSeries(names, tuple(plain), tuple(compensated))


REPORTED_PACKAGES = ("numpy", "opencv-python-headless", "torch", "transformers", "onnxruntime")


SCORE_BYTES = 1 << 28
"""Memory for the scores of an image; more are taken class by class, where a model gives them so."""


@dataclass(frozen=True)
class SequenceOptions:
    """The settings of a prediction of a sequence.

    Attributes:
        name: Name of the predictions.
        scores: Whether to keep soft scores, too, in `score_type`; None: as the model gives them.
        top_k: Number of the largest scores that a pixel keeps; None for all.
        batch: Images that the model sees at once.
        threads: Threads that decode images ahead.
        overwrite: Replace predictions of other settings.
        command: The command line, for the manifest.
        at_image: Maps have the pixels of their images, also where label maps of the scene have those of the depth.
        fit: Adapt the model to the sequence's first images; False where that is done.
        wait: Wait for another process that writes into the same folders; False is an error then.
    """

    name: str
    scores: bool = False
    score_type: ScoreType | None = "float16"
    top_k: int | None = None
    batch: int = 1
    threads: int | None = None
    overwrite: bool = False
    command: Sequence[str] = ()
    at_image: bool = False
    fit: bool = True
    wait: bool = False


@dataclass(frozen=True)
class SequenceReport:
    """The outcome of a prediction: its folders, frames and speed.

    Attributes:
        folders: Folders that were written.
        predicted: Frames that the model saw; `reused` ones are those of an earlier start.
        model_seconds: Seconds in the model; `seconds` are those in all, decoding and writing included.
        regions: For a model without classes, the change from frame to frame.
    """

    sequence: str
    folders: tuple[Path, ...]
    predicted: int
    reused: int
    model_seconds: float
    seconds: float
    regions: RegionSeries | None = None

    @property
    def frames_per_second(self) -> float:
        """Speed of the predicted frames, all included; NaN without predicted frames."""
        return self.predicted / self.seconds if self.predicted else float("nan")


class PredictionObserver:
    """An observer of a prediction; override what is of interest."""

    def sequence_started(self, name: str, frames: int) -> None:
        """Take note that a sequence of `frames` selected frames is begun."""

    def frame_done(self, picture: Picture, seconds: float) -> None:
        """Take note of one more frame, and the model's seconds, NaN for a frame of an earlier start."""


def predict_sequence(
    sequence: ImageSequence,
    model: Model,
    indices: Sequence[int],
    out: Path,
    options: SequenceOptions,
    observers: Sequence[PredictionObserver] = (),
) -> SequenceReport:
    """Predict the images of these indices into out/labels/NAME, and out/scores/NAME; regions into out/regions/NAME.

    Features of a model that gives some go into out/features/NAME.

    A model that adapts to a sequence is fitted to the sequence's first images. Frames that an earlier start of the
    same finished are reused; an image whose content changed is predicted again. If a frame is missing, a sequential
    model is shown all of them again from the first one.

    Raises:
        ConfigError: If the folder holds other predictions.
        DataError: If that fails; the message names an image; what was finished stays.
    """
    for observer in observers:
        observer.sequence_started(sequence.name, len(indices))
    started = time.perf_counter()
    if options.fit:
        model = model.fit(first_images(sequence, model.fit_frames))
    work = _Work(sequence, model, indices, out, options, observers)
    with contextlib.closing(work):
        anew = model.sequential and not all(work.is_stored(picture) for picture in work.pictures())
        for picture in work.pictures():
            work.take(picture, anew)
        work.flush()
    seconds = time.perf_counter() - started
    series = None
    if model.label_space is None:
        series = region_series(sequence, indices, work.folders[0].file)
        series.write(work.folders[0].path / "changes.csv")
    return work.report(seconds, series)


class _Work:
    """The sequence on its way: pictures that wait for a full batch, folders, and counts."""

    def __init__(
        self,
        sequence: ImageSequence,
        model: Model,
        indices: Sequence[int],
        out: Path,
        options: SequenceOptions,
        observers: Sequence[PredictionObserver],
    ) -> None:
        self.sequence, self.model, self.options, self.observers = sequence, model, options, observers
        self.indices = indices
        self.folders = _folders(sequence, model, indices, out, options)
        self._waiting: list[Picture] = []
        self._predicted = self._reused = 0
        self._model_seconds = 0.0

    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures that the model is shown, in order.

        The prediction of a sequential model depends on all images that it was shown before.
        """
        if self.model.sequential:
            self.model.reset()
        so_far = ""
        read = partial(picture, self.sequence, model=self.model)
        with contextlib.closing(
            prefetch(read, self.indices, threads=self.options.threads, size=lambda item: item.nbytes)
        ) as ahead:
            for fetched in ahead:
                item = fetched.item
                if self.model.sequential:
                    so_far = content_key({"after": so_far, "shown": item.digest})
                    item = dataclasses.replace(item, digest=so_far)
                yield item

    def is_stored(self, picture: Picture) -> bool:
        """Return whether an earlier start finished it."""
        return all(folder.has(picture.name, picture.digest) for folder in self.folders)

    def take(self, picture: Picture, anew: bool) -> None:
        """Skip a finished picture, unless `anew`; collect other pictures, and predict in batches of one size."""
        if not anew and self.is_stored(picture):
            self._reused += 1
            self._tell(picture, math.nan)
            return
        if self._waiting and self._waiting[0].pixels.shape != picture.pixels.shape:
            self.flush()
        self._waiting.append(picture)
        if len(self._waiting) >= self.options.batch:
            self.flush()

    def flush(self) -> None:
        """Predict on the pictures that wait."""
        pictures, self._waiting = self._waiting, []
        if not pictures:
            return
        started = time.perf_counter()
        geometry = [frame for picture in pictures for frame in picture.geometry]
        images = [picture.pixels for picture in pictures]
        if self._too_large(pictures[0]):
            predictions = [self.model.stream(image) for image in images]
        else:
            predictions = [
                streamed(prediction)
                for prediction in ask(self.model, images, scores=self.options.scores, geometry=geometry)
            ]
        seconds = time.perf_counter() - started
        self._model_seconds += seconds
        for predicted_picture, prediction in zip(pictures, predictions, strict=True):
            self._write(predicted_picture, prediction, seconds / len(pictures))
            self._predicted += 1
            self._tell(predicted_picture, seconds / len(pictures))

    def close(self) -> None:
        """Write the manifests of what is finished, also after an error or an interruption."""
        for folder in self.folders:
            folder.close()

    def report(self, seconds: float, series: RegionSeries | None) -> SequenceReport:
        """Return the report.

        Raises:
            DataError: If a map that was written is gone.
        """
        for folder in self.folders:
            folder.require_whole()
        paths = tuple(folder.path for folder in self.folders)
        return SequenceReport(
            self.sequence.name, paths, self._predicted, self._reused, self._model_seconds, seconds, series
        )

    def _too_large(self, picture: Picture) -> bool:
        """Return whether all scores of an image take too much memory, and the model can give them one by one."""
        size = 4 * picture.pixels.shape[0] * picture.pixels.shape[1] * len(self.model.label_space or ())
        return self.options.scores and self.model.streams and size > SCORE_BYTES

    def _write(self, picture: Picture, prediction: Streamed, seconds: float) -> None:
        """Write a prediction at the pixels that the scene's label files have."""
        at_depth = self.sequence.labels_like_depth and not self.options.at_image
        frame = self.sequence.predicted(picture.index, labels=prediction.labels) if at_depth else None
        for folder in self.folders:
            if folder.kind == "features":
                assert prediction.features is not None
                folder.write_features(picture.name, picture.digest, prediction.features, seconds)
                continue
            if folder.kind != "scores":
                labels = prediction.labels if frame is None else frame.predicted
                folder.write(picture.name, picture.digest, labels, seconds)
                continue
            maps = prediction.maps if frame is None else resized(prediction.maps, frame.shape, picture.name)
            maps = maps if self.options.top_k is None else largest_only(maps, self.options.top_k)
            folder.write_scores(picture.name, picture.digest, maps(), seconds)

    def _tell(self, predicted_picture: Picture, seconds: float) -> None:
        for observer in self.observers:
            observer.frame_done(predicted_picture, seconds)


def _folders(
    sequence: ImageSequence, model: Model, indices: Sequence[int], out: Path, options: SequenceOptions
) -> list[PredictionFolder]:
    space, settings = model.label_space, model.identity()
    if model.sequential:
        settings = {**settings, "frames": _selection([sequence.image_name(index) for index in indices])}
    about = {"command": list(options.command), "packages": _versions(), "batch": options.batch}
    kinds: list[Kind] = ["regions"] if space is None else ["labels"]
    if options.scores:
        kinds.append("scores")
    if model.gives_features:
        kinds.append("features")
    return [
        PredictionFolder(
            out / kind / options.name,
            kind,
            settings,
            about,
            space,
            score_type=options.score_type,
            top_k=options.top_k,
            overwrite=options.overwrite,
            wait=options.wait,
        )
        for kind in kinds
    ]


def _selection(names: Sequence[str]) -> str:
    """Return which frames a sequential model saw, in a few words that are equal where all of them are."""
    digest = content_key({"names": list(names)})[:8]
    return f"{len(names)} from {names[0]} to {names[-1]} ({digest})" if names else "none"


def _versions() -> dict[str, str | None]:
    """Return the versions of the packages that compute; None for those that are not installed."""
    return {package: version_of(package) for package in ("semstab", *REPORTED_PACKAGES)}
