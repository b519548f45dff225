"""Coverage: what the frames of a scene share, how noisy their depth is, and what voxels that carries."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from semstab.backends import create
from semstab.check.reprojection import Pair, Sample, View
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT

CONSISTENT = 0.05
"""A point that is seen again is taken for the same surface where the two depths differ by at most this share."""

FUSED_FRAMES = 24
"""Frames that are fused for the distribution of OP, evenly spaced over the selected ones."""

FUSED_PIXELS = 2**18
"""Pixels of each that are fused; of a larger image every n-th of each axis."""

SIZES = tuple(m * 10.0**e for e in range(-3, 3) for m in (1, 2, 5))
"""Voxel sizes that are suggested, metres."""

STAYS = 0.5
"""The suggested voxel size is the smallest in which this share of the points fall into the same voxel seen again."""

PHASES = (0.25, 0.5, 0.75)
IN_SURFACE = 0.85
"""Faces of voxels lie in a surface where along an axis at most this part of the points stays in its voxel, compared
with grids that are moved by these parts of a voxel."""

PIXELS_ACROSS = 2
"""The suggested pixel stride leaves this many pixels along a voxel's edge, at the far end of the depths."""

SHARED = 0.6
"""The suggested frame stride leaves this share of a frame's points in view of the next one."""

FRAMES_LEFT = 20
"""The least number of frames that it leaves, where there are so many: intervals need them to tell how frames differ."""

BINS = ((1, 1), (2, 2), (3, 8), (9, 27))
"""Distances between frames that are reported together."""


@dataclass(frozen=True)
class Overlap:
    """The overlap of frames that lie `apart` selected frames apart, from the first to the last number.

    Attributes:
        in_view: Share of a frame's points that lie in the other image.
        covisible: Share of them that have depth there, too.
        error: Median relative depth error of those.
        agreement: Share of those on the same surface whose labels agree, NaN without labels.
    """

    apart: tuple[int, int]
    pairs: int
    in_view: float
    covisible: float
    error: float
    agreement: float


@dataclass(frozen=True)
class Persistence:
    """The distribution of OP at a voxel size, from frames that were fused.

    Attributes:
        shares: Shares of the voxels by stratum: OP = 1, OP = 2, 3 to 5, more.
        stays: Share of the points that fall into the same voxel when another frame sees them.
    """

    voxel_size: float
    voxels: int
    mean_op: float
    shares: tuple[float, ...]
    stays: float


@dataclass(frozen=True)
class Noise:
    """Noise of depth, metres: a point seen again is off by `between`, pixels of one frame by `within`; medians.

    Attributes:
        footprint: Width that a pixel covers at the median depth, metres.
    """

    between: float
    within: float
    footprint: float


@dataclass(frozen=True)
class Suggestion:
    """Settings that suit the data, each with the reason; None where the data do not tell."""

    voxel_size: float | None
    voxel_size_reason: str
    pixel_stride: int | None
    pixel_stride_reason: str
    frame_stride: int
    frame_stride_reason: str


@dataclass(frozen=True, eq=False)
class Seen:
    """Points of one view that another one sees on the same surface.

    Attributes:
        offset: (N,) metres between the two depths.
        first, second: (N, 3) the point, and the point of the pixel that sees it, in the world.
        agree: Whether their labels agree, for those that have one in both.
    """

    offset: Float64
    first: Float64
    second: Float64
    agree: Mask


@dataclass(frozen=True)
class Faces:
    """Faces of voxels that lie in a surface, whose noise splits its points between two voxels.

    Attributes:
        voxel_size: Metres.
        axes: Names of the axes that they are normal to.
        stays: Share of the points that stay in their voxel when another frame sees them.
        moved: The same with the grid half a voxel off along these axes.
    """

    voxel_size: float
    axes: tuple[str, ...]
    stays: float
    moved: float

    def __str__(self) -> str:
        half, along = self.voxel_size / 2, " and ".join(self.axes)
        return (
            f"faces of voxels of {self.voxel_size:g} m lie in a surface (normal to {along}), whose noise splits its"
            f" points: {self.stays:.0%} stay in their voxel when another frame sees them, {self.moved:.0%} with the"
            f" grid half a voxel off; move the poses by {half:g} m along {along}"
        )


