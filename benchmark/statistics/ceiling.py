"""Agreement beside its ceiling: what it would be had frames seen the same cells of each voxel.

Voxels hold more than one thing, and frames see other parts of them: that sets a ceiling to agreement, which falls as
voxels grow. Two frames share a cell of a voxel less often than two pixels of a frame do. What that costs follows from
the pairs of frames that did see the same cell, so that errors of the labels lower neither the share nor the ceiling.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend
from semstab.backends.shared.association import back_project, voxel_index
from semstab.core.types import THIS_SCENE, Float64, Int64, Scope
from semstab.errors import DataError
from semstab.metrics import dominant
from semstab.metrics.agreement import shared_rows, voxel_keys
from semstab.model.frames import Frame
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.model.statistics import CeilingShare, ClassCeilingShare, Interval, Losses
from semstab.model.voxels import VoxelTable
from semstab.statistics.accumulate import Cubes, CubeSums, cluster_sums_of
from semstab.statistics.agreement import psa, ratio_of
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import EstimateSpec, confidence_intervals, probability_above, scope_of, spec_of
from semstab.statistics.observations import ObservationSample
from semstab.statistics.verdict import LIMITS, Limits


def ceiling_share(
    sample: ObservationSample,
    table: VoxelTable,
    sums: ClusterSums | None = None,
    *,
    critical: Sequence[str] = (),
    limits: Limits = LIMITS,
) -> CeilingShare:
    """Alpha between frames in the sampled voxels beside what it would be of the same cells, of all classes and of each.

    table     the whole map: how many places a class has
    sums      of the map with that sample, where they are there already
    critical  names of the classes that matter; where none is given, those with enough
    """
    sums = cluster_sums_of(table, sample=sample) if sums is None else sums
    locations = locations_by_class(table)
    result = confidence_intervals(ceiling_specs(sums, table.K))
    return ceiling_share_from(locations, sums, result, critical=critical, limits=limits)


def locations_by_class(table: VoxelTable) -> Float64:
    """Return (K,) voxels with OP >= 2 by their dominant class."""
    return np.bincount(dominant(table)[table.op >= 2], minlength=table.K).astype(np.float64)


def ceiling_specs(sums: ClusterSums, K: int, wanted: Scope = THIS_SCENE) -> Iterator[EstimateSpec]:
    """Yield for `answers` alpha in the sample, its ceiling, and the share reached, together and by class of K."""
    assert sums.seen is not None
    scope = scope_of(sums, wanted)
    yield spec_of(sums.seen, "alpha_between", scope=scope)
    yield spec_of(sums, "ceiling", scope=scope)
    for k in (None, *range(K)):
        yield spec_of(sums, "reached", k, scope)


def ceiling_share_from(
    locations: Float64,
    sums: ClusterSums,
    result: Sequence[Interval],
    *,
    critical: Sequence[str] = (),
    limits: Limits = LIMITS,
) -> CeilingShare:
    """The same from the sums of a map with a sample; places (K,) of each class.

    result  the answers to `ceiling_specs`
    """
    assert sums.seen is not None
    names = sums.classes or tuple(str(k) for k in range(len(locations)))
    named = set(critical) & set(names)
    alpha, ceiling, reached, *of_classes = result
    return CeilingShare(
        voxels=round(float(sums.seen["voxels"].sum())),
        alpha=alpha,
        ceiling=ceiling,
        share=reached,
        classes=tuple(
            ClassCeilingShare(
                name,
                float(locations[k]),
                name in named if named else bool(locations[k] >= limits.class_locations),
                value(sums.seen, "alpha_between", k),
                value(sums, "ceiling", k),
                of_classes[k],
                1 - probability_above(of_classes[k], limits.usable, "agreement"),
            )
            for k, name in enumerate(names)
        ),
    )


# Geometry or semantics: what agreement would be left if the labels did not depend on the view at all.
#
# View-independent labels are fused under the same poses, depth and noise. What is lost there is geometry's: pixels that
# fall into the wrong voxel, voxels that hold more than one thing. The rest of the loss is the model's.


def ceiling(
    frames: Iterable[Frame],
    make_backend: Callable[[], FusionBackend],
    *,
    world: VoxelTable | None = None,
    views: Iterable[Frame] | None = None,
) -> VoxelTable:
    """The map of view-independent labels: what the fusion of `frames` would be with a model that never errs.

    frames        the frames as they were fused, noise included; one is held at a time
    make_backend  makes a new, empty map of the same voxels: `lambda: create("numba", voxel_size=0.2, num_classes=7)`
    world         a map whose dominant labels are rendered into the frames; where there is none, the frames' own labels
                  count, which are to be the ground truth
    views         the same frames free of the noise that was added to them: labels are seen from there

    With `world` the map itself and no `views` nothing is lost, as each pixel sees the voxel that it falls into. Give
    ground truth, a map of finer voxels, or the frames before noise was added.
    Raises DataError where frames and views do not fit together.
    """
    backend = make_backend()
    for frame in frames if world is None else rendered(frames, world, views):
        backend.integrate(frame)
    return backend.table()


def rendered(frames: Iterable[Frame], world: VoxelTable, views: Iterable[Frame] | None = None) -> Iterator[Frame]:
    """The frames with the labels that the map shows in them: each pixel has the dominant label of the voxel it sees.

    A pixel that sees no voxel of the map is ignored. `views` (the frames themselves where not given) say where a pixel
    sees. Raises DataError where a view is missing or differs in size from its frame.
    """
    labels = _Labels(world)
    for frame, view in ((frame, frame) for frame in frames) if views is None else _paired(frames, views):
        seen = np.full(view.shape, labels.ignore, dtype=labels.dtype)
        seen[view.valid] = labels.at(voxel_index(back_project(view), world.voxel_size, view))
        yield dataclasses.replace(frame, labels=seen, scores=None)


def losses(table: VoxelTable, limit: VoxelTable) -> Losses:
    """Split the disagreement in a model's map by the ceiling's map `limit` of the same voxels.

    Raises DataError where the maps differ in K or voxel size.
    """
    rows, limit_rows = shared_rows(table, limit)
    both = (table.op[rows] >= 2) & (limit.op[limit_rows] >= 2)
    rows, limit_rows = rows[both], limit_rows[both]
    total, geometry = 1 - psa(table)[rows], 1 - psa(limit)[limit_rows]
    cubes = Cubes.of(table.rows(rows), where=np.ones(len(rows), np.bool_))
    means = cubes.means({"total": total, "geometry": geometry, "model": total - geometry})
    means["share"] = np.stack([means["geometry"][:, 0], means["total"][:, 0]], axis=1)
    sums = CubeSums(cubes.cell, cubes.edge, means)
    return Losses(
        voxels=len(rows),
        total=sums.estimate("total", ratio_of).ends,
        geometry=sums.estimate("geometry", ratio_of).ends,
        model=sums.estimate("model", ratio_of, (-1.0, 1.0)).ends,
        share=sums.estimate("share", ratio_of, (0.0, math.inf)).ends,
    )


class _Labels:
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

    def at(self, index: Int64) -> npt.NDArray[np.integer]:
        """Labels (n,) of voxel indices (3, n)."""
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
            what = "there is none" if view is None else f"it is {view.shape[1]}x{view.shape[0]}"
            raise DataError(f"frame {frame.index}: needs a view of its size to see labels from; {what}")
        yield frame, view
