"""ECDFs of what each measure lacks, and each against OP (paper, Semantic Agreement and Belief Drift)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from semstab.model.measures import measures
from semstab.model.results import RECURRENT
from semstab.outputs.averages import ENOUGH
from semstab.outputs.plots.histograms import Histograms, MeasureByOP, lacking, op_position, together
from semstab.outputs.plots.style import COLUMN, FAINT, INK, LETTERS, PAGE, canvas, color, legend_columns, mark_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Panels = np.ndarray[tuple[int], np.dtype[np.object_]]

INFORMATIVE = 0.99
"""The axes of the ECDFs end where this share of the voxels of every curve is reached."""


def draw_ecdf(scenes: Mapping[str, Histograms], ends: Mapping[str, float]) -> Figure:
    """The ECDF of how much each measure lacks in each scene, and in all recurrent voxels; ends are those of x axes."""
    shown = measures()
    figure = canvas(PAGE, 2.4 * math.ceil(len(shown) / 2))
    panels = figure.subplots(math.ceil(len(shown) / 2), 2, squeeze=False).ravel()
    everything = together(scenes.values())
    for axes, letter, measure in zip(panels, LETTERS, shown, strict=False):
        _draw_curves(axes, {name: found[measure.key] for name, found in scenes.items()}, everything[measure.key])
        label = measure.title if measure.better == "lower" else f"{measure.largest:g} - {measure.title}"
        unit = f" ({measure.unit})" if measure.unit else ""
        axes.set(xlabel=label + unit, ylabel="share of voxels", xlim=(0, 1.03 * ends[measure.key]), ylim=(0.0, 1.02))
        mark_panel(axes, letter, f"{label}, voxels with OP ≥ {measure.lowest_op}" if measure.lowest_op > 1 else label)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=legend_columns(labels, figure.get_figwidth()))
    return figure


def _draw_curves(axes: Axes, scenes: Mapping[str, MeasureByOP], everything: MeasureByOP) -> None:
    """One curve a scene, and a dashed one of all recurrent voxels, where there are any."""
    for k, (name, found) in enumerate(scenes.items()):
        axes.step(found.values, found.ecdf(), where="post", color=color(k), label=f"{name}, all voxels")
    recurrent = everything.ecdf(RECURRENT)
    if recurrent[-1]:
        axes.step(
            everything.values,
            recurrent,
            "k--",
            where="post",
            linewidth=1.0,
            label="voxels with OP ≥ 3" + (", all scenes" if len(scenes) > 1 else ""),
        )


def informative(units: Iterable[Histograms]) -> dict[str, float]:
    """Where the x axis of each measure ends, so that every scene's curve is seen up to its last percent."""

    def end(found: MeasureByOP) -> float:
        reached = found.ecdf() >= INFORMATIVE
        return float(found.values[reached.argmax()]) if reached.any() else found.largest

    ends: dict[str, float] = {}
    for scene in units:
        for key, found in scene.items():
            ends[key] = max(ends.get(key, 0.06 * found.largest), end(found))
    return ends


def draw_persistence(backbones: Mapping[str, Histograms]) -> Figure:
    """Each measure against OP, mean and interquartile range, and the number of voxels; one column a backbone."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    columns, shown = len(backbones), measures()
    figure = canvas(COLUMN if columns == 1 else PAGE, 1.2 + 1.5 * len(shown))
    ratios = (*[3.0] * len(shown), 1.6)
    grid = figure.subplots(len(ratios), columns, sharex=True, sharey="row", squeeze=False, height_ratios=ratios)
    for k, (name, histogram) in enumerate(backbones.items()):
        _draw_column(grid[:, k], histogram, color(k))
        grid[0, k].set_title(name)
        grid[-1, k].set_xlabel("OP (frames)")
    labels = (f"{m.title} ({m.unit})" if m.unit else m.title for m in shown)
    for axes, label in zip(grid[:, 0], (*labels, "voxels"), strict=True):
        axes.set_ylabel(label)
    band = Patch(facecolor=FAINT, alpha=0.4, label="interquartile range")
    few = Line2D(
        [], [], color=INK, marker="o", markerfacecolor="white", linewidth=0, label=f"fewer than {ENOUGH:,} voxels"
    )
    handles = [Line2D([], [], color=INK, marker="o", label="mean"), band, few]
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if columns > 1 else 2)
    return figure


def _draw_column(rows: Panels, found: Histograms, shade: str) -> None:
    voxels = next(iter(found.values())).voxels
    present = voxels > 0
    x, few = op_position()[present], voxels[present] < ENOUGH
    for axes, measure in zip(rows[:-1], measures(), strict=True):
        own = found[measure.key]
        curves = (own.mean(), own.quantile(0.25), own.quantile(0.75))
        mean, *ends = (lacking(measure, curve[present]) for curve in curves)
        axes.fill_between(x, *ends, color=shade, alpha=0.2, linewidth=0.8)
        axes.plot(x, mean, color=shade, marker="o", markersize=3)
        axes.plot(x[few], mean[few], color=shade, marker="o", markersize=3, markerfacecolor="white", linewidth=0)
    rows[-1].vlines(x, 0.5, voxels[present], color=shade, linewidth=3)
    rows[-1].axhline(ENOUGH, color=INK, linewidth=0.6, linestyle=":")
    rows[-1].set(xscale="log", yscale="log", ylim=(0.5, None))
    mark_op(rows[-1], x[-1])


def mark_op(axes: Axes, largest: float) -> None:
    """Ticks at round OP on the logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    ticks = range(1, 9) if largest <= 8 else (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in ticks if tick <= max(largest, 3)]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(ScalarFormatter())