class Coverage:
    """The share of a scene that the views of a sample have in common under the configured convention."""

    def __init__(self, sample: Sample) -> None:
        self.sample = sample
        one = np.array([1.0])
        self._matches = {pair: sample.matched(pair, sample.configured, one) for pair in sample.pairs}
        self._seen = {pair: self._same_surface(pair) for pair in sample.pairs}

    def overlaps(self) -> list[Overlap]:
        """Return one row a distance between frames."""
        rows = []
        for low, high in BINS:
            pairs = [(a, b) for a, b in self.sample.pairs if low <= abs(a - b) <= high]
            if pairs:
                rows.append(self._overlap((low, high), pairs))
        return rows

    def noise(self) -> Noise:
        """Return how far depth is off, between frames and within one."""
        offsets = [seen.offset for seen in self._seen.values()]
        views = self.sample.views.values()
        footprints = [view.depth[view.v, view.u] / view.camera.fx for view in views]
        return Noise(
            between=_median(np.concatenate(offsets)) if offsets else math.nan,
            within=_median(np.concatenate([plane_residuals(view) for view in views])),
            footprint=_median(np.concatenate(footprints)),
        )

    def stays(self, voxel_size: float) -> float:
        """Return the share of the points that fall into the same voxel when another frame sees them.

        NaN where none does.
        """
        return _mean(np.all(self._same_along(voxel_size, np.zeros(3)), axis=1))

    def faces(self, voxel_size: float) -> Faces | None:
        """Return the axes along which faces of voxels lie in a surface; None where they do not, or most points stay.

        Along them far fewer points stay than with the grid a quarter, a half or three quarters of a voxel off.
        """
        if not self.stays(voxel_size) < STAYS:
            return None
        here = self._same_along(voxel_size, np.zeros(3)).mean(axis=0)
        moved = [self._same_along(voxel_size, np.full(3, phase)).mean(axis=0) for phase in PHASES]
        axes = np.asarray(here < IN_SURFACE * np.mean(moved, axis=0))
        if not axes.any():
            return None
        off = self._same_along(voxel_size, np.where(axes, 0.5, 0.0))
        names = tuple(name for name, is_one in zip("xyz", axes.tolist(), strict=True) if is_one)
        return Faces(voxel_size, names, self.stays(voxel_size), _mean(np.all(off, axis=1)))

    def _same_along(self, voxel_size: float, phase: Float64) -> Mask:
        """Return (n, 3) whether points seen again lie between the same faces of a grid moved by a part of a voxel."""
        seen = [one for one in self._seen.values() if len(one.first)]
        if not seen:
            return np.zeros((0, 3), dtype=np.bool_)
        first, second = (np.concatenate([getattr(one, name) for one in seen]) for name in ("first", "second"))
        return np.asarray(np.floor(first / voxel_size + phase) == np.floor(second / voxel_size + phase))

    def _overlap(self, apart: tuple[int, int], pairs: Sequence[Pair]) -> Overlap:
        matches = [self._matches[pair] for pair in pairs]
        errors = np.concatenate([match.error[0] for match in matches])
        agree = np.concatenate([self._seen[pair].agree for pair in pairs])
        return Overlap(
            apart=apart,
            pairs=len(pairs),
            in_view=_mean(np.concatenate([match.inside[0] for match in matches])),
            covisible=_mean(np.isfinite(errors)),
            error=_median(errors[np.isfinite(errors)]),
            agreement=_mean(agree),
        )

    def _same_surface(self, pair: Pair) -> Seen:
        a, b = self.sample.views[pair[0]], self.sample.views[pair[1]]
        match = self._matches[pair]
        same = match.error[0] <= CONSISTENT
        u, v, depth = match.u[0][same], match.v[0][same], match.depth[0][same]
        agree = np.empty(0, dtype=np.bool_)
        if a.labels is not None and b.labels is not None:
            first, second = a.labels[a.v[same], a.u[same]], b.labels[v, u]
            agree = (first == second)[(first != a.ignore_id) & (second != b.ignore_id)]
        return Seen(
            offset=np.abs(depth - match.z[0][same]),
            first=world_points(a, a.u[same], a.v[same]),
            second=world_points(b, u, v),
            agree=agree,
        )


def world_points(view: View, u: Int64, v: Int64) -> Float64:
    """Return (N, 3) world coordinates of sampled pixels, metres."""
    K = view.camera.every(view.stride)
    depth = view.depth[v, u].astype(np.float64)
    points = np.stack([(u - K.cx) / K.fx * depth, (v - K.cy) / K.fy * depth, depth], axis=1)
    world: Float64 = points @ view.T_wc[:3, :3].T + view.T_wc[:3, 3]
    return world


