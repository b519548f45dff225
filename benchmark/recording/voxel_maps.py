"""Fused voxels in the viewer: VoxelGridMaps with all measures on the same voxels; a view picks the one that it shows.

A map is logged in chunks. While it grows a chunk is a stretch of voxels in the order of their first observation, so its
voxels were seen together, are seen again together, and rest together: only chunks that changed are logged again, and
those that got no new voxels without their indices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from semstab.backends import GrowingMap
from semstab.core.types import Float32, Float64, Int32, Int64, UInt32
from semstab.metrics import CATEGORY_COLORS, vss
from semstab.metrics.agreement import shared_rows
from semstab.metrics.summary import categorise
from semstab.model.labels import LabelSpace
from semstab.model.measures import ENTROPY, SBD, VSS, Measure, mean_drift, measures
from semstab.model.results import RECURRENT
from semstab.model.statistics import LagBin, MapStatistics
from semstab.model.voxels import VoxelTable
from semstab.recording.kernels import read_off


@dataclass(frozen=True)
class ColorMode:
    """What a map is coloured by; ranges are fixed, so that a colour means the same in every recording.

    tab    its name where there is little room; `title` is that of its views
    range  of the values that the colour map spans; None where voxels have a colour of their own
    """

    tab: str
    title: str
    colormap: rr.components.Colormap | None = None
    range: tuple[float, float] | None = None

    @classmethod
    def of(cls, measure: Measure) -> ColorMode:
        """Of a measure: 'SBD (0 to 0.31 bits; black: seen once)'."""
        low, high = measure.range
        ends = f"{low:.2g}{' and less' if low > 0 else ''} to {high:.2g}{' and more' if high < measure.largest else ''}"
        once = "; black: seen once" if measure.lowest_op == 2 else ""
        once = f"; black: OP < {measure.lowest_op}" if measure.lowest_op > 2 else once
        title = f"{measure.title} ({f'{ends} {measure.unit}'.strip()}{once})"
        colors = rr.components.Colormap
        return cls(measure.title, title, colors.Viridis if measure.better == "higher" else colors.Plasma, measure.range)


def color_modes() -> dict[str, ColorMode]:
    """What the maps can be coloured by."""
    category = f"category (blue stable, orange uncertain, yellow drifting, grey OP < {RECURRENT})"
    return {
        "class": ColorMode("Class", "dominant class"),
        **{measure.key: ColorMode.of(measure) for measure in measures()},
        "op": ColorMode("OP", "OP (1 to 10 and more)", rr.components.Colormap.Viridis, (1.0, 10.0)),
        "category": ColorMode("Category", category),
    }


@dataclass(frozen=True, eq=False)
class Columns:
    """What the measures of n voxels are computed from, as `VoxelTable` has it."""

    op: Int32
    evidence: Float64
    drift_sum: Float64


MAX_VOXELS = 2_000_000
"""VoxelBatch of one map; at its end a larger one is thinned."""

CHUNKS = 32
BUDGET = 2_000_000
"""Voxels that are logged of one map while it grows; those at its end come on top, at most MAX_VOXELS."""

MOST_A_FRAME = 10_000
"""Voxels, of the budget, for which a frame pays: short runs need not log everything anew with each frame."""

NEW = 10
"""How many voxels that were seen again wait for one that is not drawn yet."""


def edges() -> Int64:
    """(CHUNKS + 1,) first voxel of each chunk: small maps have several chunks, large ones not too many."""
    return np.round(MAX_VOXELS * (np.arange(CHUNKS + 1) / CHUNKS) ** 2).astype(np.int64)


def chunks_of(voxels: int) -> int:
    """In how many chunks a map of that size is drawn."""
    return int(np.searchsorted(edges(), min(voxels, MAX_VOXELS)))


def chunk(entity: str, number: int) -> str:
    """The entity of a chunk, where `entity` is the map's."""
    return f"{entity}/{number:02d}"


