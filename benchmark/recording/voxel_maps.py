"""Fused voxels in the viewer: VoxelGridMaps, one for each chunk of the map and each measure that colours it.

A chunk is a stretch of voxels in the order of their first observation, so its voxels were seen together, are seen
again together, and rest together: only chunks that changed are logged again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.backends.numba_hash import NumbaHash
from semstab.labels import LabelSpace
from semstab.metrics import CATEGORY_COLORS, categories, op, sbd
from semstab.recording.belief_kernel import read_off
from semstab.results import RECURRENT
from semstab.voxels import VoxelTable

# The largest SBD there is, 0.311 bits: a voxel's second frame sees a class that its first one did not see at all.
SBD_MAX = 1.5 - 0.75 * math.log2(3)


@dataclass(frozen=True)
class Measure:
    """How a number of each voxel is shown; ranges are fixed, so that a colour means the same in every recording."""

    title: str
    colormap: rr.components.Colormap
    range: tuple[float, float]


MEASURES = {
    "vss": Measure("VSS (0.5 and less to 1)", rr.components.Colormap.Viridis, (0.5, 1.0)),
    "sbd": Measure(f"SBD (0 to {SBD_MAX:.2f} bits; black: seen once)", rr.components.Colormap.Plasma, (0.0, SBD_MAX)),
    "entropy": Measure("Entropy (0 to 0.5 and more)", rr.components.Colormap.Plasma, (0.0, 0.5)),
    "op": Measure("OP (1 to 10 and more)", rr.components.Colormap.Viridis, (1.0, 10.0)),
}
TITLES = {
    "class": "dominant class",
    **{name: measure.title for name, measure in MEASURES.items()},
    "category": f"category (blue stable, orange uncertain, yellow drifting, grey OP < {RECURRENT})",
}
"""What the maps are coloured by, and what their views are called."""

TABS = {"class": "Class", "vss": "VSS", "sbd": "SBD", "entropy": "Entropy", "op": "OP", "category": "Category"}

MAX_VOXELS = 2_000_000
"""Drawn of one map; at its end a larger one is thinned."""

CHUNKS = 64
BUDGET = 2_000_000
"""Voxels that are logged of one map while it grows; those at its end come on top, at most MAX_VOXELS."""

MOST_A_FRAME = 10_000
"""Voxels, of the budget, for which a frame pays: short runs need not log everything anew with each frame."""


def edges() -> npt.NDArray[np.int64]:
    """(CHUNKS + 1,) first voxel of each chunk: small maps have several chunks, large ones not too many."""
    return np.round(MAX_VOXELS * (np.arange(CHUNKS + 1) / CHUNKS) ** 2).astype(np.int64)


def packed(colors: npt.ArrayLike) -> npt.NDArray[np.uint32]:
    """RGB (n, 3) as the viewer's 0xRRGGBBAA (n,)."""
    r, g, b = np.asarray(colors, dtype=np.uint32).T
    rgba: npt.NDArray[np.uint32] = (r << 24) | (g << 16) | (b << 8) | 0xFF
    return rgba


