"""The three figures of docs/real-networks.md, from results/streets.csv; colours of Okabe and Ito, told apart by all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import streets_analysis as analysis
from matplotlib.figure import Figure
from streets_analysis import MEASURES, QUESTIONS, StreetGrid, with_interval

from semstab.core.files import atomic_path

FAMILIES = {
    "espnetv2": ("#0072B2", "o", "ESPNetv2"), "dicenet": ("#D55E00", "s", "DiCENet"),
    "espnet": ("#009E73", "^", "ESPNet"), "deeplab": ("#CC79A7", "D", "DeepLab (edge TPU)"),
}  # fmt: skip
STYLE = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}


def draw(grid: StreetGrid, folder: Path) -> None:
    """Write streets-measures.png, streets-accuracy.png and streets-places.png."""
    with mpl.rc_context(STYLE):
        for name, of in (("measures", _measures), ("accuracy", _accuracy), ("places", _places)):
            with atomic_path(folder / f"streets-{name}.png") as path:
                of(grid).savefig(path, format="png", dpi=150, metadata={"Software": None})


def _measures(grid: StreetGrid) -> Figure:
    """Return the correlations of each measure with accuracy, over networks and over streets, with intervals."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    asked = {"networks: which is better?": "which network, over all streets",
             "streets: which is harder?": "which street, for one network"}  # fmt: skip
    for axes, (title, question) in zip(figure.subplots(1, 2, sharey=True), asked.items(), strict=True):
        for k, name in enumerate(MEASURES):
            value, low, high = with_interval(grid, grid.column(name), QUESTIONS[question], grid.column("accuracy"))
            if np.isnan(value):
                continue
            color = "#D55E00" if name == "alpha" else "#0072B2"
            axes.plot([low, high], [k, k], color=color, linewidth=1.5)
            axes.plot(value, k, "o", color=color, markersize=5)
        axes.axvline(0, color="#555555", linewidth=0.8)
        axes.set_xlim(-1, 1.02)
        axes.set_xticks([-0.5, 0, 0.5, 1])
        axes.set_yticks(range(len(MEASURES)), list(MEASURES.values()))
        axes.set_title(title, fontsize=10)
        axes.grid(axis="x", color="#dddddd", linewidth=0.5)
    axes.invert_yaxis()
    figure.supxlabel("rank correlation with accuracy, 95 % interval (+1: ranks as accuracy does)", fontsize=10)
    return figure


def _accuracy(grid: StreetGrid) -> Figure:
    """Return alpha and VSS against accuracy: each network (mean of the streets), each street (mean of the networks)."""
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    accuracy = 100 * grid.column("accuracy")
    for column, name in enumerate(("alpha", "vss")):
        measure = grid.column(name)
        of_networks, of_streets = (figure.add_subplot(2, 2, 1 + 2 * row + column) for row in (0, 1))
        for family, (color, marker, title) in FAMILIES.items():
            networks = [k for k, of_network in enumerate(grid.family) if of_network == family]
            of_networks.plot(
                accuracy[networks].mean(axis=1), measure[networks].mean(axis=1), marker, color=color, label=title
            )
        of_streets.plot(accuracy.mean(axis=0), measure.mean(axis=0), "o", color="#0072B2")
        for k, street in enumerate(grid.streets):
            at = accuracy[:, k].mean(), measure[:, k].mean()
            of_streets.annotate(street, at, xytext=(4, 3), textcoords="offset points", fontsize=8)
        pairs = ((of_networks, "network", "which network, over all streets"),
                 (of_streets, "street", "which street, mean of networks"))  # fmt: skip
        for axes, what, question in pairs:
            rho = analysis.signed(QUESTIONS[question](measure, accuracy))
            axes.set_title(f"{MEASURES[name]}, each {what}: {rho}", fontsize=10)
            axes.set_xlabel(f"accuracy of a {what}, %")
            axes.set_ylabel(MEASURES[name])
            axes.grid(color="#dddddd", linewidth=0.5)
            axes.set_axisbelow(True)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _places(grid: StreetGrid) -> Figure:
    """Return the AUROC of each sign for wrong pixels: a point for each street, and the mean."""
    figure = Figure(figsize=(7, 2.9), layout="constrained")
    axes: Any = figure.add_subplot()
    signs = {"disagreement": "frames disagree", "entropy": "entropy of the voxel", "border": "border near",
             "softmax": "softmax low", "all": "all four"}  # fmt: skip
    for k, name in enumerate(signs):
        areas = np.nanmean(grid.column(f"auroc_{name}"), axis=0)
        axes.plot(areas, np.full(len(areas), k), "o", color="#56B4E9", markersize=5, alpha=0.8)
        axes.plot(areas.mean(), k, "|", color="black", markersize=16, markeredgewidth=2)
    axes.set_yticks(range(len(signs)), list(signs.values()))
    axes.set_xlim(0.5, 1)
    axes.set_ylim(len(signs) - 0.5, -0.5)
    axes.set_xlabel("AUROC for wrong pixels")
    axes.set_title("a point: a street (mean of the networks); a bar: the mean", fontsize=10)
    axes.grid(axis="x", color="#dddddd", linewidth=0.5)
    return figure
