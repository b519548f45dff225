"""The check of a scene of scans: whether they lie on each other by their poses, and how else they would.

A point of one scan is carried by the poses into the axes of another; its distance from the surface there, divided by
the point's range, is its error. Each other reading of the poses is assessed in the same way.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from semstab.backends import create
from semstab.backends.shared.association import in_world
from semstab.check.conventions import Convention
from semstab.check.coverage import (
    BINS,
    CONSISTENT,
    FRAMES_LEFT,
    SHARED,
    Noise,
    Overlap,
    Persistence,
    Suggestion,
    distribution,
    suggested_size,
)
from semstab.check.geometry import Fit, Verdict
from semstab.check.quaternions import first_number_last, last_number_first
from semstab.check.reprojection import Pair, clusters, frames_at, motion, pairs_within, reader
from semstab.check.surfaces import LEAST_RANGE, Surfaces
from semstab.core.arrays import evenly
from semstab.core.types import Float32, Float64, Int64, Mask
from semstab.data.frames import Frame
from semstab.datasets import Scene
from semstab.errors import DataError

QUERIES = 2000
"""Points of a scan that are sought in another one, ..."""

JUDGED = 4
"""... every so many of them beside surfaces, under each reading of the poses."""

EXACT = 1e-5
"""The least error: a smaller one is that of the arithmetic."""

TO_CAMERA = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From the axes of a LiDAR (x forward, y left, z up) to those of a camera beside it (x right, y down, z forward)."""

BETTER = 0.67
"""Another reading of the poses is right where its error is at most this part of the configured one, ..."""

WON = 0.8
"""... and lower in this share of the pairs of scans."""

ALIKE = 1.1
"""Readings whose errors differ by no more cannot be told apart."""

APART = 4.0
"""They lie so many times as far from each other as the points of one scan do, at least: sparse scans err more."""

FAR = 20_000.0
"""Metres beyond which no scanner sees half of its points."""

HOPELESS = 0.05
"""The error from which on scans do not lie on each other, though no reading explains it."""


@dataclass(frozen=True)
class PoseReading:
    """A way to read the poses of scans.

    Attributes:
        name: Its name, in words.
        of: From a pose (4, 4) as it is read now to the pose as it would be.
        mends: The options that mend it, by the option's name and value now; '' for those of any reader.
        otherwise: What to do where the reader has no such option.
        applies: Whether it may be the right one for scans at these poses, by the middles (n, 3) of their points and the
            positions (n, 3) of their sensors; any poses that are wrong look better where nothing moves.
    """

    name: str
    of: Callable[[Float64], Float64]
    mends: Mapping[tuple[str, str], str]
    otherwise: str
    applies: Callable[[Float64, Float64], bool] = lambda middle, sensor: True


def _nearer_to_their_sensors(middle: Float64, sensor: Float64) -> bool:
    """Return whether points lie around the positions of their sensors, and not around the origin."""
    from_sensor, from_origin = (np.linalg.norm(middle - at, axis=1) for at in (sensor, np.zeros(3)))
    return bool(np.median(from_sensor) < np.median(from_origin))


def _inverse(T: Float64) -> Float64:
    return np.asarray(np.linalg.inv(T), dtype=np.float64)


def _camera_to_lidar(T: Float64) -> Float64:
    pose: Float64 = np.linalg.inv(TO_CAMERA) @ T @ TO_CAMERA
    return pose


def _lidar_to_camera(T: Float64) -> Float64:
    return TO_CAMERA @ T @ np.linalg.inv(TO_CAMERA)


def _scaled(factor: float) -> Callable[[Float64], Float64]:
    def of(T: Float64) -> Float64:
        scaled = T.copy()
        scaled[:3, 3] *= factor
        return scaled

    return of


def _turned(factor: float) -> Callable[[Float64], Float64]:
    """Return how poses would be whose angles are so many times those that were read."""

    def of(T: Float64) -> Float64:
        from scipy.spatial.transform import Rotation

        turned = T.copy()
        turned[:3, :3] = Rotation.from_rotvec(factor * Rotation.from_matrix(T[:3, :3]).as_rotvec()).as_matrix()
        return turned

    return of


