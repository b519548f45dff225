"""Define the commands over a dataset before it is fused: check, predict, convert."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semstab.cli import options as opt
from semstab.cli.options import chosen
from semstab.errors import ConfigError, DataError

if TYPE_CHECKING:
    pass


@opt.grouped
def check(
    *,
    config: opt.ConfigFile = None,
    source: opt.Source,
    voxel_size: opt.VoxelSize = None,
    frames: opt.Frames = None,
    settings: opt.DatasetSettings = None,
    options: opt.DatasetOptions = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write all numbers.")] = None,
    verbose: opt.Verbose = False,
    quiet: opt.Quiet = False,
) -> None:
    """Check poses, depth, units and labels of a dataset. Exit code 0 if they are sound, 2 if not."""
    from semstab.check import SCHEMA
    from semstab.check import check as check_scenes
    from semstab.check.display import print_check
    from semstab.configure import load_config, resolve
    from semstab.core.console import Console
    from semstab.core.files import write_json
    from semstab.engine.folder import require_output

    if json_file is not None:
        require_output(json_file, [config])
    run_settings = {"scenes": source.scene, "models": source.model, "voxel_size": voxel_size}
    content = chosen(run_settings, settings, options, source.dataset, source.data, frames)
    selected = resolve(load_config(config, content))
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
    from semstab.configure import load_config, resolve
    from semstab.predict import command

    model_settings = {
        "checkpoint": checkpoint, "revision": revision, "device": device, "dtype": dtype, "threads": threads,
        "classes": classes, "image_size": None if image_size is None else _input_size(image_size),
    }  # fmt: skip
    of_data = [setting for setting in settings or () if setting.startswith(("dataset.", "frames."))]
    content = chosen({}, of_data, options, dataset, data, frames)
    model_options = chosen(model_settings, [setting for setting in settings or () if setting not in of_data], None)
    read = content.get("dataset")
    if read is not None and data is None and dataset is None:
        raise ConfigError("--option sets how a dataset is read; choose one with --data or --dataset")
    predictor_settings = {"name": name, "taxonomy": taxonomy, "mapping": mapping, "scores": scores, "filters": filters}
    command.run(
        predictor={"model": model, **{key: value for key, value in predictor_settings.items() if value is not None}},
        options=model_options,
        images=images,
        dataset=None if read is None else resolve(load_config(None, {"dataset": read})).dataset,
        scenes=None if scene == ["all"] else scene,
        frames=content.get("frames", {}),
        out=out,
        batch=batch,
        overwrite=overwrite,
        quiet=quiet,
        top_k=top_k,
    )


def _input_size(text: str) -> Any:
    """Return the size of a model's input: its shorter side, or height and width."""
    from semstab.models import sides

    size: Any = int(text) if re.fullmatch(r"[0-9]{1,9}", text) else sides(text)
    if size == text:
        raise ConfigError(f"--image-size {text}: write the shorter side, for example 512, or HEIGHTxWIDTH")
    return size


@opt.grouped
def convert(
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder in which each scene becomes a folder.")],
    config: opt.ConfigFile = None,
    source: opt.Source,
    frames: opt.Frames = None,
    settings: opt.DatasetSettings = None,
    options: opt.DatasetOptions = None,
    depth_error: Annotated[float, typer.Option(
        min=0, metavar="METRES", help="Store depth in 16 bits if every pixel's error is at most this.")] = 0.0,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write any dataset as posed folders. A second start resumes."""
    from semstab.configure import load_config, resolve
    from semstab.convert import convert, frame_bar, print_converted
    from semstab.core.console import Console

    run_settings = {"scenes": source.scene, "models": source.model}
    content = chosen(run_settings, settings, options, source.dataset, source.data, frames)
    selected, console = resolve(load_config(config, content)), Console(quiet=quiet, markup=False)
    with frame_bar(Console(stderr=True, quiet=quiet)) as bar:
        for converted in convert(selected, out, depth_error=depth_error, progress=bar):
            print_converted(converted, console)
