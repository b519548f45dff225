"""The command line `semstab-bench`. Heavy imports stand inside the commands: --help answers at once."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from semstab import __version__
from semstab.errors import ConfigError, DataError, SemstabError
from semstab.process import settle

if TYPE_CHECKING:
    from semstab.config import Config
    from semstab.engine import Executor
    from semstab.engine.observer import Observer
    from semstab.recording import Recording
    from semstab.records import Result
    from semstab.registry import Registry

DISAGREE, INTERRUPTED = 3, 130

# --- Options that commands share --------------------------------------------------------------------------------------

ConfigFile = Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with settings.")]
DataFolder = Annotated[Path | None, typer.Option(help="Folder of scenes in posed_folder layout, or one scene.")]
DatasetSettings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.depth_scale=5000."),
]
DatasetName = Annotated[str | None, typer.Option(help="Dataset, as named by `semstab-bench list`.")]
Scenes = Annotated[list[str] | None, typer.Option("--scene", "-s", help="Scene; repeatable; or 'all'.")]
Backbones = Annotated[
    list[str] | None, typer.Option("--backbone", "-m", help="Label source; repeatable; or 'all'; 'gt': truth.")
]
VoxelSize = Annotated[float | None, typer.Option(help="Edge of a voxel, metres.")]
Frames = Annotated[str | None, typer.Option(metavar="START:STOP:STRIDE", help="Frames, as a Python slice.")]
TrustGeometry = Annotated[
    bool, typer.Option("--trust-geometry", help="Fuse also where depth and poses contradict each other.")
]
Rerun = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|spawn|connect|URL|serve|off",
        help="Recording: a file, OUT/recording.rrd by default; and a viewer to start, to connect to, or to serve.",
    ),
]
Report = Annotated[str, typer.Option(metavar="on|off", help="Write tables, figures and report.html.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Local processes.")]
Scheduler = Annotated[str | None, typer.Option(metavar="URL", help="Dask scheduler to run on, e.g. tcp://HOST:PORT.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]

# --- Commands ---------------------------------------------------------------------------------------------------------


class Group(TyperGroup):
    """Runs `run` where no command is named, shows its options in the help, and reports every error in one line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `run` in front of bare options."""
        own = {"--help", "-h", "--version", "--install-completion", "--show-completion"}
        if not args or (args[0].startswith("-") and args[0] not in own):
            args = ["run", *args]
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The group's own help, with the options of `run` in it."""
        own = self.params
        self.params = [*own, *self.commands["run"].params]
        try:
            super().format_help(ctx, formatter)
        finally:
            self.params = own

    def invoke(self, ctx: Any) -> Any:
        """The one place that catches: bad input is one line and exit code 2."""
        try:
            return super().invoke(ctx)
        except SemstabError as error:
            _say(f"error: {error}")
            raise typer.Exit(error.exit_code) from error
        except KeyboardInterrupt as error:
            _say("interrupted; what was finished is kept, and the same command with the same --out goes on from there")
            raise typer.Exit(INTERRUPTED) from error
        except OSError as error:
            _say(f"error: {error.filename or 'input or output'}: {error.strerror or error}")
            raise typer.Exit(2) from error


app = typer.Typer(
    cls=Group,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="How stable are a segmentation backbone's predictions at the same physical place?\n\n"
    "Fuses label maps by depth and pose into metric voxels and measures VSS, SBD, OP and entropy. Without a command it "
    "runs; with no option either, on the built-in city.",
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"semstab {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")
    ] = False,
) -> None:
    """Options that stand before the command."""


