"""The sensitivity sweeps: aggregate and recurrent values together with the recurrent share (paper, Sensitivity)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from semstab.model.measures import measures
from semstab.outputs.averages import ENOUGH, Level, Pooled, Sweep, over_all, over_recurrent
from semstab.outputs.plots.style import INK, LETTERS, PAGE, canvas, color, mark_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


APART = 0.06
"""Of a step along the x axis: series that have the same values lie beside each other."""


def draw_sweep(sweep: Sweep, backbones: Mapping[str, tuple[Level, ...]]) -> Figure:
    """The recurrent share and every measure along a sweep; the values stand at equal distances, in order."""
    shown = measures()
    rows = math.ceil((1 + len(shown)) / 3)
    figure = canvas(PAGE, 2.5 if rows == 1 else 2.1 * rows)
    share, *panels = figure.subplots(rows, 3, squeeze=False).ravel()
    values = sorted({level.value for levels in backbones.values() for level in levels})
    for k, levels in enumerate(backbones.values()):
        aside = APART * (k - (len(backbones) - 1) / 2)
        x = [values.index(level.value) + aside for level in levels]
        draw_line(share, x, levels, lambda p: 100 * p.recurrent.share, color(k), marker="s")
        enough = [level for level in levels if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH]
        at = [values.index(level.value) + aside for level in enough]
        for axes, measure in zip(panels, shown, strict=False):
            draw_line(axes, x, levels, over_all(measure), color(k))
            draw_line(axes, at, enough, over_recurrent(measure), color(k), open_=True)
    titles = ("recurrent share (%)", *(f"{m.title} ({m.unit})" if m.unit else m.title for m in shown))
    for axes, letter, title in zip((share, *panels), LETTERS, titles, strict=False):
        mark_values(axes, sweep, values)
        mark_panel(axes, letter, title)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    share.set_ylim(bottom=-0.04 * share.get_ylim()[1])
    figure.legend(handles=_legend(list(backbones)), loc="outside lower center", ncols=len(backbones) + 2)
    return figure


def mark_values(axes: Axes, sweep: Sweep, values: Sequence[float]) -> None:
    """The swept values along the x axis, at equal distances."""
    axes.set_xticks(range(len(values)), [sweep.text(value) for value in values])
    axes.set_xlim(-0.3, len(values) - 0.7)
    axes.margins(y=0.1)  # a point at an axis' end is seen whole
    axes.set_xlabel(f"{sweep.title.split(',')[0]} ({sweep.unit})" if sweep.unit else sweep.title)


def draw_line(
    axes: Axes,
    x: Sequence[float],
    levels: Sequence[Level],
    measure: Callable[[Pooled], float],
    shade: str,
    *,
    marker: str = "o",
    open_: bool = False,
) -> None:
    """A measure along a sweep, with the standard deviation over repeats; `open_` dashes it and opens the markers."""
    spreads = [level.spread(measure) for level in levels]
    errors = [0.0 if math.isnan(spread.sd) else spread.sd for spread in spreads]
    axes.errorbar(
        x,
        [spread.mean for spread in spreads],
        yerr=errors if any(errors) else None,
        color=shade,
        linestyle="--" if open_ else "-",
        marker=marker,
        markerfacecolor="white" if open_ else shade,
        capsize=2,
        elinewidth=0.8,
    )


def _legend(backbones: list[str]) -> list[object]:
    from matplotlib.lines import Line2D

    every = Line2D([], [], color=INK, marker="o", label="all voxels")
    recurrent = Line2D([], [], color=INK, marker="o", linestyle="--", markerfacecolor="white", label="OP ≥ 3")
    return [*(Line2D([], [], color=color(k), label=name) for k, name in enumerate(backbones)), every, recurrent]
