"""Figure of the correlogram: agreement beyond chance by how far apart two looks at a place are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from semstab.model.statistics import NEXT_FLIGHT, Correlogram, LagBin
from semstab.outputs.plots.style import FAINT, INK, PAGE, canvas, color, mark_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = (
    ("time", "frames apart"),
    ("angle", "degrees between the views"),
    ("range", "ratio of the ranges"),
    ("baseline", "metres between the cameras"),
)


def draw_correlogram(backbones: Mapping[str, Correlogram]) -> Figure:
    """Alpha between frames with its band, and its ceiling; one panel for each way of being apart.

    Points are open where the band is for this map alone.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter

    figure = canvas(PAGE, 2.5)
    panels = figure.subplots(1, len(AXES), sharey=True)
    for axes, letter, (axis, title) in zip(panels, "abcd", AXES, strict=True):
        axes.axhline(0.0, color=FAINT, linewidth=0.8)
        for k, found in enumerate(backbones.values()):
            _draw_bins(axes, getattr(found, axis), color(k))
        if axis in ("time", "baseline"):
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.locator_params(axis="x", nbins=4)
        axes.set_xlabel(title)
        mark_panel(axes, letter, "")
    panels[0].set_ylabel("alpha between frames")
    panels[0].set_ylim(top=1.03)
    handles = [Line2D([], [], color=color(k), marker="o", label=name) for k, name in enumerate(backbones)]
    ceiling = Line2D([], [], color=INK, linestyle="--", linewidth=0.9, label="ceiling")
    figure.legend(handles=[*handles, ceiling], loc="outside lower center", ncols=min(len(handles) + 1, 6))
    return figure


def _draw_bins(axes: Axes, bins: Sequence[LagBin], shade: str) -> None:
    x = [row.mean for row in bins]
    axes.plot(x, [row.ceiling for row in bins], color=shade, linestyle="--", linewidth=0.9)
    axes.plot(x, [row.alpha.value for row in bins], color=shade)
    for row in bins:
        face = shade if row.alpha.question == NEXT_FLIGHT else "white"
        axes.plot(row.mean, row.alpha.value, color=shade, marker="o", markersize=3.5, markerfacecolor=face)
    axes.fill_between(
        x, [row.alpha.low for row in bins], [row.alpha.high for row in bins], color=shade, alpha=0.15, linewidth=0
    )