@app.command("run")
def run(
    backend: Annotated[list[str] | None, typer.Option("--backend", "-b", help="Fusion backend; repeatable.")] = None,
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    taxonomy: Annotated[str | None, typer.Option(help="Taxonomy to fuse in: a name or a YAML file.")] = None,
    voxel_size: VoxelSize = None,
    pixel_stride: Annotated[int | None, typer.Option(help="Use every n-th pixel of each axis.")] = None,
    frames: Frames = None,
    device: Annotated[str | None, typer.Option(help="CPU:0, or CUDA:0 for backends that take a device.")] = None,
    check: Annotated[str | None, typer.Option(help="Backend to check against, or 'none'.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of a simulated dataset.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.width=640."),
    ] = None,
    trust_geometry: TrustGeometry = False,
    events: Annotated[bool | None, typer.Option("--events", help="Also write the log of observations.")] = None,
    statistics: Annotated[
        bool | None,
        typer.Option("--statistics", help="Also test drift, judge by ground truth, compare backbones; takes longer."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder; runs/TIME by default.")] = None,
    rerun: Rerun = None,
    report: Report = "on",
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    predict: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[,KEY=VALUE...]", help="Model that makes the labels, nothing on disk; repeatable."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Fuse every selected backbone with every selected backend, measure, compare. This is the default command."""
    overrides = _overrides(
        {
            "backends": backend,
            "scenes": scene,
            "backbones": backbone,
            "taxonomy": taxonomy,
            "voxel_size": voxel_size,
            "pixel_stride": pixel_stride,
            "check": check,
            "events": events,
            "statistics": statistics,
            "check_geometry": False if trust_geometry else None,
        },
        settings or [],
    )
    _select_dataset(overrides, dataset, data, seed)
    if frames is not None:
        overrides["frames"] = _slice(frames)
    if check in ("none", "off"):
        overrides["check"] = None
    resolved = _load(config, overrides, predict or [])
    if device is not None:
        resolved = _on_device(resolved, device)
    _execute(resolved, out or _default_out(), _executor(jobs, scheduler), rerun, report, quiet)


@app.command()
def study(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Study file, or a shipped study: see `list`.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Study folder; studies/NAME by default.")] = None,
    jobs: Jobs = 1,
    scheduler: Scheduler = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="PART", help="A sweep, shared_taxonomy or backends; repeatable.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. sweeps.voxel_size=[0.1,0.4]."),
    ] = None,
    rerun: Rerun = "off",
    report: Report = "on",
    trust_geometry: TrustGeometry = False,
    quiet: Quiet = False,
) -> None:
    """Everything that the paper reports: scenes x backbones x backends x variations. Goes on where it was."""
    from semstab.settings import load_study

    config = load_study(file, _overrides({"check_geometry": False if trust_geometry else None}, settings or []))
    if only is not None:
        config = config.only(only)
    _execute(config, out or Path("studies") / config.name, _executor(jobs, scheduler), rerun, report, quiet)


@app.command()
def predict(
    backbone: Annotated[str, typer.Option("--backbone", "-m", help="Model, as named by `semstab-bench list`.")],
    images: Annotated[str | None, typer.Option(metavar="GLOB", help="Image files, quoted; or choose scenes.")] = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    frames: Frames = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder above labels/ and scores/; the scene's own by default.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="What the predictions are called; the model's name here.")] = None,
    model: Annotated[str | None, typer.Option(help="Folder that save_pretrained wrote, or a hub id.")] = None,
    revision: Annotated[str | None, typer.Option(help="Branch, tag or commit on the hub.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1, mps.")] = None,
    dtype: Annotated[str | None, typer.Option(help="float32, bfloat16 or float16; float32 by default.")] = None,
    image_size: Annotated[
        str | None, typer.Option(metavar="N|HxW", help="Shorter side, or height and width, that the model sees.")
    ] = None,
    batch: Annotated[int, typer.Option(min=1, help="Images at a time.")] = 1,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the model on a CPU.")] = None,
    taxonomy: Annotated[str | None, typer.Option(help="Give labels in this taxonomy: a name or a YAML file.")] = None,
    mapping: Annotated[str | None, typer.Option(help="strict, or lenient: near classes count as well.")] = None,
    scores: Annotated[bool, typer.Option("--scores", help="Also keep soft scores.")] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any option of the model, or dataset.KEY=VALUE."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace predictions of other settings.")] = False,
    quiet: Quiet = False,
) -> None:
    """Run a segmentation model over images; label maps go where `run` and `study` read them. Goes on where it was."""
    from semstab.predict import command
    from semstab.settings import load_config, resolve

    named = {"model": model, "revision": revision, "device": device, "dtype": dtype, "threads": threads}
    size = None if image_size is None else _image_size(image_size)
    options = _overrides({**named, "image_size": size}, settings or [])
    chosen: dict[str, Any] = {}
    _select_dataset(chosen, dataset, data, None)
    of_dataset = options.pop("dataset", {})
    if chosen:
        chosen["dataset"].setdefault("options", {}).update(of_dataset)
    said = {"name": name, "taxonomy": taxonomy, "mapping": mapping, "scores": scores}
    command.run(
        predictor={"backbone": backbone, **{key: value for key, value in said.items() if value is not None}},
        options=options,
        images=images,
        dataset=resolve(load_config(None, chosen)).dataset if chosen else None,
        scenes=None if scene == ["all"] else scene,
        frames={} if frames is None else _slice(frames),
        out=out,
        batch=batch,
        overwrite=overwrite,
        quiet=quiet,
    )


