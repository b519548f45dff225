"""The commands gate and commit: may a new model ship, and which of its labels may be acted on?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semstab.cli.options import Quiet

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

    from semstab.comparison.opening import open_contender, save_summary
    from semstab.gating import gate as judge
    from semstab.gating import gate_config, report

    report.require_formats(out or ())
    console = Console(quiet=quiet)
    if save_baseline is None or rule or config:
        result = judge(new, against, gate_config(config, rule or (), level, undecided, frames))
        for file in out or ():
            report.write(result, file)
        for line in report.lines(result, console.width):
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

    from semstab.gating.calibration import calibrated, lines

    found = calibrated(run, precision=precision, confidence=confidence)
    found.save(out)
    for line in lines(found):
        Console(quiet=quiet).print(line, markup=False, highlight=False, soft_wrap=True)
