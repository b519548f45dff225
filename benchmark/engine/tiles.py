"""A map in tiles: which frames see which tile, the result of each, and a time series of all of them."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import parse_json, read_arrays, write_arrays
from semstab.core.json_form import from_json, to_json
from semstab.core.types import Float64, Int32
from semstab.data.frames import Frame
from semstab.data.image_measures import FrameQuality, VideoMeasures
from semstab.data.results import Agreement
from semstab.engine.series import NUMBERS, Series
from semstab.errors import DataError
from semstab.metrics.agreement import together
from semstab.metrics.summary import TableSums

TILE_OBSERVATIONS, TILE_FEATURES = "observations.parquet", "features.npz"
"""Files of the sample of observations of all frames, and of their features."""

MOST_TILES = 1 << 16
"""Tiles that one frame may meet."""

MARGIN = 1.0
"""Voxels by which a frustum is widened: a pixel at its side may be rounded into the next voxel."""


def tiles_met(frame: Frame, voxel_size: float, size: int) -> Int32:
    """Return (n, 2) the tiles of that edge in voxels that the frustum between the least and the largest depth meets.

    Of a scan it is the box around its points, along the sensor's axes.

    A tile is left out where a line separates it from the corners of the frustum, seen from above. None is left out that
    a pixel falls into.

    Raises:
        DataError: If there are too many.
    """
    depth = frame.depth[(frame.depth > 0) & np.isfinite(frame.depth)]
    if not depth.size:
        return np.zeros((0, 2), np.int32)
    if frame.points is None:
        across, down = (axis[[0, -1]] for axis in frame.rays)
        x, y, d = np.meshgrid(across, down, [depth.min(), depth.max()])
        x, y = x * d, y * d
    else:  # the box around its points
        points = frame.points[(frame.depth > 0) & np.isfinite(frame.depth)]
        x, y, d = np.meshgrid(*zip(points.min(axis=0), points.max(axis=0), strict=True))
    box = np.stack([x, y, d], axis=-1, dtype=np.float64).reshape(-1, 3)
    corners = ((box @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]) / voxel_size)[:, :2]
    low = np.floor((corners.min(axis=0) - MARGIN) / size)
    high = np.floor((corners.max(axis=0) + MARGIN) / size)
    if (count := float(np.prod(high - low + 1))) > MOST_TILES:
        raise DataError(
            f"{frame.where('depth')}: up to {depth.max():g} m deep, it sees {count:.0f} tiles of"
            f" {size * voxel_size:g} m; mask such depth, or use a larger --tile-size"
        )
    columns, rows = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    tiles = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2)
    a, b = np.triu_indices(len(corners), 1)
    normal = (corners[a] - corners[b])[:, ::-1] * [1, -1]  # of each line through two corners: the hull's are among them
    reach = size / 2 * np.abs(normal).sum(axis=1) + MARGIN * np.linalg.norm(normal, axis=1)
    centre, along = (tiles + 0.5) * size @ normal.T, corners @ normal.T
    separated = (centre + reach < along.min(axis=0)) | (centre - reach > along.max(axis=0))
    met: Int32 = tiles[~separated.any(axis=1)].astype(np.int32)
    return met


@dataclass(frozen=True, eq=False)
class TileMeta:
    """The fields of a result that are no arrays.

    Attributes:
        files: Digests of its files, by their path in the folder.
        checked: Agreement with the reference on a sample of its voxels.
        origin: Voxel of the first camera.
    """

    files: Mapping[str, str]
    checked: Agreement | None = None
    quality: FrameQuality | None = None
    origin: tuple[int, int, int] | None = None
    video_measures: VideoMeasures | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TileResult(TileMeta):
    """The result of a whole unit, of one tile, or of the pass over all frames; tile results are merged into the unit's.

    Attributes:
        series: (F, C) NUMBERS of each frame.
        sums: Sums of its voxels, by name, as `TableSums` has them.
        reduced: Sums of the map of labels that soft scores were reduced to; empty without scores.
        image: (F, C) stability of each frame in image coordinates, poses (F, 3, 3) of the cameras: of all frames.
        seen: (m, 3) a frame and a tile that it meets, ascending by frame.
    """

    series: Float64
    sums: Mapping[str, Float64] = field(default_factory=dict)
    reduced: Float64 = field(default_factory=lambda: np.zeros(0))
    image: Float64 = field(default_factory=lambda: np.zeros((0, 0)))
    poses: Float64 = field(default_factory=lambda: np.zeros((0, 3, 3)))
    seen: Int32 = field(default_factory=lambda: np.zeros((0, 3), np.int32))

    def save(self, path: Path) -> None:
        """Write it, atomically."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays |= {f"sums {name}": value for name, value in self.sums.items()}
        meta = to_json({field.name: getattr(self, field.name) for field in dataclasses.fields(TileMeta)})
        write_arrays(path, {"meta": np.frombuffer(json.dumps(meta).encode(), np.uint8), **arrays})

    @classmethod
    def load(cls, path: Path) -> TileResult | None:
        """Read the file that `save` wrote; return None if it is missing, damaged or of another version."""
        arrays = read_arrays(path)
        if arrays is None or not {"meta", *ARRAYS} <= arrays.keys() or arrays["series"].shape[1:] != (len(NUMBERS),):
            return None
        try:
            meta = from_json(TileMeta, parse_json(arrays["meta"].tobytes()), path)
        except (DataError, ValueError):
            return None
        sums = {name[5:]: array for name, array in arrays.items() if name.startswith("sums ")}
        contents: dict[str, Any] = {name: arrays[name] for name in ARRAYS}
        return cls(**vars(meta), **contents, sums=sums)

    def with_tiles(self, tiles: Sequence[TileResult]) -> TileResult:
        """Return the result of a unit: of this pass over its frames with all of its tiles."""
        sums = functools.reduce(operator.add, (TableSums.read(tile.sums) for tile in tiles)).arrays() if tiles else {}
        reduced = [tile.reduced for tile in tiles if len(tile.reduced)]
        checked = [tile.checked for tile in tiles if tile.checked is not None]
        return dataclasses.replace(
            self,
            files={name: digest for part in (self, *tiles) for name, digest in part.files.items()},
            sums=sums,
            reduced=np.sum(reduced, axis=0) if reduced else np.zeros(0),
            checked=together(checked) if checked and len(checked) == len(tiles) else None,
        )

    def tiles(self) -> dict[tuple[int, int], list[int]]:
        """Return the frames that meet each tile, in order, by its index."""
        frames: dict[tuple[int, int], list[int]] = {}
        for index, x, y in self.seen.tolist():
            frames.setdefault((x, y), []).append(index)
        return dict(sorted(frames.items()))


