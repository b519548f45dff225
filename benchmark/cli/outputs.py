"""The commands export and relabel: what a finished run gives to others."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semstab.cli.options import Quiet, renamed

if TYPE_CHECKING:
    from semstab.core.registry import Registry


Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
Scene = Annotated[str | None, typer.Option("--scene", "-s", help="Scene; needed where the run has several.")]
Backbone = Annotated[str | None, typer.Option("--backbone", "-m", help="Label source; needed where there are several.")]
CommitFile = Annotated[
    Path | None, typer.Option("--commit", metavar="FILE", help="Only labels that `semstab-bench commit` vouches for.")
]
Backend = Annotated[str | None, typer.Option("--backend", "-b", help="Whose map; the run's first backend by default.")]


def export(
    run: Run,
    to: Annotated[
        list[Path], typer.Option("--to", metavar="FILE", help=".ply .las .laz .tif .glb .parquet or .csv; repeatable.")
    ],
    scene: Scene = None,
    backbone: Backbone = None,
    backend: Backend = None,
    measure: Annotated[
        list[str] | None, typer.Option(help="Column that goes along: vss, sbd, entropy, margin, op, ...; repeatable.")
    ] = None,
    min_op: Annotated[int, typer.Option(min=1, help="Only voxels that so many frames saw.")] = 1,
    classes: Annotated[list[str] | None, typer.Option("--class", help="Only voxels of this class; repeatable.")] = None,
    commit: CommitFile = None,
    cell: Annotated[int, typer.Option(min=1, help="Edge of a cell of .tif, in voxels.")] = 1,
    asprs: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML 'CLASS: CODE' for .las and .laz.")] = None,
    classify: Annotated[
        Path | None, typer.Option(metavar="CLOUD", help="Classify this .las, .laz or .ply cloud, and write it.")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(min=0, help="Metres from a point to the voxel that it may take; a voxel's edge.")
    ] = None,
    join: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Parquet with more columns of the voxels: OUT/columns of compare."),
    ] = None,
    quiet: Quiet = False,
    onto: Annotated[Path | None, typer.Option("--onto", hidden=True)] = None,
    beside: Annotated[Path | None, typer.Option("--beside", hidden=True)] = None,
) -> None:
    """The fused map as a point cloud, raster, mesh or table, with how far to trust each location."""
    from rich.console import Console

    from semstab.exports import export as write

    unit = {"scene": scene, "backbone": backbone, "backend": backend}
    written = write(
        run, to, **unit, measures=measure, min_op=min_op, classes=classes or (),
        commit=commit, cell=cell, asprs=asprs, radius=radius,
        classify=renamed(onto, "--onto", classify, "--classify"), join=renamed(beside, "--beside", join, "--join"),
    )  # fmt: skip
    console = Console(quiet=quiet)
    for file in written:
        for line in (f"{file.path}: {file.content}", *(f"  {note}" for note in file.notes)):
            console.print(line, soft_wrap=True, markup=False, highlight=False)


def relabel(
    run: Run,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder above labels/; the scene's own, to run it at once.")],
    scene: Scene = None,
    backbone: Backbone = None,
    backend: Backend = None,
    name: Annotated[str | None, typer.Option(help="What the maps are called; BACKBONE-fused by default.")] = None,
    min_op: Annotated[int, typer.Option(min=1, help="Ignore pixels of voxels that fewer frames saw.")] = 1,
    min_psa: Annotated[float, typer.Option(help="Ignore pixels of voxels on which fewer pairs of frames agree.")] = 0.0,
    category: Annotated[
        list[str] | None, typer.Option(help="Keep pixels of voxels of this category alone; repeatable.")
    ] = None,
    commit: CommitFile = None,
    leave_one_out: Annotated[
        bool, typer.Option("--leave-one-out", help="Label each frame by the other frames, without its own vote.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace maps of other settings.")] = False,
    quiet: Quiet = False,
    leave_own_out: Annotated[bool, typer.Option("--leave-own-out", hidden=True)] = False,
) -> None:
    """The fused classes back in every frame: label maps of a new source, unstable voxels ignored."""
    from rich.console import Console

    from semstab.convert import frame_bar
    from semstab.exports.relabel import Belief
    from semstab.exports.relabel import relabel as write
    from semstab.statistics.commit import Commit

    thresholds = None if commit is None else Commit.load(commit)
    leave_one_out = renamed(leave_own_out, "--leave-own-out", leave_one_out, "--leave-one-out")
    belief = Belief(min_op, min_psa, tuple(category or ()), leave_one_out, thresholds)
    with frame_bar(Console(stderr=True, quiet=quiet)) as bar:
        report = write(
            run, out, belief=belief, scene=scene, backbone=backbone, backend=backend, name=name, overwrite=overwrite,
            progress=bar,
        )  # fmt: skip
    for line in report.lines():
        Console(quiet=quiet).print(line, soft_wrap=True, markup=False, highlight=False)


# The command list.


def list_() -> None:
    """Backends, datasets, backbones, filters, taxonomies and studies, each with 'ready' or what to install."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from semstab import backbones, backends, datasets
    from semstab.model.labels import LabelSpace, shipped_taxonomies
    from semstab.predict import filters
    from semstab.settings import load_study, shipped_studies

    table = Table(show_edge=False)
    for name in ("kind", "name", "", "what it is"):
        table.add_column(name)
    for registry in (backends.REGISTRY, datasets.REGISTRY, backbones.REGISTRY, filters.REGISTRY):
        for name, entry in sorted(registry.entries().items()):
            table.add_row(registry.kind, name, _ready(registry, name), escape(entry.summary))
    for name in shipped_taxonomies():
        space = LabelSpace.load(name)
        table.add_row("taxonomy", name, "[green]ready", f"K = {len(space)}: {', '.join(space.classes)}")
    for name in shipped_studies():
        table.add_row("study", name, "[green]ready", load_study(name).description)
    Console().print(table)


def _ready(registry: Registry, name: str) -> str:
    """'ready', where what is behind the name really imports, or what to install."""
    from rich.markup import escape

    from semstab.errors import MissingDependencyError

    try:
        registry.load(name)
    except MissingDependencyError as error:
        return f"[yellow]{escape(str(error))}"
    return "[green]ready"
