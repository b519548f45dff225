"""The command remedies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from semstab.cli.options import (
    Backbones,
    Classes,
    DataFolder,
    DatasetName,
    DatasetOptions,
    DatasetSettings,
    Filters,
    Frames,
    Jobs,
    Quiet,
    Report,
    Scenes,
    TrustGeometry,
    VoxelSize,
    chosen,
    say,
    with_options,
)
from semstab.cli.running import Models, execute, executor_of


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
    execute(config, out, executor_of(jobs, None), "off", report, quiet)
