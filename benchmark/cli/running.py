"""The commands run, study and view."""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semstab.cli import options as completion
from semstab.cli.options import (
    Backbones,
    Classes,
    ConfigFile,
    DataFolder,
    DatasetName,
    DatasetOptions,
    DatasetSettings,
    Filters,
    Frames,
    Jobs,
    Quiet,
    Report,
    Rerun,
    Scenes,
    Scheduler,
    ScopeOption,
    TileSize,
    TrustGeometry,
    Verbose,
    VoxelSize,
    chosen,
    overrides,
    say,
    with_options,
)
from semstab.errors import ConfigError

if TYPE_CHECKING:
    from semstab.config import Config
    from semstab.engine import Executor, Observer
    from semstab.recording import Recording


DISAGREE = 3

Models = Annotated[
    list[str] | None,
    typer.Option(
        "--predict",
        metavar="NAME[,KEY=VALUE...]",
        help="Model that makes the labels, nothing on disk: a name of `list`, FILE.py:NAME; repeatable.",
    ),
]


def run(
    backend: Annotated[
        list[str] | None,
        typer.Option(
            "--backend",
            "-b",
            help="Fusion backend; repeatable.",
            show_default="numba",
            autocompletion=completion.backends,
        ),
    ] = None,
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    taxonomy: Annotated[
        str | None,
        typer.Option(
            help="Taxonomy to fuse in: a name or a YAML file.",
            show_default="the dataset's; city: uavid7",
            autocompletion=completion.taxonomies,
        ),
    ] = None,
    voxel_size: VoxelSize = None,
    pixel_stride: Annotated[
        int | None, typer.Option(help="Use every n-th pixel of each axis.", show_default="1")
    ] = None,
    top_k: Annotated[
        int | None,
        typer.Option("--top-k", help="Fuse the so many largest soft scores of each pixel.", show_default="all"),
    ] = None,
    frames: Frames = None,
    device: Annotated[
        str | None,
        typer.Option(help="CPU:0, or CUDA:0 for backends that take a device.", show_default="the backend's own"),
    ] = None,
    check: Annotated[
        str | None,
        typer.Option(
            metavar="sample|BACKEND|none",
            help="Check voxel by voxel against the numpy reference on a random sample, or against a backend on all.",
            show_default="sample; of the built-in city numpy",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of a simulated dataset.", show_default="0")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.width=640."),
    ] = None,
    options: DatasetOptions = None,
    trust_geometry: TrustGeometry = False,
    events: Annotated[bool | None, typer.Option("--events", help="Also write the log of observations.")] = None,
    statistics: Annotated[
        bool | None,
        typer.Option("--statistics", help="Also test drift, judge by ground truth, compare backbones; takes longer."),
    ] = None,
    scope: ScopeOption = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder.", show_default="runs/TIME")] = None,
    rerun: Rerun = None,
    report: Report = "on",
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    tile_size: TileSize = None,
    predict: Models = None,
    classes: Classes = None,
    filters: Filters = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fuse every selected backbone with every selected backend, measure, compare. This is the default command."""
    named = {
        "backends": backend,
        "scenes": scene,
        "backbones": backbone,
        "taxonomy": taxonomy,
        "voxel_size": voxel_size,
        "pixel_stride": pixel_stride,
        "top_k": top_k,
        "check": check,
        "events": events,
        "statistics": statistics,
        "scope": scope,
        "check_geometry": False if trust_geometry else None,
        "tile_size": tile_size if tile_size is None or not tile_size.isdigit() else int(tile_size),
    }
    content = chosen(named, with_options(settings, options), dataset, data, frames, seed)
    if check in ("none", "off"):
        content["check"] = None
    resolved = _load(config, content, predict or [], classes, filters or [])
    if device is not None:
        resolved = _on_device(resolved, device)
    execute(resolved, out or _default_out(), executor_of(jobs, scheduler), rerun, report, quiet=quiet, verbose=verbose)


def study(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE", help="Study file, or a shipped study: see `list`.", autocompletion=completion.studies
        ),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Study folder.", show_default="studies/NAME")] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="PART", help="A sweep, shared_taxonomy or backends; repeatable.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. sweeps.voxel_size=[0.1,0.4]."),
    ] = None,
    options: DatasetOptions = None,
    rerun: Rerun = "off",
    report: Report = "on",
    trust_geometry: TrustGeometry = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Everything that the paper reports: scenes x backbones x backends x variations. Goes on where it was."""
    from semstab.model.results import slug
    from semstab.settings import load_study

    config = load_study(
        file, overrides({"check_geometry": False if trust_geometry else None}, with_options(settings, options))
    )
    if only is not None:
        config = config.only(only)
    execute(
        config,
        out or Path("studies") / slug(config.name),
        executor_of(jobs, scheduler),
        rerun,
        report,
        quiet=quiet,
        verbose=verbose,
    )


def show(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    what: Annotated[
        list[str] | None, typer.Argument(metavar="[TABLE]...", help="Tables to print, by the beginning of their names.")
    ] = None,
) -> None:
    """Print the answer of a finished run again, or its tables, without computing."""
    from rich.console import Console

    from semstab.engine.folder import load_result
    from semstab.report.tables import tables
    from semstab.report.tables.table import to_terminal
    from semstab.report.terminal import print_summary

    result, console = load_result(run), Console()
    there = {table.name: table for table in tables(result)}
    if not what:
        print_summary(result, console, out=run)
        console.print(f"  tables  {', '.join(there)}", highlight=False, markup=False)
        return
    for name in what:
        chosen_tables = [table for key, table in there.items() if key.startswith(name)]
        if not chosen_tables:
            raise ConfigError(f"{run}: no table '{name}'; there are {', '.join(there)}")
        for table in chosen_tables:
            console.print(f"{to_terminal(table)}\n", highlight=False, markup=False, soft_wrap=True)


def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or an .rrd file.")]) -> None:
    """Open a run's recording in the rerun viewer; where units lack pictures, it is made again from the run folder."""
    import subprocess

    from semstab.recording import lacks_pictures, record_finished, viewer_command

    if not run.exists():
        raise ConfigError(f"{run}: there is no such run or file; name the folder that --out gave, or one of runs/")
    recording, finished = run / "recording.rrd" if run.is_dir() else run, (run / "summary.json").is_file()
    if not finished and not recording.is_file():
        raise ConfigError(f"{run}: holds no finished run; name the folder that --out gave, or one of runs/")
    if finished and lacks_pictures(run, recording):
        say(f"making {recording}")
        record_finished(run, recording)
    raise typer.Exit(subprocess.run([*viewer_command(), str(recording)], check=False).returncode)


def execute(
    config: Config,
    out: Path,
    executor: Executor,
    rerun: str | None,
    report: str,
    *,
    quiet: bool = False,
    verbose: bool = False,
) -> None:
    """Run it, print the answer, and end with the exit code that it calls for."""
    began = time.monotonic()
    from rich.console import Console

    from semstab.api import run_study
    from semstab.report.remedies import remedies
    from semstab.report.terminal import ProgressBar, failure_lines, print_remedies, print_summary

    if report not in ("on", "off"):
        raise ConfigError(f"--report {report}: write on or off")
    recording = _recording(rerun, out)
    if executor.elsewhere and any(each.target.live for each in recording):
        raise ConfigError("--rerun: a viewer follows a run in one process; leave out --jobs and --scheduler")
    observers: list[Observer] = [ProgressBar(Console(stderr=True, quiet=quiet)), *recording]
    gc.freeze()  # modules stay: looking for garbage among them takes half a second of a short run
    try:
        told: dict[str, Any] = {"executor": executor, "observers": observers, "command": sys.argv}
        result = run_study(config, out, **told, report=report == "on")
        for line in failure_lines(result):
            say(f"error: {line}")
        if not quiet:
            console = Console()
            if remedies(result):
                print_remedies(result, console)
            elif result.select():
                print_summary(result, console, out=out, seconds=time.monotonic() - began, verbose=verbose)
            else:
                console.print(f"  folder  {out}", highlight=False, markup=False, soft_wrap=True)
        for each in recording:
            each.serve()
    finally:
        for observer in observers:
            observer.close()
    if result.failures:
        raise typer.Exit(2)
    if not result.agrees:
        say(f"error: the backends disagree; the agreement in {out / 'summary.json'} says where")
        raise typer.Exit(DISAGREE)


def _recording(rerun: str | None, out: Path) -> list[Recording]:
    if rerun == "off":
        return []
    from semstab.recording import Recording, Target

    return [Recording(Target.parse(rerun, out / "recording.rrd"))]


def executor_of(jobs: int, scheduler: str | None) -> Executor:
    """Where the work is done: here, in processes of this machine, on a cluster."""
    import logging

    from semstab.engine import DaskCluster, InProcess, LocalProcesses

    if scheduler is None:
        return LocalProcesses(jobs) if jobs > 1 else InProcess()
    if jobs > 1:
        raise ConfigError("--jobs and --scheduler: the scheduler's workers do the work; leave --jobs out")
    cluster = DaskCluster(scheduler)
    for name in ("distributed", "distributed.client"):  # what becomes of a unit is said in one line
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return cluster


def _load(
    path: Path | None, overrides: dict[str, Any], predict: list[str], classes: str | None, filters: list[str]
) -> Config:
    """The configuration; with models whose predictions take the place of the dataset's labels, or filters over them."""
    from semstab.settings import filtered_config, load_config, predicted_config

    if predict:
        from semstab.predict.predictor import parse_predictor

        options = {} if classes is None else {"classes": classes}
        return predicted_config([parse_predictor(text, options, filters) for text in predict], path, overrides)
    if classes is not None:
        raise ConfigError("--classes names what a model predicts; say which one with --predict")
    return filtered_config(filters, path, overrides) if filters else load_config(path, overrides)


def _on_device(config: Config, device: str) -> Config:
    from semstab.backends import takes_option

    placed = [
        backend.model_copy(update={"options": backend.options | {"device": device}})
        if takes_option(backend.name, "device")
        else backend
        for backend in config.backends
    ]
    if placed == config.backends and not any(backend.options.get("device") == device for backend in placed):
        raise ConfigError(f"--device {device}: none of {', '.join(b.name for b in placed)} runs on a device")
    return config.model_copy(update={"backends": placed})


def _default_out() -> Path:
    from datetime import datetime

    return Path("runs") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")


# The command remedies.


def remedies(
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    predict: Models = None,
    classes: Classes = None,
    filters: Filters = None,
    frames: Frames = None,
    voxel_size: VoxelSize = None,
    taxonomy: Annotated[str | None, typer.Option(help="Taxonomy to fuse and judge in: a name or a file.")] = None,
    settings: DatasetSettings = None,
    options: DatasetOptions = None,
    trust_geometry: TrustGeometry = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="Study folder.")] = Path("studies/remedies"),
    report: Report = "on",
    jobs: Jobs = 1,
    quiet: Quiet = False,
) -> None:
    """What would steady this model: filters over it, how right, how late, at what price. Goes on where it was.

    --filter tries others than the usual ones; chains are written with a plus sign, ema-warped:0.6+threshold:0.5.
    """
    from semstab.predict.predictor import parse_predictor
    from semstab.remedies import remedies_config

    named: dict[str, Any] = {"scenes": scene, "voxel_size": voxel_size, "taxonomy": taxonomy}
    named["check_geometry"] = False if trust_geometry else None
    models = [parse_predictor(text, {} if classes is None else {"classes": classes}) for text in predict or []]
    content = chosen(named, with_options(settings, options), dataset, data, frames)
    config, left_out = remedies_config(
        models, backbone or [], filters or [], content, kept=out.absolute() / "predictions"
    )
    for line in left_out if not quiet else ():
        say(line)
    execute(config, out, executor_of(jobs, None), "off", report, quiet=quiet)
