"""Poses of a bag's camera or LiDAR: from /tf and /tf_static, from a topic of poses, or from a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semstab.datasets.bag.options import PoseOptions
from semstab.datasets.bag.reading import NANOSECONDS, OpenBag, stamp_of
from semstab.datasets.formats.disk import read_table
from semstab.datasets.geometry.cameras import Poses, from_quaternions
from semstab.datasets.geometry.transforms import Trajectory, Transforms, bare
from semstab.errors import DataError

TF = "tf"
TF_TYPE = ("tf2_msgs/TFMessage", "tf/tfMessage")

POSES: Mapping[str, Callable[[Any], tuple[str, Any]]] = {
    "nav_msgs/Odometry": lambda message: (message.child_frame_id, message.pose.pose),
    "geometry_msgs/TransformStamped": lambda message: (message.child_frame_id, message.transform),
    "geometry_msgs/PoseStamped": lambda message: ("", message.pose),
    "geometry_msgs/PoseWithCovarianceStamped": lambda message: ("", message.pose.pose),
}
"""The frame that a message's pose is of ('': it does not say) and the pose, by type; the first ones are preferred."""

WORLDS = ("map", "world", "odom")
"""Words in the names of frames of a world; the first words are preferred."""


_OF_SENSOR = {
    "camera": re.compile("optical"),
    "sensor": re.compile("lidar|laser|velodyne|ouster|os_|livox|hesai|rslidar"),
}
"""Patterns of names of a sensor's own frames; other frames belong to its mount, and have other axes."""

SAME = 1000
"""Nanoseconds by which a stamp in a file of poses may differ from the stamp of its image."""


def numbers_of(pose: Any) -> tuple[float, ...]:
    """Return x y z qx qy qz qw of a Pose or a Transform."""
    position = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w


