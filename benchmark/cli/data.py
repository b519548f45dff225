"""The commands check, convert and predict."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

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
    Quiet,
    Scenes,
    VoxelSize,
    overrides,
    select_dataset,
    selection,
    slice_of,
    with_options,
)
from semstab.errors import ConfigError, DataError


def predict(
    backbone: Annotated[
        str,
        typer.Option(
            "--backbone",
            "-m",
            help="Model, as named by `list`; or FILE.py:NAME, package.module:NAME.",
            autocompletion=completion.models,
        ),
    ],
    images: Annotated[str | None, typer.Option(metavar="GLOB", help="Image files, quoted; or choose scenes.")] = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    frames: Frames = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder above labels/ and scores/.", show_default="the scene's own"),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="What the predictions are called.", show_default="the model's name")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Folder that save_pretrained wrote, or a hub id.")] = None,
    revision: Annotated[str | None, typer.Option(help="Branch, tag or commit on the hub.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu, cuda, cuda:1, mps.", show_default="cpu")] = None,
    dtype: Annotated[str | None, typer.Option(help="float32, bfloat16 or float16.", show_default="float32")] = None,
    image_size: Annotated[
        str | None, typer.Option(metavar="N|HxW", help="Shorter side, or height and width, that the model sees.")
    ] = None,
    classes: Classes = None,
    batch: Annotated[int, typer.Option(min=1, help="Images at a time.")] = 1,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the model on a CPU.")] = None,
    taxonomy: Annotated[str | None, typer.Option(help="Give labels in this taxonomy: a name or a YAML file.")] = None,
    mapping: Annotated[
        str | None, typer.Option(help="strict, or lenient: near classes count as well.", show_default="strict")
    ] = None,
    filters: Filters = None,
    scores: Annotated[bool, typer.Option("--scores", help="Also keep soft scores.")] = False,
    top_k: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Of these only each pixel's N largest; 0 for the rest.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Any option of the model, or dataset.options.KEY=VALUE."),
    ] = None,
    options: DatasetOptions = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace predictions of other settings.")] = False,
    quiet: Quiet = False,
) -> None:
    """Run a segmentation model over images; label maps go where `run` and `study` read them. Goes on where it was."""
    from semstab.predict import command
    from semstab.settings import load_config, resolve

    named = {"model": model, "revision": revision, "device": device, "dtype": dtype, "threads": threads}
    named["classes"] = classes
    size = None if image_size is None else _image_size(image_size)
    of_model = overrides({**named, "image_size": size}, with_options(settings, options))
    chosen: dict[str, Any] = {}
    select_dataset(chosen, dataset, data, None)
    given = of_model.pop("dataset", {"options": {}})
    of_dataset = given.get("options") if isinstance(given, dict) and len(given) == 1 else None
    if not isinstance(of_dataset, dict):
        raise ConfigError("--set dataset: write --option KEY=VALUE (dataset.options.KEY), or --dataset NAME")
    if chosen:
        chosen["dataset"].setdefault("options", {}).update(of_dataset)
    elif of_dataset:
        raise ConfigError("--option says how a dataset is read; choose one with --data or --dataset")
    said = {"name": name, "taxonomy": taxonomy, "mapping": mapping, "scores": scores, "filters": filters}
    command.run(
        predictor={"backbone": backbone, **{key: value for key, value in said.items() if value is not None}},
        options=of_model,
        images=images,
        dataset=resolve(load_config(None, chosen)).dataset if chosen else None,
        scenes=None if scene == ["all"] else scene,
        frames={} if frames is None else slice_of(frames),
        out=out,
        batch=batch,
        overwrite=overwrite,
        quiet=quiet,
        top_k=top_k,
    )


def check(
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    voxel_size: VoxelSize = None,
    frames: Frames = None,
    settings: DatasetSettings = None,
    options: DatasetOptions = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers.")] = None,
    quiet: Quiet = False,
) -> None:
    """Does this dataset make sense: poses, depth, units, labels? Exit code 0 where it does, 2 where not."""
    from rich.console import Console

    from semstab.check import SCHEMA
    from semstab.check import check as check_scenes
    from semstab.check.display import print_check
    from semstab.core.files import write_json

    named = {"scenes": scene, "backbones": backbone, "voxel_size": voxel_size}
    console, found = Console(quiet=quiet), []
    for checked in check_scenes(selection(config, named, with_options(settings, options), dataset, data, frames)):
        print_check(checked, console)
        found.append(checked)
    if json_file is not None:
        write_json(json_file, {"schema": SCHEMA, "scenes": [checked.to_dict() for checked in found]})
    if problems := [f"{checked.scene}: {problem}" for checked in found for problem in checked.problems]:
        first, *more = problems
        raise DataError(f"{first}" + (f" (and {len(more)} more, see above)" if more else ""))


def convert(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder in which each scene becomes a folder.")],
    config: ConfigFile = None,
    data: DataFolder = None,
    dataset: DatasetName = None,
    scene: Scenes = None,
    backbone: Backbones = None,
    frames: Frames = None,
    settings: DatasetSettings = None,
    options: DatasetOptions = None,
    depth_error: Annotated[
        float, typer.Option(min=0, metavar="METRES", help="Store depth in 16 bits where no pixel is off by more.")
    ] = 0.0,
    quiet: Quiet = False,
) -> None:
    """Write any dataset as posed folders. Goes on where it was."""
    from rich.console import Console

    from semstab.convert import convert, frame_bar, print_converted

    chosen = selection(
        config, {"scenes": scene, "backbones": backbone}, with_options(settings, options), dataset, data, frames
    )
    console = Console(quiet=quiet, markup=False)
    with frame_bar(Console(stderr=True, quiet=quiet)) as bar:
        for converted in convert(chosen, out, depth_error=depth_error, progress=bar):
            print_converted(converted, console)


def _image_size(text: str) -> int | list[int]:
    """'512' as a number, '512x896' as height and width."""
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(re.fullmatch(r"[0-9]{1,9}", side) for side in sides):
        raise ConfigError(f"--image-size {text}: write the shorter side, for example 512, or HEIGHTxWIDTH")
    return int(sides[0]) if len(sides) == 1 else [int(side) for side in sides]
