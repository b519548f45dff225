"""Draw maps from above, of stability and of measures; and the overview from image to map."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int64, Mask, UInt8
from semstab.data.digests import require_unchanged
from semstab.data.georeference import Georeference
from semstab.data.measures import dominant, measures
from semstab.data.records import Record, Tables
from semstab.data.topdown import EMPTY, top_down
from semstab.data.voxels import VoxelTable
from semstab.datasets.formats.disk import decode_array, read_bytes
from semstab.errors import DataError, summarize_error
from semstab.metrics import CATEGORIES, CATEGORY_COLORS, categories
from semstab.report.figures.distributions import Histograms, histograms, together
from semstab.report.figures.located import Located, metres
from semstab.report.figures.style import COLORS, COLUMN, FAINT, INK, LETTERS, PAGE, canvas, mark_panel
from semstab.report.figures.topdown import MOST, FromAbove, best_view, topmost

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure


Image = UInt8
Colors = Sequence[tuple[int, int, int]]

BLANK = (255, 255, 255)
UNDEFINED = "#cccccc"
COLORMAP = "YlOrRd"
LEGEND_LINE, LEGEND_KEY, LEGEND_LETTER = 0.15, 0.5, 0.066
"""The height of a line of a legend, and the widths of a key with its margins and of a letter, inches."""

WIDE = 1.4
"""The panels of a map that is this many times as wide as high, or more, are drawn one below the other."""


def draw_stability(above: FromAbove, georeference: Georeference | None = None) -> Figure:
    """Return the stability category of the topmost voxels and the measures that have a panel, with coordinates."""
    table, rows, located = above.table, above.rows, Located.from_view(above, georeference)
    panel_measures = [measure for measure in measures() if measure.panel]
    figure, (kind, *panels) = map_panels(rows, 1 + len(panel_measures))
    draw_kinds(figure, kind, rows, categories(table), CATEGORY_COLORS, CATEGORIES)
    for axes, measure in zip(panels, panel_measures, strict=True):
        values = np.where(table.op > 1, measure.of(table), np.nan)
        _draw_measure(figure, axes, rows, values, measure.range, best_first=measure.better == "lower")
    where = "" if above.view == "from above" else f", {above.view}"
    titles = (f"stability{where}", *(f"{m.title}, {m.unit}" if m.unit else m.title for m in panel_measures))
    for axes, letter, title in zip((kind, *panels), LETTERS, titles, strict=False):
        mark_panel(axes, letter, title)
        framed(axes)
        locate(axes, located, rows.shape, numbers=axes is kind)
    return figure


@dataclass(frozen=True, eq=False)
class LoneFrames:
    """Frames that stand out, the largest excess first, as small images.

    Attributes:
        frames: (n,) their indices.
        labels: (n, h, w) rows 0..K-1, and above where a pixel has none.
        alone: (n, h, w) pixels whose label differs from those of the frames before and after.
        color: (n, h, w, 3); None if the dataset has no images.
    """

    frames: Int64
    labels: npt.NDArray[np.integer[Any]]
    alone: Mask
    color: Image | None


@dataclass(frozen=True, eq=False)
class PlacePictures:
    """Places where frames disagree, as small images of the frames that see them.

    Attributes:
        of: (n,) number of the place that an image shows.
        centre: (n, 3) its centre in the scene, metres.
        frame: (n,) index of the frame.
        labels: (n, h, w) rows 0..K-1, and above where a pixel has none.
        ring: (n, 3) centre x, y and radius of a circle around the place, shares of the image.
        color: (n, h, w, 3); None if the dataset has no images.
    """

    of: Int64
    centre: Float64
    frame: Int64
    labels: npt.NDArray[np.integer[Any]]
    ring: Float64
    color: Image | None


@dataclass(frozen=True, eq=False)
class Overview:
    """A frame as the camera and the model saw it.

    Attributes:
        frame: Its index.
        labels: (H, W) predicted rows 0..K-1; K and above: ignored.
        color: (H, W, 3) the image; None if the dataset has none.
        palette: (K, 3) RGB of the classes.
        lone: Frames that stand out; None if no frame does.
        places: Places where frames disagree; None without pictures of places.
    """

    frame: int
    labels: npt.NDArray[np.integer[Any]]
    color: Image | None
    palette: Image
    lone: LoneFrames | None = None
    places: PlacePictures | None = None

    @classmethod
    def load(cls, path: Path) -> Overview:
        """Read SCENE__MODEL.npz with the arrays frame, labels, palette and, if the dataset has images, color.

        Raises:
            DataError: If the file is damaged or of another kind.
        """
        require_unchanged(path)
        try:
            data = read_bytes(path)
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                arrays = {name: decode_array(path, data, name[:-4]) for name in archive.namelist()}
            content = {name.removesuffix(".npy"): value for name, value in arrays.items()}
            lone_arrays: list[Any] = [content.get(f"lone_{name}") for name in ("frames", "labels", "alone", "color")]
            names = ("of", "centre", "frame", "labels", "ring", "color")
            places: list[Any] = [content.get(f"place_{name}") for name in names]
            return cls(
                int(content["frame"]), content["labels"], content.get("color"), content["palette"],
                None if lone_arrays[0] is None else LoneFrames(*lone_arrays),
                None if places[0] is None else PlacePictures(*places),
            )  # fmt: skip
        except (ValueError, TypeError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
            raise DataError(
                f"{path}: not a saved frame ({summarize_error(error)}); delete it, and it is made again"
            ) from error


def draw_overview(above: FromAbove, overview: Overview, georeference: Georeference | None = None) -> Figure:
    """Return image, prediction and the fused map from above, in one palette."""
    table, rows = above.table, above.rows
    palette: Colors = [(int(r), int(g), int(b)) for r, g, b in overview.palette]
    images = [] if overview.color is None else [("image", overview.color)]
    images.append(
        ("prediction", _colored(np.where(overview.labels < table.K, overview.labels.astype(np.int64), EMPTY), palette))
    )
    shapes = [*(image.shape for _, image in images), rows.shape]
    figure = canvas(PAGE, PAGE / len(shapes) * max(shape[0] / shape[1] for shape in shapes) + 0.5)
    axes = figure.subplots(1, len(shapes))
    for panel, letter, (title, image) in zip(axes, "ab", images, strict=False):
        panel.imshow(image)
        mark_panel(panel, letter, f"{title}, frame {overview.frame}")
    label = dominant(table)
    axes[-1].imshow(_painted(rows, label, palette), interpolation_stage="rgba")
    mark_panel(axes[-1], "abc"[len(images)], f"fused, {above.view}")
    for panel in axes:
        framed(panel)
    locate(axes[-1], Located.from_view(above, georeference), rows.shape)
    names = table.classes or tuple(str(k) for k in range(table.K))
    class_ids = sorted({int(k) for k in np.unique(label)} | {int(k) for k in np.unique(overview.labels) if k < table.K})
    entries = [(names[k], tuple(channel / 255 for channel in palette[k])) for k in class_ids]
    columns = legend_columns([name for name, _ in entries])
    figure.set_figheight(figure.get_figheight() + LEGEND_LINE * math.ceil(len(entries) / columns))
    figure.legend(handles=_handles(entries), loc="outside lower center", ncols=columns)
    return figure


def legend_columns(names: Sequence[str]) -> int:
    """Return how many columns of a legend with these names fit the page."""
    longest = max(len(name) for name in names)
    return max(1, min(len(names), int(PAGE / (LEGEND_KEY + LEGEND_LETTER * longest))))


def map_panels(rows: Int64, n: int) -> tuple[Figure, Sequence[Axes]]:
    """Return a figure for n maps.

    Up to three maps are side by side; wide maps are one below the other in one column of the page.
    """
    height, width = rows.shape
    if width >= WIDE * height:
        figure = canvas(COLUMN, n * (max(0.3, COLUMN * height / width) + 0.5))
        return figure, list(figure.subplots(n, 1, squeeze=False)[:, 0])
    columns = min(n, 3)
    lines = math.ceil(n / columns)
    figure = canvas(PAGE, min(8.0, lines * (PAGE / columns * height / width + 0.65)))
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels[n:]:
        axes.set_axis_off()
    return figure, list(panels[:n])


def _painted(rows: Int64, label: npt.NDArray[Any], colors: Colors) -> Image:
    """Return the map in the colours of its voxels' labels (H, W, 3), blank in cells without a voxel."""
    return _colored(np.where(rows == EMPTY, EMPTY, label.astype(np.int64)[rows]), colors)


