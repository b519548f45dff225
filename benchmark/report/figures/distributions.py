"""Draw the ECDF of each measure, and each measure against OP (paper, Semantic Agreement and Belief Drift)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.data.measures import RECURRENT, Measure, measures, op
from semstab.data.statistics import Estimate
from semstab.data.voxels import VoxelTable
from semstab.report.figures.style import COLUMN, FAINT, INK, LETTERS, PAGE, canvas, color, legend_columns, mark_panel
from semstab.report.means import ENOUGH, Level, Pooled, Sweep, over_all, over_recurrent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Histograms of the voxels of units by OP give the ECDFs and the curves against OP; histograms can be added.

BINS = 1000
"""The number of bins of a measure between 0 and its largest value; a further bin, the first, holds 0 alone."""

EDGES = np.append(-1.0, np.arange(BINS + 1) / BINS + 1e-9)
"""The ends of these bins, as shares of the largest value."""


def _op_bounds() -> Int64:
    """Return the lowest OP of each bin: single values up to 8, then steps of about a quarter."""
    bounds = list(range(1, 10))
    while bounds[-1] < 2**31:
        bounds.append(max(bounds[-1] + 1, round(bounds[-1] * 1.25)))
    return np.array(bounds)


OP_BOUNDS = _op_bounds()

Histograms = Mapping[Measure, Float64]
"""Counts (OP bins, 1 + BINS) of the voxels of a unit, or of several, by OP and distance from a measure's best value."""


def distance(measure: Measure, value: Float64) -> Float64:
    """Return the distance of values from the best value; applied twice it returns the values."""
    return value if measure.better == "lower" else measure.largest - value


def histograms(table: VoxelTable) -> Histograms:
    """Return the histograms of a unit, without undefined values."""
    persistence, bounds = op(table), np.append(OP_BOUNDS, np.inf)
    shares = {m: distance(m, m.of(table)) / m.largest for m in measures()}
    return {m: np.histogram2d(persistence, share, [bounds, EDGES])[0] for m, share in shares.items()}


def together(units: Iterable[Histograms]) -> Histograms:
    """Return the voxels of several units pooled."""
    return reduce(lambda a, b: {measure: counts + b[measure] for measure, counts in a.items()}, units)


def upper_ends(measure: Measure) -> Float64:
    """Return (1 + BINS,) the upper ends of the bins."""
    return np.arange(BINS + 1) / BINS * measure.largest


def ecdf(counts: Float64, lowest_op: int = 1) -> Float64:
    """Return (1 + BINS,) the share of the voxels with at least that OP whose value is at most the bin's upper end."""
    sums = counts[np.searchsorted(OP_BOUNDS, lowest_op) :].sum(axis=0)
    share: Float64 = sums.cumsum() / max(1, sums.sum())
    return share


def by_op(measure: Measure, counts: Float64) -> tuple[Float64, Float64, Float64]:
    """Return mean and quartiles of the values (OP bins,), half a bin too far off at most; NaN without voxels."""
    voxels, ends = counts.sum(axis=1), upper_ends(measure)
    middles = np.append(0.0, (ends[1:] + ends[:-1]) / 2)
    mean = counts @ middles / np.where(voxels > 0, voxels, np.nan)
    low, high = (ends[(counts.cumsum(axis=1) >= q * voxels[:, None]).argmax(axis=1)] for q in (0.25, 0.75))
    return distance(measure, mean), distance(measure, low), distance(measure, high)


def op_position() -> Float64:
    """Return (OP bins,) the position of a bin on a logarithmic axis: the geometric mean of its OP."""
    last = np.append(OP_BOUNDS[1:] - 1, OP_BOUNDS[-1])
    return np.sqrt(OP_BOUNDS * last.astype(np.float64))


Panels = np.ndarray[tuple[int], np.dtype[np.object_]]

INFORMATIVE = 0.99
"""The axes of the ECDFs end where this share of the voxels of every curve is reached."""


