"""Figures of the statistics: agreement along sweeps, SBD beside its null, calibration, intervals of the backbones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semstab.core.types import THIS_SCENE, Float64
from semstab.model.measures import VSS, sbd
from semstab.model.statistics import Correlogram, Estimate, LagBin, Reliability
from semstab.model.voxels import VoxelTable
from semstab.report.averages import ENOUGH, Level, Pooled, Sweep, over_all
from semstab.report.figures.distributions import (
    OP_BOUNDS,
    draw_line,
    mark_op,
    mark_values,
    op_position,
    positions,
    settle_scale,
)
from semstab.report.figures.style import COLUMN, FAINT, INK, LETTERS, PAGE, canvas, color, legend_columns, mark_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- Along a sweep ----------------------------------------------------------------------------------------------------

_JUDGED: tuple[tuple[str, Callable[[Pooled], Estimate]], ...] = (
    ("PSA", lambda pooled: pooled.psa),
    ("alpha", lambda pooled: pooled.alpha),
    ("SBD (bits)", lambda pooled: pooled.drift),
)


def _value(take: Callable[[Pooled], Estimate]) -> Callable[[Pooled], float]:
    return lambda pooled: take(pooled).value


def draw_agreement(sweep: Sweep, backbones: Mapping[str, tuple[Level, ...]]) -> Figure:
    """VSS beside what random thinning does not change, and SBD beside its null, along a sweep."""
    from matplotlib.lines import Line2D

    figure = canvas(PAGE, 2.5)
    vss, *judged = figure.subplots(1, 4)
    drift = judged[-1]
    values = sorted({level.value for levels in backbones.values() for level in levels})
    for k, levels in enumerate(backbones.values()):
        x, seen, shuffled = (
            positions(values, levels, i, n * len(backbones)) for i, n in ((k, 1), (2 * k, 2), (2 * k + 1, 2))
        )
        draw_line(vss, x, levels, over_all(VSS), color(k))
        for axes, (_, take) in zip(judged, _JUDGED, strict=True):
            at = seen if axes is drift else x
            draw_line(axes, at, levels, _value(take), color(k), interval=take)
        draw_line(drift, shuffled, levels, lambda pooled: pooled.drift_null, color(k), open_=True)
    titles = ("VSS, all voxels", *(title for title, _ in _JUDGED))
    for axes, letter, title in zip((vss, *judged), "abcd", titles, strict=True):
        mark_values(axes, sweep, values)
        mark_panel(axes, letter, title)
        settle_scale(axes, from_zero=axes is drift)
    handles = [Line2D([], [], color=color(k), label=name) for k, name in enumerate(backbones)]
    own = Line2D([], [], color=INK, marker="o", label="as seen")
    null = Line2D([], [], color=INK, marker="o", linestyle="--", markerfacecolor="white", label="(d) in random order")
    columns = legend_columns([*backbones, "as seen", "(d) in random order"], PAGE)
    figure.legend(handles=[*handles, own, null], loc="outside lower center", ncols=columns)
    return figure


# --- SBD beside its null, by OP ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DriftByOP:
    """Sums over the voxels whose null is known, by bin of OP: how many, of SBD, of the null; they add up."""

    voxels: Float64
    sbd: Float64
    null: Float64

    @classmethod
    def of(cls, table: VoxelTable, null: Float64) -> DriftByOP:
        """Of a map, and the SBD (n,) expected of its voxels in random order."""
        known = ~np.isnan(null)
        bins = np.searchsorted(OP_BOUNDS, table.op[known], side="right") - 1
        columns = (np.ones(len(bins)), sbd(table)[known], null[known])
        voxels, drift, expected = (
            np.bincount(bins, weights=column, minlength=len(OP_BOUNDS)).astype(np.float64) for column in columns
        )
        return cls(voxels, drift, expected)

    def __add__(self, other: DriftByOP) -> DriftByOP:
        return DriftByOP(self.voxels + other.voxels, self.sbd + other.sbd, self.null + other.null)


def draw_drift(backbones: Mapping[str, DriftByOP]) -> Figure:
    """Mean SBD by OP, and what the same observations give in random order; one panel a backbone."""
    columns = len(backbones)
    figure = canvas(COLUMN if columns == 1 else PAGE, 2.4)
    panels = figure.subplots(1, columns, sharey=True, squeeze=False)[0]
    for k, (axes, (name, found)) in enumerate(zip(panels, backbones.items(), strict=True)):
        _draw_drift(axes, found, color(k))
        axes.set_title(name)
        axes.set_xlabel("OP (frames)")
    panels[0].set_ylabel("mean SBD (bits)")
    settle_scale(panels[0], from_zero=True)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2 if columns == 1 else 3)
    return figure


def _draw_drift(axes: Axes, found: DriftByOP, shade: str) -> None:
    there = found.voxels > 0
    x, voxels = op_position()[there], found.voxels[there]
    seen, null = found.sbd[there] / voxels, found.null[there] / voxels
    few = voxels < ENOUGH
    axes.plot(x, null, color=INK, linestyle="--", linewidth=1.0, label="in random order")
    axes.plot(x, seen, color=shade, marker="o", markersize=3.5, linewidth=0.9, label="as seen")
    axes.plot(
        x[few], seen[few], color=shade, marker="o", markersize=3.5, markerfacecolor="white", linewidth=0,
        label=f"fewer than {ENOUGH:,} voxels",
    )  # fmt: skip
    axes.set_xscale("log")
    mark_op(axes, float(x[-1]) if len(x) else 3.0)


# --- Calibration ------------------------------------------------------------------------------------------------------


def draw_reliability(backbones: Mapping[str, Sequence[Reliability]]) -> Figure:
    """Accuracy against the largest belief, and how many voxels have it; the bins of several scenes are pooled."""
    figure = canvas(COLUMN, 3.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    upper.plot([0, 1], [0, 1], color=FAINT, linewidth=1.0, linestyle=":", label="as sure as right")
    for k, (name, bins) in enumerate(backbones.items()):
        voxels, confidence, accuracy, middle = _pooled_bins(bins)
        upper.plot(confidence, accuracy, color=color(k), linewidth=0.9)
        few = voxels < ENOUGH
        upper.plot(confidence[~few], accuracy[~few], color=color(k), marker="o", linewidth=0, label=name)
        upper.plot(confidence[few], accuracy[few], color=color(k), marker="o", markerfacecolor="white", linewidth=0)
        width = 0.8 / 15 / len(backbones)
        lower.bar(middle + (k - (len(backbones) - 1) / 2) * width, voxels, width=width, color=color(k))
    upper.set(ylabel="accuracy", ylim=(-0.03, 1.03))
    lower.set(xlabel="largest belief (confidence)", ylabel="voxels", yscale="log", xlim=(-0.03, 1.03))
    handles, labels = upper.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _pooled_bins(bins: Sequence[Reliability]) -> tuple[Float64, Float64, Float64, Float64]:
    """Voxels, mean confidence and accuracy, and the middle of each bin that has voxels."""
    sums: dict[float, Float64] = {}
    for row in bins:
        if row.voxels:
            own = row.voxels * np.array([1.0, row.confidence, row.accuracy])
            middle = (row.low + row.high) / 2
            sums[middle] = sums.get(middle, np.zeros(3)) + own
    middles = np.array(sorted(sums))
    voxels, confidence, accuracy = np.array([sums[middle] for middle in middles]).reshape(-1, 3).T
    return voxels, confidence / voxels, accuracy / voxels, middles


# --- Intervals --------------------------------------------------------------------------------------------------------

Rows = Mapping[str, Mapping[str, Estimate]]
"""By scene, and by what has its own colour."""


def draw_intervals(panels: Mapping[str, Rows], marks: Mapping[str, Sequence[float]]) -> Figure:
    """Estimates with their intervals, scene beneath scene; one panel a measure, some with values that are marked."""
    scenes = list(dict.fromkeys(scene for rows in panels.values() for scene in rows))
    names = list(dict.fromkeys(name for rows in panels.values() for found in rows.values() for name in found))
    height = max(1.5, 0.75 + len(scenes) * (0.12 + 0.16 * len(names)))
    columns = min(4, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = canvas(PAGE if columns > 2 else COLUMN, height * lines)
    grid = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, letter, (title, rows) in zip(grid, LETTERS, panels.items(), strict=False):
        for value in marks.get(title, ()):
            axes.axvline(value, color=INK, linewidth=0.8, linestyle=":" if value else "-")
        for i, scene in enumerate(scenes):
            for k, name in enumerate(names):
                if (found := rows.get(scene, {}).get(name)) is not None:
                    _draw_interval(
                        axes, i + (k + 0.5) / len(names) * 0.7 - 0.35, found, color(k), name if not i else ""
                    )
        axes.set_yticks(range(len(scenes)), scenes)
        axes.set_ylim(len(scenes) - 0.5, -0.5)
        axes.locator_params(axis="x", nbins=4)
        mark_panel(axes, letter, title)
    beside = legend_columns(names, figure.get_figwidth())
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=beside)
    return figure


def _draw_interval(axes: Axes, y: float, found: Estimate, shade: str, label: str) -> None:
    if math.isnan(found.value):
        return
    ends = [[0.0], [0.0]] if math.isnan(found.low) else [[found.value - found.low], [found.high - found.value]]
    axes.errorbar(
        [found.value], [y], xerr=np.maximum(ends, 0.0), color=shade, marker="o", markersize=3.5, capsize=2,
        elinewidth=1.0, linewidth=0, label=label or None,
    )  # fmt: skip


# Figure of the correlogram: agreement beyond chance by how far apart two looks at a place are.

AXES = (
    ("time", "frames apart"),
    ("angle", "degrees between the views"),
    ("range", "ratio of the ranges"),
    ("baseline", "metres between the cameras"),
)


def draw_correlogram(backbones: Mapping[str, Correlogram]) -> Figure:
    """Alpha between frames with its band; one panel for each way of being apart.

    Points are open where the band is for these frames alone.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullLocator

    figure = canvas(PAGE, 2.5)
    panels = figure.subplots(1, len(AXES), sharey=True)
    for axes, letter, (axis, title) in zip(panels, "abcd", AXES, strict=True):
        axes.axhline(0.0, color=FAINT, linewidth=0.8)
        for k, found in enumerate(backbones.values()):
            _draw_bins(axes, getattr(found, axis), color(k))
        if axis in ("time", "baseline"):
            axes.set_xscale("log")
            low, high = axes.get_xlim()
            round_ones = [digit * 10.0**power for power in range(-4, 6) for digit in (1, 2, 5)]
            ticks = [tick for tick in round_ones if low <= tick <= high]
            axes.set_xticks(ticks if len(ticks) > 1 else [low * (high / low) ** part for part in (0.1, 0.5, 0.9)])
            axes.xaxis.set_major_formatter("{x:.3g}")
            axes.xaxis.set_minor_locator(NullLocator())
        else:
            axes.locator_params(axis="x", nbins=4)
        axes.set_xlabel(title)
        mark_panel(axes, letter, "")
    panels[0].set_ylabel("alpha between frames")
    panels[0].set_ylim(top=1.03)
    handles = [Line2D([], [], color=color(k), marker="o", label=name) for k, name in enumerate(backbones)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6))
    return figure


def _draw_bins(axes: Axes, bins: Sequence[LagBin], shade: str) -> None:
    x = [row.mean for row in bins]
    axes.plot(x, [row.alpha.value for row in bins], color=shade)
    for row in bins:
        face = shade if row.alpha.scope == THIS_SCENE else "white"
        axes.plot(row.mean, row.alpha.value, color=shade, marker="o", markersize=3.5, markerfacecolor=face)
    axes.fill_between(
        x, [row.alpha.low for row in bins], [row.alpha.high for row in bins], color=shade, alpha=0.15, linewidth=0
    )
