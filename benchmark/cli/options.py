"""Options that commands share, and what they say as settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semstab.errors import ConfigError, SemstabError, told

if TYPE_CHECKING:
    from semstab.config import Config


# What the shell completes: names of backends, datasets, backbones, taxonomies, studies, scenes and label sources.

Complete = Callable[[Any, str], list[str]]


def _beginning(names: Callable[[Any], Iterable[str]]) -> Complete:
    def complete(ctx: Any, incomplete: str) -> list[str]:
        try:
            return sorted(name for name in names(ctx) if name.startswith(incomplete))
        except (SemstabError, OSError):
            return []  # what is wrong is said when the command runs

    return complete


def _backends(_: Any) -> Iterable[str]:
    from semstab import backends

    return backends.REGISTRY.entries()


def _datasets(_: Any) -> Iterable[str]:
    from semstab import datasets

    return datasets.REGISTRY.entries()


def _models(_: Any) -> Iterable[str]:
    from semstab import backbones

    return backbones.REGISTRY.entries()


def _filters(_: Any) -> Iterable[str]:
    from semstab.predict.filters import REGISTRY

    return REGISTRY.entries()


def _taxonomies(_: Any) -> Iterable[str]:
    from semstab.model.labels import shipped_taxonomies

    return shipped_taxonomies()


def _studies(_: Any) -> Iterable[str]:
    from semstab.settings import shipped_studies

    return shipped_studies()


def _opened(ctx: Any) -> Any:
    """The dataset that the options before select."""
    from semstab.datasets import open_dataset
    from semstab.settings import load_config, resolve

    data, name = ctx.params.get("data"), ctx.params.get("dataset")
    dataset = {"name": name or ("posed_folder" if data else None), "options": {"root": str(data)} if data else None}
    said = {key: value for key, value in dataset.items() if value is not None}
    config = resolve(load_config(ctx.params.get("config"), {"dataset": said} if said else {}))
    return open_dataset(config.dataset.name, config.dataset.options)


def _scenes(ctx: Any) -> Iterable[str]:
    return [*_opened(ctx).scenes, "all"]


def _sources(ctx: Any) -> Iterable[str]:
    opened = _opened(ctx)
    scenes = [opened.scene(name) for name in opened.scenes[:1]]
    return [*(name for scene in scenes for name in scene.backbones), "gt", "all"]


backends, datasets, models = _beginning(_backends), _beginning(_datasets), _beginning(_models)
filters = _beginning(_filters)
taxonomies, studies = _beginning(_taxonomies), _beginning(_studies)
scenes, label_sources = _beginning(_scenes), _beginning(_sources)


ConfigFile = Annotated[Path | None, typer.Option("--config", "-c", help="YAML file with settings.")]
DataFolder = Annotated[Path | None, typer.Option(help="Folder of scenes in posed_folder layout, or one scene.")]
DatasetOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option", metavar="KEY=VALUE", help="Option of the dataset, short for --set dataset.options.KEY=VALUE."
    ),
]
DatasetSettings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Any setting, e.g. dataset.options.depth_scale=5000."),
]
DatasetName = Annotated[
    str | None,
    typer.Option(
        help="Dataset, as named by `semstab-bench list`.",
        show_default="posed_folder with --data, else city",
        autocompletion=datasets,
    ),
]
Scenes = Annotated[
    list[str] | None,
    typer.Option("--scene", "-s", help="Scene; repeatable; or 'all'.", show_default="all", autocompletion=scenes),
]
Backbones = Annotated[
    list[str] | None,
    typer.Option(
        "--backbone",
        "-m",
        help="Label source; repeatable; or 'all'; 'gt': truth.",
        show_default="all",
        autocompletion=label_sources,
    ),
]
Classes = Annotated[
    str | None,
    typer.Option(metavar="A,B,C|FILE", help="Names of the model's classes by id, where it does not say them."),
]
Filters = Annotated[
    list[str] | None,
    typer.Option(
        "--filter",
        metavar="NAME:NUMBER",
        help="What steadies the labels: ema:0.6, vote:5, ... (`list`); repeatable, in this order.",
        autocompletion=filters,
    ),
]
VoxelSize = Annotated[
    float | None, typer.Option(help="Edge of a voxel, metres.", show_default="what `check` suggests; city: 0.2")
]
Frames = Annotated[
    str | None, typer.Option(metavar="START:STOP:STRIDE", help="Frames, as a Python slice.", show_default="all")
]
TrustGeometry = Annotated[
    bool, typer.Option("--no-geometry-check", help="Fuse also where depth and poses contradict each other.")
]
Rerun = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|spawn|connect|URL|serve|off",
        help="Recording: a file, and a viewer to start, to connect to, or to serve.",
        show_default="OUT/recording.rrd; of a study off",
    ),
]
Report = Annotated[str, typer.Option(metavar="on|off", help="Write tables, figures and report.html.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Local processes.")]
Scheduler = Annotated[
    str | None, typer.Option(metavar="URL", help="Dask scheduler to run on, e.g. tcp://HOST:PORT.", show_default="none")
]
TileSize = Annotated[
    str | None,
    typer.Option(
        metavar="N|off",
        help="Fuse maps tile by tile, N voxels wide (a power of 2); off: refuse what does not fit in memory.",
        show_default="where a map would not fit",
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Also print every table.")]
ScopeOption = Annotated[
    str | None,
    typer.Option(
        "--scope",
        metavar="these-frames|this-scene|other-scenes",
        help="What intervals are for: these very frames, this scene flown again, or other scenes like it.",
        show_default="this-scene",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


def selection(
    file: Path | None,
    named: dict[str, Any],
    settings: list[str] | None,
    dataset: str | None,
    data: Path | None,
    frames: str | None,
) -> Config:
    """The resolved configuration of a file and options that select data."""
    from semstab.settings import load_config, resolve

    return resolve(load_config(file, chosen(named, settings, dataset, data, frames)))


def chosen(
    named: dict[str, Any],
    settings: list[str] | None,
    dataset: str | None,
    data: Path | None,
    frames: str | None,
    seed: int | None = None,
) -> dict[str, Any]:
    """What options say, as settings."""
    content = overrides(named, settings or [])
    select_dataset(content, dataset, data, seed)
    return content if frames is None else content | {"frames": slice_of(frames)}


def with_options(settings: list[str] | None, options: list[str] | None) -> list[str]:
    """What --set and --option say, as --set says it."""
    for option in options or ():
        if "=" not in option:
            raise ConfigError(f"--option {option}: write KEY=VALUE")
    return [*(settings or []), *(f"dataset.options.{option}" for option in options or [])]


def overrides(named: dict[str, Any], settings: list[str]) -> dict[str, Any]:
    """The settings given as options, those of --set last."""
    from semstab.core.files import parse_yaml

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


def select_dataset(overrides: dict[str, Any], name: str | None, data: Path | None, seed: int | None) -> None:
    """Put the dataset that options select into the settings."""
    if data is not None and not data.is_dir():
        raise ConfigError(f"{data}: there is no such folder")
    given = {"root": str(data)} if data is not None else {}
    options = given | ({"seed": seed} if seed is not None else {})
    name = name or ("posed_folder" if data is not None else None)
    if name is None and not options:
        return
    group = overrides.setdefault("dataset", {})
    if not isinstance(group, dict) or not isinstance(group.get("options", {}), dict):
        raise ConfigError("--set dataset: is given by other options too; write dataset.options.KEY=VALUE")
    if name is not None:
        group["name"] = name
    group["options"] = group.get("options", {}) | options


def slice_of(text: str) -> dict[str, int]:
    """'START:STOP:STRIDE' as settings; each part may be empty."""
    from semstab.config.settings import slice_of

    try:
        return slice_of(text)
    except ConfigError as error:
        raise ConfigError(f"--frames {text}: {error}") from error


def say(text: str) -> None:
    """A line beside the results: on standard error."""
    typer.echo(told(text), err=True)