def draw_ecdf(scenes: Mapping[str, Histograms], ends: Mapping[Measure, float]) -> Figure:
    """Return the ECDF of each measure's distance from the best value, in each scene and in all recurrent voxels.

    `ends` are the ends of the x axes.
    """
    panel_measures = measures()
    figure = canvas(PAGE, 2.4 * math.ceil(len(panel_measures) / 2))
    panels = figure.subplots(math.ceil(len(panel_measures) / 2), 2, squeeze=False).ravel()
    everything = together(scenes.values())
    for axes, letter, measure in zip(panels, LETTERS, panel_measures, strict=False):
        _draw_curves(axes, measure, {name: counts[measure] for name, counts in scenes.items()}, everything[measure])
        label = measure.title if measure.better == "lower" else f"{measure.largest:g} - {measure.title}"
        unit = f" ({measure.unit})" if measure.unit else ""
        axes.set(xlabel=label + unit, ylabel="share of voxels", xlim=(0, 1.03 * ends[measure]), ylim=(0.0, 1.02))
        mark_panel(axes, letter, f"{label}, voxels with OP ≥ {measure.lowest_op}" if measure.lowest_op > 1 else label)
    for axes in panels[len(panel_measures) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=legend_columns(labels, figure.get_figwidth()))
    return figure


def _draw_curves(axes: Axes, measure: Measure, scenes: Mapping[str, Float64], everything: Float64) -> None:
    """Draw one curve a scene, and a dashed one of all recurrent voxels, if any."""
    ends = upper_ends(measure)
    for k, (name, counts) in enumerate(scenes.items()):
        axes.step(ends, ecdf(counts), where="post", color=color(k), label=f"{name}, all voxels")
    recurrent = ecdf(everything, RECURRENT)
    if recurrent[-1]:
        label = "voxels with OP ≥ 3" + (", all scenes" if len(scenes) > 1 else "")
        axes.step(ends, recurrent, "k--", where="post", linewidth=1.0, label=label)


def informative(units: Iterable[Histograms]) -> dict[Measure, float]:
    """Return the end of the x axis of each measure, so that every scene's curve is seen up to its last percent."""
    ends: dict[Measure, float] = {}
    for scene in units:
        for measure, counts in scene.items():
            reached = ecdf(counts) >= INFORMATIVE
            end = float(upper_ends(measure)[reached.argmax()]) if reached.any() else measure.largest
            ends[measure] = max(ends.get(measure, 0.06 * measure.largest), end)
    return ends