@app.command("check")
def check_(
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    voxel_size: VoxelSize = None,
    frames: Frames = None,
    settings: DatasetSettings = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers.")] = None,
    quiet: Quiet = False,
) -> None:
    """Does this dataset make sense: poses, depth, units, labels? Exit code 0 where it does, 2 where not."""
    named = {"scenes": scene, "backbones": backbone, "voxel_size": voxel_size}
    problems = _check(_selection(config, named, settings, dataset, data, frames), json_file, quiet)
    if problems:
        first, *more = problems
        raise DataError(f"{first}" + (f" (and {len(more)} more, see above)" if more else ""))


@app.command()
def convert(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder in which each scene becomes a folder.")],
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    frames: Frames = None,
    settings: DatasetSettings = None,
    depth_error: Annotated[
        float, typer.Option(min=0, metavar="METRES", help="Store depth in 16 bits where no pixel is off by more.")
    ] = 0.0,
    quiet: Quiet = False,
) -> None:
    """Write any dataset as posed folders. Goes on where it was."""
    _convert(
        _selection(config, {"scenes": scene, "backbones": backbone}, settings, dataset, data, frames),
        out,
        depth_error,
        quiet,
    )


@app.command()
def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or an .rrd file.")]) -> None:
    """Open a run's recording in the rerun viewer."""
    import subprocess

    from semstab.recording.target import viewer_command

    recording = run / "recording.rrd" if run.is_dir() else run
    if not recording.exists():
        raise ConfigError(f"{recording}: there is no recording; run again without --rerun off")
    raise typer.Exit(subprocess.run([*viewer_command(), str(recording)], check=False).returncode)


@app.command("list")
def list_() -> None:
    """Backends, datasets, backbones, taxonomies and studies, each with 'ready' or what to install."""
    from rich.console import Console
    from rich.table import Table

    from semstab import backbones, backends, datasets
    from semstab.labels import LabelSpace, shipped_taxonomies
    from semstab.settings import load_study, shipped_studies

    table = Table(show_edge=False)
    for name in ("kind", "name", "", "what it is"):
        table.add_column(name)
    for registry in (backends.REGISTRY, datasets.REGISTRY, backbones.REGISTRY):
        for name, entry in sorted(registry.entries().items()):
            table.add_row(registry.kind, name, _ready(registry, name), entry.summary)
    for name in shipped_taxonomies():
        space = LabelSpace.load(name)
        table.add_row("taxonomy", name, "[green]ready", f"K = {len(space)}: {', '.join(space.classes)}")
    for name in shipped_studies():
        table.add_row("study", name, "[green]ready", load_study(name).description)
    Console().print(table)


def _ready(registry: Registry, name: str) -> str:
    """'ready', where what is behind the name really imports, or what to install."""
    from semstab.errors import MissingDependencyError

    try:
        registry.load(name)
    except MissingDependencyError as error:
        return f"[yellow]{error}"
    return "[green]ready"


def _executor(jobs: int, scheduler: str | None) -> Executor:
    import logging

    from semstab.engine import DaskCluster, InProcess, LocalProcesses

    if scheduler is None:
        return LocalProcesses(jobs) if jobs > 1 else InProcess()
    if jobs > 1:
        raise ConfigError("--jobs and --scheduler: the scheduler's workers do the work; leave --jobs out")
    cluster = DaskCluster(scheduler)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what becomes of a unit is said in one line
    return cluster


def _execute(config: Config, out: Path, executor: Executor, rerun: str | None, report: str, quiet: bool) -> None:
    """Run it, say what was found, and end with the exit code that this calls for."""
    from rich.console import Console

    from semstab.api import run_study
    from semstab.progress import ProgressBar, failure_lines
    from semstab.terminal import print_summary

    if report not in ("on", "off"):
        raise ConfigError(f"--report {report}: write on or off")
    recording = _recording(rerun, out)
    observers: list[Observer] = [ProgressBar(Console(stderr=True, quiet=quiet)), *recording]
    gc.freeze()  # modules stay: looking for garbage among them takes half a second of a short run
    try:
        result = run_study(config, out, executor=executor, observers=observers, command=sys.argv, report=report == "on")
        for line in failure_lines(result):
            _say(f"error: {line}")
        if not quiet:
            console = Console()
            if result.select():
                print_summary(result, console)
            for line in _where(result, out, recording, report):
                console.print(line, soft_wrap=True, markup=False, highlight=False)
        for each in recording:
            each.serve()
    finally:
        for observer in observers:
            observer.close()
    if result.failures:
        raise typer.Exit(2)
    if not result.agrees:
        _say(f"error: the backends disagree; the agreement in {out / 'summary.json'} says where")
        raise typer.Exit(DISAGREE)


