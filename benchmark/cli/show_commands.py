"""Define the commands that show: show and view a finished run, list the parts of semstab."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
import textwrap
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semstab.cli.options import OwnCode, own_defaults, print_lines, say
from semstab.errors import ConfigError, DataError

if TYPE_CHECKING:
    from semstab.report.tables import Table


class FigureFormat(StrEnum):
    """The file format of figures."""

    png = "png"
    svg = "svg"


COMPARISON = "comparison"
"""The beginning of the names of the tables that compare a run's models: they are made on demand."""


def show(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run, or of several.")],
    what: Annotated[list[str] | None, typer.Argument(
        metavar="[RUN|TABLE]...", help="Further runs, for one table of all; or tables, by the beginning of their names."
    )] = None,
    out: Annotated[Path | None, typer.Option(
        help="Write the tables into this file: .csv, .json, .md or .tex; or figures, or several runs, into this folder."
    )] = None,
    figures: Annotated[FigureFormat | None, typer.Option(help="Draw the figures for a paper into RUN/figures.")] = None,
) -> None:  # fmt: skip
    """Print the answer of a finished run, or its tables, without computing; of several runs one table of all."""
    from semstab.core.console import Console, wrapped
    from semstab.data.records import is_run
    from semstab.engine.folder import load_result
    from semstab.report.comparison.own_models import own_models
    from semstab.report.tables import tables, write_table_file
    from semstab.report.tables.table import to_terminal
    from semstab.report.terminal import failure_lines, print_answer

    further = [Path(word) for word in what or () if Path(word).is_dir()]
    if further or (run.is_dir() and not is_run(run)):
        _show_several(run, further, [word for word in what or () if Path(word) not in further], out, figures)
        return
    result = load_result(run)
    for line in failure_lines(result):
        say(f"failed: {line}")
    if not result.select():
        raise DataError(f"{run}: no unit finished; {run / 'failures.log'} has more, if it exists; run it again")
    by_name = {table.name: table for table in tables(result)}
    if any(name.startswith(COMPARISON) for name in what or ()):
        by_name |= {table.name: table for table in own_models(result)}
    if figures is not None:
        from semstab.report.figures import write_figures

        print_lines(map(str, write_figures(result, run, out, svg=figures is FigureFormat.svg)))
    elif not what and out is None:
        print_answer(result, Console(), out=run)
        names = [*by_name, COMPARISON] if len(result.models) > 1 else [*by_name]
        listed = f"tables  semstab-bench show {run} TABLE, of {', '.join(names)}"
        print_lines(wrapped(listed, hanging=10))
    chosen: dict[str, Table] = {}
    for name in what or ():
        matching = {key: table for key, table in by_name.items() if key.startswith(name)}
        if not matching:
            raise ConfigError(f"{run}: no table '{name}'; the tables are {', '.join(by_name)}")
        is_single = out is not None and out.suffix == ".csv" and name in matching
        chosen |= {name: matching[name]} if is_single else matching
    if out is not None and figures is None:
        print_lines([str(write_table_file([*(chosen if what else by_name).values()], out))])
    else:
        print_lines(f"{to_terminal(table)}\n" for table in chosen.values())


def _show_several(
    run: Path, further: list[Path], names: list[str], out: Path | None, figures: FigureFormat | None
) -> None:
    """Print one table of several runs, and write it with its figure where that is wanted."""
    from semstab.report.figures.runs import runs_figure
    from semstab.report.tables import FORMATS, write_table_file, write_tables
    from semstab.report.tables.runs import found_runs, runs_table
    from semstab.report.tables.table import to_terminal

    if names:
        raise ConfigError(f"'{names[0]}' is neither a table of several runs nor a folder; name one run for its tables")
    results = found_runs([run, *further])
    table = runs_table(results)
    print_lines([to_terminal(table)])
    if out is not None and out.suffix in FORMATS:
        print_lines([str(write_table_file([table], out))])
    elif out is not None:
        written = write_tables([table], out)
        print_lines(map(str, [*written, *runs_figure(results).save(out, svg=figures is FigureFormat.svg)]))


NO_WINDOW = "winit"
"""Library that opens windows; the viewer's message names it if it cannot open a window."""


