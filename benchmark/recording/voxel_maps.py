"""Record fused voxels: VoxelGridMaps with all measures on the same voxels; a view selects the measure that it shows.

A map is logged in chunks, ranges of rows of its table, which the viewer can load one by one. While it grows it is
logged now and then, as a budget of voxels allows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from semstab.core.types import Int64, UInt8, UInt32
from semstab.data.labels import LabelSpace
from semstab.data.measures import Voxels, bits, measures, sbd
from semstab.data.records import Record, Result
from semstab.data.statistics import CONFIDENCE, LagBin, MapStatistics
from semstab.data.voxels import VoxelTable
from semstab.metrics import CATEGORY_COLORS, NOT_ASSESSED, dominant, vss
from semstab.metrics.agreement import shared_rows
from semstab.metrics.summary import categorise
from semstab.recording.loops import first_of_blocks
from semstab.report.narrative import outlying_line
from semstab.report.ranking import order_of_models
from semstab.report.terminal import TEXTS, columns, row_of
from semstab.statistics.moving import STATE_COLORS


@dataclass(frozen=True)
class ColorMode:
    """A colouring of a map; ranges are fixed, so that a colour means the same in every recording.

    Attributes:
        tab: Its short name.
        title: The title of its views.
        range: The range of values that the colour map spans; None if each voxel has its own colour.
    """

    tab: str
    title: str
    colormap: rr.components.Colormap | None = None
    range: tuple[float, float] | None = None


def color_modes() -> dict[str, ColorMode]:
    """Return the modes of the maps by name."""
    colors, modes = rr.components.Colormap, {"class": ColorMode("Class", "dominant class")}
    for measure in measures():  # 'SBD (0 to 0.31 bits; black: OP < 2)'
        low, high = measure.range
        ends = f"{low:.2g}{' and less' if low > 0 else ''} to {high:.2g}{' and more' if high < measure.largest else ''}"
        undefined = f"; black: OP < {measure.lowest_op}" if measure.lowest_op > 1 else ""
        title = f"{measure.title} ({f'{ends} {measure.unit}'.strip()}{undefined})"
        colormap = colors.Viridis if measure.better == "higher" else colors.Plasma
        modes[measure.key] = ColorMode(measure.title, title, colormap, measure.range)
    modes["op"] = ColorMode("OP", "OP (1 to 10 and more)", colors.Viridis, (1.0, 10.0))
    return modes | {"category": ColorMode("Category", "category")}


MOVED = "moved"
"""The mode of a map whose voxels are coloured by whether they moved; only final maps with movers have it."""


def mode_of(name: str) -> ColorMode:
    """Return a mode by its name, that of movers, too."""
    return ColorMode("Moved", "orange moved, blue stayed") if name == MOVED else color_modes()[name]


MAX_VOXELS = 2_000_000
"""The most voxels of a map; a larger map is thinned at its end."""

CHUNKS = 10
"""The number of parts of a map; a layout has an entry of kilobytes for each part in each view."""

BUDGET = 2_000_000
"""The most voxels that are logged of a map while it grows; its end adds at most MAX_VOXELS."""

MOST_A_FRAME = 25_000
"""The most voxels that a frame adds to what may be logged, so that short runs do not log every voxel each frame."""


def edges() -> Int64:
    """Return the first voxel of each chunk (CHUNKS + 1,): small maps have several chunks, large ones not too many."""
    return np.round(MAX_VOXELS * (np.arange(CHUNKS + 1) / CHUNKS) ** 2).astype(np.int64)


def chunk(entity: str, number: int) -> str:
    """Return the entity of a chunk of a map."""
    return f"{entity}/{number:02d}"


def packed(colors: npt.ArrayLike) -> UInt32:
    """Return RGB (n, 3) as the viewer's 0xRRGGBBAA (n,)."""
    r, g, b = np.asarray(colors, dtype=np.uint32).T
    rgba: UInt32 = (r << 24) | (g << 16) | (b << 8) | 0xFF
    return rgba


def components(
    index: Int64, size: float, classes: LabelSpace, voxels: Voxels, *, assessed: bool = True, moved: UInt8 | None = None
) -> list[Any]:
    """Return a grid that shows the dominant class, with the measures that it can show instead; see `visualizer`.

    Args:
        index: (n, 3) relative to the map's origin: small, so that the viewer's float32 keeps it exact.
        size: Edge of a voxel, metres.
        classes: The label space, with its colours.
        voxels: Evidence that is measured, so that each measure is computed in one pass.
        assessed: False for a map about whose stability its frames say nothing: its categories have no colours.
        moved: (n,) the voxels' states, if movers were found: see `states_at`.
    """
    colors = CATEGORY_COLORS if assessed else [NOT_ASSESSED] * len(CATEGORY_COLORS)
    category = packed(colors)[categorise(voxels.op, sbd(voxels), bits(voxels))]
    states = None if moved is None else packed(STATE_COLORS)[moved]
    values: dict[str, npt.NDArray[Any]] = {measure.key: measure.of(voxels) for measure in measures()}
    return [
        rr.VoxelGridMap.from_fields(
            voxel_indices=index.astype(np.int32), voxel_size=[size] * 3, colors=packed(classes.colors)[dominant(voxels)]
        ),
        *(
            rr.DynamicArchetype(name, components={"colors": rr.components.ColorBatch(column)})
            for name, column in {"category": category, MOVED: states}.items()
            if column is not None
        ),
        *(
            rr.DynamicArchetype(name, components={"values": rr.components.VoxelValueBatch(column.astype(np.float32))})
            for name, column in {**values, "op": voxels.op}.items()
        ),
    ]


