"""Depth of one view, reprojected into another under a convention: how well it agrees, and where."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from semstab.check.conventions import INVERSE, Convention
from semstab.check.loops import find_matches
from semstab.check.verdict import Fit
from semstab.core.prefetch import prefetch
from semstab.core.types import Float32, Float64, Int64, Mask
from semstab.data.frames import Frame, Intrinsics, Pinhole, pinhole
from semstab.data.labels import fixed
from semstab.datasets import GROUND_TRUTH, Scene
from semstab.datasets.geometry.cameras import CAMERA_AXES, ray_lengths
from semstab.errors import DataError

# The frames and pixels that a check holds in memory: their number is bounded at any length and image size.

MAX_PIXELS = 2**20
"""The most pixels of an image: of a larger one only every n-th pixel of each axis is used."""

STEPS = (0, 1, 2, 8, 27)
"""Frames of a cluster, counted from its first one: their pairs lie 1 to 27 selected frames apart."""

CONSISTENT = 0.05
"""A point that is seen again is taken for the same surface where the two depths differ by at most this share."""

PAIR_POINTS = 20
"""Points of a pair of frames that are seen again, from which on its error counts."""

Pair = tuple[int, int]
Ids = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class View:
    """The part of a frame that is held in memory: every stride-th pixel, and a sample of these.

    Attributes:
        depth: (H, W) planar, metres, as configured.
        camera: Intrinsics of the whole image, whose (width, height) is `size`.
        T_wc: (4, 4) camera-to-world, OpenCV axes, as configured.
        labels: (H, W) class ids, or None for a scene without labels.
        u, v: (N,) the sample: pixels with valid depth.
    """

    index: int
    depth: Float32
    camera: Intrinsics
    size: tuple[int, int]
    stride: int
    T_wc: Float64
    labels: npt.NDArray[Any] | None
    ignore_id: int
    u: Int64
    v: Int64

    @classmethod
    def from_frame(cls, frame: Frame, points: int, labelled: bool = True) -> View:
        """Thin a frame. The sample is drawn at random by the frame's index: the same one each time."""
        H, W = frame.shape
        stride = max(1, math.ceil(math.sqrt(H * W / MAX_PIXELS)))
        pick = (slice(None, None, stride), slice(None, None, stride))
        depth = np.ascontiguousarray(frame.depth[pick])
        valid = np.flatnonzero((depth > 0) & (depth < np.inf))
        if len(valid) > points:
            valid = np.random.default_rng(frame.index).choice(valid, points, replace=False)
        v, u = np.unravel_index(valid, depth.shape)
        labels = np.ascontiguousarray(frame.predicted[pick]) if labelled else None
        return cls(frame.index, depth, frame.intrinsics, (W, H), stride, frame.T_wc, labels, frame.ignore_id, u, v)

    def pose(self, convention: Convention, configured: Convention) -> Float64:
        """Return (4, 4) camera-to-world, OpenCV axes, of the file as that convention reads it."""
        pose = self.T_wc.copy()
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AXES[configured.axes].T
        if convention.pose != configured.pose:
            pose = np.linalg.inv(pose).astype(np.float64)
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AXES[convention.axes]
        return pose

    def sampled_camera(self, convention: Convention) -> Intrinsics:
        """Return the intrinsics of every stride-th pixel."""
        width, height = self.size
        made_for = (width * convention.ratio[0], height * convention.ratio[1])
        return self.camera.resized(cast(Any, made_for), self.size).every(self.stride)

    def rays(self, convention: Convention, configured: Convention) -> tuple[int, Intrinsics]:
        """Return by which power of the rays' length depth of the file becomes planar, and the intrinsics of the rays.

        The file is read as that convention does; the factor of depth is left out.
        """
        if (convention.depth == "ray") == (configured.depth == "ray"):
            return 0, self.sampled_camera(configured)
        return (
            (1, self.sampled_camera(configured)) if configured.depth == "ray" else (-1, self.sampled_camera(convention))
        )


def clusters(length: int, count: int) -> list[list[int]]:
    """Return positions of neighbouring frames to compare: `count` clusters, evenly spaced over a sequence."""
    steps = [step for step in STEPS if step <= min(length - 1, max(1, 0.75 * (length - 1)))]
    room = length - 1 - steps[-1]
    starts = {int(room * (k + 0.5) / count) for k in range(count)}
    return [[start + step for step in steps] for start in sorted(starts)]


def pairs_within(groups: Sequence[Sequence[int]]) -> list[Pair]:
    """Return every ordered pair of two positions of one cluster, each once."""
    return sorted({(a, b) for group in groups for a in group for b in group if a != b})


