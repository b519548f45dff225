"""The command `semstab-bench predict`: everything is checked before the model is loaded, and a report follows."""

from __future__ import annotations

import functools
import glob
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import TextColumn

from semstab.config import DatasetConfig, FrameSelection, validated
from semstab.core.console import Console
from semstab.core.progress import frame_progress
from semstab.data.frames import Frame
from semstab.datasets import Scene, open_dataset, options_model
from semstab.datasets.formats.disk import natural
from semstab.datasets.formats.images import COLOR_SUFFIXES, read_color
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError, DataError
from semstab.models import Image, Model
from semstab.predict.images import ImageSequence, Picture
from semstab.predict.predictor import NAME as STORED
from semstab.predict.predictor import PredictorConfig, load_predictor, stored_labels
from semstab.predict.sequence import PredictionObserver, SequenceOptions, SequenceReport, predict_sequence

# Image files to predict on, and scenes of a dataset.


class ImageFiles:
    """Image files by a pattern such as 'flight/*.png', in natural order.

    Raises:
        DataError: If none fits, or two have one name.
    """

    labels_like_depth = False

    def __init__(self, pattern: str) -> None:
        paths = [Path(path) for path in glob.glob(str(Path(pattern).expanduser()), recursive=True)]  # noqa: PTH207
        files = sorted((path for path in paths if path.suffix.lower() in COLOR_SUFFIXES), key=lambda p: natural(str(p)))
        if not files:
            raise DataError(f"{pattern}: no image of {', '.join(COLOR_SUFFIXES)} fits; quote the pattern in the shell")
        stems = [path.stem for path in files]
        if repeated := [path for path in files if stems.count(path.stem) > 1]:
            raise DataError(f"{repeated[0]}: {repeated[1]} has the same name; predict on one folder after the other")
        self.name = files[0].parent.resolve().name
        self._files = files

    def __len__(self) -> int:
        """Return the number of files."""
        return len(self._files)

    def image(self, index: int) -> Image:
        """Return (H, W, 3) uint8 RGB.

        Raises:
            DataError: If that fails; the message names the file.
        """
        return read_color(self._files[index])

    def image_name(self, index: int) -> str:
        """Return the file's name without suffix."""
        return self._files[index].stem

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return nothing: all images of the pattern are there."""
        return []

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame | None:
        """Return none: single images have no depth."""
        return None

    def view(self, index: int, shape: tuple[int, int]) -> Frame | None:
        """Return none: single images have no depth."""
        return None


def chosen(names: Sequence[str] | None, available: Sequence[str], where: str) -> Sequence[str]:
    """Return the named scenes, by default all.

    Raises:
        ConfigError: For one that is not there.
    """
    if lost := [name for name in names or () if name not in available]:
        raise ConfigError(f"{where}: no scene '{lost[0]}'; there is {', '.join(available)}")
    return list(dict.fromkeys(names)) if names is not None else available


# The jobs of a prediction command: images of sequences, and the folders of their predictions.

IMAGES: Mapping[str, Any] = {"color": True}
"""The parts of a frame that must be there where a model looks at images."""


@dataclass(frozen=True, eq=False)
class Job:
    """A sequence, the indices of its images, and the folder above labels/, scores/ and regions/."""

    sequence: ImageSequence
    indices: list[int]
    out: Path


def file_job(pattern: str, frames: FrameSelection, out: Path | None) -> Job:
    """Return images by a pattern.

    Raises:
        ConfigError: Without `out`, or without a selected image.
    """
    if out is None:
        raise ConfigError("--images: predictions of single images need a folder; name it with --out")
    files = ImageFiles(pattern)
    return Job(files, _require_some(frames.indices(len(files)), files), out)


def scene_jobs(
    dataset: DatasetConfig,
    scenes: Sequence[str] | None,
    frames: FrameSelection,
    out: Path | None,
    looks_at: Mapping[str, Any] = IMAGES,
) -> list[Job]:
    """Return the scenes of a dataset.

    Predictions go into the scene's own folder, into `out`, or of several into out/SCENE.

    `looks_at` names the parts of a frame that must be there, as for `select_frames`.

    Raises:
        ConfigError: For a dataset without its own folders and without `out`, and for a scene or frames that do not
            exist.
    """
    opened = open_dataset(dataset.name, dataset.options)
    names = chosen(scenes, opened.scenes, dataset.name)
    jobs = []
    for name in names:
        scene = opened.scene(name)
        indices = _require_some(select_frames(scene, frames, **looks_at).indices, scene)
        jobs.append(Job(scene, indices, _folder_for(scene, out if out is None or len(names) == 1 else out / name)))
    return jobs


def _folder_for(scene: Scene, out: Path | None) -> Path:
    folder = out or scene.folder
    if folder is None:
        raise ConfigError(f"{scene.name}: has no folder of its own; name one for its predictions with --out")
    return folder


def _require_some(indices: list[int], sequence: ImageSequence) -> list[int]:
    if not indices:
        raise ConfigError(
            f"{sequence.name}: the selection of frames leaves none of its {len(sequence)}; change --frames"
        )
    return indices


# A prediction in the terminal: progress with frames a second and time left, and a report at the end.


class PredictionBar(PredictionObserver):
    """One bar a sequence. Speed and time left count frames that the model saw, not those of an earlier start."""

    def __init__(self, console: Console) -> None:
        self._bar = frame_progress(console, TextColumn("{task.fields[speed]}"))
        self._work = self._bar.add_task("starting", total=None, speed="")
        self._left = self._predicted = 0
        self._started = time.monotonic()

    def sequence_started(self, name: str, frames: int) -> None:
        """Show the bar."""
        self._left, self._predicted, self._started = frames, 0, time.monotonic()
        self._bar.reset(self._work, total=frames, description=name, speed="")
        self._bar.start()

    def frame_done(self, picture: Picture, seconds: float) -> None:
        """Advance by one frame."""
        reused = math.isnan(seconds)
        self._left -= 1
        if reused and not self._predicted:
            self._started = time.monotonic()
        self._predicted += not reused
        speed = speed_text(self._predicted, time.monotonic() - self._started, self._left)
        self._bar.update(self._work, advance=1, speed=speed)

    def close(self) -> None:
        """Take the bar away, also after an interruption."""
        self._bar.stop()


def speed_text(frames: int, seconds: float, left: int) -> str:
    """Return the speed and time left.

    >>> speed_text(10, 20.0, 30)
    '0.50 frames/s, 0:01:00 left'
    """
    if not frames or seconds <= 0:
        return ""
    remaining = int(left * seconds / frames)
    clock = f"{remaining // 3600}:{remaining // 60 % 60:02d}:{remaining % 60:02d}"
    return f"{frames / seconds:.2f} frames/s, {clock} left"


def print_report(report: SequenceReport, console: Console) -> None:
    """Print the frames of a sequence, the speed and the folders, and how much regions change."""
    reused = f", {report.reused} from an earlier start" if report.reused else ""
    speed = ""
    if report.predicted:
        model = 1e3 * report.model_seconds / report.predicted
        speed = f", {report.frames_per_second:.2f} frames/s (model {model:.0f} ms a frame)"
    console.print(f"{report.sequence}: {report.predicted} frames predicted{reused}{speed}", soft_wrap=True)
    for folder in report.folders:
        console.print(f"  {folder}", soft_wrap=True)
    if report.regions is not None:
        line = f"  flicker of matched regions {report.regions.flicker_percent:.2f} %"
        if report.regions.compensated:
            line += f", without camera motion {report.regions.compensated_flicker_percent:.2f} %"
        console.print(line, soft_wrap=True)


def run(
    *,
    predictor: Mapping[str, Any],
    options: Mapping[str, Any],
    images: str | None,
    dataset: DatasetConfig | None,
    scenes: list[str] | None,
    frames: Mapping[str, int],
    out: Path | None,
    batch: int,
    overwrite: bool,
    quiet: bool,
    top_k: int | None = None,
) -> list[SequenceReport]:
    """Predict what is selected, and return a report a sequence.

    Args:
        predictor: Settings of `PredictorConfig` without options.
        options: Options of the model.
        images: Folder or files of images, None for images of scenes.
        dataset: Resolved settings of the dataset, for images of scenes.
        scenes: Names of the scenes; None for all.
        frames: Settings of `FrameSelection`.
        out: Folder of the predictions; None for the scene's own.
        batch: Images that the model is given together.
        overwrite: Whether other predictions in the folder are replaced.
        quiet: Whether nothing is printed.
        top_k: Number of scores that a pixel retains; None for all.

    Raises:
        ConfigError, DataError, MissingDependencyError: If something cannot be predicted; what was finished stays.
    """
    if top_k is not None and not predictor.get("scores"):
        raise ConfigError("--top-k sets how many scores a pixel keeps; add --scores, or leave it out")
    config = validated(PredictorConfig, {**predictor, "options": options}).resolved()
    selection = validated(FrameSelection, frames)
    jobs = _jobs(images, dataset, scenes, selection, out, config.looks_at)
    load = _loader(config)
    load(jobs[0])  # its faults are reported before the first image is read
    sequence_options = SequenceOptions(
        config.label_name, config.scores, top_k=top_k, batch=batch, overwrite=overwrite, command=sys.argv
    )
    bar = PredictionBar(Console(stderr=True, quiet=quiet))
    reports = []
    try:
        for job in jobs:
            sequence, model = load(job)
            reports.append(predict_sequence(sequence, model, job.indices, job.out, sequence_options, [bar]))
    finally:
        bar.close()
    for report in reports:
        print_report(report, Console(quiet=quiet, markup=False))
    if dataset is not None and load(jobs[0])[1].label_space is not None:
        hint = _next_command(config, dataset, scenes, selection, out, several=len(jobs) > 1)
        Console(quiet=quiet).print(hint, soft_wrap=True, highlight=False, markup=False)
    return reports


def _loader(config: PredictorConfig) -> Callable[[Job], tuple[ImageSequence, Model]]:
    """Return the images of a job and the model that predicts on them: one for all, or each scene's own labels."""
    if config.model != STORED:
        model = load_predictor(config)
        return lambda job: (job.sequence, model)

    @functools.cache
    def of_scene(job: Job) -> tuple[ImageSequence, Model]:
        if not isinstance(job.sequence, Scene) or not job.sequence.labels_like_depth:
            raise ConfigError(
                f"{job.sequence.name}: its own labels are filtered inside a run (--filter, no --predict), or on disk"
                " once `convert` has made a posed folder of it"
            )
        return stored_labels(config, job.sequence)

    return of_scene


