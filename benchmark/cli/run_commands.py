"""Define the commands that compute: run, study, benchmark, filters, check, predict, convert; and show and view."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import shlex
import sys
import textwrap
import time
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semstab.cli import options as opt
from semstab.cli.options import chosen, print_lines, say
from semstab.errors import ConfigError, DataError

if TYPE_CHECKING:
    from semstab.config import Config
    from semstab.engine import Executor, Observer
    from semstab.engine.videos import VideoObserver


DISAGREE = 3


def run(
    backend: Annotated[list[str] | None, typer.Option(
        "--backend", "-b", help="Fusion backend: a name of `list`, FILE.py:NAME; repeatable.", show_default="numba",
        autocompletion=opt.backends,
    )] = None,
    config: opt.ConfigFile = None,
    data: opt.DataFolder = None,
    dataset: opt.DatasetName = None,
    scene: opt.Scenes = None,
    model: opt.Models = None,
    taxonomy: Annotated[str | None, typer.Option(
        help="Taxonomy to fuse in: a name or a YAML file.", show_default="the dataset's; city: uavid7",
        autocompletion=opt.taxonomies, rich_help_panel=opt.SETTINGS)] = None,
    voxel_size: opt.VoxelSize = None,
    pixel_stride: Annotated[int | None, typer.Option(
        help="Use every n-th pixel of each axis.", show_default="1", rich_help_panel=opt.SETTINGS)] = None,
    top_k: Annotated[int | None, typer.Option(
        "--top-k", help="Fuse the so many largest soft scores of each pixel.", show_default="all",
        rich_help_panel=opt.SETTINGS)] = None,
    frames: opt.Frames = None,
    device: Annotated[str | None, typer.Option(
        help="CPU:0, or CUDA:0 for backends that take a device.", show_default="the backend's own",
        rich_help_panel=opt.MACHINE)] = None,
    check: Annotated[str | None, typer.Option(
        metavar="sample|BACKEND|none", show_default="sample",
        help="Check voxel by voxel against the numpy reference on a random sample, or against a backend on all.",
        rich_help_panel=opt.CHECKS)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of a simulated dataset.", show_default="0",
    rich_help_panel=opt.SETTINGS)] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.width=640.",
        rich_help_panel=opt.SETTINGS)] = None,
    options: opt.DatasetOptions = None,
    trust_geometry: opt.TrustGeometry = False,
    events: Annotated[bool | None, typer.Option("--events", help="Also write the log of observations.",
    rich_help_panel=opt.SETTINGS)] = None,
    statistics: Annotated[bool | None, typer.Option(
        "--statistics", help="Also measure drift and accuracy, and compare models; takes longer.")] = None,
    video_measures: Annotated[str | None, typer.Option(
        "--video-measures", metavar="depth|dis", show_default="none",
        help="Also VC and TC as papers report them, by depth and pose, or by optical flow between images.")] = None,
    scope: opt.ScopeOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder.", show_default="runs/TIME")] = None,
    overwrite: opt.Overwrite = False,
    rerun: opt.Rerun = None,
    report: opt.Report = "on",
    jobs: opt.Jobs = 1,
    scheduler: opt.Scheduler = None,
    tile_size: opt.TileSize = None,
    predict: opt.Predicted = None,
    classes: opt.Classes = None,
    filters: opt.Filters = None,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Fuse every selected model with every selected backend, measure and compare. This is the default command."""
    from datetime import datetime

    from semstab.predict.predictor import parse_predictors
    from semstab.settings import filtered_config, load_config, predicted_config
    from semstab.videos import is_video

    named = {
        "backends": backend, "scenes": scene, "models": model, "taxonomy": taxonomy, "voxel_size": voxel_size,
        "pixel_stride": pixel_stride, "top_k": top_k, "check": check, "events": events, "statistics": statistics,
        "video_measures": video_measures, "scope": scope, "check_geometry": False if trust_geometry else None,
        "tile_size": tile_size if tile_size is None or not tile_size.isdigit() else int(tile_size),
    }  # fmt: skip
    content = chosen(named, settings, options, dataset, data, frames, seed)
    if check in ("none", "off"):
        content["check"] = None
    if classes is not None and not predict:
        raise ConfigError(
            "--classes names the classes of a model that --predict chooses; those of label maps stand in scene.yaml"
            " (classes: [name, ...]), or in --option 'classes=[name, ...]'"
        )
    if predict:
        given = {} if classes is None else {"classes": classes}
        loaded = predicted_config(parse_predictors(predict, given, filters or []), config, content)
    else:
        loaded = filtered_config(filters, config, content) if filters else load_config(config, content)
    if device is not None:
        loaded = _on_device(loaded, device)
    out = out or Path("runs") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    with _naming(out):
        if is_video(loaded):
            if jobs > 1 or scheduler is not None:
                raise ConfigError("--jobs and --scheduler: videos are measured in one process; leave them out")
            measure_videos(loaded, out, rerun, report, overwrite=overwrite, quiet=quiet)
        else:
            execute(
                loaded, out, executor_of(jobs, scheduler), rerun, report, overwrite=overwrite, quiet=quiet,
                verbose=verbose,
            )  # fmt: skip


