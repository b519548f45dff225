"""Coverage: what the frames of a scene share, how noisy their depth is, and what voxels that carries."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from semstab.backends import create
from semstab.check.reprojection import Pair, Sample, Shared, View
from semstab.core.types import Float64, Int64, Mask
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT
from semstab.data.measures import mean
from semstab.errors import DataError

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
"""The least number of frames that it leaves, if there are enough: intervals need them to tell how frames differ."""

BINS = ((1, 1), (2, 2), (3, 8), (9, 27))
"""Distances between frames that are reported together."""


def by_distance(pairs: Iterable[Pair]) -> Iterator[tuple[tuple[int, int], list[Pair]]]:
    """Yield the distances between frames that are reported together, with the pairs that lie so far apart, if any."""
    all_pairs = [*pairs]
    for low, high in BINS:
        if near := [(a, b) for a, b in all_pairs if low <= abs(a - b) <= high]:
            yield (low, high), near


def said(apart: tuple[int, int]) -> str:
    """Return distances between frames in words.

    >>> said((1, 1)), said((3, 8))
    ('1', '3 to 8')
    """
    return " to ".join(map(str, dict.fromkeys(apart)))


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
class DepthNoise:
    """Noise of depth, metres: a point seen again is off by `between`, pixels of one frame by `within`; medians.

    Attributes:
        footprint: Width that a pixel covers at the median depth, metres.
    """

    between: float
    within: float
    footprint: float


@dataclass(frozen=True)
class Suggestion:
    """Settings that suit the data, each with the reason; None if the data do not tell."""

    voxel_size: float | None
    voxel_size_reason: str
    pixel_stride: int | None
    pixel_stride_reason: str
    frame_stride: int
    frame_stride_reason: str


@dataclass(frozen=True, eq=False)
class SharedPoints:
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

    reasons = (
        "another frame puts {:.0%} of the points into the same voxel",
        "a frame and the next share {:.0%} of their view",
    )

    def __init__(self, sample: Sample) -> None:
        self.sample = sample
        factors = np.array([1.0])
        self._matches = {pair: sample.matched(pair, sample.configured, factors) for pair in sample.pairs}
        self._seen = {pair: self._same_surface(pair) for pair in sample.pairs}

    def overlaps(self) -> list[Overlap]:
        """Return one row a distance between frames."""
        return [self._overlap(distances, pairs) for distances, pairs in by_distance(self.sample.pairs)]

    def noise(self) -> DepthNoise:
        """Return how far depth is off, between frames and within one."""
        offsets = [surface.offset for surface in self._seen.values()]
        views = self.sample.views.values()
        footprints = [view.depth[view.v, view.u] / view.camera.fx for view in views]
        return DepthNoise(
            between=_median(np.concatenate(offsets)) if offsets else math.nan,
            within=_median(np.concatenate([plane_residuals(view) for view in views])),
            footprint=_median(np.concatenate(footprints)),
        )

    def stays(self, voxel_size: float) -> float:
        """Return the share of the points that fall into the same voxel when another frame sees them, or NaN."""
        return mean(np.all(self._same_along(voxel_size, np.zeros(3)), axis=1))

    def faces(self, voxel_size: float) -> Faces | None:
        """Return the axes along which faces of voxels lie in a surface, or None without an axis or if most points stay.

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
        return Faces(voxel_size, names, self.stays(voxel_size), mean(np.all(off, axis=1)))

    def pixel_stride(self, voxel_size: float | None) -> tuple[int | None, str]:
        """Return the pixel stride that leaves some pixels along a voxel's edge, and the reason."""
        views = self.sample.views.values()
        far = float(np.percentile(np.concatenate([view.depth[view.v, view.u] for view in views]), 95))
        footprint = far / min(view.camera.fx for view in views)
        pixels = None if voxel_size is None else max(1, int(voxel_size / (PIXELS_ACROSS * footprint)))
        return pixels, f"{PIXELS_ACROSS} pixels or more along a voxel's edge at {far:.3g} m"

    def _same_along(self, voxel_size: float, phase: Float64) -> Mask:
        """Return (n, 3) whether points seen again lie between the same faces of a grid moved by a part of a voxel."""
        surfaces = [surface for surface in self._seen.values() if len(surface.first)]
        if not surfaces:
            return np.zeros((0, 3), dtype=np.bool_)
        first, second = (
            np.concatenate([getattr(surface, name) for surface in surfaces]) for name in ("first", "second")
        )
        return np.asarray(np.floor(first / voxel_size + phase) == np.floor(second / voxel_size + phase))

    def _overlap(self, distances: tuple[int, int], pairs: Sequence[Pair]) -> Overlap:
        matches = [self._matches[pair] for pair in pairs]
        errors = np.concatenate([match.error[0] for match in matches])
        agree = np.concatenate([self._seen[pair].agree for pair in pairs])
        return Overlap(
            apart=distances,
            pairs=len(pairs),
            in_view=mean(np.concatenate([match.inside[0] for match in matches])),
            covisible=mean(np.isfinite(errors)),
            error=_median(errors[np.isfinite(errors)]),
            agreement=mean(agree),
        )

    def _same_surface(self, pair: Pair) -> SharedPoints:
        a, b = self.sample.views[pair[0]], self.sample.views[pair[1]]
        match = self._matches[pair]
        shared = Shared.from_matches(a, match)
        first, second = shared.labels(a.labels, b.labels, a.ignore_id, b.ignore_id)
        return SharedPoints(
            offset=np.abs(match.depth - match.z)[0][shared.chosen],
            first=world_points(a, *shared.first),
            second=world_points(b, *shared.second),
            agree=first == second,
        )