ARRAYS = ("series", "reduced", "image", "poses", "seen")
"""The fields of a result that are arrays, without the sums."""

# --- The time series of a unit in tiles -------------------------------------------------------------------------------

SUMS = ("points", "voxels", "new_voxels", "drift_sum", "seconds")

SECONDS = ("association_seconds", "update_seconds")
"""The columns that are not known of a frame that no tile fused."""

MEANS = ("map_vss_all", "map_entropy_all", "map_recurrent")


def joined_series(frames: Float64, tiles: Sequence[Float64]) -> Series:
    """Return the time series of a unit, from the rows of NUMBERS of its frames, and those of each tile of its map."""
    column, rows = {name: k for k, name in enumerate(NUMBERS)}, frames.copy()
    frame = rows[:, column["frame"]]
    totals = {name: np.zeros(len(rows)) for name in MEANS}
    voxels = np.zeros(len(rows))
    for tile in tiles:
        tile_frames = tile[:, column["frame"]]
        positions = np.searchsorted(frame, tile_frames)
        for name in (*SUMS, *SECONDS):
            before = rows[positions, column[name]]
            rows[positions, column[name]] = (np.nan_to_num(before) if name in SECONDS else before) + tile[
                :, column[name]
            ]
        so_far = tile[:, column["map_voxels"]]
        voxels += _latest(frame, tile_frames, so_far)
        for name in MEANS:
            totals[name] += _latest(frame, tile_frames, np.where(so_far > 0, so_far * tile[:, column[name]], 0.0))
    rows[:, column["map_voxels"]] = voxels
    for name in MEANS:
        rows[:, column[name]] = totals[name] / np.where(voxels > 0, voxels, math.nan)
    return Series(rows)


def _latest(frame: Float64, tile_frames: Float64, values: Float64) -> Float64:
    """Return (F,) the value of the last of its own frames at each frame, 0 before them."""
    latest: Float64 = np.concatenate([np.zeros(1), values])[np.searchsorted(tile_frames, frame, side="right")]
    return latest