READINGS = (
    PoseReading(
        "inverse poses",
        _inverse,
        {
            ("pose_convention", "camera_to_world"): "pose_convention: world_to_camera",
            ("pose_convention", "world_to_camera"): "pose_convention: camera_to_world",
        },
        "invert the poses: they map the world to the sensor",
    ),
    PoseReading(
        "poses of a camera, not of the LiDAR",
        _camera_to_lidar,
        {("pose_frame", "lidar"): "pose_frame: camera"},
        "the calibration from the LiDAR to the camera is forgotten: apply it",
    ),
    PoseReading(
        "poses of the LiDAR, to which a camera's calibration was applied",
        _lidar_to_camera,
        {("pose_frame", "camera"): "pose_frame: lidar"},
        "leave the calibration away",
    ),
    PoseReading(
        "points that are in the world already",
        lambda T: np.eye(len(T)),
        {("coordinates", "sensor"): "coordinates: world"},
        "carry the points into the axes of the sensor",
        _nearer_to_their_sensors,
    ),
    PoseReading(
        "points that are in the sensor's axes already",
        lambda T: T @ T,
        {("coordinates", "world"): "coordinates: sensor"},
        "carry the points into the axes of the sensor once",
    ),
    PoseReading("quaternions w x y z", first_number_last, {}, "write quaternions as x y z w"),
    PoseReading("quaternions x y z w", last_number_first, {}, "write quaternions as w x y z"),
    PoseReading("poses in millimetres", _scaled(0.001), {}, "divide the positions of the poses by 1000"),
    PoseReading("poses in kilometres", _scaled(1000.0), {}, "multiply the positions of the poses by 1000"),
    PoseReading("angles in degrees, read as radians", _turned(math.pi / 180), {}, "convert the angles to radians"),
    PoseReading("angles in radians, read as degrees", _turned(180 / math.pi), {}, "convert the angles to degrees"),
)
"""Other readings of poses than the configured one."""


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
        clouds = {position: _Cloud(self.scans[position]) for position in compared & self.scans.keys()}
        self._clouds = {position: cloud for position, cloud in clouds.items() if len(cloud.rows)}
        self.pairs = [pair for pair in pairs_within(groups) if pair[0] < pair[1] and {*pair} <= self._clouds.keys()]

    @cached_property
    def met(self) -> dict[Pair, Met]:
        """Points of each pair's first scan in its second one."""
        return {pair: self._met(pair) for pair in self.pairs}

    def _met(self, pair: Pair) -> Met:
        R, t = motion(*(self.scans[position].T_wc for position in pair))
        points = self._clouds[pair[0]].sought
        distance, nearest = self._clouds[pair[1]].tree.query(points @ R.T + t)
        return Met(distance, np.linalg.norm(points, axis=1), nearest)

    def surfaces(self, pair: Pair, of: Callable[[Float64], Float64] = lambda T: T, every: int = 1) -> Surfaces:
        """Seek points of the pair's first scan beside surfaces of its second one, under a reading of the poses."""
        here, there = (self._clouds[position] for position in pair)
        R, t = motion(*(of(self.scans[position].T_wc) for position in pair))
        return Surfaces.of(here.sought[::every], there.points, there.tree, R, t)

    @property
    def ranges(self) -> list[Float32]:
        """Return for each scan the ranges (n,) of its points that have one, metres."""
        return [scan.depth[(scan.depth > 0) & (scan.depth < np.inf)] for scan in self.scans.values()]

    @property
    def places(self) -> tuple[Float64, Float64]:
        """Return the middles (n, 3) of the points of scans that are compared, and the positions (n, 3) of the poses."""
        middle = [np.median(cloud.points, axis=0) for cloud in self._clouds.values()]
        return np.array(middle), np.array([self.scans[position].T_wc[:3, 3] for position in self._clouds])

    @property
    def between(self) -> float:
        """Median distance of a point from the nearest of another scan, metres."""
        return float(np.median(np.concatenate([met.distance for met in self.met.values()])))

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point from the nearest of its own scan, metres."""
        clouds = [self._clouds[position] for position in {pair[0] for pair in self.pairs}]
        own = [cloud.tree.query(cloud.sought, k=2)[0][:, 1] for cloud in clouds]
        return float(np.median(np.concatenate(own))) if own else math.nan

    def agree(self, pair: Pair) -> Mask:
        """Return whether labels agree, of the points met that have one in both scans."""
        a, b = self.scans[pair[0]], self.scans[pair[1]]
        here, there, met = self._clouds[pair[0]], self._clouds[pair[1]], self.met[pair]
        first = a.predicted.reshape(-1)[here.rows][here.chosen]
        second = b.predicted.reshape(-1)[there.rows][met.nearest]
        known = (met.error <= CONSISTENT) & (first != a.ignore_id) & (second != b.ignore_id)
        agree: Mask = (first == second)[known]
        return agree

    def faces(self, voxel_size: float) -> None:
        """Return that faces of voxels are not looked for: rings of a scan do not lie in them."""

    def stays(self, voxel_size: float) -> float:
        """Return the share of the points met that lie in the same voxel as the nearest of the other scan."""
        first, second = self._in_world
        same = np.all(np.floor(first / voxel_size) == np.floor(second / voxel_size), axis=1)
        return float(same.mean()) if len(same) else math.nan

    @cached_property
    def _in_world(self) -> tuple[Float64, Float64]:
        """Return (n, 3) the points met of all pairs, and the nearest ones of the other scans, in the world."""
        first, second = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for pair, met in self.met.items():
            (here, T), (there, T_other) = ((self._clouds[p], self.scans[p].T_wc) for p in pair)
            near = met.error <= CONSISTENT
            first.append(in_world(here.sought[near].T, T).T)
            second.append(in_world(there.points[met.nearest[near]].T, T_other).T)
        return np.concatenate(first), np.concatenate(second)


class _Cloud:
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


def assess_scans(sample: ScanSample) -> Verdict:
    """Return whether scans lie on each other, and the reading of the poses under which they would."""
    pairs, ranges = sample.pairs, sample.ranges
    if not pairs:
        return Verdict("unclear", "it takes two scans with points to tell whether poses are right")
    if (away := float(np.median(np.concatenate(ranges)))) > FAR:
        other = {"sensor": "world", "world": "sensor"}.get(sample.scene.settings.get("coordinates", ""))
        mend = None if other is None else f"coordinates: {other}"
        advice = "carry them into its axes" if mend is None else f"set {mend} (--option coordinates={other})"
        text = f"points lie {away / 1000:,.0f} km from their sensor, as in the axes of the world; {advice}"
        return Verdict("unsound", text, () if mend is None else (mend,))
    others = [each for each in READINGS if each.applies(*sample.places)]
    readings = {"as configured": lambda T: T, **{each.name: each.of for each in others}}
    errors = {name: [sample.surfaces(pair, of, JUDGED).error for pair in pairs] for name, of in readings.items()}
    fits = {name: _fit(own) for name, own in errors.items()}
    configured, now = fits["as configured"], np.array([_typical(own) for own in errors["as configured"]])
    wins = {name: float(np.mean([_typical(own) for own in errors[name]] < now)) for name in errors}
    best = min(others, key=lambda each: fits[each.name].error)
    better = fits[best.name].error <= BETTER * configured.error and wins[best.name] >= WON
    shown = sorted(fits.items(), key=lambda item: (item[0] != "as configured", item[1].error))[:5]
    about: dict[str, Any] = {
        "error": configured.error, "share": configured.share, "frames": len({p for pair in pairs for p in pair}),
        "pairs": len(pairs), "fits": tuple(shown),
    }  # fmt: skip
    if better:
        settings = sample.scene.settings
        mend = next((text for (key, now_), text in best.mends.items() if settings.get(key) == now_), None)
        advice = f"set {mend} (--option {mend.replace(': ', '=')})" if mend else best.otherwise
        text = (
            f"scans do not lie on each other: points are typically {configured.error:.1%} of their range from the"
            f" surfaces of another scan, and {fits[best.name].error:.2%} with {best.name}; {advice}"
        )
        return Verdict("unsound", text, () if mend is None else (mend,), **about)
    nearest = float(np.median(np.concatenate([met.error for met in sample.met.values()])))
    if nearest > HOPELESS and sample.between > APART * sample.spacing:
        text = (
            f"scans do not lie on each other: the nearest point of another scan is {nearest:.1%} of the range away, and"
            " no reading of the poses explains it; check the order of poses and scans"
        )
        return Verdict("unsound", text, **about)
    open_ = tuple(each.name for each in others if fits[each.name].error <= ALIKE * configured.error)
    text = (
        f"scans lie on each other: points are typically {configured.error:.2%} of their range from the surfaces of"
        " another scan"
    )
    reason = "the sensor hardly moves or turns" if open_ else ""
    return Verdict("sound", text, undetermined=open_, reason=reason, **about)


def _fit(errors: Sequence[Float64]) -> Fit:
    every = np.concatenate(errors)
    told = every[np.isfinite(every)]
    share = float(np.mean(told <= CONSISTENT)) if len(told) else 0.0
    return Fit(Convention(), _typical(every), share, len(told))


def _typical(errors: Float64) -> float:
    """Return the geometric mean of errors (n,): some points lie on no surface of the other scan; inf where none is."""
    told = errors[np.isfinite(errors)]
    return float(np.exp(np.log(np.maximum(told, EXACT)).mean())) if len(told) else math.inf


# What a check reports beside the verdict.


@dataclass(frozen=True, eq=False)
class ScanCoverage:
    """What scans share, how far their points lie apart, and the voxels that this carries."""

    sample: ScanSample

    def overlaps(self) -> list[Overlap]:
        """Return one row a distance between scans."""
        rows = []
        for low, high in BINS:
            pairs = [pair for pair in self.sample.pairs if low <= pair[1] - pair[0] <= high]
            if pairs:
                error = np.concatenate([self.sample.met[pair].error for pair in pairs])
                agree = np.concatenate([self.sample.agree(pair) for pair in pairs])
                share = float(np.mean(error <= CONSISTENT))
                agreement = float(agree.mean()) if len(agree) else math.nan
                rows.append(Overlap((low, high), len(pairs), share, share, float(np.median(error)), agreement))
        return rows

    def noise(self) -> Noise:
        """Return the distance of points from the nearest of another scan and of their own, and between rays."""
        ranges = np.concatenate([met.range for met in self.sample.met.values()])
        angle = float(np.median([scan.ray_angle for scan in self.sample.scans.values()]))
        return Noise(self.sample.between, self.sample.spacing, angle * float(np.median(ranges)))

    def suggestion(self, overlaps: Sequence[Overlap], scans: int, stride: int) -> Suggestion:
        """Return voxel size and stride that suit so many scans, whose own stride is `stride`."""
        size = suggested_size(self.sample)
        stays = math.nan if size is None else self.sample.stays(size)
        shared = {row.apart[0]: row.covisible for row in overlaps}
        times = max((n for n in shared if shared[n] >= SHARED and scans >= FRAMES_LEFT * n), default=1)
        share = shared.get(times, math.nan)
        return Suggestion(
            voxel_size=size,
            voxel_size_reason=f"{stays:.0%} of the points have the nearest one of another scan in the same voxel",
            pixel_stride=1,
            pixel_stride_reason="all points",
            frame_stride=stride * times,
            frame_stride_reason=f"{share:.0%} of a scan's points lie on the surfaces of the next one",
        )

    def persistence(self, voxel_size: float) -> Persistence | None:
        """Fuse the scans that were read for it, and count how often each voxel is seen.

        None where points lie so far out that voxels of that size cannot be counted.
        """
        backend = create("numba", voxel_size=voxel_size, num_classes=2)
        for position in self.sample.fused:
            scan = self.sample.scans[position]
            try:
                backend.integrate(dataclasses.replace(scan, labels=np.zeros(scan.shape, np.uint8), scores=None))
            except DataError:
                return None
        return distribution(backend.table().op, voxel_size, self.sample.stays(voxel_size))
