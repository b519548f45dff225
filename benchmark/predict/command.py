"""The command `semstab-bench predict`: everything is checked before the model is loaded, and said at the end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from rich.console import Console

from semstab.config import FrameSelection, explain
from semstab.errors import ConfigError
from semstab.predict.jobs import Job, file_job, scene_jobs
from semstab.predict.predictor import PredictorConfig, load_predictor
from semstab.predict.sequence import SequenceOptions, SequenceReport, predict_sequence
from semstab.predict.terminal import PredictionBar, print_report
from semstab.settings import load_config, resolve


def run(
    *,
    predictor: Mapping[str, Any],
    options: Mapping[str, Any],
    images: str | None,
    dataset: Mapping[str, Any] | None,
    scenes: list[str] | None,
    frames: Mapping[str, int],
    out: Path | None,
    batch: int,
    overwrite: bool,
    quiet: bool,
) -> list[SequenceReport]:
    """Predict what is selected. Raises ConfigError, DataError, MissingDependencyError; what was finished stays.

    predictor  settings of `PredictorConfig` without options
    options    of the backbone; those below 'dataset' are the dataset's
    """
    options = dict(options)
    dataset_options = options.pop("dataset", {})
    config = _validated(PredictorConfig, {**predictor, "options": options}).resolved()
    selection = _validated(FrameSelection, frames)
    jobs = _jobs(images, dataset, dataset_options, scenes, selection, out)
    backbone = load_predictor(config)
    sequence_options = SequenceOptions(
        config.label_name, config.scores, batch=batch, overwrite=overwrite, command=sys.argv
    )
    bar = PredictionBar(Console(stderr=True, quiet=quiet))
    reports = []
    try:
        for job in jobs:
            reports.append(predict_sequence(job.sequence, backbone, job.indices, job.out, sequence_options, [bar]))
    finally:
        bar.close()
    for report in reports:
        print_report(report, Console(quiet=quiet))
    if images is None and out is None and backbone.label_space is not None:
        skip = any(len(job.indices) < len(job.sequence) for job in jobs)
        hint = _next_command(config, {**(dataset or {}).get("options", {}), **dataset_options}, dataset or {}, skip)
        Console(quiet=quiet).print(hint, soft_wrap=True, highlight=False)
    return reports


def _next_command(
    predictor: PredictorConfig, options: Mapping[str, Any], dataset: Mapping[str, Any], skip: bool
) -> str:
    """What fuses the predictions; frames without one have to be left out."""
    name = dataset["name"]
    words = ["semstab-bench", *([] if name == "posed_folder" else ["--dataset", name])]
    words += ["--data", str(options["root"])] if "root" in options else []
    words += ["--backbone", predictor.label_name]
    words += ["--set", "dataset.options.incomplete=skip"] if skip else []
    return f"fuse them: {shlex.join(words)}"


def _jobs(
    images: str | None,
    dataset: Mapping[str, Any] | None,
    dataset_options: Any,
    scenes: list[str] | None,
    frames: FrameSelection,
    out: Path | None,
) -> list[Job]:
    if (images is None) == (dataset is None):
        raise ConfigError("say what to predict on: --images GLOB, or --data FOLDER, or --dataset NAME")
    if images is not None:
        return [file_job(images, frames, out)]
    overrides = {"dataset": {**(dataset or {}), "options": {**(dataset or {}).get("options", {}), **dataset_options}}}
    return scene_jobs(resolve(load_config(None, overrides)).dataset, scenes, frames, out)


def _validated(model: Any, content: Mapping[str, Any]) -> Any:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ConfigError(explain(error, model)) from error
