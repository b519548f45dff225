"""Geometry or semantics: the agreement that would be left if the labels did not depend on the view at all.

View-independent labels are fused under the same poses, depth and noise. The loss there is geometry's: pixels that
fall into the wrong voxel, voxels that hold more than one thing. The rest of the loss is the model's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend
from semstab.backends.shared.association import back_project, voxel_index
from semstab.core.types import Int64
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.data.statistics import Losses
from semstab.data.voxel_keys import voxel_keys
from semstab.data.voxels import VoxelTable
from semstab.errors import DataError
from semstab.metrics import dominant
from semstab.metrics.agreement import shared_rows
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import psa
from semstab.statistics.cluster_sums import mean_functional
from semstab.statistics.intervals import estimate


def ceiling(
    frames: Iterable[Frame],
    make_backend: Callable[[], FusionBackend],
    *,
    world: VoxelTable | None = None,
    views: Iterable[Frame] | None = None,
) -> VoxelTable:
    """Return the map of view-independent labels: the fusion of `frames` with a model that never errs.

    With `world` the map itself and no `views` nothing is lost, as each pixel sees the voxel that it falls into. Give
    ground truth, a map of finer voxels, or the frames before noise was added.

    Args:
        frames: The frames as they were fused, noise included; one is held at a time.
        make_backend: Makes a new, empty map of the same voxels: `lambda: create("numba", voxel_size=0.2,
            num_classes=7)`.
        world: A map whose dominant labels are rendered into the frames; without a map, the frames' own labels
            count, which must be the ground truth.
        views: The same frames free of the noise that was added to them: labels are seen from there.

    Raises:
        DataError: If frames and views do not fit together.
    """
    backend = make_backend()
    for frame in frames if world is None else rendered(frames, world, views):
        backend.integrate(frame)
    return backend.table()


def rendered(frames: Iterable[Frame], world: VoxelTable, views: Iterable[Frame] | None = None) -> Iterator[Frame]:
    """Yield the frames with the labels that the map shows in them.

    Each pixel has the dominant label of the voxel it sees.

    A pixel that sees no voxel of the map is ignored. `views` (the frames themselves by default) show which
    point a pixel sees.

    Raises:
        DataError: If a view is missing or differs in size from its frame.
    """
    labels = _DominantLabels(world)
    for frame, view in ((frame, frame) for frame in frames) if views is None else _paired(frames, views):
        rendered_labels = np.full(view.shape, labels.ignore, dtype=labels.dtype)
        rendered_labels[view.valid] = labels.labels_at(voxel_index(back_project(view), world.voxel_size, view))
        yield dataclasses.replace(frame, labels=rendered_labels, scores=None)


def losses(table: VoxelTable, limit: VoxelTable) -> Losses:
    """Split the disagreement in a model's map by the ceiling's map `limit` of the same voxels.

    Raises:
        DataError: If the maps differ in K or voxel size.
    """
    rows, limit_rows = shared_rows(table, limit)
    repeated = (table.op[rows] >= 2) & (limit.op[limit_rows] >= 2)
    rows, limit_rows = rows[repeated], limit_rows[repeated]
    total, geometry = 1 - psa(table)[rows], 1 - psa(limit)[limit_rows]
    cubes = Cubes.from_table(table.rows(rows), where=np.ones(len(rows), np.bool_))
    means = cubes.means({"total": total, "geometry": geometry, "model": total - geometry})
    means["share"] = np.stack([means["geometry"][:, 0], means["total"][:, 0]], axis=1)
    sums = cubes.sums_by_name(means)
    return Losses(
        voxels=len(rows),
        total=estimate(sums, mean_functional("total")).ends,
        geometry=estimate(sums, mean_functional("geometry")).ends,
        model=estimate(sums, mean_functional("model", -1.0)).ends,
        share=estimate(sums, mean_functional("share", 0.0, math.inf)).ends,
    )


class _DominantLabels:
    """The dominant label of a map's voxel by its index; `ignore` where the map has no voxel."""

    def __init__(self, world: VoxelTable) -> None:
        if not len(world):
            raise DataError("the map to render has no voxels")
        few = world.K <= IGNORE_8BIT
        self.dtype = np.uint8 if few else np.uint16
        self.ignore = IGNORE_8BIT if few else IGNORE_16BIT
        self._low = world.index.min(axis=0).astype(np.int64)
        self._size = world.index.max(axis=0) - self._low + 1
        (self._keys,) = voxel_keys(world.index)
        self._labels = dominant(world).astype(self.dtype)

    def labels_at(self, index: Int64) -> npt.NDArray[np.integer]:
        """Return labels (n,) of voxel indices (3, n)."""
        x, y, z = index - self._low[:, None]
        inside = (
            (np.minimum(np.minimum(x, y), z) >= 0) & (x < self._size[0]) & (y < self._size[1]) & (z < self._size[2])
        )
        key = (x * self._size[1] + y) * self._size[2] + z
        row = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(inside & (self._keys[row] == key), self._labels[row], self.dtype(self.ignore))


def _paired(frames: Iterable[Frame], views: Iterable[Frame]) -> Iterator[tuple[Frame, Frame]]:
    frames, views = iter(frames), iter(views)
    for frame in frames:
        view = next(views, None)
        if view is None or view.shape != frame.shape:
            size = "there is none" if view is None else f"it is {view.shape[1]}x{view.shape[0]}"
            raise DataError(f"frame {frame.index}: it needs a view of its size to see labels from; {size}")
        yield frame, view