def _colored(labels: Int64, colors: Colors) -> Image:
    """Return a label map in colours (H, W, 3), blank where a label is EMPTY."""
    image: Image = np.array([*colors, BLANK], dtype=np.uint8)[labels]
    return image


def draw_kinds(
    figure: Figure, axes: Axes, rows: Int64, kind: npt.NDArray[Any], colors: Colors, names: Sequence[str]
) -> None:
    """Draw the kind (n,) of each voxel, as its category, with the names of the kinds on a colour bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    axes.imshow(_painted(rows, kind, colors), interpolation_stage="rgba")
    shades = ListedColormap(np.array(colors) / 255)
    edges = np.arange(len(names) + 1) - 0.5
    bar = color_bar(figure, axes, ScalarMappable(BoundaryNorm(edges, len(names)), shades))
    bar.set_ticks(range(len(names)), labels=[name.replace(" ", "\n") for name in names])
    bar.ax.tick_params(length=0)


def _draw_measure(
    figure: Figure, axes: Axes, rows: Int64, values: Float64, ends: tuple[float, float], *, best_first: bool = True
) -> None:
    """Draw a measure in colour between two ends, with its colour bar; undefined values are grey."""
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shades = matplotlib.colormaps[COLORMAP if best_first else f"{COLORMAP}_r"].with_extremes(bad=UNDEFINED)
    colors = ScalarMappable(Normalize(*ends), shades)
    image = colors.to_rgba(np.ma.masked_invalid(values[rows]), bytes=True)
    image[rows == EMPTY, :3] = BLANK
    axes.imshow(image, interpolation_stage="rgba")
    color_bar(figure, axes, colors, extend=_beyond(values, ends))


def _beyond(values: Float64, ends: tuple[float, float]) -> str:
    """Return the ends of a scale beyond which there are values; a colour bar has an arrow there."""
    with np.errstate(invalid="ignore"):
        below, above = bool(np.any(values < ends[0] - 1e-9)), bool(np.any(values > ends[1] + 1e-9))
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")


def color_bar(figure: Figure, axes: Axes, colors: ScalarMappable, extend: str = "neither") -> Colorbar:
    """Draw a colour bar below a panel."""
    bar = figure.colorbar(colors, ax=axes, location="bottom", aspect=40, pad=0.03, extend=extend)
    bar.outline.set_linewidth(0.4)
    return bar


def framed(axes: Axes) -> None:
    """Draw a thin frame and no ticks: the scale bar shows the size."""
    axes.set(xticks=[], yticks=[], anchor="N")
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, linewidth=0.4, color=FAINT)


def scale_length(width: float) -> float:
    """Return a round length of at most a quarter of the width: 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(width / 4))
    return max(step * power for step in (1, 2, 5) if step * power <= width / 4)


