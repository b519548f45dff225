"""ECDFs of disagreement and drift, and both against OP (paper, Semantic Agreement and Belief Drift)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from semstab.averages import ENOUGH
from semstab.plots.histograms import Histogram, Measure, op_position, together
from semstab.plots.style import COLUMN, FAINT, INK, PAGE, canvas, color, mark_panel
from semstab.results import RECURRENT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Panels = np.ndarray[tuple[int], np.dtype[np.object_]]

INFORMATIVE = 0.99
"""The axes of the ECDFs end where this share of the voxels of every curve is reached."""


def draw_ecdf(scenes: Mapping[str, Histogram], limits: tuple[float, float]) -> Figure:
    """The ECDF of 1 - VSS and of SBD of each scene, and of all recurrent voxels; limits end the x axes."""
    figure = canvas(PAGE, 2.4)
    left, right = figure.subplots(1, 2)
    everything = together(scenes.values())
    disagreement = {name: histogram.disagreement for name, histogram in scenes.items()}
    drift = {name: histogram.sbd for name, histogram in scenes.items()}
    _draw_curves(left, disagreement, everything.disagreement)
    _draw_curves(right, drift, everything.sbd)
    left.set(xlabel="1 - VSS", ylabel="share of voxels", xlim=(0, 1.03 * limits[0]), ylim=(None, 1.0))
    right.set(xlabel="SBD (bits)", ylabel="share of voxels", xlim=(0, 1.03 * limits[1]), ylim=(None, 1.0))
    mark_panel(left, "a", "disagreement")
    mark_panel(right, "b", "drift, voxels seen twice or more")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=min(6, len(scenes) + 1))
    return figure


def _draw_curves(axes: Axes, scenes: Mapping[str, Measure], everything: Measure) -> None:
    """One curve a scene, and a dashed one of all recurrent voxels, where there are any."""
    for k, (name, measure) in enumerate(scenes.items()):
        axes.step(measure.values, measure.ecdf(), where="post", color=color(k), label=name)
    recurrent = everything.ecdf(RECURRENT)
    if recurrent[-1]:
        axes.step(everything.values, recurrent, "k--", where="post", linewidth=1.0, label="OP ≥ 3, all scenes")


def informative(histograms: Mapping[str, Histogram]) -> tuple[float, float]:
    """Where the x axes of 1 - VSS and of SBD end, so that every scene's curve is seen up to its last percent."""

    def end(measure: Measure) -> float:
        reached = measure.ecdf() >= INFORMATIVE
        return float(measure.values[reached.argmax()]) if reached.any() else measure.largest

    ends = [(end(h.disagreement), end(h.sbd)) for h in histograms.values()]
    return max(0.05, *(d for d, _ in ends)), max(0.02, *(s for _, s in ends))


def draw_persistence(backbones: Mapping[str, Histogram]) -> Figure:
    """VSS and SBD against OP, mean and interquartile range, and the number of voxels; one column a backbone."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    columns = len(backbones)
    figure = canvas(COLUMN if columns == 1 else PAGE, 4.2)
    grid = figure.subplots(3, columns, sharex=True, sharey="row", squeeze=False, height_ratios=(3, 3, 1.6))
    for k, (name, histogram) in enumerate(backbones.items()):
        _draw_column(grid[:, k], histogram, color(k))
        grid[0, k].set_title(name)
        grid[2, k].set_xlabel("OP (frames)")
    for axes, label in zip(grid[:, 0], ("VSS", "SBD (bits)", "voxels"), strict=True):
        axes.set_ylabel(label)
    band = Patch(facecolor=FAINT, alpha=0.4, label="interquartile range")
    few = Line2D(
        [], [], color=INK, marker="o", markerfacecolor="white", linewidth=0, label=f"fewer than {ENOUGH:,} voxels"
    )
    handles = [Line2D([], [], color=INK, marker="o", label="mean"), band, few]
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if columns > 1 else 2)
    return figure


def _draw_column(rows: Panels, histogram: Histogram, shade: str) -> None:
    voxels = histogram.disagreement.voxels
    present = voxels > 0
    x, few = op_position()[present], voxels[present] < ENOUGH
    d, s = histogram.disagreement, histogram.sbd
    curves = (
        (1 - d.mean()[present], 1 - d.quantile(0.75)[present], 1 - d.quantile(0.25)[present]),
        (s.mean()[present], s.quantile(0.25)[present], s.quantile(0.75)[present]),
    )
    for axes, (mean, low, high) in zip(rows[:2], curves, strict=True):
        axes.fill_between(x, low, high, color=shade, alpha=0.2, linewidth=0.8)
        axes.plot(x, mean, color=shade, marker="o", markersize=3)
        axes.plot(x[few], mean[few], color=shade, marker="o", markersize=3, markerfacecolor="white", linewidth=0)
    rows[2].vlines(x, 0.5, voxels[present], color=shade, linewidth=3)
    rows[2].axhline(ENOUGH, color=INK, linewidth=0.6, linestyle=":")
    rows[2].set(xscale="log", yscale="log", ylim=(0.5, None))
    mark_op(rows[2], x[-1])


def mark_op(axes: Axes, largest: float) -> None:
    """Ticks at round OP on the logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    ticks = range(1, 9) if largest <= 8 else (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in ticks if tick <= max(largest, 3)]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(ScalarFormatter())