def grids(
    table: VoxelTable, classes: LabelSpace, origin: npt.NDArray[np.int64], factor: int = 1
) -> Iterator[tuple[str, rr.VoxelGridMap]]:
    """The voxels in each of the colourings `TITLES`.

    Indices relative to the origin are small, so the viewer's float32 keeps them exact. The voxels of a table that was
    thinned are `factor` times as large.
    """
    index = ((table.index - origin) // factor).astype(np.int32)
    size = [table.voxel_size * factor] * 3
    label, vss, entropy = (np.empty(len(table), dtype) for dtype in (np.uint16, np.float32, np.float32))
    read_off(table.evidence, label, vss, entropy)
    yield "class", rr.VoxelGridMap(index, size, colors=packed(classes.colors)[label])
    values: dict[str, npt.NDArray[Any]] = {"vss": vss, "sbd": sbd(table), "entropy": entropy, "op": op(table)}
    for name, measure in MEASURES.items():
        value = values[name].astype(np.float32)
        yield name, rr.VoxelGridMap(index, size, values=value, colormap=measure.colormap, value_range=measure.range)
    yield "category", rr.VoxelGridMap(index, size, colors=packed(CATEGORY_COLORS)[categories(table)])


def thinned(index: npt.NDArray[np.int64]) -> tuple[int, npt.NDArray[np.int64]]:
    """Blocks of factor^3 voxels, few enough to draw: the factor, and the row of one voxel in each, ascending."""
    factor, blocks, rows = 1, index, np.arange(len(index))
    while len(blocks) > MAX_VOXELS:
        factor, blocks = factor * 2, blocks // 2
        x, y, z = (blocks - blocks.min(axis=0)).T
        _, first = np.unique((x << 42) ^ (y << 21) ^ z, return_index=True)
        blocks, rows = blocks[first], rows[first]
    return factor, np.sort(rows) if factor > 1 else rows


class GrowingMap:
    """Logs what changes in a map, within the budget: of `frames` frames each one may log its share, and what is saved.

    Where there is more to log, chunks come first in which the most voxels were observed since they were logged.
    """

    def __init__(self, entity: str, classes: LabelSpace, origin: npt.NDArray[np.int64], frames: int) -> None:
        self.entity = entity
        self.logged = 0
        """Voxels logged so far."""
        self._classes = classes
        self._origin = origin
        self._edges = edges()
        self._chunk_of = np.repeat(np.arange(CHUNKS, dtype=np.uint8), np.diff(self._edges))
        self._share = min(BUDGET / frames, MOST_A_FRAME)
        self._allowed = 0.0
        self._changed = np.zeros(CHUNKS, dtype=np.int64)  # observations in each chunk since it was logged
        self._size = np.zeros(CHUNKS, dtype=np.int64)  # voxels that each chunk was logged with

    def update(self, stream: rr.RecordingStream, fused: NumbaHash) -> None:
        """A frame went into the map: log what the budget allows."""
        rows = fused.changes.row
        self._changed += np.bincount(self._chunk_of[rows[rows < MAX_VOXELS]], minlength=CHUNKS)
        self._allowed += self._share
        sizes = np.diff(np.minimum(self._edges, len(fused)))
        for c in np.argsort(-self._changed / np.maximum(sizes, 1), kind="stable"):
            if self._changed[c] == 0 or self.logged + sizes[c] > self._allowed:
                break
            self._log(stream, fused, int(c))

    def finish(self, stream: rr.RecordingStream, table: VoxelTable) -> str:
        """Log the final map in place of what is there; says how it was thinned, where it is too large."""
        factor, rows = thinned(table.index - self._origin)
        for c, part in enumerate(np.split(rows, self._edges[1:-1])):
            if len(part):
                self._log_table(stream, c, select(table, part), factor)
            elif self._size[c]:
                for name in TITLES:
                    stream.log(self._path(name, c), rr.Clear(recursive=False))
            self._size[c] = len(part)
        thin = f"; drawn: one voxel of each block of {factor}x{factor}x{factor}, as large as the block"
        return thin if factor > 1 else ""

    def _log(self, stream: rr.RecordingStream, fused: NumbaHash, c: int) -> None:
        rows = np.arange(self._edges[c], min(self._edges[c + 1], len(fused)))
        self._log_table(stream, c, fused.table_of(rows))
        self._changed[c], self._size[c] = 0, len(rows)

    def _log_table(self, stream: rr.RecordingStream, c: int, table: VoxelTable, factor: int = 1) -> None:
        for name, grid in grids(table, self._classes, self._origin, factor):
            stream.log(self._path(name, c), grid)
        self.logged += len(table)

    def _path(self, name: str, chunk: int) -> str:
        return f"{self.entity}/{name}/{chunk:02d}"


def select(table: VoxelTable, rows: npt.NDArray[np.int64]) -> VoxelTable:
    """Those rows of a table, ascending."""
    columns = ("ix", "iy", "iz", "op", "evidence", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum",
               "frame_entropy_sum")  # fmt: skip
    whole = len(rows) > 0 and rows[-1] - rows[0] == len(rows) - 1
    pick = slice(rows[0], rows[-1] + 1) if whole else rows  # a stretch is not copied
    picked = {name: getattr(table, name)[pick] for name in columns}
    return VoxelTable(**picked, voxel_size=table.voxel_size, classes=table.classes)
