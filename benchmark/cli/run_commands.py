"""Define the commands that fuse and measure: run, study, benchmark, filters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semstab.cli import options as opt
from semstab.cli.execution import execute, naming
from semstab.cli.options import chosen, print_lines, say
from semstab.errors import ConfigError

if TYPE_CHECKING:
    from semstab.config import Config


@opt.grouped
def run(
    *,
    backend: Annotated[list[str] | None, typer.Option(
        "--backend", "-b", help="Fusion backend: a name of `list`, FILE.py:NAME; repeatable.", show_default="numba",
        autocompletion=opt.backends,
    )] = None,
    rule: Annotated[list[str] | None, typer.Option(
        help="Fusion rule: mean, votes, bayes, weighted, recent, first, last, max, FILE.py:NAME; repeatable.",
        show_default="mean", autocompletion=opt.rules, rich_help_panel=opt.SETTINGS)] = None,
    config: opt.ConfigFile = None,
    source: opt.Source,
    measurement: opt.Measurement,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder.", show_default="runs/TIME")] = None,
    execution: opt.Execution,
    tile_size: opt.TileSize = None,
    prediction: opt.PredictionOptions,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Fuse every selected model with every selected backend, measure and compare. This is the default command."""
    from datetime import datetime

    loaded = _configured(prediction, config, measurement.content(source, backend, tile_size))
    if rule:
        loaded = _by_rules(loaded, rule)
    if measurement.device is not None:
        loaded = _on_device(loaded, measurement.device)
    out = out or Path("runs") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    with naming(out):
        execute(loaded, out, execution, quiet=quiet, verbose=verbose)


def _configured(prediction: opt.PredictionOptions, config: Path | None, content: dict[str, Any]) -> Config:
    """Return the configuration of a file and further settings, with vocabularies over the features of its models."""
    from semstab.configure import with_vocabularies

    loaded = _labelled(prediction, config, content)
    return with_vocabularies(loaded, prediction.vocabulary) if prediction.vocabulary else loaded


def _labelled(prediction: opt.PredictionOptions, config: Path | None, content: dict[str, Any]) -> Config:
    """Return the configuration of a file and further settings, of stored labels or of a model that predicts them."""
    from semstab.configure import filtered_config, load_config, predicted_config
    from semstab.predict.predictor import parse_predictors

    filters = prediction.filters or []
    if prediction.predict:
        predictors = parse_predictors(prediction.predict, prediction.model_options, filters)
        return predicted_config(predictors, config, content)
    if prediction.classes is not None:
        raise ConfigError(
            "--classes names the classes of a model that --predict chooses; name the classes of label maps in"
            " scene.yaml (classes: [name, ...]), or in --option 'classes=[name, ...]'"
        )
    return filtered_config(filters, config, content) if filters else load_config(config, content)


def _by_rules(config: Config, rules: list[str]) -> Config:
    """Return the configuration with each backend once for each rule."""
    from semstab.config import Config

    by_rule = [backend.fusing_by(rule) for backend in config.backends for rule in dict.fromkeys(rules)]
    Config(backends=by_rule)  # each has a name of its own
    return config.model_copy(update={"backends": by_rule})


def _on_device(config: Config, device: str) -> Config:
    from semstab.backends import takes_option

    names = [backend.name for backend in config.backends]
    if not any(takes_option(name, "device") for name in names):
        raise ConfigError(f"--device {device}: none of {', '.join(names)} runs on a device")
    changed = [
        backend.model_copy(update={"options": backend.options | {"device": device}})
        if takes_option(backend.name, "device")
        else backend
        for backend in config.backends
    ]
    return config.model_copy(update={"backends": changed})


