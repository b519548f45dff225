"""Alpha of every model of many runs, with its interval, above the limits of the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from semstab.data.records import Result
from semstab.data.statistics import CONFIDENCE
from semstab.report.figures.style import Figure, canvas, color
from semstab.statistics.verdict import LIMITS

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

WIDTH, ROW = 6.9, 0.24
"""Inches of the figure across, and of one model on a scene."""


def runs_figure(results: Mapping[str, Result]) -> Figure:
    """Return the figure 'runs'."""
    caption = "Alpha of each model on each scene of each run, with its confidence interval."
    return Figure("runs", "Alpha of all runs", caption, caption, lambda: _drawn(results))


def _drawn(results: Mapping[str, Result]) -> Canvas:
    records = [(name, record) for name, result in results.items() for record in result.select()]
    models = list(dict.fromkeys(record.unit.model for _, record in records))
    scenes = {record.unit.scene for _, record in records}
    figure = canvas(WIDTH, 0.9 + ROW * len(records))
    axes = figure.add_subplot()
    for limit, level in ((LIMITS.stable, "stable"), (LIMITS.usable, "usable")):
        axes.axvline(limit, color="0.75", linewidth=0.8, zorder=0)
        where = ("data", "axes fraction")
        axes.annotate(level, (limit, 1.0), (2, 2), xycoords=where, textcoords="offset points", color="0.4")
    labels = []
    for k, (name, record) in enumerate(records):
        scene = f", {record.unit.scene}" if len(scenes) > 1 else ""
        labels.append(f"{name}{scene}: {record.unit.model}")
        if record.statistics is None or math.isnan((alpha := record.statistics.headline.alpha).value):
            axes.annotate("no alpha", (0.0, k), (2, -3), textcoords="offset points", color="0.4")
            continue
        shade = color(models.index(record.unit.model))
        if not math.isnan(alpha.low):
            axes.plot([alpha.low, alpha.high], [k, k], color=shade, linewidth=1.6, solid_capstyle="butt")
        axes.plot([alpha.value], [k], "o", color=shade, markersize=4)
    axes.set_yticks(range(len(records)), labels)
    axes.set_ylim(len(records) - 0.4, -0.6)
    axes.set_xlim(right=1.0)
    axes.set_xlabel(f"alpha ({CONFIDENCE:.0%} confidence interval)")
    return figure
