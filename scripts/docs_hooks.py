"""Pages of the documentation that are made from the code: the command line's options, and the public Python names."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import semstab

PARENT = re.compile(r"\]\(\.\./[^)]*\)")
"""Links to files of the repository outside of docs/, which the site does not hold: their text alone is kept."""


TABLE = re.compile(r"^\[([^\]]*)\]\((tables/[^)]*\.csv)\)$", re.MULTILINE)
"""A line that is a link to a table alone, which the site shows in its place."""


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(notebook)
        page = notebook.src_uri.removesuffix(".ipynb") + ".md"
        files.append(File.generated(config, page, content="\n\n".join(cells(notebook.content_string))))
    for path, lines in (("reference/cli.md", command_line()), ("reference/api.md", python_names())):
        files.append(File.generated(config, path, content="\n".join(lines)))
    return files


def on_page_markdown(markdown: str, config: Any, **_: Any) -> str:
    """Show tables, and take away links that lead out of the site."""

    def table(link: re.Match[str]) -> str:
        with (Path(config["docs_dir"]) / link[2]).open(newline="", encoding="utf-8") as file:
            head, *rows = ([_cell(cell) for cell in row] for row in csv.reader(file))
        lines = "\n".join(f"    | {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))
        return f'??? info "{link[1]}, {len(rows)} rows"\n\n{lines}'

    return PARENT.sub("]", TABLE.sub(table, markdown))


def cells(notebook: str) -> Iterator[str]:
    """The cells of an executed notebook, with what they show."""
    for cell in json.loads(notebook)["cells"]:
        source = "".join(cell["source"])
        yield source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```"
        for output in cell.get("outputs", ()):
            shown = output.get("data", {})
            if "text" in output:
                yield f"```text\n{''.join(output['text'])}\n```"
            elif "text/html" in shown or "text/markdown" in shown:
                yield "".join(shown.get("text/html", shown.get("text/markdown")))


def command_line() -> Iterator[str]:
    """A section a command: its synopsis, its arguments and options by panel."""
    import typer

    from semstab.cli import app

    yield "# Command line\n\nMade from the commands themselves; `semstab-bench COMMAND --help` prints the same.\n"
    commands: Any = typer.main.get_command(app)
    for name, command in commands.commands.items():
        if command.hidden:
            continue
        yield f"## semstab-bench {name}\n\n{(command.help or '').strip()}\n"
        panels: dict[str, list[Any]] = {}
        for parameter in command.params:
            if not getattr(parameter, "hidden", False):
                panels.setdefault(getattr(parameter, "rich_help_panel", None) or "Options", []).append(parameter)
        for panel, own in panels.items():
            yield f"**{panel}**\n\n| | |\n| --- | --- |"
            yield from (f"| {_names(parameter)} | {_cell(parameter.help)} |" for parameter in own)
            yield ""


def _names(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    return ", ".join(f"`{option}`" for option in (*parameter.opts, *parameter.secondary_opts))


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


def python_names() -> Iterator[str]:
    """The public names of `semstab`, from their docstrings."""
    yield "# Python\n\n`import semstab` is instant: what a name needs is imported when it is first used.\n"
    for name in semstab.__all__:
        home = semstab._HOMES.get(name)
        yield f"::: semstab.{home}.{name}\n" if home else f"::: semstab.{name}\n    options: {{members: false}}\n"