def packed(colors: npt.ArrayLike) -> UInt32:
    """RGB (n, 3) as the viewer's 0xRRGGBBAA (n,)."""
    r, g, b = np.asarray(colors, dtype=np.uint32).T
    rgba: UInt32 = (r << 24) | (g << 16) | (b << 8) | 0xFF
    return rgba


@dataclass(frozen=True, eq=False)
class VoxelBatch:
    """n voxels as they are drawn.

    index   (n, 3) int32 relative to the map's origin: small, so that the viewer's float32 keeps them exact
    size    edge of a voxel, metres
    colors  (n,) uint32 by dominant class and by category, 'class' and 'category'
    values  (n,) float32 of each measure and of OP
    """

    index: Int32
    size: float
    colors: dict[str, UInt32]
    values: dict[str, Float32]

    @classmethod
    def of(
        cls,
        index: Int32,
        size: float,
        classes: LabelSpace,
        evidence: Float64,
        op: Int32,
        drift_sum: Float64,
    ) -> VoxelBatch:
        """From the voxels' columns, as `VoxelTable` has them."""
        n, K = evidence.shape
        label, stability, bits = np.empty(n, dtype=np.uint16), np.empty(n), np.empty(n)
        read_off(evidence, label, stability, bits)
        sbd = mean_drift(drift_sum, op)
        read = {VSS: stability, SBD: sbd, ENTROPY: bits / math.log2(K)}  # in one pass over the evidence
        voxels = Columns(op, evidence, drift_sum)
        values: dict[str, npt.NDArray[Any]] = {m.key: read[m] if m in read else m.of(voxels) for m in measures()}
        values["op"] = op
        colors = {
            "class": packed(classes.colors)[label],
            "category": packed(CATEGORY_COLORS)[categorise(op, sbd, bits)],
        }
        return cls(index, size, colors, {name: value.astype(np.float32) for name, value in values.items()})

    def components(self, *, whole: bool) -> list[Any]:
        """A grid that shows the dominant class, and beside it what else it can show; see `visualizer`.

        Where not `whole`, only colours and values, as the rest was logged before.
        """
        places: dict[str, Any] = {"voxel_indices": self.index, "voxel_size": [self.size] * 3} if whole else {}
        category = rr.components.ColorBatch(self.colors["category"])
        return [
            rr.VoxelGridMap.from_fields(**places, colors=self.colors["class"]),
            rr.DynamicArchetype("category", components={"colors": category}),
            *(
                rr.DynamicArchetype(name, components={"values": rr.components.VoxelValueBatch(values)})
                for name, values in self.values.items()
            ),
        ]


def visualizer(name: str) -> rr.blueprint.Visualizer:
    """What makes a view show a measure, or the category, of a grid that has them all; of itself it shows the class.

    The view's `defaults` say how values are coloured.
    """
    source = ComponentSourceKind.SourceComponent
    if name == "category":
        mappings = [VisualizerComponentMapping("VoxelGridMap:colors", source, source_component="category:colors")]
    else:
        mappings = [
            VisualizerComponentMapping("VoxelGridMap:values", source, source_component=f"{name}:values"),
            VisualizerComponentMapping("VoxelGridMap:colors", ComponentSourceKind.Default),
        ]
    return rr.VoxelGridMap.from_fields().visualizer(mappings=mappings)


def defaults(name: str) -> list[rr.VoxelGridMap]:
    """How a view colours the values of a measure."""
    mode = color_modes()[name]
    return [] if mode.range is None else [rr.VoxelGridMap.from_fields(colormap=mode.colormap, value_range=mode.range)]


def thinned(index: Int64) -> tuple[int, Int64]:
    """Blocks of factor^3 voxels, few enough to draw: the factor, and the row of one voxel in each, ascending."""
    factor, blocks, rows = 1, index, np.arange(len(index))
    while len(blocks) > MAX_VOXELS:
        factor, blocks = factor * 2, blocks // 2
        x, y, z = (blocks - blocks.min(axis=0)).T
        _, first = np.unique((x << 42) ^ (y << 21) ^ z, return_index=True)
        blocks, rows = blocks[first], rows[first]
    return factor, np.sort(rows) if factor > 1 else rows


