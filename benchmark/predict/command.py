"""The command `semstab-bench predict`: everything is checked before the model is loaded, and said at the end."""

from __future__ import annotations

import functools
import json
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from semstab.backbones import Backbone
from semstab.config import DatasetConfig, FrameSelection, validated
from semstab.datasets import Scene, options_model
from semstab.errors import ConfigError
from semstab.predict.disk.jobs import Job, file_job, scene_jobs
from semstab.predict.disk.sequence import SequenceOptions, SequenceReport, predict_sequence
from semstab.predict.images import ImageSequence
from semstab.predict.predictor import PredictorConfig, load_predictor, stored_labels
from semstab.predict.stored import NAME as STORED
from semstab.predict.terminal import PredictionBar, print_report


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
    """Predict what is selected. Raises ConfigError, DataError, MissingDependencyError; what was finished stays.

    predictor  settings of `PredictorConfig` without options
    options    of the backbone
    top_k      how many scores a pixel keeps; None for all
    dataset    resolved, where the images are those of scenes
    """
    if top_k is not None and not predictor.get("scores"):
        raise ConfigError("--top-k says how many scores a pixel keeps; add --scores, or leave it out")
    config = validated(PredictorConfig, {**predictor, "options": options}).resolved()
    selection = validated(FrameSelection, frames)
    jobs = _jobs(images, dataset, scenes, selection, out, config.looks_at)
    load = _loader(config)
    load(jobs[0])  # what is wrong with it is said before the first image is read
    sequence_options = SequenceOptions(
        config.label_name, config.scores, top_k=top_k, batch=batch, overwrite=overwrite, command=sys.argv
    )
    bar = PredictionBar(Console(stderr=True, quiet=quiet))
    reports = []
    try:
        for job in jobs:
            sequence, backbone = load(job)
            reports.append(predict_sequence(sequence, backbone, job.indices, job.out, sequence_options, [bar]))
    finally:
        bar.close()
    for report in reports:
        print_report(report, Console(quiet=quiet, markup=False))
    if dataset is not None and load(jobs[0])[1].label_space is not None:
        hint = _next_command(config, dataset, scenes, selection, out, several=len(jobs) > 1)
        Console(quiet=quiet).print(hint, soft_wrap=True, highlight=False, markup=False)
    return reports


def _loader(config: PredictorConfig) -> Callable[[Job], tuple[ImageSequence, Backbone]]:
    """What gives the images of a job and who predicts on them: one model for all, or each scene's own labels."""
    if config.backbone != STORED:
        backbone = load_predictor(config)
        return lambda job: (job.sequence, backbone)

    @functools.cache
    def of_scene(job: Job) -> tuple[ImageSequence, Backbone]:
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
    """What fuses the predictions: of the same scenes and frames, read the same way, as the others have none."""
    words = ["semstab-bench", *([] if dataset.name == "posed_folder" else ["--dataset", dataset.name])]
    words += ["--data", str(dataset.options["root"])] if "root" in dataset.options else []
    for key, value in _said(dataset).items():
        words += ["--option", f"{key}={json.dumps(value)}" if not isinstance(value, str) else f"{key}={value}"]
    if out is not None:
        words += ["--option", f"labels_root={out}"]
        words += ["--option", f"labels={'{scene}/' if several else ''}labels/{{backbone}}/{{name}}"]
    for scene in scenes or ():
        words += ["--scene", scene]
    words += ["--backbone", predictor.label_name]
    if frames != FrameSelection():
        words += ["--frames", f"{frames.start or ''}:{frames.stop or ''}:{frames.stride}"]
    return f"fuse them: {shlex.join(words)}"


def _said(dataset: DatasetConfig) -> dict[str, Any]:
    """The dataset's options that are not as they are by themselves, but for its root."""
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
        raise ConfigError("say what to predict on: --images GLOB, or --data FOLDER, or --dataset NAME")
    return [file_job(images, frames, out)]