@contextlib.contextmanager
def _naming(out: Path) -> Iterator[None]:
    """Let an interruption say in which folder the same command goes on."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(*error.args, out) from error


def measure_videos(config: Config, out: Path, rerun: str | None, report: str, *, overwrite: bool, quiet: bool) -> None:
    """Measure flicker of videos, print the answer, and write the results."""
    began = time.monotonic()
    from rich.console import Console

    from semstab.report.videos import NEEDS, VideoProgress, screen
    from semstab.videos import run_videos

    if report not in ("on", "off"):
        raise ConfigError(f"--report {report}: write on or off")
    observers: list[VideoObserver] = [VideoProgress(Console(stderr=True, quiet=quiet))]
    if rerun != "off":
        from semstab.recording import Target, VideoRecording

        observers.append(VideoRecording(Target.parse(rerun, out / "recording.rrd")))
    try:
        result = run_videos(
            config, out=out, observers=observers, command=sys.argv, report=report == "on", overwrite=overwrite
        )
    finally:
        for observer in observers:
            observer.close()
    lines = [*screen(result), *textwrap.wrap(f"note: {NEEDS}", 80, initial_indent="  ", subsequent_indent="    ")]
    lines.append(f"  {time.monotonic() - began:.0f} s")
    for line, file in (("report  ", out / "report.html"), ("viewer  semstab-bench view ", out / "recording.rrd")):
        if file.exists():
            lines.append(f"  {line}{file}")
    print_lines([*lines, f"  more    {out}"], quiet=quiet)


def study(
    file: Annotated[str, typer.Argument(
        metavar="FILE", help="Study file, or a shipped study: see `list`.", autocompletion=opt.studies)],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Study folder.", show_default="studies/NAME")] = None,
    overwrite: opt.Overwrite = False,
    jobs: opt.Jobs = 1,
    scheduler: opt.Scheduler = None,
    only: Annotated[list[str] | None, typer.Option(
        metavar="PART", help="A sweep, shared_taxonomy or backends; repeatable.")] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", metavar="KEY=VALUE", help="Any setting, e.g. sweeps.voxel_size=[0.1,0.4].")] = None,
    options: opt.DatasetOptions = None,
    rerun: opt.Rerun = "off",
    report: opt.Report = "on",
    trust_geometry: opt.TrustGeometry = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Run everything that the paper reports: scenes x models x backends x variations. A second start resumes."""
    from semstab.data.results import slug
    from semstab.settings import load_study

    config = load_study(file, chosen({"check_geometry": False if trust_geometry else None}, settings, options))
    config = config if only is None else config.only(only)
    out = out or Path("studies") / slug(config.name)
    execute(config, out, executor_of(jobs, scheduler), rerun, report, overwrite=overwrite, quiet=quiet, verbose=verbose)


