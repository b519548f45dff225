"""Make the parts of a page that needs no other file: its style, its tables, its images."""

from __future__ import annotations

import base64
import functools
import io
import itertools
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int64, Mask, UInt8
from semstab.report.charts import colors_css
from semstab.report.figures.style import COLUMN, DPI, PINS, Figure
from semstab.report.tables.table import ARROWS, Table, relations, sections

if TYPE_CHECKING:
    from jinja2 import Environment

SCREEN_DPI = 200
"""The pixels per inch of embedded figures, which have 256 colours: a quarter of the file's size."""

CSS_INCH = 122
"""The pixels of the page per inch of a figure, so that its smallest type is as large as the text of the tables."""

ABSENT = "absent"
"""A table's note of a class that covers no voxel: the page names such classes in a line."""


HERE = Path(__file__).parent


@functools.cache
def templates() -> Environment:
    """Return the templates of pages, each of which is compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def filled(template: str, **content: Any) -> str:
    """Return a page from its template; `style` and `script` are added."""
    style, script = ((HERE / name).read_text(encoding="utf-8") for name in ("style.css", "page.js"))
    return templates().get_template(template).render(style=f"{style}\n{colors_css()}", script=script, **content)


def blocks(tables: Sequence[Table], drawn: Sequence[Figure], folder: Path) -> Iterator[dict[str, Any]]:
    """Yield tables, each with the figure of its name beneath it, then the other figures."""
    figures = {figure.name: figure for figure in drawn}
    ordered: list[Table | Figure] = []
    for table in tables:
        ordered += [table, *([figures.pop(table.name)] if table.name in figures else [])]
    for item in (*ordered, *figures.values()):
        if isinstance(item, Table):
            yield {"kind": "table", "content": table_block(item)}
        else:
            yield {"kind": "figure", "content": figure_block(item, folder)}


def table_block(table: Table) -> dict[str, Any]:
    """Return a table as the page shows it."""
    table = table.printed()
    headers = [f"{column.header} {ARROWS[column.better]}".strip() for column in table.columns]
    absent = [*dict.fromkeys(row[0] for _, rows in sections(table) for row in rows if row[-1] == ABSENT)]
    left_out = f" Absent: {', '.join(absent)}." if absent else ""
    over = [relations(column.over) for column in table.columns]
    return {
        "name": table.name,
        "title": relations(table.title),
        "caption": relations(table.caption + left_out),
        "headers": [relations(header) for header in headers],
        "over": [(name, len(list(run))) for name, run in itertools.groupby(over)] if any(over) else [],
        "numeric": [column.digits is not None for column in table.columns],
        "sections": [
            (relations(name), [[_cell(cell) for cell in row] for row in rows if row[-1] != ABSENT])
            for name, rows in sections(table)
        ],
    }


def _cell(text: str) -> str:
    """Return a cell in typographic form: with minus signs, and a dash if the number is undefined."""
    if text == "--":
        return "\N{EN DASH}"
    is_number = text[-1:].isdigit() or re.fullmatch(r"[-+]?[\d.,]+ \([-+\d., ]+\)", text)
    return relations(re.sub(r"(^|(?<=\()|(?<=, )|(?<=\de))-(?=\d)", "\N{MINUS SIGN}", text) if is_number else text)


def figure_block(figure: Figure, folder: Path) -> dict[str, Any]:
    """Return a figure as the page holds it; it is drawn where FOLDER/figures does not contain it."""
    from PIL import Image

    png = folder / "figures" / f"{figure.name}.png"
    if not png.exists():
        figure.save(png.parent)
    with Image.open(png) as image:
        width, height = (edge / DPI for edge in image.size)
        pins = json.loads(image.info.get(PINS, "[]"))
        size = [round(edge * SCREEN_DPI / DPI) for edge in image.size]
        small = image.convert("RGB").resize((size[0], size[1]), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    # the octree keeps colours of small areas, which the median cut merges, and takes a fortieth of its time
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(data, "PNG")
    return {
        "name": figure.name,
        "title": figure.title,
        "caption": relations(figure.caption),
        "alt": figure.alt,
        "source": _url(data.getvalue(), "png"),
        "width": round(width * CSS_INCH),
        "height": round(height * CSS_INCH),
        "pins": [(text, link, 100 * x, 100 * y) for text, link, x, y in pins],
        "narrow": width <= COLUMN * 1.01,
    }


def png(image: UInt8, palette: UInt8 | None = None) -> str:
    """Return an image (H, W, 3), or indices (H, W) into a palette (n, 3), as the address of a PNG without loss."""
    from PIL import Image

    data, made = io.BytesIO(), Image.fromarray(np.ascontiguousarray(image))
    if palette is not None:
        made = made.convert("P")
        made.putpalette(np.ascontiguousarray(palette[:256]).tobytes())
    made.save(data, "PNG")
    return _url(data.getvalue(), "png")


def jpeg(image: UInt8) -> str:
    """Return an image (H, W, 3) as the address of a JPEG."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(data, "JPEG", quality=80)
    return _url(data.getvalue(), "jpeg")


def lone_pictures(
    color: UInt8 | None, labels: npt.NDArray[Any], alone: Mask, palette: npt.ArrayLike
) -> list[tuple[str, str]]:
    """Return a frame as named images: its colour (h, w, 3), its labels (h, w), and the pixels that stand alone.

    Labels are rows of the palette (K, 3); K and above: no label.
    """
    classes = np.asarray(palette, np.uint8).reshape(-1, 3)
    shades = np.vstack([classes, np.full((1, 3), 128, np.uint8)])
    faded = np.tile(160 + 0.35 * shades.mean(axis=1, keepdims=True), 3).astype(np.uint8)
    marked = np.vstack([faded, np.array([[213, 94, 0]], np.uint8)])
    rows = np.minimum(labels.astype(np.int64), len(classes))
    pictures = [] if color is None else [("image", jpeg(color))]
    return [
        *pictures, ("labels", _indexed(rows, shades)), ("alone", _indexed(np.where(alone, len(shades), rows), marked)),
    ]  # fmt: skip


def label_picture(labels: npt.NDArray[Any], palette: npt.ArrayLike) -> str:
    """Return labels (h, w) as a PNG: rows of the palette (K, 3), grey for K and above."""
    shades = np.vstack([np.asarray(palette, np.uint8).reshape(-1, 3), np.full((1, 3), 128, np.uint8)])
    return _indexed(np.minimum(labels.astype(np.int64), len(shades) - 1), shades)


def _indexed(index: Int64, palette: UInt8) -> str:
    """Return a PNG of indices (H, W) into colours."""
    return png(index.astype(np.uint8), palette) if len(palette) <= 256 else png(palette[index])


def _url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
