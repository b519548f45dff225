"""The parts of a page that needs no other file: its style, tables and figures."""

from __future__ import annotations

import base64
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from semstab.outputs.plots.style import COLUMN, DPI, Figure
from semstab.outputs.tables import Table
from semstab.outputs.tables.writers import ARROWS, relations, sections

SCREEN_DPI = 200
"""Dense images are embedded with that many pixels an inch and in 256 colours: a quarter of the file's size."""

CSS_INCH = 122
"""Pixels of the page an inch of a figure: its smallest type then is as large as the text of the tables."""


ABSENT = "absent"
"""What a table notes of a class that covers no voxel: the page names such classes in a line."""


def filled(template: str, **content: Any) -> str:
    """A page, from its template; `style` is there already."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(here), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = (here / "style.css").read_text(encoding="utf-8")
    page: str = environment.get_template(template).render(style=style, **content)
    return page


def blocks(own: Sequence[Table], shown: Sequence[Figure], folder: Path) -> Iterator[dict[str, Any]]:
    """Tables, each with the figure of its name beneath it, then the other figures."""
    beside = {figure.name: figure for figure in shown}
    ordered: list[Table | Figure] = []
    for table in own:
        ordered.append(table)
        if table.name in beside:
            ordered.append(beside.pop(table.name))
    for item in (*ordered, *beside.values()):
        if isinstance(item, Table):
            yield {"kind": "table", "content": table_block(item)}
        else:
            yield {"kind": "figure", "content": figure_block(item, folder)}


def table_block(table: Table) -> dict[str, Any]:
    """A table as the page shows it."""
    headers = [f"{column.header} {ARROWS[column.better]}".strip() for column in table.columns]
    absent = [*dict.fromkeys(row[0] for _, rows in sections(table) for row in rows if row[-1] == ABSENT)]
    left_out = f" Absent: {', '.join(absent)}." if absent else ""
    return {
        "name": table.name,
        "title": relations(table.title),
        "caption": relations(table.caption + left_out),
        "headers": [relations(header) for header in headers],
        "over": _runs([relations(column.over) for column in table.columns]),
        "numeric": [column.digits is not None for column in table.columns],
        "sections": [
            (relations(name), [[_cell(cell) for cell in row] for row in rows if row[-1] != ABSENT])
            for name, rows in sections(table)
        ],
    }


def _runs(names: Sequence[str]) -> list[tuple[str, int]]:
    """Equal neighbours and how many they are; nothing where all are empty."""
    return [(name, len(list(run))) for name, run in itertools.groupby(names)] if any(names) else []


def _cell(text: str) -> str:
    """A cell as typography has it: minus signs, a dash for what is undefined."""
    if text == "--":
        return "\N{EN DASH}"
    number = text[-1:].isdigit() or re.fullmatch(r"[-+]?[\d.,]+ \([-+\d., ]+\)", text)
    return relations(re.sub(r"(^|(?<=\()|(?<=, )|(?<=e))-(?=\d)", "\N{MINUS SIGN}", text) if number else text)


def figure_block(figure: Figure, folder: Path) -> dict[str, Any]:
    """A figure as the page holds it; drawn where FOLDER/figures lacks it."""
    from PIL import Image

    png, svg = (folder / "figures" / f"{figure.name}.{suffix}" for suffix in ("png", "svg"))
    if not (png.exists() and svg.exists()):
        figure.save(folder / "figures")
    with Image.open(png) as image:
        width, height = (edge / DPI for edge in image.size)
        data = _screen_png(image) if figure.dense else svg.read_bytes()
    kind = "png" if figure.dense else "svg+xml"
    return {
        "name": figure.name,
        "title": figure.title,
        "caption": relations(figure.caption),
        "alt": figure.alt,
        "source": f"data:image/{kind};base64,{base64.b64encode(data).decode()}",
        "width": round(width * CSS_INCH),
        "height": round(height * CSS_INCH),
        "narrow": width <= COLUMN * 1.01,
    }


def _screen_png(image: Any) -> bytes:
    """The image at the resolution of a screen, in few colours."""
    from PIL import Image

    size = tuple(round(edge * SCREEN_DPI / DPI) for edge in image.size)
    small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    data = io.BytesIO()
    # the octree keeps colours of small areas, which the median cut merges, and takes a fortieth of its time
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(data, "PNG")
    return data.getvalue()