def _recording(rerun: str | None, out: Path) -> list[Recording]:
    if rerun == "off":
        return []
    from semstab.recording import Recording, Target

    return [Recording(Target.parse(rerun, out / "recording.rrd"), run=out)]


def _where(result: Result, out: Path, recording: list[Recording], report: str) -> Iterator[str]:
    """Where to find what."""
    yield f"folder: {out}"
    if report == "on" and result.select():
        yield f"report: {out / 'report.html'}"
    for each in recording:
        file = each.target.file
        yield f"recording: semstab-bench view {out if file == out / 'recording.rrd' else file}"


def _load(path: Path | None, overrides: dict[str, Any], predict: list[str]) -> Config:
    """The configuration; with models whose predictions take the place of the dataset's labels."""
    if not predict:
        from semstab.settings import load_config

        return load_config(path, overrides)
    from semstab.predict.predictor import parse_predictor
    from semstab.settings import predicted_config

    return predicted_config([parse_predictor(text) for text in predict], path, overrides)


def _image_size(text: str) -> int | list[int]:
    """'512' as a number, '512x896' as height and width."""
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(side.isdigit() for side in sides):
        raise ConfigError(f"--image-size {text}: write the shorter side, for example 512, or HEIGHTxWIDTH")
    return int(sides[0]) if len(sides) == 1 else [int(side) for side in sides]


def _check(config: Config, json_file: Path | None, quiet: bool) -> list[str]:
    """Check and print scene by scene; what is wrong, one line each."""
    from rich.console import Console

    from semstab.check import SCHEMA, check
    from semstab.check.display import print_check
    from semstab.files import write_json

    console, found = Console(quiet=quiet), []
    for checked in check(config):
        print_check(checked, console)
        found.append(checked)
    if json_file is not None:
        write_json(json_file, {"schema": SCHEMA, "scenes": [checked.to_dict() for checked in found]})
    return [f"{checked.scene}: {problem}" for checked in found for problem in checked.problems]


def _convert(config: Config, out: Path, depth_error: float, quiet: bool) -> None:
    from rich.console import Console

    from semstab.convert import convert
    from semstab.convert.display import FrameBar, print_converted

    console = Console(quiet=quiet)
    with FrameBar(Console(stderr=True, quiet=quiet)) as bar:
        for converted in convert(config, out, depth_error=depth_error, progress=bar):
            print_converted(converted, console)


def _selection(
    file: Path | None,
    named: dict[str, Any],
    settings: list[str] | None,
    dataset: str | None,
    data: Path | None,
    frames: str | None,
) -> Config:
    """The resolved configuration of a file and options that select data."""
    from semstab.settings import load_config, resolve

    overrides = _overrides(named, settings or [])
    _select_dataset(overrides, dataset, data, None)
    if frames is not None:
        overrides["frames"] = _slice(frames)
    return resolve(load_config(file, overrides))


def _overrides(named: dict[str, Any], settings: list[str]) -> dict[str, Any]:
    """The settings given as options, those of --set last."""
    from semstab.files import parse_yaml

    content = {key: None if value == ["all"] else value for key, value in named.items() if value is not None}
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: write KEY=VALUE")
        *groups, key = path.split(".")
        inner: Any = content
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"--set {setting}: '{group}' is given as an option too; use one of the two")
        inner[key] = parse_yaml(text, f"--set {setting}")
    return content


def _select_dataset(overrides: dict[str, Any], name: str | None, data: Path | None, seed: int | None) -> None:
    if data is not None and not data.is_dir():
        raise ConfigError(f"{data}: there is no such folder")
    given = {"root": str(data)} if data is not None else {}
    options = given | ({"seed": seed} if seed is not None else {})
    name = name or ("posed_folder" if data is not None else None)
    if name is None and not options:
        return
    group = overrides.setdefault("dataset", {})
    if name is not None:
        group["name"] = name
    group["options"] = group.get("options", {}) | options


def _slice(text: str) -> dict[str, int]:
    """'START:STOP:STRIDE' as settings; each part may be empty."""
    parts = text.split(":")
    if len(parts) > 3 or not all(part.strip().isdigit() for part in parts if part):
        raise ConfigError(f"--frames {text}: write START:STOP:STRIDE, for example 0:80:4 or ::4")
    if len(parts) == 1:
        raise ConfigError(
            f"--frames {text}: write {text}:{int(text or 0) + 1} for one frame, :{text} for the first {text}"
        )
    return {key: int(part) for key, part in zip(("start", "stop", "stride"), parts, strict=False) if part}


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


def _say(text: str) -> None:
    typer.echo(text, err=True)


def main() -> None:
    """Entry point of the console script."""
    settle()
    app()
