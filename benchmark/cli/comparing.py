"""The command compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semstab.cli.options import Quiet, say


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

    from semstab.comparison.narrative import print_comparison
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


# The commands gate and commit: may a new model ship, and which of its labels may be acted on?

FAILED = 4


def gate(
    new: Annotated[str, typer.Argument(metavar="NEW", help="Folder of a finished run, or FOLDER:BACKBONE.")],
    against: Annotated[
        str | None, typer.Option(metavar="BASE", help="The baseline: a folder likewise, or a small summary.")
    ] = None,
    rule: Annotated[
        list[str] | None,
        typer.Option("--rule", "-r", metavar="RULE", help="E.g. 'alpha drop < 0.02', 'class car: recall > 0.6'."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="YAML file: rules, level, undecided, frames.")
    ] = None,
    level: Annotated[
        float | None, typer.Option(help="How often a rule may err on each side.", show_default="0.05")
    ] = None,
    undecided: Annotated[
        str | None, typer.Option(metavar="pass|fail", help="What becomes of rules that stay open.", show_default="pass")
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="random|fixed", help="For frames like these, or these alone.", show_default="random"),
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", "-o", metavar="FILE", help=".xml (JUnit), .md (pull request), .json; repeatable."),
    ] = None,
    save_baseline: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep NEW as a small summary, where the gate passes.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Fail where a new model is shown to be worse: exit code 4 where a rule fails."""
    from rich.console import Console

    from semstab.comparison import gate_report
    from semstab.comparison.gate import gate as judge
    from semstab.comparison.gate import gate_config
    from semstab.comparison.opening import open_contender, save_summary

    gate_report.require_formats(out or ())
    console = Console(quiet=quiet)
    if save_baseline is None or rule or config:
        result = judge(new, against, gate_config(config, rule or (), level, undecided, frames))
        for file in out or ():
            gate_report.write(result, file)
        for line in gate_report.lines(result, console.width):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        if result.failed:
            raise typer.Exit(FAILED)
    if save_baseline is not None:
        save_summary(open_contender(new), save_baseline)
        console.print(f"{save_baseline}: a baseline of {save_baseline.stat().st_size:,} bytes", markup=False)


def commit(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a run with ground truth, or FOLDER:BACKBONE.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="YAML file to write.")],
    precision: Annotated[float, typer.Option(help="How often a label that is acted on shall be right.")] = 0.95,
    confidence: Annotated[float, typer.Option(help="With which this is to hold, class by class.")] = 0.95,
    quiet: Quiet = False,
) -> None:
    """For each class the least evidence at which its labels are right often enough to be acted on."""
    from rich.console import Console

    from semstab.comparison.gate_measures import calibrated, lines

    found = calibrated(run, precision=precision, confidence=confidence)
    found.save(out)
    for line in lines(found):
        Console(quiet=quiet).print(line, markup=False, highlight=False, soft_wrap=True)


# The command conform.

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