def scale_text(length: float) -> str:
    """Return the length of a scale bar in words."""
    return f"{length:g} m" if length >= 0.1 else f"{length * 100:g} cm"


def locate(axes: Axes, located: Located, cells: tuple[int, ...], *, numbers: bool = True) -> None:
    """Draw a bar of round length, an arrow to grid north if it is known, and coordinates along two edges.

    Args:
        axes: The panel that shows the map.
        located: Where the map lies.
        cells: Its height and width in cells.
        numbers: Whether the coordinates have numbers; else they have ticks only, and the next panel has the numbers.
    """
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.5, foreground="white")]
    length = scale_length(located.size[0])
    end = 0.03 + length / located.size[0]
    axes.plot(
        [0.03, end],
        [0.05, 0.05],
        transform=axes.transAxes,
        color=INK,
        linewidth=1.8,
        path_effects=halo,
        solid_capstyle="butt",
    )
    axes.text(
        0.03, 0.08, scale_text(length), transform=axes.transAxes, fontsize=6.5, va="bottom", path_effects=halo
    )  # fmt: skip
    H, W = cells[:2]
    lower, left = located.edges
    axes.set_xticks([share * W - 0.5 for share, _ in lower.ticks], [metres(value) for _, value in lower.ticks])
    axes.set_yticks([(1 - share) * H - 0.5 for share, _ in left.ticks], [metres(value) for _, value in left.ticks])
    axes.tick_params(labelsize=5, length=2, width=0.4, color=FAINT, pad=1.5, labelbottom=numbers, labelleft=numbers)
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")
    if numbers:
        axes.set_xlabel(f"{lower.name}, m ({located.system})" if lower.name else "", fontsize=5, labelpad=1)
        axes.set_ylabel(f"{left.name}, m" if left.name else "", fontsize=5, labelpad=1)
    if located.north is not None:
        _north(axes, located.north)