def benchmark(
    name: Annotated[str, typer.Argument(
        metavar="NAME[@VERSION]", help="Benchmark of `list`, or its YAML file.", autocompletion=opt.benchmarks)],
    data: Annotated[Path | None, typer.Option(help="Folder of its data.", show_default="built in")] = None,
    labels: Annotated[Path | None, typer.Option(
        help="Folder of label maps, SCENE/MODEL/NAME.png below it.", show_default="the data's own")] = None,
    predict: opt.Predicted = None,
    classes: opt.Classes = None,
    filters: opt.Filters = None,
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
    overwrite: opt.Overwrite = False,
    rerun: opt.Rerun = "off",
    report: opt.Report = "on",
    jobs: opt.Jobs = 1,
    scheduler: opt.Scheduler = None,
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
    if classes is not None and not predict:
        raise ConfigError("--classes names the classes of a model that --predict chooses")
    if card is not None and submit is None:
        raise ConfigError("--card describes a result to hand in; name its file with --submit")
    about = None if card is None else ModelCard.load(card)
    if submit is not None and submit.suffix:
        require_output(submit, [card])
    predictors = parse_predictors(predict or [], {} if classes is None else {"classes": classes}, filters or [])
    if filters and not predict:
        raise ConfigError("--filter stands over a model that --predict chooses")
    config = definition.configured(data, labels, predictors, None if model == ["all"] else model, taxonomy)
    if definition.digests is None:
        say(f"{definition.id}: nobody had the data when it was defined, so that your copy is not compared")
    definition.require_data(data)
    out = out or Path("runs") / definition.id
    execute(config, out, executor_of(jobs, scheduler), rerun, report, overwrite=overwrite, quiet=quiet, verbose=verbose)
    if submit is not None:
        for path, handle in submissions(out, submit, about):
            print_lines([f"{path}: {handle.model} on {definition.id}, {path.stat().st_size:,} bytes"], quiet=quiet)


def filters(
    data: opt.DataFolder = None,
    dataset: opt.DatasetName = None,
    scene: opt.Scenes = None,
    model: opt.Models = None,
    predict: opt.Predicted = None,
    classes: opt.Classes = None,
    filter_: opt.Filters = None,
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

    --filter replaces the shipped filters; chains are written with a plus sign, ema-warped:0.6+threshold:0.5.
    """
    from semstab.filter_study import filter_study_config
    from semstab.predict.predictor import parse_predictors

    named: dict[str, Any] = {"scenes": scene, "voxel_size": voxel_size, "taxonomy": taxonomy}
    named["check_geometry"] = False if trust_geometry else None
    models = parse_predictors(predict or [], {} if classes is None else {"classes": classes})
    content = chosen(named, settings, options, dataset, data, frames)
    config, left_out = filter_study_config(models, model or [], filter_ or [], content)
    for line in left_out if not quiet else ():
        say(line)
    execute(config, out, executor_of(jobs, None), "off", report, overwrite=overwrite, quiet=quiet)


def execute(
    config: Config, out: Path, executor: Executor, rerun: str | None, report: str, *, overwrite: bool, quiet: bool,
    verbose: bool = False,
) -> None:  # fmt: skip
    """Run a configuration, print the answer, and end with the exit code of its outcome."""
    began = time.monotonic()
    from rich.console import Console

    from semstab.api import run_study
    from semstab.report.terminal import ProgressBar, failure_lines, print_answer

    if report not in ("on", "off"):
        raise ConfigError(f"--report {report}: write on or off")
    recording = []
    if rerun != "off":
        from semstab.recording import Recording, Target

        recording.append(Recording(Target.parse(rerun, out / "recording.rrd")))
        if executor.elsewhere and recording[0].target.live:
            raise ConfigError("--rerun: a viewer follows a run in one process; leave out --jobs and --scheduler")
    observers: list[Observer] = [ProgressBar(Console(stderr=True, quiet=quiet)), *recording]
    gc.freeze()  # the garbage collector skips modules, which takes half a second of a short run otherwise
    try:
        result = run_study(
            config, out, executor=executor, observers=observers, command=sys.argv, report=report == "on",
            overwrite=overwrite,
        )  # fmt: skip
        for line in failure_lines(result):
            say(f"error: {line}")
        if result.select() and not quiet:
            print_answer(result, Console(), out=out, seconds=time.monotonic() - began, verbose=verbose)
        else:
            print_lines([f"  folder  {out}"], quiet=quiet)
        for each in recording:
            each.serve()
    finally:
        for observer in observers:
            observer.close()
    if result.failures:
        raise typer.Exit(2)
    if not result.agrees:
        first = next(row for row in result.agreement if not row.agrees)
        where = f" ({first.scene}, {first.model}: {first.first})" if first.first else ""
        say(f"error: the backends disagree{where}; the agreement in {out / 'summary.json'} shows where")
        raise typer.Exit(DISAGREE)


def executor_of(jobs: int, scheduler: str | None) -> Executor:
    """Return the executor of the work: this process, processes of this machine, or a cluster."""
    import logging

    from semstab.engine import DaskCluster, InProcess, LocalProcesses

    if scheduler is None:
        return LocalProcesses(jobs) if jobs > 1 else InProcess()
    if jobs > 1:
        raise ConfigError("--jobs and --scheduler: the scheduler's workers do the work; leave --jobs out")
    cluster = DaskCluster(scheduler)
    for name in ("distributed", "distributed.client"):  # the run itself prints one line for a unit that fails
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return cluster


def _on_device(config: Config, device: str) -> Config:
    from semstab.backends import takes_option

    names = [backend.name for backend in config.backends]
    if not any(takes_option(name, "device") for name in names):
        raise ConfigError(f"--device {device}: none of {', '.join(names)} runs on a device")
    changed = [
        each.model_copy(update={"options": each.options | {"device": device}})
        if takes_option(each.name, "device")
        else each
        for each in config.backends
    ]
    return config.model_copy(update={"backends": changed})


def check(
    config: opt.ConfigFile = None,
    data: opt.DataFolder = None,
    dataset: opt.DatasetName = None,
    scene: opt.Scenes = None,
    model: opt.Models = None,
    voxel_size: opt.VoxelSize = None,
    frames: opt.Frames = None,
    settings: opt.DatasetSettings = None,
    options: opt.DatasetOptions = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers.")] = None,
    verbose: opt.Verbose = False,
    quiet: opt.Quiet = False,
) -> None:
    """Check poses, depth, units and labels of a dataset. Exit code 0 if they are sound, 2 if not."""
    from rich.console import Console

    from semstab.check import SCHEMA
    from semstab.check import check as check_scenes
    from semstab.check.display import print_check
    from semstab.core.files import write_json
    from semstab.engine.folder import require_output
    from semstab.settings import load_config, resolve

    if json_file is not None:
        require_output(json_file, [config])
    named = {"scenes": scene, "models": model, "voxel_size": voxel_size}
    selected = resolve(load_config(config, chosen(named, settings, options, dataset, data, frames)))
    console, results = Console(quiet=quiet), []
    for checked in check_scenes(selected):
        print_check(checked, console, verbose=verbose)
        results.append(checked)
    if json_file is not None:
        write_json(json_file, {"schema": SCHEMA, "scenes": [checked.to_dict() for checked in results]})
    if problems := [f"{checked.scene}: {problem}" for checked in results for problem in checked.problems]:
        first, *more = problems
        raise DataError(f"{first}" + (f" (and {len(more)} more, see above)" if more else ""))


def predict(
    model: Annotated[str, typer.Option(
        "--model", "-m", help="Model, as named by `list`; or FILE.py:NAME, package.module:NAME.",
        autocompletion=opt.predictors,
    )],
    images: Annotated[str | None, typer.Option(metavar="GLOB", help="Image files, quoted; or choose scenes.")] = None,
    data: opt.DataFolder = None,
    dataset: opt.DatasetName = None,
    scene: opt.Scenes = None,
    frames: opt.Frames = None,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Folder above labels/ and scores/.", show_default="the scene's own")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the predictions.", show_default="the model's name")] = None,
    checkpoint: Annotated[str | None, typer.Option(help="Folder that save_pretrained wrote, or a hub id.")] = None,
    revision: Annotated[str | None, typer.Option(help="Branch, tag or commit on the hub.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1, mps.", show_default="cpu")] = None,
    dtype: Annotated[str | None, typer.Option(help="float32, bfloat16 or float16.", show_default="float32")] = None,
    image_size: Annotated[str | None, typer.Option(
        metavar="N|HxW", help="Shorter side, or height and width, of the model's input.")] = None,
    classes: opt.Classes = None,
    batch: Annotated[int, typer.Option(min=1, help="Images at a time.")] = 1,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the model on a CPU.")] = None,
    taxonomy: Annotated[str | None, typer.Option(help="Give labels in this taxonomy: a name or a YAML file.")] = None,
    mapping: Annotated[str | None, typer.Option(
        help="strict, or lenient: near classes count as well.", show_default="strict")] = None,
    filters: opt.Filters = None,
    scores: Annotated[bool, typer.Option("--scores", help="Also keep soft scores.")] = False,
    top_k: Annotated[int | None, typer.Option(
        min=1, metavar="N", help="Of these only the N largest of each pixel; 0 for the rest.")] = None,
    settings: Annotated[list[str] | None, typer.Option(
        "--set", metavar="KEY=VALUE", help="Any option of the model, or dataset.options.KEY=VALUE.")] = None,
    options: opt.DatasetOptions = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace predictions of other settings.")] = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Run a segmentation model over images; `run` and `study` read the label maps. A second start resumes."""
    from semstab.models import sides
    from semstab.predict import command
    from semstab.settings import load_config, resolve

    size: Any = None
    if image_size is not None:
        size = int(image_size) if re.fullmatch(r"[0-9]{1,9}", image_size) else sides(image_size)
        if size == image_size:
            raise ConfigError(f"--image-size {image_size}: write the shorter side, for example 512, or HEIGHTxWIDTH")
    named = {
        "checkpoint": checkpoint, "revision": revision, "device": device, "dtype": dtype, "threads": threads,
        "classes": classes, "image_size": size,
    }  # fmt: skip
    of_data = [setting for setting in settings or () if setting.startswith(("dataset.", "frames."))]
    content = chosen({}, of_data, options, dataset, data, frames)
    indices, group = content.get("frames", {}), content.get("dataset")
    own = chosen(named, [setting for setting in settings or () if setting not in of_data], None)
    if group is not None and data is None and dataset is None:
        raise ConfigError("--option sets how a dataset is read; choose one with --data or --dataset")
    given = {"name": name, "taxonomy": taxonomy, "mapping": mapping, "scores": scores, "filters": filters}
    command.run(
        predictor={"model": model, **{key: value for key, value in given.items() if value is not None}},
        options=own,
        images=images,
        dataset=None if group is None else resolve(load_config(None, {"dataset": group})).dataset,
        scenes=None if scene == ["all"] else scene,
        frames=indices,
        out=out,
        batch=batch,
        overwrite=overwrite,
        quiet=quiet,
        top_k=top_k,
    )


def convert(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder in which each scene becomes a folder.")],
    config: opt.ConfigFile = None,
    data: opt.DataFolder = None,
    dataset: opt.DatasetName = None,
    scene: opt.Scenes = None,
    model: opt.Models = None,
    frames: opt.Frames = None,
    settings: opt.DatasetSettings = None,
    options: opt.DatasetOptions = None,
    depth_error: Annotated[float, typer.Option(
        min=0, metavar="METRES", help="Store depth in 16 bits where no pixel is off by more.")] = 0.0,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write any dataset as posed folders. A second start resumes."""
    from rich.console import Console

    from semstab.convert import convert, frame_bar, print_converted
    from semstab.settings import load_config, resolve

    content = chosen({"scenes": scene, "models": model}, settings, options, dataset, data, frames)
    selected, console = resolve(load_config(config, content)), Console(quiet=quiet, markup=False)
    with frame_bar(Console(stderr=True, quiet=quiet)) as bar:
        for converted in convert(selected, out, depth_error=depth_error, progress=bar):
            print_converted(converted, console)


class FigureFormat(StrEnum):
    """The file format of figures."""

    png = "png"
    svg = "svg"


FORMER_TABLES = {"glance": "overview", "remedies": "filters"}
"""The names of tables in 0.3, with the current names; the old ones work for one version."""


def show(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run, or of several.")],
    what: Annotated[list[str] | None, typer.Argument(
        metavar="[RUN|TABLE]...", help="Further runs, for one table of all; or tables, by the beginning of their names."
    )] = None,
    out: Annotated[Path | None, typer.Option(help="Write the table of several runs and a figure here.")] = None,
    figures: Annotated[FigureFormat | None, typer.Option(help="Draw the figures for a paper into RUN/figures.")] = None,
) -> None:  # fmt: skip
    """Print the answer of a finished run, or its tables, without computing; of several runs one table of all."""
    from rich.console import Console

    from semstab.data.records import is_run
    from semstab.engine.folder import load_result
    from semstab.report.tables import tables
    from semstab.report.tables.table import to_terminal
    from semstab.report.terminal import failure_lines, print_answer

    further = [Path(word) for word in what or () if Path(word).is_dir()]
    if further or (run.is_dir() and not is_run(run)):
        _show_several(run, further, [word for word in what or () if Path(word) not in further], out, figures)
        return
    if out is not None:
        raise ConfigError("--out is for the table of several runs; the tables of one are in its folder")
    result = load_result(run)
    for line in failure_lines(result):
        say(f"failed: {line}")
    if not result.select():
        raise DataError(f"{run}: no unit finished; {run / 'failures.log'} has more where it exists; run it again")
    there = {table.name: table for table in tables(result)}
    if figures is not None:
        from semstab.report.figures import write_figures

        print_lines(map(str, write_figures(result, run, svg=figures is FigureFormat.svg)))
    elif not what:
        print_answer(result, Console(), out=run)
        listed = f"tables  {', '.join(there)}"
        print_lines(textwrap.wrap(listed, 80, initial_indent="  ", subsequent_indent=" " * 10))
    for name in what or ():
        matching = [table for key, table in there.items() if key.startswith(FORMER_TABLES.get(name, name))]
        if not matching:
            raise ConfigError(f"{run}: no table '{name}'; the tables are {', '.join(there)}")
        print_lines(f"{to_terminal(table)}\n" for table in matching)


def _show_several(
    run: Path, further: list[Path], names: list[str], out: Path | None, figures: FigureFormat | None
) -> None:
    """Print one table of several runs, and write it with its figure where that is wanted."""
    from semstab.report.figures.runs import runs_figure
    from semstab.report.tables import save_tables
    from semstab.report.tables.runs import found_runs, runs_table
    from semstab.report.tables.table import to_terminal

    if names:
        raise ConfigError(f"'{names[0]}' is neither a table of several runs nor a folder; name one run for its tables")
    results = found_runs([run, *further])
    table = runs_table(results)
    print_lines([to_terminal(table)])
    if out is not None:
        written = save_tables([table], out)
        print_lines(map(str, [*written, *runs_figure(results).save(out, svg=figures is FigureFormat.svg)]))


def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or an .rrd file.")]) -> None:
    """Open a run's recording in the rerun viewer; it is made again if units have no pictures in it."""
    import subprocess

    from semstab.recording import lacks_pictures, record_finished, viewer_command

    if not run.exists():
        raise ConfigError(f"{run}: there is no such run or file; give the folder of --out, or one of runs/")
    recording, finished = run / "recording.rrd" if run.is_dir() else run, (run / "summary.json").is_file()
    if not finished and not recording.is_file():
        raise ConfigError(f"{run}: there is no finished run here; give the folder of --out, or one of runs/")
    if finished and lacks_pictures(run, recording):
        say(f"making {recording}")
        record_finished(run, recording)
    display = sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    stderr = None if display else subprocess.DEVNULL  # where it says in several lines that there is none
    code = subprocess.run([*viewer_command(), str(recording)], check=False, stderr=stderr).returncode
    if code and not display:
        raise ConfigError(
            f"{recording}: there is no display for the viewer; copy the file to a machine with one, or show it in a"
            f" browser: rerun --serve-web {shlex.quote(str(recording))}"
        )
    raise typer.Exit(code)