class SensorPoses:
    """Poses of a sensor from a bag: add the messages of `topics`, then ask.

    Args:
        bag: The bag.
        options: Which poses are meant.
        sensor: What it is called in messages; SENSOR_frame is the option of its frame.
        seen: What its messages are: images, clouds.

    Attributes:
        topics: The topics that are needed.

    Raises:
        DataError: If an option names what is not there.
    """

    def __init__(self, bag: OpenBag, options: PoseOptions, sensor: str = "camera", seen_by: str = "images") -> None:
        self._path = bag.path
        self._sensor, self._seen = sensor, seen_by
        self._options = options
        self._transforms = Transforms()
        self._tf = bag.of_types(*TF_TYPE)
        pose_topic = None if options.pose == TF else options.pose
        topics = [name for kind in POSES for name in sorted(bag.of_types(kind), key=lambda k: -bag.topics[k].count)]
        finds_topic = options.trajectory is None and options.pose != TF
        self._topic = pose_topic or (topics[0] if topics and finds_topic else None)
        self._read = None if self._topic is None else POSES[bag.topics[self._topic].type]
        self._own, self._of = Trajectory(), ""
        self._frame = ""
        self.topics = [*self._tf, *([] if self._topic is None else [self._topic])]

    def add(self, topic: str, time: int, message: Any) -> None:
        """Add a message of one of the topics, with its bag time."""
        if topic == self._topic and self._read is not None:
            self._of, pose = self._read(message)
            self._frame = message.header.frame_id
            self._own.add(self._stamp(message, time), numbers_of(pose))
            return
        fixed = topic.rstrip("/").endswith("tf_static")
        for transform in message.transforms:
            stamp = self._stamp(transform, time)
            self._transforms.add(
                transform.header.frame_id, transform.child_frame_id, stamp, numbers_of(transform.transform), fixed=fixed
            )

    def _stamp(self, message: Any, time: int) -> int:
        return time if self._options.stamps == "bag" else stamp_of(message)

    def around(self, stamps: Sequence[int], sensor: str, what: str) -> tuple[Poses, str]:
        """Return what `at` does, for stamps by the sensor's clock, and a line that says how many of `what` have a pose.

        Raises:
            DataError: What `at` raises, or if none has one.
        """
        offset, limit = round(self._options.time_offset * NANOSECONDS), self._options.max_pose_gap
        poses, where = self.poses_at([stamp + offset for stamp in stamps], sensor)
        num_posed = int(np.count_nonzero(np.isfinite(poses).all(axis=(1, 2))))
        if not num_posed:
            raise DataError(
                f"{self._path}: no {what} lies between two poses of {where} that are at most {limit:g} s apart; set"
                " max_pose_gap, or stamps: bag"
            )
        return poses, f"poses    {where}; around {num_posed} of {len(poses)} {what}s, at most {limit:g} s apart"

    def poses_at(self, stamps: Sequence[int], sensor: str) -> tuple[Poses, str]:
        """Return poses (n, 4, 4) of the sensor at stamps, NaN if unknown, and the source of the poses.

        `sensor` is the frame of its messages.

        Raises:
            DataError: If the bag has no poses of the sensor.
        """
        options = self._options
        sensor = bare(sensor)
        if options.trajectory is not None:
            numbers = read_table(options.trajectory, 8, "timestamp tx ty tz qx qy qz qw")
            series = Trajectory()
            for time, *pose in numbers.tolist():
                series.add(round(time * NANOSECONDS), pose)
            poses = series.poses_at(_snapped(stamps, series.stamps), options.max_pose_gap, options.trajectory)
            return self._from_body(poses, options.pose_frame or "", sensor, stamps, str(options.trajectory))
        chain, why = self._chain(sensor)
        if chain and (options.pose == TF or (options.pose is None)):
            poses = self._transforms.poses_at(chain, stamps, options.max_pose_gap, self._path)
            poses = poses @ self._extrinsics()
            by = f" by {', '.join(reversed(chain[1:-1]))}" if chain[1:-1] else ""
            return poses, f"{' and '.join(self._tf)}: {chain[0]} in {chain[-1]}{by}"
        if self._topic is None:
            raise DataError(f"{self._path}: no pose of the {self._sensor}: {why}")
        poses = self._own.poses_at(stamps, options.max_pose_gap, Path(f"{self._path}, {self._topic}"))
        body = options.pose_frame or self._of
        where = f"{self._topic}{f' in {self._frame}' if self._frame else ''}"
        return self._from_body(poses, bare(body), sensor, stamps, where)

    def _from_body(self, poses: Poses, body: str, sensor: str, stamps: Sequence[int], where: str) -> tuple[Poses, str]:
        """Return poses of the sensor from those of a body that it is mounted on; '' is the sensor itself."""
        options = self._options
        if options.extrinsics is not None:
            return poses @ self._extrinsics(), f"{where}, and extrinsics"
        if body in ("", sensor):
            return poses, f"{where}, of the {self._sensor}"
        chain = self._transforms.upwards(sensor)
        if body not in chain:
            raise DataError(
                f"{self._path}: the poses of {where} are of the frame '{body}', from which no transform leads to the"
                f" {self._sensor}'s frame '{sensor}'; set extrinsics: [x, y, z, qx, qy, qz, qw], or pose_frame:"
                f" {sensor} if they are the {self._sensor}'s"
            )
        chain = chain[: chain.index(body) + 1]
        mounted = self._transforms.poses_at(chain, stamps, options.max_pose_gap, self._path)
        return poses @ mounted, f"{where}, of {body}; {sensor} in it from {' and '.join(self._tf)}"

    def _extrinsics(self) -> Poses:
        if self._options.extrinsics is None:
            return np.eye(4)
        numbers = np.array([self._options.extrinsics], dtype=np.float64)
        T: Poses = from_quaternions(numbers[:, :3], numbers[:, 3:], Path("option extrinsics"))[0]
        return T

    def _chain(self, sensor: str) -> tuple[list[str], str]:
        """Return the frames from the sensor up to the world, or none and the reason."""
        chain, world = self._transforms.upwards(sensor), self._options.world_frame
        if not self._tf:
            return [], "there is no /tf; set trajectory: FILE, or pose: TOPIC"
        if len(chain) == 1:
            frames, option = self._transforms.frames(), f"{self._sensor}_frame"
            of_sensor = [frame for frame in frames if _OF_SENSOR[self._sensor].search(frame.lower())]
            hint = f"{option}: one of {', '.join(of_sensor[:8])}, or " if of_sensor else ""
            return [], (
                f"'{sensor}', the frame of its {self._seen}, is not in /tf, which has {', '.join(frames[:8])}"
                f" ({hint}record /tf_static, too, or give {option}: FRAME with extrinsics: [x, y, z, qx, qy, qz, qw] of"
                f" the {self._sensor} in it)"
            )
        if world is not None:
            if bare(world) not in chain:
                raise DataError(
                    f"{self._path}: option world_frame: '{world}' is not above '{sensor}' in /tf, which hangs from"
                    f" {', '.join(chain[1:])}"
                )
            return chain[: chain.index(bare(world)) + 1], ""
        moving = [frame for k, frame in enumerate(chain) if self._transforms.moves(chain[: k + 1])]
        if not moving:
            return [], f"no transform moves between '{sensor}' and '{chain[-1]}', from which it hangs"
        world_like = (f for word in WORLDS for f in moving if word in f.rpartition("/")[2].lower())
        topmost = next(world_like, moving[-1])
        return chain[: chain.index(topmost) + 1], ""


def _snapped(stamps: Sequence[int], targets: Sequence[int]) -> list[int]:
    """Return stamps, each as the nearest of the targets where a file with six digits of a second cannot tell them."""
    snapped, sorted_targets = np.array(stamps, dtype=np.int64), np.sort(np.array(targets, dtype=np.int64))
    after = np.searchsorted(sorted_targets, snapped).clip(max=len(sorted_targets) - 1)
    for near in (sorted_targets[after], sorted_targets[np.maximum(after - 1, 0)]):
        snapped = np.where(np.abs(near - snapped) <= SAME, near, snapped)
    return [int(stamp) for stamp in snapped]