def world_points(view: View, v: Int64, u: Int64) -> Float64:
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


def persistence(frames: Iterable[Frame], coverage: Covers, voxel_size: float) -> Persistence | None:
    """Fuse frames and count how often each voxel is seen.

    Returns None if points lie so far out that voxels of this size cannot be counted.
    """
    backend = create("numba", voxel_size=voxel_size, num_classes=2)
    with contextlib.suppress(DataError):
        for frame in frames:
            backend.integrate(frame)
        op, edges = backend.table().op, [0, 1, 2, 5, np.inf]
        shares = tuple(mean((low < op) & (op <= high)) for low, high in itertools.pairwise(edges))
        return Persistence(voxel_size, len(op), mean(op), shares, coverage.stays(voxel_size))
    return None


def fused_stride(size: tuple[int, int], pixel_stride: int) -> int:
    """Return the pixel stride at which frames of that (width, height) are fused: the run's, or a larger one."""
    return max(pixel_stride, math.ceil(math.sqrt(size[0] * size[1] / FUSED_PIXELS)))


def without_labels(view: View, pixel_stride: int) -> Frame:
    """Return every n-th pixel of a view, as a frame of one class."""
    step = max(1, fused_stride(view.size, pixel_stride) // view.stride)
    labels = np.where((view.depth > 0) & (view.depth < np.inf), 0, IGNORE_8BIT).astype(np.uint8)
    return Frame(view.index, view.depth, view.camera.every(view.stride), view.T_wc, labels=labels).every(step)


class Covers(Protocol):
    """The overlap of frames, or scans.

    Attributes:
        reasons: Reasons for the suggested voxel size and frame stride, with a place for the share of the points.
    """

    reasons: tuple[str, str]

    def overlaps(self) -> list[Overlap]:
        """Return one row a distance between frames."""

    def noise(self) -> DepthNoise:
        """Return how far points are off, between frames and within one."""

    def stays(self, voxel_size: float) -> float:
        """Return the share of the points that stay in their voxel, or NaN if no point is seen again."""

    def faces(self, voxel_size: float) -> Faces | None:
        """Return the axes along which faces of voxels lie in a surface, or None without such an axis."""

    def pixel_stride(self, voxel_size: float | None) -> tuple[int | None, str]:
        """Return the pixel stride that suits a voxel size, and the reason."""


def suggested_size(coverage: Covers) -> float | None:
    """Return the smallest voxel size, in metres, at which points stay in their voxel, or None without overlap.

    If faces of voxels lie in a surface, the grid is taken half a voxel off: a larger voxel does not mend this.
    """
    return next((size for size in SIZES if _stays_off_faces(coverage, size) >= STAYS), None)


def _stays_off_faces(coverage: Covers, size: float) -> float:
    faces = coverage.faces(size)
    return coverage.stays(size) if faces is None else faces.moved


def suggest(coverage: Covers, overlaps: Sequence[Overlap], frames: int, stride: int) -> Suggestion:
    """Return voxel size, pixel stride and frame stride that suit the `frames` frames, whose own stride is `stride`."""
    size = suggested_size(coverage)
    shared = {row.apart[0]: row.in_view for row in overlaps}
    times = max((n for n in shared if shared[n] >= SHARED and frames >= FRAMES_LEFT * n), default=1)
    stays = math.nan if size is None else _stays_off_faces(coverage, size)
    off = size is not None and stays != coverage.stays(size)
    share, (of_voxels, of_frames) = shared.get(times, math.nan), coverage.reasons
    return Suggestion(
        size,
        f"{of_voxels.format(stays)}{', where its faces lie in no surface' if off else ''}",
        *coverage.pixel_stride(size),
        frame_stride=stride * times,
        frame_stride_reason=f"{of_frames.format(share)}{_few(share)}",
    )


def _few(share: float) -> str:
    return f", less than {SHARED:.0%}: more frames help" if share < SHARED else ""


def _median(values: npt.NDArray[Any]) -> float:
    return float(np.median(values)) if len(values) else math.nan
