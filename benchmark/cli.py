"""The command line `semstab-bench`. Heavy imports stand inside the commands: --help answers at once."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from semstab import __version__
from semstab.errors import ConfigError, SemstabError

if TYPE_CHECKING:
    from semstab.config import Config
    from semstab.pipeline import Observer
    from semstab.registry import Registry
    from semstab.results import RunResult

DISAGREE, INTERRUPTED = 3, 130


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
    config: Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with settings.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of scenes in posed_folder layout, or one scene.")] = None,
    dataset: Annotated[str | None, typer.Option(help="Dataset, as named by `semstab-bench list`.")] = None,
    scene: Annotated[list[str] | None, typer.Option("--scene", "-s", help="Scene; repeatable; or 'all'.")] = None,
    backbone: Annotated[
        list[str] | None, typer.Option("--backbone", "-m", help="Label source; repeatable; or 'all'; 'gt': truth.")
    ] = None,
    taxonomy: Annotated[str | None, typer.Option(help="Taxonomy to fuse in: a name or a YAML file.")] = None,
    voxel_size: Annotated[float | None, typer.Option(help="Edge of a voxel, metres.")] = None,
    pixel_stride: Annotated[int | None, typer.Option(help="Use every n-th pixel of each axis.")] = None,
    frames: Annotated[str | None, typer.Option(metavar="START:STOP:STRIDE", help="Frames, as a Python slice.")] = None,
    device: Annotated[str | None, typer.Option(help="CPU:0, or CUDA:0 for backends that take a device.")] = None,
    check: Annotated[str | None, typer.Option(help="Backend to check against, or 'none'.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of a simulated dataset.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.width=640."),
    ] = None,
    events: Annotated[bool | None, typer.Option("--events", help="Also write the log of observations.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Run folder; runs/TIME by default.")] = None,
    rerun: Annotated[
        str | None, typer.Option(metavar="FILE|off", help="Recording; RUN/recording.rrd by default.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Fuse every selected backbone with every selected backend, measure, compare. This is the default command."""
    from semstab.plan import load_config

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
        },
        settings or [],
    )
    _select_dataset(overrides, dataset, data, seed)
    if frames is not None:
        overrides["frames"] = _slice(frames)
    if check in ("none", "off"):
        overrides["check"] = None
    resolved = load_config(config, overrides)
    if device is not None:
        resolved = _on_device(resolved, device)
    result = _run(resolved, out or _default_out(), rerun, quiet)
    if not result.agrees:
        _say("error: the backends disagree; the agreement table and summary.json say where")
        raise typer.Exit(DISAGREE)


@app.command()
def view(run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or an .rrd file.")]) -> None:
    """Open a run's recording in the rerun viewer."""
    import subprocess

    recording = run / "recording.rrd" if run.is_dir() else run
    if not recording.exists():
        raise ConfigError(f"{recording}: there is no recording; run again without --rerun off")
    raise typer.Exit(subprocess.run([sys.executable, "-m", "rerun", str(recording)], check=False).returncode)


@app.command("list")
def list_() -> None:
    """Backends, datasets and taxonomies, each with 'ready' or what to install."""
    from rich.console import Console
    from rich.table import Table

    from semstab import backends, datasets
    from semstab.labels import LabelSpace, shipped_taxonomies

    table = Table(show_edge=False)
    for name in ("kind", "name", "", "what it is"):
        table.add_column(name)
    for registry in (backends.REGISTRY, datasets.REGISTRY):
        for name, entry in sorted(registry.entries().items()):
            table.add_row(registry.kind, name, _ready(registry, name), entry.summary)
    for name in shipped_taxonomies():
        space = LabelSpace.load(name)
        table.add_row("taxonomy", name, "[green]ready", f"K = {len(space)}: {', '.join(space.classes)}")
    Console().print(table)


def _ready(registry: Registry, name: str) -> str:
    """'ready', where what is behind the name really imports, or what to install."""
    from semstab.errors import MissingDependencyError

    try:
        registry.load(name)
    except MissingDependencyError as error:
        return f"[yellow]{error}"
    return "[green]ready"


def _run(config: Config, out: Path, rerun: str | None, quiet: bool) -> RunResult:
    from rich.console import Console

    from semstab import pipeline
    from semstab.terminal import ProgressBar, print_summary

    progress = ProgressBar(Console(stderr=True, quiet=quiet))
    observers: list[Observer] = [progress]
    recording = None if rerun == "off" else Path(rerun) if rerun is not None else out / "recording.rrd"
    closing: list[Any] = [progress]
    if recording is not None:
        from semstab.recording import Recording

        observers.append(watching := Recording(recording))
        closing.append(watching)
    try:
        result = pipeline.run(config, out=out, observers=observers, command=sys.argv)
    finally:
        for observer in closing:
            observer.close()
    if not quiet:
        console = Console()
        print_summary(result, console)
        console.print(f"run folder: {out}", soft_wrap=True)
        if recording is not None:
            console.print(f"recording: semstab-bench view {out if rerun is None else recording}", soft_wrap=True)
    return result


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
    # Threads that spin while they wait for the next frame take the time of those that decode it.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    app()