def label_source(scene: Scene) -> str | None:
    """Return the model with which frames are read by default: the first model, else the ground truth, else None."""
    return scene.models[0] if scene.models else GROUND_TRUTH if scene.ground_truth else None


def reader(scene: Scene, model: str | None, *, color: bool = False) -> Callable[[int], Frame]:
    """Return a function that reads a frame: with a model's labels, or without a model, with all pixels class 0."""
    if model is None:
        return lambda index: scene.geometry(index, color=color)
    return lambda index: scene.frame(index, model, color=color)


def frames_at(
    positions: Iterable[int], indices: Sequence[int], read: Callable[[int], Frame], *, passing_over: bool = False
) -> Iterator[tuple[int, Frame]]:
    """Yield frames of a sequence with their positions in `indices`, ascending, read ahead by threads.

    Those that cannot be read raise what `read` does, or are passed over.
    """

    def attempt(index: int) -> Frame | None:
        try:
            return read(index)
        except DataError:
            if not passing_over:
                raise
            return None

    ordered = sorted(positions)
    for position, fetched in zip(ordered, prefetch(attempt, [indices[p] for p in ordered]), strict=True):
        if fetched.item is not None:
            yield position, fetched.item


class Placed(NamedTuple):
    """A view as a convention reads it, in whatever pairs it is.

    Attributes:
        pose: (4, 4) camera-to-world.
        back: (3, 3) the inverse of its rotation.
        points: (3, N) its sample in the camera's axes.
        image: What `find_matches` takes of it to look points of others up: its camera, (H, W) the stored depth, and how
            that becomes planar, see `View.rays`.
    """

    pose: Float64
    back: Float64
    points: Float64
    image: tuple[Pinhole, Float32, int, Pinhole]

    def seen_from(self, other: Placed) -> tuple[Any, ...]:
        """Return this sample, and how it turns and moves from this camera's axes to another view's, metres."""
        return self.points, other.back @ self.pose[:3, :3], other.back @ (self.pose[:3, 3] - other.pose[:3, 3])


@dataclass(frozen=True, eq=False)
class Sample:
    """The views of a check, which pairs of them are compared, and how their files are read."""

    views: dict[int, View]
    pairs: Sequence[Pair]
    configured: Convention
    _inverse: dict[int, Float32] = field(default_factory=dict, init=False, repr=False)
    _placed: dict[Convention, dict[int, Placed]] = field(default_factory=dict, init=False, repr=False)

    def with_views(self, views: dict[int, View]) -> Sample:
        """Return a sample of the same pairs, of which these are the views."""
        return Sample(views, self.pairs, self.configured)

    def by_pair(self, convention: Convention | None = None) -> Float64:
        """Return (pairs,) the median error under a convention, by default as configured; NaN with too few points."""
        convention = convention or self.configured
        errors = self.errors(convention, np.array([convention.factor]))
        return np.array([median_of_seen(e)[0] if np.isfinite(e).sum() >= PAIR_POINTS else np.nan for e in errors])

    def fit(self) -> Fit:
        """Return the fit of the configured convention."""
        return self.fits(self.configured, np.array([1.0]))[0]

    def fits(self, convention: Convention, factors: Float64) -> list[Fit]:
        """Return the fit under a convention with each of the factors (F,) on depth."""
        errors = self.errors(convention, factors)
        pooled = np.concatenate(errors, axis=1) if errors else np.empty((len(factors), 0))
        points = np.isfinite(pooled).sum(axis=1)
        medians = median_of_seen(pooled) if pooled.size else np.full(len(factors), np.nan)
        return [
            Fit(dataclasses.replace(convention, factor=f), median, n / max(1, pooled.shape[1]), n)
            for f, median, n in zip(factors.tolist(), medians.tolist(), points.tolist(), strict=True)
        ]

    def errors(self, convention: Convention, factors: Float64) -> list[Float64]:
        """Return for each pair the relative error (F, N) of the first view's sample in the second; inf if not seen."""
        placed = {position: self._placed_by(convention, position) for position in set(chain(*self.pairs))}
        most = max((view.points.shape[1] for view in placed.values()), default=0)
        unused = _room(len(factors), most)[:-1]
        errors = [np.empty((len(factors), placed[a].points.shape[1])) for a, _ in self.pairs]
        for (a, b), error in zip(self.pairs, errors, strict=True):
            find_matches(*placed[a].seen_from(placed[b]), factors, *placed[b].image, *unused, error)
        return errors

    def matched(self, pair: Pair, convention: Convention, factors: Float64) -> Matches:
        """Look the sample of the pair's first view up in the second one, for each factor on depth."""
        a, b = (self._placed_by(convention, position) for position in pair)
        matches = Matches(*_room(len(factors), a.points.shape[1]))
        find_matches(*a.seen_from(b), factors, *b.image, *matches.arrays)
        return matches

    def _placed_by(self, convention: Convention, position: int) -> Placed:
        """Return a view as a convention reads it; it is in several pairs."""
        of_convention = self._placed.setdefault(convention, {})
        if (cached := of_convention.get(position)) is not None:
            return cached
        view, pose = self.views[position], self.views[position].pose(convention, self.configured)
        K, (power, rays) = view.sampled_camera(convention), view.rays(convention, self.configured)
        stored = self._read_as(convention, position)
        depth = stored[view.v, view.u] * ray_lengths(rays, view.u, view.v) ** power
        points = np.stack([(view.u - K.cx) / K.fx * depth, (view.v - K.cy) / K.fy * depth, depth])
        back = np.linalg.inv(pose[:3, :3]).astype(np.float64)
        placed = of_convention[position] = Placed(pose, back, points, (pinhole(K), fixed(stored), power, pinhole(rays)))
        return placed

    def _read_as(self, convention: Convention, position: int) -> Float32:
        """Return depth (H, W) as a convention reads it, but for rays and the factor; an inverse is kept."""
        if (convention.depth == INVERSE) == (self.configured.depth == INVERSE):
            return self.views[position].depth
        if position not in self._inverse:
            depth = self.views[position].depth
            with np.errstate(divide="ignore", over="ignore"):
                self._inverse[position] = np.where(depth > 0, 1 / depth, np.float32(0)).astype(np.float32)
        return self._inverse[position]

    def motions(self, convention: Convention) -> list[tuple[Float64, Float64]]:
        """Return for each pair the rotation and translation from the first camera to the second."""
        poses = {position: view.pose(convention, self.configured) for position, view in self.views.items()}
        return [motion(poses[a], poses[b]) for a, b in self.pairs]


