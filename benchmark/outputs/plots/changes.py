"""Where two maps differ, seen from above or from the side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from semstab.model.voxels import VoxelTable
from semstab.outputs.plots.maps import BLANK, color_bar, framed, map_panels, scale_bar
from semstab.outputs.plots.style import COLORS, INK, LETTERS, mark_panel
from semstab.outputs.plots.topdown import EMPTY, OUTLIERS, Float64, Int64, best_view, level_axes, top_down

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SAME = "#dedede"
"""Of voxels that did not change; blank paper is where there are none."""


@dataclass(frozen=True)
class Panel:
    """What is drawn of each voxel, from -1, worse, to 1, better; and the numbers of places (m,) at their centres."""

    title: str
    ends: tuple[str, str]
    values: Float64
    numbers: Sequence[int]
    centres: Sequence[tuple[float, float, float]]


def draw_changes(table: VoxelTable, up: npt.ArrayLike, panels: Sequence[Panel]) -> Figure:
    """The largest change in each column of voxels, worse in orange, better in blue."""
    axis, view = best_view(table, up)[1:]
    seen = [top_down(table, axis, np.abs(panel.values)) for panel in panels]
    figure, axes = map_panels(seen[0][0], len(panels))
    for own, letter, panel, (rows, cell) in zip(axes, LETTERS, panels, seen, strict=False):
        _draw(figure, own, panel, rows)
        mark_panel(own, letter, f"{panel.title}, {view.partition(',')[0]}")
        framed(own)
        scale_bar(own, rows.shape[1], cell)
        _number(own, panel, table, axis, rows.shape[0], cell)
    return figure


def _draw(figure: Figure, axes: Axes, panel: Panel, rows: Int64) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    shades = ScalarMappable(Normalize(-1, 1), LinearSegmentedColormap.from_list("change", [COLORS[1], SAME, COLORS[0]]))
    image = shades.to_rgba(panel.values[rows], bytes=True)
    image[rows == EMPTY, :3] = BLANK
    axes.imshow(image, interpolation_stage="rgba")
    bar = color_bar(figure, axes, shades)
    bar.set_ticks([-1, 0, 1], labels=[panel.ends[0], "as before", panel.ends[1]])
    first, _, last = bar.ax.get_xticklabels()
    first.set_horizontalalignment("left")
    last.set_horizontalalignment("right")


def _number(axes: Axes, panel: Panel, table: VoxelTable, axis: Float64, height: int, cell: float) -> None:
    """The numbers of the places, beside their centres."""
    from matplotlib.patheffects import withStroke

    right, ahead, _ = level_axes(axis)
    plane = np.stack([table.centers @ ahead, table.centers @ right], axis=1)
    first = np.floor(np.quantile(plane, OUTLIERS, axis=0) / cell)
    for number, centre in zip(panel.numbers, panel.centres, strict=True):
        row, column = np.floor(np.array([ahead @ np.array(centre), right @ np.array(centre)]) / cell) - first
        axes.annotate(
            str(number), (column, height - 1 - row), fontsize=6.5, color=INK, ha="center", va="center",
            path_effects=[withStroke(linewidth=2, foreground="white")], annotation_clip=True,
        )  # fmt: skip
