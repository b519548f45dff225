"""Define the options that commands share, one by one and in groups, and build settings from them."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import operator
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from semstab.errors import ConfigError, SemstabError, sanitize

# The shell completes names of backends, datasets, models, taxonomies, studies, scenes and label sources.

Complete = Callable[[Any, str], list[str]]


def _beginning(names: Callable[[Any], Iterable[str]]) -> Complete:
    def complete(ctx: Any, incomplete: str) -> list[str]:
        try:
            return sorted(name for name in names(ctx) if name.startswith(incomplete))
        except (SemstabError, OSError):
            return []  # the command reports the error when it runs

    return complete


def _listed(module: str, function: str = "REGISTRY.entries") -> Complete:
    """Complete the names that a function returns; its module is imported when the shell asks for them."""
    return _beginning(lambda _: operator.attrgetter(function)(importlib.import_module(f"semstab.{module}"))())


def _opened(ctx: Any) -> Any:
    """Open the dataset that the options so far select."""
    from semstab.configure import load_config, resolve
    from semstab.datasets import open_dataset

    content: dict[str, Any] = {}
    select_dataset(content, ctx.params.get("dataset"), ctx.params.get("data"), None)
    dataset = resolve(load_config(ctx.params.get("config"), content)).dataset
    return open_dataset(dataset.name, dataset.options)


def _label_sources(ctx: Any) -> Iterable[str]:
    opened = _opened(ctx)
    return [*(name for scene in opened.scenes[:1] for name in opened.scene(scene).models), "gt", "all"]


backends, datasets, predictors = _listed("backends"), _listed("datasets"), _listed("models")
filters, rules = _listed("predict.filters"), _listed("backends.rules", "RULES.keys")
taxonomies, studies = _listed("data.labels", "shipped_taxonomies"), _listed("settings", "shipped_studies")
benchmarks = _listed("settings", "shipped_benchmarks")
scenes, label_sources = _beginning(lambda ctx: [*_opened(ctx).scenes, "all"]), _beginning(_label_sources)


SETTINGS, LABELS, CHECKS, MACHINE = "Settings", "Labels", "Checks", "Machine"
"""The panels of the help, below the options that most people need."""


def own_defaults() -> Path | None:
    """Return the file of settings that a user wants everywhere, or None without such a file.

    It is SEMSTAB_CONFIG, if set, else semstab/config.yaml in the user's folder of configurations.
    """
    stated = os.environ.get("SEMSTAB_CONFIG")
    if stated is not None:
        return Path(stated) if stated else None
    path = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "semstab/config.yaml"
    return path if path.is_file() else None


def _or_own_defaults(ctx: typer.Context, value: Path | None) -> Path | None:
    if value is not None or ctx.resilient_parsing or (path := own_defaults()) is None:
        return value
    if not ctx.params.get("quiet"):
        say(f"settings of {path}")
    return path


# fmt: off
ConfigFile = Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with settings.",
    show_default="yours, see `list`", callback=_or_own_defaults, rich_help_panel=SETTINGS)]
DataFolder = Annotated[Path | None, typer.Option(help="Folder of scenes, or one scene, or a bag; the format is found.")]
DatasetOptions = Annotated[list[str] | None, typer.Option(
    "--option", metavar="KEY=VALUE", help="Option of the dataset, short for --set dataset.options.KEY=VALUE.",
    rich_help_panel=SETTINGS)]
DatasetSettings = Annotated[list[str] | None, typer.Option(
    "--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.depth_scale=5000.", rich_help_panel=SETTINGS)]
DatasetName = Annotated[str | None, typer.Option(
    help="Dataset: a name of `semstab-bench list`, or FILE.py:NAME.", show_default="format of --data, else city",
    autocompletion=datasets)]
Scenes = Annotated[list[str] | None, typer.Option(
    "--scene", "-s", help="Scene; repeatable; or 'all'.", show_default="all", autocompletion=scenes)]
Models = Annotated[list[str] | None, typer.Option(
    "--model", "-m", help="Label source; repeatable; or 'all'; 'gt': truth.", show_default="all",
    autocompletion=label_sources)]
Predicted = Annotated[list[str] | None, typer.Option(
    "--predict", metavar="NAME[,KEY=VALUE...]",
    help="Model that makes the labels in memory: a name of `list`, FILE.py:NAME; repeatable.")]
Classes = Annotated[str | None, typer.Option(
    metavar="A,B,C|FILE", help="Names of the classes of a --predict model by id, if it does not contain them.",
    rich_help_panel=LABELS)]
Filters = Annotated[list[str] | None, typer.Option(
    "--filter", metavar="NAME:NUMBER", autocompletion=filters,
    help="Filter over the labels: ema:0.6, vote:5, ... (`list`); repeatable, in this order.", rich_help_panel=LABELS)]
VoxelSize = Annotated[float | None, typer.Option(
    help="Edge of a voxel, metres.", show_default="as `check` suggests; city: 0.2")]
Frames = Annotated[str | None, typer.Option(
    metavar="START:STOP:STRIDE", help="Frames, as a Python slice.", show_default="all")]
TrustGeometry = Annotated[bool, typer.Option(
    "--no-geometry-check", help="Fuse even if depth and poses contradict each other.", rich_help_panel=CHECKS)]
Rerun = Annotated[str | None, typer.Option(
    metavar="FILE|spawn|connect|URL|serve|off", show_default="OUT/recording.rrd; of a study off",
    help="Recording: a file, and a viewer to start, to connect to, or to serve.")]
Report = Annotated[str, typer.Option(metavar="on|off", help="Write tables and report.html.",
    rich_help_panel=SETTINGS)]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Local processes.")]
Scheduler = Annotated[str | None, typer.Option(
    metavar="URL", help="Dask scheduler to run on, e.g. tcp://HOST:PORT.", show_default="none",
    rich_help_panel=MACHINE)]
TileSize = Annotated[str | None, typer.Option(
    metavar="N|off", show_default="if a map would not fit",
    help="Fuse maps tile by tile, N voxels wide (a power of 2); off: refuse maps that do not fit in memory.",
    rich_help_panel=MACHINE)]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Also print every table.", rich_help_panel=SETTINGS)]
ScopeOption = Annotated[str | None, typer.Option(
    "--scope", metavar="these-frames|this-scene|other-scenes", show_default="this-scene",
    help="What intervals are for: these very frames, this scene flown again, or other scenes like it.",
    rich_help_panel=SETTINGS)]
OwnCode = Annotated[list[str] | None, typer.Option(
    "--code", metavar="FILE.py:NAME", rich_help_panel=SETTINGS,
    help="Your model or backend, which the run's settings name: only code named here runs; repeatable.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the results of another run in --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
# fmt: on


# Groups of options: a command takes a group as one argument, and the command line has each of its fields as an option.


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each argument of a command that is a group, a dataclass of options, by the options of its fields.

    The default of an argument, a group itself, gives the defaults of these options.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        hint, kind = hints[parameter.name], inspect.Parameter.KEYWORD_ONLY
        if not dataclasses.is_dataclass(hint):
            options.append(parameter.replace(annotation=hint, kind=kind))
            continue
        groups[parameter.name] = hint
        default, of_fields = parameter.default, get_type_hints(hint, include_extras=True)
        for field in dataclasses.fields(hint):
            value = field.default if default is inspect.Parameter.empty else getattr(default, field.name)
            options.append(inspect.Parameter(field.name, kind, default=value, annotation=of_fields[field.name]))

    @functools.wraps(command)
    def flat(**values: Any) -> None:
        for name, group in groups.items():
            values[name] = group(**{field.name: values.pop(field.name) for field in dataclasses.fields(group)})
        command(**values)

    flat.__annotations__ = {option.name: option.annotation for option in options}
    flat.__dict__["__signature__"] = inspect.Signature(options)
    return flat


# fmt: off
@dataclass(frozen=True)
class Source:
    """The scenes and label maps that a command reads."""

    data: DataFolder = None
    dataset: DatasetName = None
    scene: Scenes = None
    model: Models = None


Vocabularies = Annotated[list[Path] | None, typer.Option(
    metavar="FILE[,CHANGE]", help="Label the features of models by the likeliest name of a vocabulary, with names"
    " changed: without=NAME, without=each (one after the other), add=NAME, rename=OLD:NEW; repeatable.",
    show_default="none", rich_help_panel=SETTINGS)]


@dataclass(frozen=True)
class PredictionOptions:
    """A model that makes the labels in memory, and filters over the labels."""

    predict: Predicted = None
    classes: Classes = None
    filters: Filters = None
    vocabulary: Vocabularies = None

    @property
    def model_options(self) -> dict[str, Any]:
        """The options of the model that the command line sets."""
        return {} if self.classes is None else {"classes": self.classes}


@dataclass(frozen=True)
class Execution:
    """How a configuration is run: the processes, the recording, and what is written."""

    overwrite: Overwrite = False
    rerun: Rerun = None
    report: Report = "on"
    jobs: Jobs = 1
    scheduler: Scheduler = None


UNRECORDED = Execution(rerun="off")


@dataclass(frozen=True)
class Measurement:
    """The settings of a run that options set: what is fused and measured."""

    taxonomy: Annotated[str | None, typer.Option(
        help="Taxonomy to fuse in: a name or a YAML file.", show_default="the dataset's; city: uavid7",
        autocompletion=taxonomies, rich_help_panel=SETTINGS)] = None
    distances: Annotated[str | None, typer.Option(
        metavar="FILE", help="Distances between classes: a table .csv or .npy, or embeddings .npy.",
        show_default="of the taxonomy's groups", rich_help_panel=SETTINGS)] = None
    voxel_size: VoxelSize = None
    pixel_stride: Annotated[int | None, typer.Option(
        help="Use every n-th pixel of each axis.", show_default="1", rich_help_panel=SETTINGS)] = None
    top_k: Annotated[int | None, typer.Option(
        "--top-k", help="Fuse only the K largest scores of each pixel.", show_default="all",
        rich_help_panel=SETTINGS)] = None
    frames: Frames = None
    device: Annotated[str | None, typer.Option(
        help="CPU:0, or CUDA:0 for backends that take a device.", show_default="the backend's own",
        rich_help_panel=MACHINE)] = None
    check: Annotated[str | None, typer.Option(
        metavar="sample|BACKEND|none", show_default="sample",
        help="Check voxel by voxel against the numpy reference on a random sample, or against a backend on all.",
        rich_help_panel=CHECKS)] = None
    seed: Annotated[int | None, typer.Option(
        help="Seed of a simulated dataset.", show_default="0", rich_help_panel=SETTINGS)] = None
    settings: Annotated[list[str] | None, typer.Option(
        "--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.width=640.",
        rich_help_panel=SETTINGS)] = None
    options: DatasetOptions = None
    trust_geometry: TrustGeometry = False
    events: Annotated[bool | None, typer.Option(
        "--events", help="Also write each frame's evidence in each voxel.", rich_help_panel=SETTINGS)] = None
    statistics: Annotated[bool | None, typer.Option(
        "--statistics",
        help="Also measure drift, flips and how much of the disagreement geometry causes; slower.")] = None
    no_truth: Annotated[bool, typer.Option(
        "--no-truth", metavar="", help="Do not compare with the ground truth of the scene.",
        rich_help_panel=CHECKS)] = False
    moving: Annotated[str | None, typer.Option(
        "--moving", metavar="tell|keep", show_default="tell",
        help="Leave spots that moved out of the verdict, and tell which they are; or keep them in it.",
        rich_help_panel=SETTINGS)] = None
    video_measures: Annotated[str | None, typer.Option(
        "--video-measures", metavar="depth|dis", show_default="none",
        help="Also VC and TC as papers report them, by depth and pose, or by optical flow between images.")] = None
    scope: ScopeOption = None

    def content(self, source: Source, backends: list[str] | None, tile_size: str | None) -> dict[str, Any]:
        """Return the settings of a run by their names in a file of settings."""
        run_settings = {
            "backends": backends, "scenes": source.scene, "models": source.model, "taxonomy": self.taxonomy,
            "distances": self.distances, "voxel_size": self.voxel_size, "pixel_stride": self.pixel_stride,
            "top_k": self.top_k, "moving": self.moving,
            "check": self.check, "events": self.events, "statistics": self.statistics,
            "video_measures": self.video_measures, "scope": self.scope,
            "check_geometry": False if self.trust_geometry else None,
            "truth": False if self.no_truth else None,
            "tile_size": int(tile_size) if tile_size is not None and tile_size.isdigit() else tile_size,
        }
        content = chosen(
            run_settings, self.settings, self.options, source.dataset, source.data, self.frames, self.seed
        )
        if self.check in ("none", "off"):
            content["check"] = None
        return content
# fmt: on


def chosen(
    values: dict[str, Any],
    settings: list[str] | None,
    options: list[str] | None,
    dataset: str | None = None,
    data: Path | None = None,
    frames: str | None = None,
    seed: int | None = None,
) -> dict[str, Any]:
    """Return options as settings; --set (`settings`) and --option (`options`) have priority."""
    from semstab.config.groups import in_full
    from semstab.core.files import parse_yaml

    content = {key: None if value == ["all"] else value for key, value in values.items() if value is not None}
    for option in options or ():
        if "=" not in option:
            raise ConfigError(f"--option {option}: write KEY=VALUE")
    for setting in (*(settings or ()), *(f"dataset.options.{option}" for option in options or ())):
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: write KEY=VALUE")
        *groups, key = path.split(".")
        inner: Any = content
        for group in groups:
            inner = inner.setdefault(group, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"--set {setting}: '{group}' is given as an option too; use one of the two")
        try:
            inner[key] = parse_yaml(text, f"--set {setting}")
        except ConfigError:
            if "{name}" not in text and "{model}" not in text:
                raise
            inner[key] = text  # a template of paths, whose braces are no YAML
    select_dataset(content, dataset, data, seed)
    _require_settings(settings or (), content)
    if frames is not None:
        try:
            content["frames"] = in_full(frames)
        except ConfigError as error:
            raise ConfigError(f"--frames {frames}: {error}") from error
    return content


def _require_settings(settings: list[str] | tuple[()], content: dict[str, Any]) -> None:
    """Raise ConfigError where --set names an option of the dataset instead of a setting."""
    from semstab.config import Config
    from semstab.datasets import options_model

    dataset = content.get("dataset")
    name = dataset.get("name") if isinstance(dataset, dict) else None
    for setting in settings:
        key, _, text = setting.partition("=")
        if name is not None and key not in Config.model_fields and key in options_model(str(name)).model_fields:
            raise ConfigError(f"--set {setting}: {key} is an option of the dataset; write --option {key}={text}")


def select_dataset(content: dict[str, Any], name: str | None, data: Path | None, seed: int | None) -> None:
    """Put the dataset that options select into the settings."""
    if data is not None and not data.exists():
        raise ConfigError(f"{data}: there is no such {'file' if data.suffix else 'folder'}")
    options = {"root": None if data is None else str(data), "seed": seed}
    options = {key: value for key, value in options.items() if value is not None}
    stated = content.get("dataset")
    if name is None and data is not None and not (isinstance(stated, dict) and "name" in stated):
        name = _recognised(data)
    if name is None and not options:
        return
    group = content.setdefault("dataset", {})
    if not isinstance(group, dict) or not isinstance(group.get("options", {}), dict):
        raise ConfigError("--set dataset: other options also set the dataset; write dataset.options.KEY=VALUE")
    if name is not None:
        group["name"] = name
    group["options"] = group.get("options", {}) | options


def _recognised(data: Path) -> str:
    from semstab.datasets import recognise

    name, why = recognise(data)
    if name != "posed_folder":
        say(f"{data}: read as {name} ({why})")
    return name


def say(text: str) -> None:
    """Print a line on standard error, apart from the results."""
    typer.echo(sanitize(text), err=True)


def print_lines(lines: Iterable[str], *, quiet: bool = False) -> None:
    """Print results as they are: no markup, no colours, no line breaks."""
    from semstab.core.console import Console

    console = Console(quiet=quiet)
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
