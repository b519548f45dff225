"""The sensitivity sweeps: aggregate and recurrent values together with the recurrent share (paper, Sensitivity)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from semstab.model.measures import measures
from semstab.model.statistics import Estimate
from semstab.outputs.averages import ENOUGH, Level, Pooled, Sweep, over_all, over_recurrent
from semstab.outputs.plots.style import INK, LETTERS, PAGE, canvas, color, legend_columns, mark_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


APART = 0.06
"""Of a step along the x axis: series that have the same values lie beside each other."""

LEAST_SPAN = 0.1
"""Of the axis of a share that is good when high (VSS, margin, PSA, alpha): a smaller difference looks small. What is
good when low (SBD, entropy), and the recurrent share, stand on an axis from 0."""


def draw_sweep(sweep: Sweep, backbones: Mapping[str, tuple[Level, ...]]) -> Figure:
    """The recurrent share and every measure along a sweep; the values stand at equal distances, in order."""
    shown = measures()
    rows = math.ceil((1 + len(shown)) / 3)
    figure = canvas(PAGE, 2.5 if rows == 1 else 2.1 * rows)
    share, *panels = figure.subplots(rows, 3, squeeze=False).ravel()
    values = sorted({level.value for levels in backbones.values() for level in levels})
    for k, levels in enumerate(backbones.values()):
        x = positions(values, levels, k, len(backbones))
        draw_line(share, x, levels, lambda p: 100 * p.recurrent.share, color(k), marker="s")
        enough = [level for level in levels if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH]
        at = positions(values, enough, k, len(backbones))
        for axes, measure in zip(panels, shown, strict=False):
            draw_line(axes, x, levels, over_all(measure), color(k))
            draw_line(axes, at, enough, over_recurrent(measure), color(k), open_=True)
    titles = ("recurrent share (%)", *(f"{m.title} ({m.unit})" if m.unit else m.title for m in shown))
    for axes, letter, title in zip((share, *panels), LETTERS, titles, strict=False):
        mark_values(axes, sweep, values)
        mark_panel(axes, letter, title)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    for axes, better in zip((share, *panels), ("lower", *(m.better for m in shown)), strict=False):
        settle_scale(axes, from_zero=better == "lower")
    columns = legend_columns([*backbones, "all voxels", "OP ≥ 3"], PAGE)
    figure.legend(handles=_legend(list(backbones)), loc="outside lower center", ncols=columns)
    return figure


def positions(values: Sequence[float], levels: Sequence[Level], k: int, series: int) -> list[float]:
    """Where the k-th of so many series has its levels along the x axis."""
    return [values.index(level.value) + APART * (k - (series - 1) / 2) for level in levels]


def settle_scale(axes: Axes, *, from_zero: bool) -> None:
    """Widen the y axis to hold 0, or `LEAST_SPAN`; what is drawn, intervals too, stays inside with its markers."""
    if not any(np.isfinite(np.asarray(line.get_ydata(), dtype=np.float64)).any() for line in axes.lines):
        axes.text(0.5, 0.5, "not known\nwithout --statistics", transform=axes.transAxes, ha="center", va="center")
        axes.set_yticks([])
        return
    low, high = axes.get_ylim()
    if from_zero:
        axes.set_ylim(min(low, -0.04 * high), high)
    elif (missing := LEAST_SPAN - (high - low)) > 0:
        top = max(high, min(high + missing / 2, 1.01))  # a share has no values above 1
        axes.set_ylim(top - LEAST_SPAN, top)


def mark_values(axes: Axes, sweep: Sweep, values: Sequence[float]) -> None:
    """The swept values along the x axis, at equal distances."""
    axes.set_xticks(range(len(values)), [sweep.text(value) for value in values])
    axes.set_xlim(-0.35, len(values) - 0.65)
    axes.margins(y=0.1)  # a point at an axis' end is seen whole
    axes.set_xlabel(f"{sweep.title.split(',')[0]} ({sweep.unit})" if sweep.unit else sweep.title)


def draw_line(
    axes: Axes,
    x: Sequence[float],
    levels: Sequence[Level],
    measure: Callable[[Pooled], float],
    shade: str,
    *,
    interval: Callable[[Pooled], Estimate] | None = None,
    marker: str = "o",
    open_: bool = False,
) -> None:
    """A measure along a sweep, with its interval, else the standard deviation over repeats; `open_` dashes it."""
    means = [level.mean(measure) for level in levels]
    errors = [_error(level, measure, interval) for level in levels]
    axes.errorbar(
        x,
        means,
        yerr=list(zip(*errors, strict=True)) if any(map(any, errors)) else None,
        color=shade,
        linestyle="--" if open_ else "-",
        marker=marker,
        markerfacecolor="white" if open_ else shade,
        capsize=2,
        elinewidth=0.8,
    )


def _error(
    level: Level, measure: Callable[[Pooled], float], interval: Callable[[Pooled], Estimate] | None
) -> tuple[float, float]:
    """How far the bar reaches below and above the mean; 0 where that is not known."""
    if interval is None:
        sd = level.spread(measure).sd
        return (0.0, 0.0) if math.isnan(sd) else (sd, sd)
    found = level.interval(interval)
    if math.isnan(found.low):
        return 0.0, 0.0
    return max(found.value - found.low, 0.0), max(found.high - found.value, 0.0)


def _legend(backbones: list[str]) -> list[object]:
    from matplotlib.lines import Line2D

    every = Line2D([], [], color=INK, marker="o", label="all voxels")
    recurrent = Line2D([], [], color=INK, marker="o", linestyle="--", markerfacecolor="white", label="OP ≥ 3")
    return [*(Line2D([], [], color=color(k), label=name) for k, name in enumerate(backbones)), every, recurrent]