def thinned_map(path: Path, origin: Int64) -> tuple[int, VoxelTable]:
    """Return a map from its file, or few enough voxels of one in tiles: the factor, and a voxel of each factor^3 block.

    Tiles are read one after the other. Blocks are aligned with the origin.
    """
    if path.is_file():
        return 1, VoxelTable.load(path)
    factor, parts = 1, list[VoxelTable]()
    for tile in VoxelTable.iter_tiles(path):
        parts.append(tile)
        while factor > 1 or sum(map(len, parts)) > MAX_VOXELS:
            joined = VoxelTable.joined(parts)
            factor *= 1 if sum(map(len, parts)) <= MAX_VOXELS else 2
            _, first = np.unique((joined.index - origin) // factor, axis=0, return_index=True)
            parts = [joined.rows(np.sort(first))]
            if len(first) <= MAX_VOXELS:
                break
    return factor, VoxelTable.joined(parts)


class VoxelLogger:
    """Logs what changes in a map, within the budget: of `frames` frames each one may log its share, and what is saved.

    Where there is more to log, chunks come first in which the most voxels are new or were observed again since they
    were logged.
    """

    def __init__(self, entity: str, classes: LabelSpace, origin: Int64, frames: int) -> None:
        self.entity = entity
        self.logged = 0
        """Voxels logged so far."""
        self._classes = classes
        self._origin = origin
        self._edges = edges()
        self._chunk_of = np.repeat(np.arange(CHUNKS, dtype=np.uint8), np.diff(self._edges))
        self._share = min(BUDGET / frames, MOST_A_FRAME)
        self.allowed = 0.0
        """How many of them the frames so far pay for."""
        self._changed = np.zeros(CHUNKS, dtype=np.int64)  # observations in each chunk since it was logged
        self._drawn = np.zeros(CHUNKS, dtype=np.int64)  # voxels that each chunk was logged with

    def update(self, stream: rr.RecordingStream, fused: GrowingMap) -> list[Callable[[], None]]:
        """A frame went into the map: what logs as much of it as the budget allows, whatever becomes of the map."""
        rows = fused.changes.row
        self._changed += np.bincount(self._chunk_of[rows[rows < MAX_VOXELS]], minlength=CHUNKS)
        self.allowed += self._share
        sizes = np.diff(np.minimum(self._edges, len(fused)))
        urgent = (self._changed + NEW * (sizes - self._drawn)) / np.maximum(sizes, 1)
        jobs: list[Callable[[], None]] = []
        for c in np.argsort(-urgent, kind="stable"):
            if self._changed[c] == 0 or self.logged + sizes[c] > self.allowed:
                break
            jobs.append(self._job(stream, fused, int(c), int(sizes[c])))
        return jobs

    def finish(self, stream: rr.RecordingStream, table: VoxelTable, factor: int = 1) -> str:
        """Log the final map in place of what is there; says how it was thinned, where it is too large.

        factor  of a table that is thinned already
        """
        index = table.index - self._origin
        factor, rows = thinned(index) if factor == 1 else (factor, np.arange(len(index)))
        for c, part in enumerate(np.split(rows, self._edges[1:-1])):
            if len(part):
                at = np.s_[part[0] : part[-1] + 1] if factor == 1 else part  # what is not thinned is not copied
                batch = VoxelBatch.of(
                    (index[at] // factor).astype(np.int32), table.voxel_size * factor, self._classes,
                    table.evidence[at], table.op[at], table.drift_sum[at],
                )  # fmt: skip
                stream.log(chunk(self.entity, c), *batch.components(whole=True))
                self._note(c, len(part))
            elif self._drawn[c]:
                stream.log(chunk(self.entity, c), rr.Clear(recursive=False))
        thin = f"; drawn: one voxel of each block of {factor}x{factor}x{factor}, as large as the block"
        return thin if factor > 1 else ""

    def _job(self, stream: rr.RecordingStream, fused: GrowingMap, c: int, size: int) -> Callable[[], None]:
        """What logs a chunk as it is now."""
        stretch = np.s_[self._edges[c] : self._edges[c] + size]
        rows = np.arange(stretch.start, stretch.stop)
        index, evidence = fused.index_of(rows), fused.evidence_of(rows)
        op, drift_sum = (fused.column(name, stretch) for name in ("op", "drift_sum"))
        whole = self._drawn[c] != size
        self._note(c, size)

        def job() -> None:
            at = (index - self._origin).astype(np.int32)
            batch = VoxelBatch.of(at, fused.voxel_size, self._classes, evidence, op, drift_sum)
            stream.log(chunk(self.entity, c), *batch.components(whole=whole))

        return job

    def _note(self, c: int, size: int) -> None:
        self.logged += size
        self._changed[c], self._drawn[c] = 0, size


# Voxels where the maps of two backends differ.

ONLY_FIRST, ONLY_SECOND = (230, 159, 0), (86, 180, 233)
VSS_RANGE = (0.0, 0.5)

DIFFERENCE = {"only_first": "in the first only", "only_second": "in the second only", "changed": "|VSS difference|"}
"""The parts of a difference, and what they are called."""


def log_difference(
    stream: rr.RecordingStream,
    entity: str,
    tables: Mapping[str, VoxelTable],
    origin: Int64,
    tolerance: float,
) -> str:
    """Log the voxels that one of two maps has only, and those whose VSS differs by more than the tolerance.

    tables  the two maps by the names of their backends

    Returns how many there are, in words. They are of the final maps, so they are logged for all times.
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
    styles: dict[str, dict[str, Any]] = {
        "only_first": {"colors": ONLY_FIRST},
        "only_second": {"colors": ONLY_SECOND},
        "changed": {"colormap": rr.components.Colormap.Inferno, "value_range": VSS_RANGE},
    }
    for part in DIFFERENCE:
        index = parts[part] - origin
        factor, rows = thinned(index)
        values: dict[str, Any] = {"values": change[differs][rows].astype(np.float32)} if part == "changed" else {}
        cells = (index[rows] // factor).astype(np.int32)
        size = [first.voxel_size * factor] * 3
        stream.log(f"{entity}/{part}", rr.VoxelGridMap(cells, size, **values, **styles[part]), static=True)
    one, other = tables
    return (
        f"{len(parts['only_first']):,} voxels in {one} only, {len(parts['only_second']):,} in {other} only; of"
        f" {len(in_first):,} in both VSS differs in {int(differs.sum()):,}, by {change.max(initial=0.0):.2g} at most"
    )


# Agreement between frames, shown below the map.

AXES = {
    "angle": "degrees between the views",
    "time": "frames apart",
    "baseline": "metres between the cameras",
    "range": "ratio of the ranges",
}


def agreement_report(statistics: MapStatistics) -> str:
    """Return the verdict, and agreement by the distance between two observations of a location, in Markdown."""
    lines = [statistics.verdict.line, ""]
    if statistics.correlogram is not None:
        lines.append("Alpha between frames, by how far apart two observations of a location are:")
    for axis, unit in AXES.items() if statistics.correlogram is not None else ():
        bins: tuple[LagBin, ...] = getattr(statistics.correlogram, axis)
        if bins:
            lines += ["", f"| {unit} | alpha | 95% | for |", "|---|---|---|---|"]
        for row in bins:
            a = row.alpha
            band = f"{a.low:.2f} to {a.high:.2f} | {a.scope}{'' if a.decided else ', undecided'}"
            lines.append(f"| {row.mean:.3g} | {a.value:.2f} | {band} |")
    return "\n".join(lines)
