"""The command conform."""

from __future__ import annotations

from typing import Annotated

import typer

from semstab.cli.options import Quiet, say

DIFFERS = 3


def conform(
    command: Annotated[
        str, typer.Argument(metavar="CMD", help="Program and its options, quoted; CASE and OUT are appended.")
    ],
    only: Annotated[list[str] | None, typer.Option(metavar="CASE", help="This case alone; repeatable.")] = None,
    tolerance: Annotated[float, typer.Option(min=0, help="Largest difference of a sum or a measure.")] = 1e-9,
    quiet: Quiet = False,
) -> None:
    """Hold an outside fusion program against the conformance data. Exit code 3 where its tables differ."""
    from semstab.conformance import conform

    wrong = 0
    for verdict in conform(command, only or (), tolerance):
        wrong += bool(verdict.problem)
        if verdict.problem:
            say(f"{verdict.case}: {verdict.problem}")
        elif not quiet:
            typer.echo(f"{verdict.case}: the same")
    if wrong:
        raise typer.Exit(DIFFERS)
