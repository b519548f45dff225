"""Set the style of all figures: sizes, type, colours that suit any colour vision, and files without random bytes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semstab.core.files import atomic_path
from semstab.core.palette import hexadecimal, model_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


COLUMN, PAGE = 3.4, 7.0
"""The widths of one and of both columns of a page, inches."""

DPI = 300

COLORS = ("#0072B2", "#D55E00")
"""The ends of a scale between two sides, for any colour vision."""

PINS = "Pins"
"""Key of a PNG's text that has the links of its numbers: a page lays them over the picture."""

INK, FAINT = "#222222", "#999999"

_STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 7.5,
    "axes.titlesize": 8,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.edgecolor": INK,
    "savefig.facecolor": "white",
    "svg.hashsalt": "semstab",
    "svg.fonttype": "path",
}


@dataclass(frozen=True)
class Figure:
    """A figure of the study: the name of its files, its title and caption, and the function that draws it.

    Attributes:
        alt: A description for readers who do not see it.
        unit: The unit whose voxels it shows as a map; empty for a figure without a map.
    """

    name: str
    title: str
    caption: str
    alt: str
    draw: Callable[[], Canvas]
    unit: str = ""

    def save(self, folder: Path, *, svg: bool = False) -> list[Path]:
        """Draw it and write FOLDER/NAME.png, and .svg on request; the same bytes for the same content."""
        import matplotlib

        formats: dict[str, Any] = {
            "png": {"dpi": DPI, "metadata": {"Software": None}, "pil_kwargs": {"compress_level": 2}}
        }
        if svg:
            formats["svg"] = {"metadata": {"Date": None, "Creator": None}}
        with matplotlib.rc_context(_STYLE):
            canvas = self.draw()
            _without_formulas(canvas)
            if pins := _pins(canvas):
                formats["png"]["metadata"][PINS] = json.dumps(pins)
            for suffix, options in formats.items():
                with atomic_path(folder / f"{self.name}.{suffix}") as temporary:
                    canvas.savefig(temporary, format=suffix, **options)
                canvas.set_layout_engine("none")  # the layout is complete; repeating it takes as long as drawing
        return [folder / f"{self.name}.{suffix}" for suffix in formats]


def _pins(canvas: Canvas) -> list[tuple[str, str, float, float]]:
    """Return each text with a link: itself, the link, and its centre as shares of width and height from above left."""
    from matplotlib.text import Text

    texts = [artist for artist in canvas.findobj(Text) if isinstance(artist, Text)]
    linked = [(text, url) for text in texts if (url := text.get_url())]
    if linked:
        canvas.set_dpi(DPI)
        canvas.draw_without_rendering()
    boxes = [(text.get_text(), url, text.get_window_extent()) for text, url in linked]
    width, height = canvas.bbox.size
    return [
        (text, url, float(box.x0 + box.x1) / 2 / width, 1 - float(box.y0 + box.y1) / 2 / height)
        for text, url, box in boxes
    ]


def _without_formulas(canvas: Canvas) -> None:
    """Take names as they are: a '$' in one begins no formula. Ticks of logarithmic axes are formulas."""
    from matplotlib.text import Text

    logarithmic = {
        label
        for axes in canvas.axes
        for axis in (axes.xaxis, axes.yaxis)
        if axis.get_scale() == "log"
        for label in axis.get_ticklabels(which="both")
    }
    for text in canvas.findobj(Text):
        if text not in logarithmic:
            text.set_parse_math(False)


def canvas(width: float, height: float) -> Canvas:
    """Return an empty figure of this size in inches; it belongs to no window and no global state."""
    from matplotlib.figure import Figure as Canvas

    return Canvas(figsize=(width, height), layout="constrained")


def color(k: int) -> str:
    """Return the colour of the k-th model."""
    return hexadecimal(model_color(k))


def legend_columns(names: Sequence[str], width: float) -> int:
    """Return how many entries of a legend fit side by side in a figure that wide (inches)."""
    widths = [0.55 + 0.06 * len(name) for name in names]
    return len(names) if sum(widths) <= width else max(1, int(width / max(widths)))


LETTERS = "abcdefghijklmnop"
"""The letters of panels, in order."""


def mark_panel(axes: Axes, letter: str, title: str) -> None:
    """Title a panel as the paper does: '(a) title'."""
    axes.set_title(f"({letter}) {title}", loc="left")
