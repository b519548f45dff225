"""Scans of a scene whose points are sought in each other, under the poses as they are or as they may be."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from semstab.backends.shared.association import in_world
from semstab.check.conventions import Convention
from semstab.check.coverage import DepthNoise, Overlap, by_distance
from semstab.check.reprojection import CONSISTENT, Pair, clusters, frames_at, motion, pairs_within, reader
from semstab.check.surfaces import LEAST_RANGE, Surfaces
from semstab.check.verdict import Fit
from semstab.core.arrays import evenly
from semstab.core.types import Float32, Float64, Int64, Mask
from semstab.data.frames import Frame
from semstab.datasets import Scene
from semstab.errors import DataError

QUERIES = 2000
"""Points of a scan that are sought in another one, ..."""

JUDGED = 4
"""... every so many of them beside surfaces, under each reading of the poses."""

LEVELLED, LEVEL, BESIDE = 4, 0.95, 0.1
"""Scans in which level surfaces are looked for; the least cosine of their slope; metres above or below the sensor."""

MOSTLY, GROUND, OTHER_SIDE = 0.9, 0.1, 0.05
"""Least share of points within 45 degrees of the horizon, least share of flat places that are level and above, and most
level ones below for each of these."""

EXACT = 1e-5
"""The least error: a smaller one is that of the arithmetic."""


@dataclass(frozen=True, eq=False)
class Met:
    """The points of a scan that were sought in another one.

    Attributes:
        distance: (n,) metres to the nearest point there.
        range: (n,) of each point from its own sensor.
        nearest: (n,) its row there.
    """

    distance: Float64
    range: Float64
    nearest: Int64

    @property
    def error(self) -> Float64:
        """(n,) the distance as a share of the range."""
        return self.distance / np.maximum(self.range, LEAST_RANGE)


class ScanSample:
    """Scans of a scene at some positions of the sequence, and points of each sought in the others.

    Args:
        scene: The scene.
        indices: The selected scans.
        source: Label source to read them with; None needs no labels.
        groups: Positions in `indices` of scans that are compared with each other.
        fused: Number of scans, evenly spaced, that are read for fusion too.
        passing_over: Leave out scans that cannot be read, instead of raising what reading them raises.
    """

    reasons = (
        "another scan puts {:.0%} of the points into the same voxel",
        "{:.0%} of a scan's points lie on the surfaces of the next one",
    )

    def __init__(
        self,
        scene: Scene,
        indices: Sequence[int],
        source: str | None,
        groups: Sequence[Sequence[int]],
        *,
        fused: int = 0,
        passing_over: bool = False,
    ) -> None:
        self.scene, self.fused = scene, evenly(len(indices), fused)
        compared = {position for group in groups for position in group}
        positions = compared | set(self.fused)
        read = frames_at(positions, indices, reader(scene, source), passing_over=passing_over)
        self.scans: dict[int, Frame] = dict(read)
        self.poses: dict[int, Float64] = {position: scan.T_wc for position, scan in self.scans.items()}
        clouds = {position: ScanPoints(self.scans[position]) for position in compared & self.scans.keys()}
        self._clouds = {position: cloud for position, cloud in clouds.items() if len(cloud.rows)}
        self.pairs = [pair for pair in pairs_within(groups) if pair[0] < pair[1] and {*pair} <= self._clouds.keys()]

    def _motion(self, pair: Pair) -> tuple[Float64, Float64]:
        return motion(*(self.poses[position] for position in pair))

    @cached_property
    def met(self) -> dict[Pair, Met]:
        """Points of each pair's first scan in its second one."""
        return {pair: self._met(pair) for pair in self.pairs}

    def _met(self, pair: Pair) -> Met:
        R, t = self._motion(pair)
        points = self._clouds[pair[0]].sought
        distance, nearest = self._clouds[pair[1]].tree.query(points @ R.T + t)
        return Met(distance, np.linalg.norm(points, axis=1), nearest)

    def posed(self, change: Callable[[Float64], Float64]) -> ScanSample:
        """Return the same scans with each pose (4, 4) changed."""
        return self._with({position: change(T) for position, T in self.poses.items()})

    def delayed(self, by: int) -> ScanSample:
        """Return the same scans with the poses of the scans `by` later in the sequence; at its ends with their own."""
        scene = self.scene

        def pose(position: int) -> Float64:
            index = self.scans[position].index
            with contextlib.suppress(DataError):
                return scene.T_wc(min(max(index + by, 0), len(scene) - 1))
            return self.poses[position]

        return self._with({position: pose(position) for position in self.poses})

    def _with(self, poses: dict[int, Float64]) -> ScanSample:
        other = copy.copy(self)
        vars(other).update(poses=poses)
        for cached in {"met", "_errors", "_in_world"} & vars(other).keys():
            delattr(other, cached)
        return other

    def surfaces(self, pair: Pair, every: int = 1) -> Surfaces:
        """Compare points of the pair's first scan with surfaces of its second scan."""
        cloud_a, cloud_b = (self._clouds[position] for position in pair)
        return Surfaces.nearest_to(cloud_a.sought[::every], cloud_b.points, cloud_b.tree, *self._motion(pair))

    @cached_property
    def _errors(self) -> list[Float64]:
        """For each pair the distance (n,) of points from the surfaces there, as a share of their range."""
        return [self.surfaces(pair, JUDGED).error for pair in self.pairs]

    def by_pair(self) -> Float64:
        """Return (pairs,) the typical error of each pair, or NaN without points of known error."""
        return np.array([_typical(errors) for errors in self._errors])

    def fit(self) -> Fit:
        """Return the typical error of all points that are told, and the share of them on one surface."""
        all_errors = np.concatenate(self._errors)
        finite = all_errors[np.isfinite(all_errors)]
        share = float(np.mean(finite <= CONSISTENT)) if len(finite) else 0.0
        return Fit(Convention(), _typical(all_errors), share, len(finite))

    @property
    def ranges(self) -> list[Float32]:
        """Return for each scan the ranges (n,) of its points that have one, metres."""
        return [scan.depth[(scan.depth > 0) & (scan.depth < np.inf)] for scan in self.scans.values()]

    @property
    def places(self) -> tuple[Float64, Float64]:
        """Return the middles (n, 3) of the points of scans that are compared, and the positions (n, 3) of the poses."""
        middle = [np.median(cloud.points, axis=0) for cloud in self._clouds.values()]
        return np.array(middle), np.array([self.poses[position][:3, 3] for position in self._clouds])

    @property
    def knows_poses(self) -> bool:
        """Return whether poses of other scans are known without reading these."""
        return type(self.scene).T_wc is not Scene.T_wc

    @cached_property
    def is_upside_down(self) -> bool:
        """Return whether level surfaces, such as the ground, lie above the sensors and not below.

        It takes scans to all sides, whose rays rise and fall by less than 45 degrees.
        """
        above = below = flat = flatter = points = 0
        for cloud in [*self._clouds.values()][:LEVELLED]:
            around = Surfaces.nearest_to(cloud.sought[::JUDGED], cloud.points, cloud.tree, np.eye(3), np.zeros(3))
            level = around.flat & (np.abs(around.normal[:, 2]) > LEVEL)
            above += int(np.count_nonzero(level & (around.middle[:, 2] > BESIDE)))
            below += int(np.count_nonzero(level & (around.middle[:, 2] < -BESIDE)))
            flat += int(np.count_nonzero(around.flat))
            flatter += int(np.count_nonzero(np.abs(cloud.sought[:, 2]) < np.hypot(*cloud.sought[:, :2].T)))
            points += len(cloud.sought)
        return flatter > MOSTLY * points and above > GROUND * flat and below < OTHER_SIDE * above

    @property
    def between(self) -> float:
        """Median distance of a point from the nearest of another scan, metres."""
        return float(np.median(np.concatenate([met.distance for met in self.met.values()])))

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point from the nearest of its own scan, metres."""
        clouds = [self._clouds[position] for position in {pair[0] for pair in self.pairs}]
        distances = [cloud.tree.query(cloud.sought, k=2)[0][:, 1] for cloud in clouds]
        return float(np.median(np.concatenate(distances))) if distances else math.nan

    def overlaps(self) -> list[Overlap]:
        """Return one row a distance between scans."""
        return [self._overlap(distances, pairs) for distances, pairs in by_distance(self.pairs)]

    def _overlap(self, distances: tuple[int, int], pairs: Sequence[Pair]) -> Overlap:
        error = np.concatenate([self.met[pair].error for pair in pairs])
        agree = np.concatenate([self.agree(pair) for pair in pairs])
        share, agreement = float(np.mean(error <= CONSISTENT)), float(agree.mean()) if len(agree) else math.nan
        return Overlap(distances, len(pairs), share, share, float(np.median(error)), agreement)

    def noise(self) -> DepthNoise:
        """Return the distance of points from the nearest of another scan and of their own, and between rays."""
        ranges = np.concatenate([met.range for met in self.met.values()])
        angle = float(np.median([scan.ray_angle for scan in self.scans.values()]))
        return DepthNoise(self.between, self.spacing, angle * float(np.median(ranges)))

    def pixel_stride(self, voxel_size: float | None) -> tuple[int | None, str]:
        """Return that all points are fused."""
        return 1, "all points"

    def agree(self, pair: Pair) -> Mask:
        """Return whether labels agree, of the points met that have one in both scans."""
        a, b = self.scans[pair[0]], self.scans[pair[1]]
        cloud_a, cloud_b, met = self._clouds[pair[0]], self._clouds[pair[1]], self.met[pair]
        first = a.predicted.reshape(-1)[cloud_a.rows][cloud_a.chosen]
        second = b.predicted.reshape(-1)[cloud_b.rows][met.nearest]
        labelled = (met.error <= CONSISTENT) & (first != a.ignore_id) & (second != b.ignore_id)
        agree: Mask = (first == second)[labelled]
        return agree

    def faces(self, voxel_size: float) -> None:
        """Return that faces of voxels are not looked for: rings of a scan do not lie in them."""

    def stays(self, voxel_size: float) -> float:
        """Return the share of the points met that lie in the same voxel as the nearest of the other scan."""
        first, second = self._in_world
        in_one_voxel = np.all(np.floor(first / voxel_size) == np.floor(second / voxel_size), axis=1)
        return float(in_one_voxel.mean()) if len(in_one_voxel) else math.nan

    @cached_property
    def _in_world(self) -> tuple[Float64, Float64]:
        """Return (n, 3) the points met of all pairs, and the nearest ones of the other scans, in the world."""
        first, second = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for pair, met in self.met.items():
            (cloud_a, T), (cloud_b, T_other) = ((self._clouds[p], self.poses[p]) for p in pair)
            near = met.error <= CONSISTENT
            first.append(in_world(cloud_a.sought[near].T, T).T)
            second.append(in_world(cloud_b.points[met.nearest[near]].T, T_other).T)
        return np.concatenate(first), np.concatenate(second)


class ScanPoints:
    """The points of a scan that have a range, and those of them that are sought in others.

    Attributes:
        rows: (n,) rows of these points among all.
        points: (n, 3) in the sensor's axes.
        chosen: (m,) those that are sought, of the n.
    """

    def __init__(self, scan: Frame) -> None:
        assert scan.points is not None
        self.rows = np.flatnonzero((scan.depth > 0) & (scan.depth < np.inf))
        self.points: Float64 = scan.points.reshape(-1, 3)[self.rows].astype(np.float64)
        self.chosen = np.array(evenly(len(self.rows), QUERIES), dtype=np.int64)

    @property
    def sought(self) -> Float64:
        """(m, 3) the points that are sought."""
        return self.points[self.chosen]

    @cached_property
    def tree(self) -> Any:
        """Return a search tree of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


def quick_sample_of_scans(scene: Scene, indices: Sequence[int]) -> ScanSample:
    """Return a few scans of a scene, those that can be read."""
    return ScanSample(scene, indices, None, clusters(len(indices), 1), passing_over=True)


def _typical(errors: Float64) -> float:
    """Return the geometric mean of finite errors (n,), or NaN; points without a surface in the other scan are NaN."""
    finite = errors[np.isfinite(errors)]
    return float(np.exp(np.log(np.maximum(finite, EXACT)).mean())) if len(finite) else math.nan