def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or an .rrd file.")],
    code: OwnCode = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Save what the viewer shows, without a window or a display.")
    ] = None,
) -> None:
    """Open a run's recording in the rerun viewer; it is made again if units have no pictures in it."""
    import subprocess

    from semstab.recording import lacks_pictures, record_finished, viewer_command

    if screenshot is not None and (screenshot.suffix.lower() != ".png" or not screenshot.absolute().parent.is_dir()):
        raise ConfigError(f"--screenshot {screenshot}: name a file .png in a folder that is there")
    if not run.exists():
        raise ConfigError(f"{run}: there is no such run or file; give the folder of --out, or one of runs/")
    recording, finished = run / "recording.rrd" if run.is_dir() else run, (run / "summary.json").is_file()
    if not finished and not recording.is_file():
        raise ConfigError(f"{run}: there is no finished run here; give the folder of --out, or one of runs/")
    if finished and lacks_pictures(run, recording):
        say(f"making {recording}")
        record_finished(run, recording, code or ())
    if screenshot is not None:
        from semstab.recording.screenshot import screenshot as save

        save(recording, screenshot)
        print_lines([str(screenshot)])
        return
    display = sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    with tempfile.TemporaryFile() as output:  # several lines without a display that answers
        ended = subprocess.run([*viewer_command(), str(recording)], check=False, stderr=output).returncode
        output.seek(0)
        words = output.read().decode(errors="replace")
    if ended and (not display or NO_WINDOW in words):
        raise ConfigError(
            f"{recording}: there is no display for the viewer; copy the file to a machine with one, show it in a"
            f" browser (rerun --serve-web {shlex.quote(str(recording))}), or save a picture: --screenshot FILE.png"
        )
    sys.stderr.write(words)
    raise typer.Exit(ended)


KINDS = {
    "backends": "backend", "datasets": "dataset", "models": "model", "filters": "filter", "taxonomies": "taxonomy",
    "studies": "study", "benchmarks": "benchmark",
}  # fmt: skip
"""The kinds of things that `list` lists, in the plural."""

USES = {
    "backend": "--backend NAME, or FILE.py:NAME",
    "dataset": "--dataset NAME; the format of --data is found",
    "model": "--predict NAME, or FILE.py:NAME",
    "filter": "--filter NAME:NUMBER",
    "taxonomy": "--taxonomy NAME",
    "study": "semstab-bench study NAME",
    "benchmark": "semstab-bench benchmark NAME",
}
"""The option or the command that takes a name of each kind."""


def _kind(text: str | None) -> str | None:
    """Return a kind by its name in the singular or the plural; raises ConfigError if there is none."""
    if text is None or text in KINDS.values():
        return text
    if text not in KINDS:
        from semstab.config import nearest

        raise ConfigError(f"list {text}: there is no such kind; {nearest(text, [*KINDS])}")
    return KINDS[text]


NAME_COLUMNS = 22
"""Columns of the names that `list` prints."""


def _entry(name: str, text: str, width: int) -> str:
    """Return the line of an entry: its name, and its description, cut to fit the terminal."""
    room = width - NAME_COLUMNS - 4
    return f"  {name:<{NAME_COLUMNS}}  {textwrap.shorten(text, room, placeholder=' ...')}"


def list_(
    kind: Annotated[
        str | None, typer.Argument(metavar="KIND", help="Only backends, datasets, models, filters, taxonomies, ...")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Also load each one, which takes seconds.")] = False,
) -> None:
    """List backends, datasets, models, filters, taxonomies, studies and benchmarks, or one kind of them.

    Packages that an entry needs and that are missing are named. The user's settings, in
    ~/.config/semstab/config.yaml, follow.
    """
    import yaml

    from semstab import backends, datasets, models
    from semstab.config import read_yaml
    from semstab.configure import load_study, shipped_benchmarks, shipped_studies
    from semstab.core.console import Console
    from semstab.data.labels import LabelSpace, shipped_taxonomies
    from semstab.errors import MissingDependencyError
    from semstab.predict import filters

    sections: dict[str, dict[str, str]] = {}
    for registry in (backends.REGISTRY, datasets.REGISTRY, models.REGISTRY, filters.REGISTRY):
        described = sections[registry.kind] = {}
        for name, entry in sorted(registry.entries().items()):
            missing = registry.missing(name)
            if check and not missing:
                try:
                    registry.load(name)
                except MissingDependencyError as error:
                    missing = str(error)
            reason, _, advice = missing.rpartition("; ")
            described[name] = f"{advice} ({reason})" if reason else missing or entry.summary
    taxonomies = {name: LabelSpace.load(name) for name in shipped_taxonomies()}
    sections["taxonomy"] = {
        name: f"{len(space)} classes: {', '.join(space.classes)}" for name, space in taxonomies.items()
    }
    sections["study"] = {name: load_study(name).description for name in shipped_studies()}
    sections["benchmark"] = {name: read_yaml(file)["description"] for name, file in shipped_benchmarks().items()}
    section = _kind(kind)
    plural = {singular: several for several, singular in KINDS.items()}
    console = Console()
    for kind_name, described in sections.items():
        if section in (None, kind_name):
            print_lines([f"{plural[kind_name]} ({len(described)}): {USES[kind_name]}"])
            print_lines(_entry(name, text, console.width) for name, text in described.items())
            print_lines([""] if section is None else [])
    if section is not None:
        return
    if (defaults_file := own_defaults()) is None:
        print_lines(["no settings in ~/.config/semstab/config.yaml or SEMSTAB_CONFIG"])
    else:
        print_lines([f"settings used without --config: {defaults_file}"])
        content = yaml.safe_dump(read_yaml(defaults_file), sort_keys=False, allow_unicode=True)
        print_lines(f"  {line}" for line in content.splitlines())