def _north(axes: Axes, degrees: float) -> None:
    """Draw an arrow to north in the upper right corner, by its angle in degrees clockwise from the top."""
    from matplotlib.patheffects import withStroke

    along = np.array([math.sin(math.radians(degrees)), math.cos(math.radians(degrees))])
    halo = [withStroke(linewidth=2.5, foreground="white")]
    axes.annotate(
        "N", xy=(0.94, 0.94), xycoords="axes fraction", xytext=(-14 * along).tolist(), textcoords="offset points",
        fontsize=6.5, color=INK, ha="center", va="center", path_effects=halo,
        arrowprops={"arrowstyle": "-|>,head_width=0.2,head_length=0.4", "color": INK, "linewidth": 0.9, "shrinkA": 0},
    )  # fmt: skip


def _handles(entries: Sequence[tuple[str, Any]]) -> list[Any]:
    from matplotlib.patches import Patch

    return [Patch(facecolor=shade, edgecolor=FAINT, linewidth=0.4, label=name) for name, shade in entries]


# Figures show the voxels of units. Each table is read once: the figures of a unit are drawn one after the other.


class TopViews:
    """The sums of every unit that was asked for, and the view from above of the last one."""

    def __init__(self) -> None:
        self._tables = Tables()
        self._sums: dict[str, Histograms] = {}
        self._last: tuple[str, FromAbove] | None = None

    def sums(self, record: Record) -> Histograms:
        """Return the measures of the unit's voxels, by OP."""
        slug = record.unit.slug
        if slug not in self._sums:
            tables = record.tiles() if record.in_tiles else [self._tables.table_of(record)]
            self._sums[slug] = together([histograms(table) for table in tables])
        return self._sums[slug]

    def above(self, record: Record, up: npt.ArrayLike) -> FromAbove:
        """Return the unit's voxels that are seen from above."""
        slug = record.unit.slug
        if self._last is None or self._last[0] != slug:
            large = record.in_tiles and record.map_summary.voxels > MOST
            table = topmost(record.tiles(), up) if large else self._tables.table_of(record)
            self._last = slug, FromAbove.from_table(table, up)
        return self._last[1]


# The differences of two maps, seen from above or from the side.

SAME = "#dedede"
"""The colour of voxels that did not change; the paper stays blank in cells without a voxel."""


@dataclass(frozen=True)
class Panel:
    """A value of each voxel, from -1, worse, to 1, better; and the numbers of areas (m,), drawn at their centres.

    Attributes:
        links: (m,) what a click on each number opens in a page.
    """

    title: str
    ends: tuple[str, str]
    values: Float64
    numbers: Sequence[int]
    centres: Sequence[tuple[float, float, float]]
    links: Sequence[str]


def draw_changes(
    table: VoxelTable, up: npt.ArrayLike, panels: Sequence[Panel], georeference: Georeference | None = None
) -> Figure:
    """Return the largest change in each column of voxels, worse in orange, better in blue."""
    axis, view = best_view(table, up)[1:]
    pictures = [top_down(table.centers, table.voxel_size, axis, np.abs(panel.values)) for panel in panels]
    figure, axes = map_panels(pictures[0].rows, len(panels))
    for panel_axes, letter, panel, (rows, cell, corner) in zip(axes, LETTERS, panels, pictures, strict=False):
        size = rows.shape[1] * cell, rows.shape[0] * cell
        located = Located.seen_along(axis, corner, size, table.centers, georeference)
        _draw(figure, panel_axes, panel, rows)
        mark_panel(panel_axes, letter, f"{panel.title}, {view.partition(',')[0]}")
        framed(panel_axes)
        locate(panel_axes, located, rows.shape, numbers=panel_axes is axes[0])
        number_places(panel_axes, panel.numbers, panel.centres, panel.links, located, rows.shape)
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


def number_places(
    axes: Axes,
    numbers: Sequence[int],
    centres: Sequence[tuple[float, float, float]],
    links: Sequence[str],
    located: Located,
    cells: tuple[int, ...],
) -> None:
    """Draw the numbers of places at their centres, in a picture of `cells` (rows, columns)."""
    from matplotlib.patheffects import withStroke

    for number, centre, link in zip(numbers, centres, links, strict=True):
        x, y = located.share(centre)
        if not (0 <= x <= 1 and 0 <= y <= 1):
            continue
        axes.annotate(
            str(number), (x * cells[1] - 0.5, y * cells[0] - 0.5), fontsize=6.5, color=INK, ha="center", va="center",
            path_effects=[withStroke(linewidth=2, foreground="white")], url=link,
        )  # fmt: skip