def draw_persistence(models: Mapping[str, Histograms]) -> Figure:
    """Return each measure against OP, mean and interquartile range, and the number of voxels; one column a model."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    columns, panel_measures = len(models), measures()
    figure = canvas(COLUMN if columns == 1 else PAGE, 1.2 + 1.5 * len(panel_measures))
    ratios = (*[3.0] * len(panel_measures), 1.6)
    grid = figure.subplots(len(ratios), columns, sharex=True, sharey="row", squeeze=False, height_ratios=ratios)
    for k, (name, histogram) in enumerate(models.items()):
        _draw_column(grid[:, k], histogram, color(k))
        grid[0, k].set_title(name)
        grid[-1, k].set_xlabel("OP (frames)")
    labels = (f"{m.title} ({m.unit})" if m.unit else m.title for m in panel_measures)
    for axes, label in zip(grid[:, 0], (*labels, "voxels"), strict=True):
        axes.set_ylabel(label)
    band = Patch(facecolor=FAINT, alpha=0.4, label="interquartile range")
    few = Line2D(
        [], [], color=INK, marker="o", markerfacecolor="white", linewidth=0, label=f"fewer than {ENOUGH:,} voxels"
    )
    handles = [Line2D([], [], color=INK, marker="o", label="mean"), band, few]
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if columns > 1 else 2)
    return figure


def _draw_column(rows: Panels, histograms: Histograms, shade: str) -> None:
    voxels = next(iter(histograms.values())).sum(axis=1)
    present = voxels > 0
    x, few = op_position()[present], voxels[present] < ENOUGH
    for axes, measure in zip(rows[:-1], measures(), strict=True):
        mean, *ends = (curve[present] for curve in by_op(measure, histograms[measure]))
        axes.fill_between(x, *ends, color=shade, alpha=0.2, linewidth=0.8)
        axes.plot(x, mean, color=shade, marker="o", markersize=3)
        axes.plot(x[few], mean[few], color=shade, marker="o", markersize=3, markerfacecolor="white", linewidth=0)
    rows[-1].vlines(x, 0.5, voxels[present], color=shade, linewidth=3)
    rows[-1].axhline(ENOUGH, color=INK, linewidth=0.6, linestyle=":")
    rows[-1].set(xscale="log", yscale="log", ylim=(0.5, None))
    mark_op(rows[-1], x[-1])


def mark_op(axes: Axes, largest: float) -> None:
    """Mark round OP on the logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    ticks = range(1, 9) if largest <= 8 else (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
    axes.xaxis.set_major_locator(FixedLocator([tick for tick in ticks if tick <= max(largest, 3)]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(ScalarFormatter())


# The sensitivity sweeps: aggregate and recurrent values together with the recurrent share (paper, Sensitivity).

APART = 0.06
"""The distance between series along the x axis, as a share of a step: equal values are drawn side by side."""

LEAST_SPAN = 0.1
"""The least span of the axis of a share that is good when high (VSS, margin, PSA, alpha), so that a smaller difference
looks small. The axes of measures that are good when low (SBD, entropy), and of the recurrent share, begin at 0."""


def draw_sweep(sweep: Sweep, models: Mapping[str, tuple[Level, ...]]) -> Figure:
    """Return the recurrent share and every measure along a sweep; the values are drawn in order, at equal distances."""
    panel_measures = measures()
    rows = math.ceil((1 + len(panel_measures)) / 3)
    figure = canvas(PAGE, 2.5 if rows == 1 else 2.1 * rows)
    share, *panels = figure.subplots(rows, 3, squeeze=False).ravel()
    values = sorted({level.value for levels in models.values() for level in levels})
    for k, levels in enumerate(models.values()):
        x = positions(values, levels, k, len(models))
        draw_line(share, x, levels, lambda p: 100 * p.recurrent.share, color(k), marker="s")
        enough = [level for level in levels if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH]
        enough_x = positions(values, enough, k, len(models))
        for axes, measure in zip(panels, panel_measures, strict=False):
            draw_line(axes, x, levels, over_all(measure), color(k))
            draw_line(axes, enough_x, enough, over_recurrent(measure), color(k), open_=True)
    titles = ("recurrent share (%)", *(f"{m.title} ({m.unit})" if m.unit else m.title for m in panel_measures))
    for axes, letter, title in zip((share, *panels), LETTERS, titles, strict=False):
        mark_values(axes, sweep, values)
        mark_panel(axes, letter, title)
    for axes in panels[len(panel_measures) :]:
        axes.set_axis_off()
    for axes, better in zip((share, *panels), ("lower", *(m.better for m in panel_measures)), strict=False):
        settle_scale(axes, from_zero=better == "lower")
    columns = legend_columns([*models, "all voxels", "OP ≥ 3"], PAGE)
    figure.legend(handles=_legend(list(models)), loc="outside lower center", ncols=columns)
    return figure


def positions(values: Sequence[float], levels: Sequence[Level], k: int, series: int) -> list[float]:
    """Return the positions of the levels of the k-th series along the x axis."""
    return [values.index(level.value) + APART * (k - (series - 1) / 2) for level in levels]


def settle_scale(axes: Axes, *, from_zero: bool) -> None:
    """Widen the y axis to hold 0, or `LEAST_SPAN`; curves, intervals and markers stay inside."""
    if not any(np.isfinite(np.asarray(line.get_ydata(), dtype=np.float64)).any() for line in axes.lines):
        axes.text(0.5, 0.5, "not known\nwithout --statistics", transform=axes.transAxes, ha="center", va="center")
        axes.set_yticks([])
        return
    low, high = axes.get_ylim()
    if from_zero:
        axes.set_ylim(min(low, -0.04 * high), high)
    elif (missing := LEAST_SPAN - (high - low)) > 0:
        top = max(high, min(high + missing / 2, 1.01))  # no share is above 1
        axes.set_ylim(top - LEAST_SPAN, top)


def mark_values(axes: Axes, sweep: Sweep, values: Sequence[float]) -> None:
    """Mark the swept values along the x axis, at equal distances."""
    axes.set_xticks(range(len(values)), [sweep.text(value) for value in values])
    axes.set_xlim(-0.35, len(values) - 0.65)
    axes.margins(y=0.1)  # shows a point at the end of an axis whole
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
    """Draw a measure along a sweep, with its interval, else its deviation over repeats; `open_` dashes it."""
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
    """Return the lengths of the bar below and above the mean; 0 where they are not known."""
    if interval is None:
        sd = level.spread(measure).sd
        return (0.0, 0.0) if math.isnan(sd) else (sd, sd)
    estimate = level.interval(interval)
    if math.isnan(estimate.low):
        return 0.0, 0.0
    return max(estimate.value - estimate.low, 0.0), max(estimate.high - estimate.value, 0.0)


def _legend(models: list[str]) -> list[object]:
    from matplotlib.lines import Line2D

    all_voxels = Line2D([], [], color=INK, marker="o", label="all voxels")
    recurrent = Line2D([], [], color=INK, marker="o", linestyle="--", markerfacecolor="white", label="OP ≥ 3")
    return [*(Line2D([], [], color=color(k), label=name) for k, name in enumerate(models)), all_voxels, recurrent]