def visualizer(name: str) -> rr.blueprint.Visualizer:
    """Return a visualizer that shows a measure, the category, or what moved, of a grid.

    Without one a view shows the class. The view's `defaults` set the colours of values.
    """
    source = ComponentSourceKind.SourceComponent
    if name in ("category", MOVED):
        mappings = [VisualizerComponentMapping("VoxelGridMap:colors", source, source_component=f"{name}:colors")]
    else:
        mappings = [
            VisualizerComponentMapping("VoxelGridMap:values", source, source_component=f"{name}:values"),
            VisualizerComponentMapping("VoxelGridMap:colors", ComponentSourceKind.Default),
        ]
    return rr.VoxelGridMap.from_fields().visualizer(mappings=mappings)


def defaults(name: str) -> list[rr.VoxelGridMap]:
    """Return the defaults by which a view colours the values of a measure."""
    mode = mode_of(name)
    return [] if mode.range is None else [rr.VoxelGridMap.from_fields(colormap=mode.colormap, value_range=mode.range)]


def thinned(index: Int64, factor: int = 1) -> tuple[int, Int64]:
    """Return the edge of blocks of voxels, few enough to draw, and the row of one voxel in each, ascending.

    Args:
        index: (n, 3) relative to the map's origin, with which blocks are aligned.
        factor: The least edge, a power of 2.
    """
    if factor == 1 and len(index) <= MAX_VOXELS:
        return factor, np.arange(len(index))
    factor = max(factor, 2)
    while len(rows := first_of_blocks(index, factor.bit_length() - 1)) > MAX_VOXELS:
        factor *= 2
    return factor, rows


def load_map(record: Record, origin: Int64) -> tuple[int, VoxelTable]:
    """Return the edge of blocks, as `thinned`, and a unit's map; a map in tiles is thinned while it is read."""
    if not record.in_tiles:
        return 1, record.table()
    factor, parts = 1, list[VoxelTable]()
    for tile in record.tiles():
        joined = VoxelTable.joined([*parts, tile])
        factor, rows = thinned(joined.index - origin, factor)
        parts = [joined.rows(rows) if len(rows) < len(joined) else joined]
    return factor, parts[0]


class VoxelLogger:
    """Logs a map while it grows, as often as the budget allows: each of `frames` frames adds its share to it."""

    def __init__(self, entity: str, classes: LabelSpace, origin: Int64, frames: int) -> None:
        self._entity, self._classes, self._origin = entity, classes, origin
        self._edges = edges()
        self._share = min(BUDGET / frames, MOST_A_FRAME)
        self._allowed = 0.0  # voxels of the budget that the frames so far have not used
        self._drawn = 0  # chunks of the growing map

    def update(
        self, stream: rr.RecordingStream, voxels: int, table: Callable[[], VoxelTable]
    ) -> list[Callable[[], None]]:
        """Return jobs that log the map if the budget allows its voxels; later frames do not alter them."""
        self._allowed += self._share
        if not 0 < voxels <= min(self._allowed, MAX_VOXELS):
            return []
        self._allowed -= voxels
        grown = table()
        chunks = [part for part in np.split(np.arange(len(grown)), self._edges[1:-1]) if len(part)]
        self._drawn = len(chunks)
        return [functools.partial(self._log, stream, c, grown, part, 1) for c, part in enumerate(chunks)]

    def _log(
        self,
        stream: rr.RecordingStream,
        c: int,
        table: VoxelTable,
        rows: Int64,
        factor: int,
        *,
        assessed: bool = True,
        moved: UInt8 | None = None,
    ) -> None:
        """Log rows of a table as a chunk, whose voxels stand for blocks with an edge of `factor` voxels."""
        selection = np.s_[rows[0] : rows[-1] + 1] if factor == 1 else rows  # a map that is not thinned is not copied
        voxels = Voxels(table.op[selection], table.evidence.take(selection).measured(), table.drift_sum[selection])
        index = (table.index[selection] - self._origin) // factor
        size = table.voxel_size * factor
        states = None if moved is None else moved[selection]
        stream.log(
            chunk(self._entity, c), *components(index, size, self._classes, voxels, assessed=assessed, moved=states)
        )

    def finish(
        self, stream: rr.RecordingStream, table: VoxelTable, factor: int = 1, *, assessed: bool = True,
        moved: UInt8 | None = None,
    ) -> str:  # fmt: skip
        """Log the final map instead of the growing one; return a note on thinning if the map is too large.

        Args:
            stream: The recording.
            table: The final map.
            factor: Edge of the blocks of a table that is thinned already.
            assessed: See `components`.
            moved: (n,) see `components`.
        """
        index = table.index - self._origin
        factor, rows = thinned(index) if factor == 1 else (factor, np.arange(len(index)))
        for c, part in enumerate(np.split(rows, self._edges[1:-1])):
            if len(part):
                self._log(stream, c, table, part, factor, assessed=assessed, moved=moved)
            elif c < self._drawn:
                stream.log(chunk(self._entity, c), rr.Clear(recursive=False))
        thin = f"; drawn: one voxel of each block of {factor}x{factor}x{factor}, as large as the block"
        return thin if factor > 1 else ""