@opt.grouped
def study(
    *,
    file: Annotated[str, typer.Argument(
        metavar="FILE", help="Study file, or a shipped study: see `list`.", autocompletion=opt.studies)],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Study folder.", show_default="studies/NAME")] = None,
    execution: opt.Execution = opt.UNRECORDED,
    only: Annotated[list[str] | None, typer.Option(
        metavar="PART", help="A sweep, shared_taxonomy or backends; repeatable.")] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", metavar="KEY=VALUE", help="Any setting, e.g. sweeps.voxel_size=[0.1,0.4].")] = None,
    options: opt.DatasetOptions = None,
    trust_geometry: opt.TrustGeometry = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Run everything that the paper reports: scenes x models x backends x variations. A second start resumes."""
    from semstab.configure import load_study
    from semstab.data.results import slug

    config = load_study(file, chosen({"check_geometry": False if trust_geometry else None}, settings, options))
    config = config if only is None else config.only(only)
    out = out or Path("studies") / slug(config.name)
    execute(config, out, execution, quiet=quiet, verbose=verbose)


@opt.grouped
def benchmark(
    *,
    name: Annotated[str, typer.Argument(
        metavar="NAME[@VERSION]", help="Benchmark of `list`, or its YAML file.", autocompletion=opt.benchmarks)],
    data: Annotated[Path | None, typer.Option(help="Folder of its data.", show_default="built in")] = None,
    labels: Annotated[Path | None, typer.Option(
        help="Folder of label maps, SCENE/MODEL/NAME.png below it.", show_default="the data's own")] = None,
    prediction: opt.PredictionOptions,
    taxonomy: Annotated[str | None, typer.Option(
        metavar="FILE", help="The benchmark's classes, with your names for them as members.",
        show_default="the benchmark's", rich_help_panel=opt.LABELS)] = None,
    model: opt.Models = None,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Run folder.", show_default="runs/NAME@VERSION")] = None,
    submit: Annotated[Path | None, typer.Option(
        metavar="FILE|FOLDER", help="Write the result as a file to hand in; a folder gets one a model.")] = None,
    card: Annotated[Path | None, typer.Option(
        metavar="FILE", help="YAML about the model: name, by, url, license, parameters, trained_on, notes.")] = None,
    execution: opt.Execution = opt.UNRECORDED,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Run a benchmark: fixed data, frames and settings, so that its numbers can be compared with everybody's."""
    from semstab.engine.folder import require_output
    from semstab.leaderboard.definition import load_benchmark
    from semstab.leaderboard.submission import ModelCard, submissions
    from semstab.predict.predictor import parse_predictors

    definition = load_benchmark(name)
    if "@" not in name or definition.superseded_by is not None:
        newer = f"; {definition.superseded_by} has replaced it" if definition.superseded_by else ""
        say(f"benchmark {definition.id}{newer}")
    if prediction.classes is not None and not prediction.predict:
        raise ConfigError("--classes names the classes of a model that --predict chooses")
    if card is not None and submit is None:
        raise ConfigError("--card describes a result to hand in; name its file with --submit")
    about = None if card is None else ModelCard.load(card)
    if submit is not None and submit.suffix:
        require_output(submit, [card])
    if submit is not None:
        definition.require_geometry()
    predictors = parse_predictors(prediction.predict or [], prediction.model_options, prediction.filters or [])
    if prediction.filters and not prediction.predict:
        raise ConfigError("--filter stands over a model that --predict chooses")
    config = definition.configured(data, labels, predictors, None if model == ["all"] else model, taxonomy)
    if definition.digests is None:
        say(f"{definition.id}: nobody had the data when it was defined, so that your copy is not compared")
    definition.require_data(data)
    out = out or Path("runs") / definition.id
    execute(config, out, execution, quiet=quiet, verbose=verbose)
    if submit is not None:
        for path, handle in submissions(out, submit, about):
            print_lines([f"{path}: {handle.model} on {definition.id}, {path.stat().st_size:,} bytes"], quiet=quiet)


@opt.grouped
def filters(
    *,
    source: opt.Source,
    prediction: opt.PredictionOptions,
    frames: opt.Frames = None,
    voxel_size: opt.VoxelSize = None,
    taxonomy: Annotated[str | None, typer.Option(help="Taxonomy to fuse and assess in: a name or a file.")] = None,
    settings: opt.DatasetSettings = None,
    options: opt.DatasetOptions = None,
    trust_geometry: opt.TrustGeometry = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="Study folder.")] = Path("studies/filters"),
    overwrite: opt.Overwrite = False,
    report: opt.Report = "on",
    jobs: opt.Jobs = 1,
    quiet: opt.Quiet = False,
) -> None:
    """Find a filter that makes a model more stable, with its accuracy, delay and cost. A second start resumes.

    --filter replaces the shipped filters; chains are written with a plus sign, ema-warped:0.6+guided:8.
    """
    from semstab.filter_study import filter_study_config
    from semstab.predict.predictor import parse_predictors

    run_settings: dict[str, Any] = {"scenes": source.scene, "voxel_size": voxel_size, "taxonomy": taxonomy}
    run_settings["check_geometry"] = False if trust_geometry else None
    models = parse_predictors(prediction.predict or [], prediction.model_options)
    content = chosen(run_settings, settings, options, source.dataset, source.data, frames)
    config, left_out = filter_study_config(models, source.model or [], prediction.filters or [], content)
    for line in left_out if not quiet else ():
        say(line)
    execute(config, out, opt.Execution(overwrite, "off", report, jobs), quiet=quiet)