def _next_command(
    predictor: PredictorConfig,
    dataset: DatasetConfig,
    scenes: list[str] | None,
    frames: FrameSelection,
    out: Path | None,
    *,
    several: bool,
) -> str:
    """Return the command that fuses the predictions of the same scenes and frames."""
    words = ["semstab-bench", *([] if dataset.name == "posed_folder" else ["--dataset", dataset.name])]
    words += ["--data", str(dataset.options["root"])] if "root" in dataset.options else []
    for key, value in _said(dataset).items():
        words += ["--option", f"{key}={json.dumps(value)}" if not isinstance(value, str) else f"{key}={value}"]
    if out is not None:
        words += ["--option", f"labels_root={out}"]
        words += ["--option", f"labels={'{scene}/' if several else ''}labels/{{model}}/{{name}}"]
    for scene in scenes or ():
        words += ["--scene", scene]
    words += ["--model", predictor.label_name]
    if frames != FrameSelection():
        words += ["--frames", f"{frames.start or ''}:{frames.stop or ''}:{frames.stride}"]
    return f"fuse them: {shlex.join(words)}"


def _said(dataset: DatasetConfig) -> dict[str, Any]:
    """Return the dataset's options that differ from their defaults, without its root."""
    usual = {
        name: field.get_default(call_default_factory=True)
        for name, field in options_model(dataset.name).model_fields.items()
    }
    plain = json.loads(json.dumps(usual, default=str))
    return {key: value for key, value in dataset.options.items() if key != "root" and value != plain.get(key)}


def _jobs(
    images: str | None,
    dataset: DatasetConfig | None,
    scenes: list[str] | None,
    frames: FrameSelection,
    out: Path | None,
    looks_at: Mapping[str, Any],
) -> list[Job]:
    if images is None and dataset is not None:
        return scene_jobs(dataset, scenes, frames, out, looks_at)
    if images is None or dataset is not None:
        raise ConfigError("name the images to predict on: --images GLOB, or --data FOLDER, or --dataset NAME")
    return [file_job(images, frames, out)]
