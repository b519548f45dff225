"""Stability against its price: each filter a point, those of one kind joined in the order of their numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from semstab.report.figures.style import FAINT, INK, LETTERS, PAGE, Figure, canvas, color, legend_columns, mark_panel
from semstab.report.remedies import Remedies, Remedy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas


FLICKERS_MORE = 1.1
"""What makes labels flicker by so much more is no remedy, and would take the room of those that are."""

Of = Callable[[Remedy], float]


def remedy_figure(found: Remedies, name: str) -> Figure:
    """The figure of a model."""
    worth = "accuracy" if found.has_truth else "foresight"
    return Figure(
        name,
        f"Stability and its price: {found.model}",
        f"Each point is a filter, joined in the order of their numbers; the star is {found.model} without one, the"
        " ring the filter to use. Steady is left; the arrows say which way is good; the grey line joins what none beats"
        f" in both flicker and {worth}. A point left of the star and below it in (a) is steadier and worse. Filters"
        " that make labels flicker by a tenth more are not drawn.",
        f"Scatter plots of flicker against {worth} and what else it costs, one point a filter over {found.model}.",
        lambda: draw_remedies(found),
    )


def draw_remedies(found: Remedies) -> Canvas:
    """Panels that share flicker as x: what labels are worth, how late they are, what is left of them."""
    panels: list[tuple[str, Of]] = [("accuracy (%) ↑", lambda row: 100 * row.accuracy)] if found.has_truth else []
    panels.append(("foresight (%) ↑", lambda row: 100 * row.foresight))
    if found.has_truth:
        panels += [
            ("stable and wrong (%) ↓", lambda row: 100 * row.stable_wrong),
            ("lag (frames) ↓", lambda row: row.lag),
        ]
    else:
        panels.append(("coverage (%) ↑", lambda row: 100 * row.coverage))
    rows = len(panels) // 2
    figure = canvas(PAGE, 2.7 * rows + 0.5)
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for k, (panel, (title, of)) in enumerate(zip(axes, panels, strict=True)):
        _draw(panel, found, of, numbers=k == 0)
        mark_panel(panel, LETTERS[k], title)
        panel.set_xlabel("flicker (%)")
    front = found.front
    axes[0].plot(
        [100 * row.flicker for row in front],
        [panels[0][1](row) for row in front],
        color=FAINT,
        lw=3,
        alpha=0.5,
        zorder=1,
    )
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=legend_columns(labels, PAGE))
    return figure


def _draw(axes: Axes, found: Remedies, of: Of, numbers: bool) -> None:
    """A panel; only the first one says the numbers of filters, as all have one x axis."""
    shown = [row for row in found.filtered if row.flicker <= FLICKERS_MORE * found.unfiltered.flicker]
    families = list(dict.fromkeys(row.family for row in found.filtered))
    for k, family in enumerate(families):
        rows = [row for row in shown if row.family == family and math.isfinite(of(row))]
        x, y = [100 * row.flicker for row in rows], [of(row) for row in rows]
        marker = "osD^vPX"[k // 8 % 7] if "+" not in family else "X"
        axes.plot(x, y, marker=marker, color=color(k), lw=0.8, label=family, zorder=2)
        for row, u, v in zip(rows, x, y, strict=True):
            if numbers and "+" not in family:
                number = row.filters.partition(":")[2]
                axes.annotate(number, (u, v), xytext=(3, 3), textcoords="offset points", fontsize=5.5, color=color(k))
    base = found.unfiltered
    if math.isfinite(of(base)):
        axes.plot([100 * base.flicker], [of(base)], "*", color=INK, ms=10, label=f"{found.model}, no filter", zorder=3)
        axes.axhline(of(base), color=INK, lw=0.5, ls=":", zorder=0)
    if found.best is not None and math.isfinite(of(found.best)):
        axes.plot(
            [100 * found.best.flicker], [of(found.best)], "o", mfc="none", mec=INK, ms=10, label="to use", zorder=3
        )
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