@dataclass(frozen=True, eq=False)
class Matches:
    """The positions of a sample of N points in another view, for F factors on depth; all (F, N).

    Attributes:
        u, v: The nearest pixel there.
        z: Distance from there along the optical axis, over the factor.
        depth: Planar depth of that pixel, over the factor.
        inside: Whether the point lies in that image, before the camera.
        error: |depth / z - 1|, inf where the point is not seen: not inside, or no depth there.
    """

    u: Int64
    v: Int64
    z: Float64
    depth: Float64
    inside: Mask
    error: Float64

    @property
    def arrays(self) -> tuple[Any, ...]:
        """The arrays in the order of `find_matches`."""
        return self.u, self.v, self.z, self.depth, self.inside, self.error


def _room(factors: int, points: int) -> tuple[Any, ...]:
    """Return room for the arrays of `Matches`, each (F, N)."""
    dtypes = np.int64, np.int64, np.float64, np.float64, np.bool_, np.float64
    return tuple(np.empty((factors, points), dtype) for dtype in dtypes)


@dataclass(frozen=True, eq=False)
class Shared:
    """Pixels of two views that see the same points: rows and columns (n,) in each, and which of the sample they are."""

    first: tuple[Int64, Int64]
    second: tuple[Int64, Int64]
    chosen: Mask

    @classmethod
    def from_matches(cls, view: View, matches: Matches) -> Shared:
        """Return the pixels of a view's sample that lie on one surface with the pixels that they meet."""
        consistent = matches.error[0] <= CONSISTENT
        return cls(
            (view.v[consistent], view.u[consistent]), (matches.v[0][consistent], matches.u[0][consistent]), consistent
        )

    def labels(self, first: Ids | None, second: Ids | None, *ignored: int) -> Ids:
        """Return (2, n) the labels of the points in two maps, those that have one in both; none without maps."""
        if first is None or second is None:
            return np.empty((2, 0), dtype=np.int64)
        label_pairs = np.stack([first[self.first], second[self.second]]).astype(np.int64)
        return label_pairs[:, (label_pairs[0] != ignored[0]) & (label_pairs[1] != ignored[-1])]


def motion(pose: Float64, other: Float64) -> tuple[Float64, Float64]:
    """Return (3, 3), (3,) from a camera's axes to the other's; exact for large coordinates, which cancel first."""
    back = np.linalg.inv(other[:3, :3])
    return back @ pose[:3, :3], back @ (pose[:3, 3] - other[:3, 3])


def median_of_seen(errors: npt.NDArray[Any]) -> Float64:
    """Return the median of finite values along the last axis (the lower one of two), or NaN without finite values."""
    finite, median = np.isfinite(errors), np.full(errors.shape[:-1], np.nan)
    for row in np.ndindex(median.shape):
        valid_errors = errors[row][finite[row]]
        if (middle := (len(valid_errors) - 1) // 2) >= 0:
            valid_errors.partition(middle)
            median[row] = valid_errors[middle]
    return median