# The voxels in which the maps of two backends differ.

DIFFERENCE: dict[str, dict[str, Any]] = {
    "only_first": {"colors": (230, 159, 0)},
    "only_second": {"colors": (86, 180, 233)},
    "changed": {"colormap": rr.components.Colormap.Inferno, "value_range": (0.0, 0.5)},
}
"""The parts of a difference: voxels in one of the maps only, and |VSS difference| of the others."""


def log_difference(
    stream: rr.RecordingStream,
    entity: str,
    tables: Mapping[str, VoxelTable],
    origin: Int64,
    tolerance: float,
) -> str:
    """Log the voxels that only one of two maps has, and those whose VSS differs by more than the tolerance.

    - `tables`: the two maps by the names of their backends

    Returns their numbers, in words. They are of the final maps, so they are logged for all times.
    """
    first, second = tables.values()
    in_first, in_second = shared_rows(first, second)
    change = np.abs(vss(first)[in_first] - vss(second)[in_second])
    differs = change > tolerance
    parts = {
        "only_first": np.delete(first.index, in_first, axis=0),
        "only_second": np.delete(second.index, in_second, axis=0),
        "changed": first.index[in_first[differs]],
    }
    for part, style in DIFFERENCE.items():
        index = parts[part] - origin
        factor, rows = thinned(index)
        values: dict[str, Any] = {"values": change[differs][rows].astype(np.float32)} if part == "changed" else {}
        cells = (index[rows] // factor).astype(np.int32)
        size = [first.voxel_size * factor] * 3
        stream.log(f"{entity}/{part}", rr.VoxelGridMap(cells, size, **values, **style), static=True)
    first_name, second_name = tables
    return (
        f"{len(parts['only_first']):,} voxels in {first_name} only, {len(parts['only_second']):,} in {second_name}"
        f" only; of {len(in_first):,} in both VSS differs in {int(differs.sum()):,}, by {change.max(initial=0.0):.2g}"
        " at most"
    )


# Agreement between frames, shown below the map.

AXES = {
    "angle": "degrees between the views",
    "time": "frames apart",
    "baseline": "metres between the cameras",
    "range": "ratio of the ranges",
}


PENDING = "The verdict follows when all frames are fused."


def verdict_report(result: Result, scene: str) -> str:
    """Return the answer of a run, and the verdict of each model on a scene, in Markdown, as the terminal has them."""
    if not result.maps.records:
        return "\n".join(f"{line}\n" for line in order_of_models(result))
    rows = [row_of(record) for record in result.select(scene=scene)]
    heads = (f"| {' | '.join(head for head, _ in columns()[:TEXTS])} |", f"|{'---|' * TEXTS}")
    table = [f"| {' | '.join(row[:TEXTS])} |" for row in rows]
    return "\n".join([*(f"{line}\n" for line in order_of_models(result)), *heads, *table])


def agreement_report(statistics: MapStatistics) -> str:
    """Return the verdict, the frames that stand out, and agreement by the distance of two observations, in Markdown."""
    lines = [statistics.verdict.line, ""]
    if statistics.outlying_frames is not None:
        lines += [outlying_line(statistics.outlying_frames), ""]
    if statistics.correlogram is not None:
        lines.append("Alpha between frames, by the distance of two observations of a location:")
    for axis, unit in AXES.items() if statistics.correlogram is not None else ():
        bins: tuple[LagBin, ...] = getattr(statistics.correlogram, axis)
        if bins:
            lines += ["", f"| {unit} | alpha | {CONFIDENCE:.0%} | for |", "|---|---|---|---|"]
        for row in bins:
            a = row.alpha
            band = f"{a.low:.2f} to {a.high:.2f} | {a.scope}{'' if a.decided else ', undecided'}"
            lines.append(f"| {row.mean:.3g} | {a.value:.2f} | {band} |")
    return "\n".join(lines)
