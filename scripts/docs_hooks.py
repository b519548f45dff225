"""Fit the pages of the documentation to the site: notebooks, tables, and links that lead out of it."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PARENT = re.compile(r"\]\(\.\./[^)]*\)")
"""Links to files of the repository outside of docs/, which the site does not hold: their text alone is kept."""


TABLE = re.compile(r"^\[([^\]]*)\]\((tables/[^)]*\.csv)\)$", re.MULTILINE)
"""A line that is a link to a table alone, which the site shows in its place."""


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Add a page for each notebook."""
    from mkdocs.structure.files import File

    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        files.remove(notebook)
        page = notebook.src_uri.removesuffix(".ipynb") + ".md"
        files.append(File.generated(config, page, content="\n\n".join(cells(notebook.content_string))))
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
            formats = output.get("data", {})
            if "text" in output:
                yield f"```text\n{''.join(output['text'])}\n```"
            elif "text/html" in formats or "text/markdown" in formats:
                yield "".join(formats.get("text/html", formats.get("text/markdown")))


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")
