"""The command compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semstab.cli.options import Quiet


def compare(
    runs: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN...", help="Folders of runs or studies, the one to compare with first; RUN:BACKBONE."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for report.html, tables, figures, JSON, Markdown.")
    ] = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", metavar="", help="Print Markdown, for a pull request.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """What differs between runs: by how much, how surely, in which classes and places, and which frames did it."""
    from rich.console import Console

    from semstab.comparison.terminal import print_comparison
    from semstab.comparison.writing import compare
    from semstab.comparison.writing import markdown as as_markdown

    with Console(stderr=True, quiet=quiet).status("opening") as status:
        found = compare(runs, out, progress=lambda scene: status.update(f"comparing {scene}"))
    console = Console(quiet=quiet)
    if markdown:
        console.print(as_markdown(found), soft_wrap=True, markup=False, highlight=False)
        return
    if not quiet:
        print_comparison(found, console)
    if out is not None:
        console.print(f"folder: {out}; report: {out / 'report.html'}", soft_wrap=True, markup=False, highlight=False)