def plane_residuals(view: View) -> Float64:
    """Return the distance in metres of sampled depths from the plane through their row neighbours, along the ray.

    Inverse depth is linear in pixels on a plane: its second difference is noise, or the surface's curvature.
    """
    inner = (view.u > 0) & (view.u < view.depth.shape[1] - 1)
    u, v = view.u[inner], view.v[inner]
    with np.errstate(all="ignore"):
        before, here, after = (1 / view.depth[v, u + step].astype(np.float64) for step in (-1, 0, 1))
        residuals = np.abs((before + after) / 2 - here) / here**2
    finite: Float64 = residuals[np.isfinite(residuals)]
    return finite


def persistence(views: Sequence[View], coverage: Coverage, voxel_size: float, pixel_stride: int) -> Persistence:
    """Fuse the views, every n-th pixel of them, and count how often each voxel is seen.

    Raises:
        DataError: If a point lies further out than voxels of that size are counted.
    """
    backend = create("numba", voxel_size=voxel_size, num_classes=2)
    for view in views:
        backend.integrate(_without_labels(view, pixel_stride))
    return distribution(backend.table().op, voxel_size, coverage.stays(voxel_size))


def distribution(op: Int32, voxel_size: float, stays: float) -> Persistence:
    """Return the distribution of OP (n,) over voxels of that size, in which that share of the points stays."""
    edges = [0, 1, 2, 5, np.inf]
    shares = tuple(_mean((low < op) & (op <= high)) for low, high in itertools.pairwise(edges))
    return Persistence(voxel_size, len(op), _mean(op), shares, stays)


def fused_stride(size: tuple[int, int], pixel_stride: int) -> int:
    """Return the pixel stride at which frames of that (width, height) are fused: the run's, or a larger one."""
    return max(pixel_stride, math.ceil(math.sqrt(size[0] * size[1] / FUSED_PIXELS)))


def _without_labels(view: View, pixel_stride: int) -> Frame:
    step = max(1, fused_stride(view.size, pixel_stride) // view.stride)
    labels = np.where((view.depth > 0) & (view.depth < np.inf), 0, IGNORE_8BIT).astype(np.uint8)
    return Frame(view.index, view.depth, view.camera.every(view.stride), view.T_wc, labels=labels).every(step)


class Stays(Protocol):
    """What tells which share of the points stays in its voxel."""

    def stays(self, voxel_size: float) -> float:
        """Return that share for a voxel size in metres; NaN where no point is seen again."""

    def faces(self, voxel_size: float) -> Faces | None:
        """Return the axes along which faces of voxels lie in a surface; None where they do not."""


def suggested_size(coverage: Stays) -> float | None:
    """Return the smallest voxel size in which points fall again, metres; None where frames do not see the same.

    Where faces of voxels lie in a surface, the grid is taken half a voxel off: a larger voxel does not mend that.
    """
    return next((size for size in SIZES if _stays_off_faces(coverage, size) >= STAYS), None)


def _stays_off_faces(coverage: Stays, size: float) -> float:
    faces = coverage.faces(size)
    return coverage.stays(size) if faces is None else faces.moved


def suggest(coverage: Coverage, overlaps: Sequence[Overlap], frames: int, stride: int) -> Suggestion:
    """Return voxel size, pixel stride and frame stride that suit so many frames, whose own stride is `stride`."""
    voxel_size = suggested_size(coverage)
    views = coverage.sample.views.values()
    far = float(np.percentile(np.concatenate([view.depth[view.v, view.u] for view in views]), 95))
    footprint = far / min(view.camera.fx for view in views)
    pixels = None if voxel_size is None else max(1, int(voxel_size / (PIXELS_ACROSS * footprint)))
    shared = {row.apart[0]: row.in_view for row in overlaps}
    times = max((n for n in shared if shared[n] >= SHARED and frames >= FRAMES_LEFT * n), default=1)
    stays = math.nan if voxel_size is None else _stays_off_faces(coverage, voxel_size)
    off = voxel_size is not None and stays != coverage.stays(voxel_size)
    return Suggestion(
        voxel_size=voxel_size,
        voxel_size_reason=f"{stays:.0%} of the points stay in such a voxel when another frame sees them"
        f"{', where its faces lie in no surface' if off else ''}",
        pixel_stride=pixels,
        pixel_stride_reason=f"{PIXELS_ACROSS} pixels or more along a voxel's edge at {far:.3g} m",
        frame_stride=stride * times,
        frame_stride_reason=_shared(shared.get(times, math.nan)),
    )


def _shared(share: float) -> str:
    few = f", less than {SHARED:.0%}: more frames help" if share < SHARED else ""
    return f"successive frames share {share:.0%} of their view{few}"


def _mean(values: npt.NDArray[Any]) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _median(values: npt.NDArray[Any]) -> float:
    return float(np.median(values)) if len(values) else math.nan
