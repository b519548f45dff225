"""Small ROS bags in all three containers, from frames: topics as RealSense's driver names them, poses on /tf."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from semstab import Frame

if TYPE_CHECKING:
    from scan_writers import Scan

START, STEP = 1305031102_000000000, 100_000_000
LATER = 4_000_000
"""Nanoseconds from a depth image to its colour image."""

OPTICAL, LINK, BASE, ODOM, MAP = "camera_color_optical_frame", "camera_link", "base_link", "odom", "map"
LIDAR, CLOUDS = "os_sensor", "/ouster/points"
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
DEPTH, COLOR = "/camera/aligned_depth_to_color/image_raw", "/camera/color/image_raw"
DEPTH_INFO, COLOR_INFO = "/camera/aligned_depth_to_color/camera_info", "/camera/color/camera_info"
LINK_IN_BASE = np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
LIDAR_IN_BASE = np.array([[0, -1, 0, 0.2], [1, 0, 0, 0], [0, 0, 1, 0.9], [0, 0, 0, 1.0]])
OPTICAL_IN_LINK = np.array([[0, 0, 1, 0], [-1, 0, 0, 0.015], [0, -1, 0, 0], [0, 0, 0, 1.0]])
ODOM_IN_MAP = np.eye(4)
ODOM_IN_MAP[:3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
ODOM_IN_MAP[:3, 3] = 2, -1, 0.5

CONTAINERS = ("ROS 1", "sqlite3", "MCAP")
Entry = tuple[str, int, Any]
"""The topic, bag time and message of a record."""


@functools.cache
def _store(first: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.LATEST)
    if first:
        definition = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
    return store


class Ros:
    """Messages of ROS 1 or ROS 2."""

    def __init__(self, container: str) -> None:
        self.first = container == "ROS 1"
        self.store = _store(self.first)
        self.types = self.store.types

    def stamp(self, ns: int) -> Any:
        return self.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)

    def header(self, ns: int, frame: str) -> Any:
        seq = {"seq": 0} if self.first else {}
        return self.types["std_msgs/msg/Header"](stamp=self.stamp(ns), frame_id=frame, **seq)

    def image(self, ns: int, pixels: np.ndarray, encoding: str, frame: str = OPTICAL, pad: int = 0) -> Any:
        """Rows are `pad` bytes longer than the pixels; the dtype's order of bytes is the message's."""
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        return self.types["sensor_msgs/msg/Image"](
            header=self.header(ns, frame), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"), step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    def compressed(self, ns: int, data: bytes, format_: str, frame: str = OPTICAL) -> Any:
        return self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(ns, frame), format=format_, data=np.frombuffer(data, np.uint8)
        )

    def info(self, ns: int, frame: Frame, D=(0.0,) * 5, model="plumb_bob", size=None, P=None, roi=None) -> Any:
        K = frame.intrinsics.matrix
        W, H = size or (frame.shape[1], frame.shape[0])
        fields = {"D": np.array(D, float), "K": K.ravel(), "R": np.eye(3).ravel()}
        fields["P"] = (np.hstack([K, np.zeros((3, 1))]) if P is None else P).ravel()
        region = self.types["sensor_msgs/msg/RegionOfInterest"]
        x, y, w, h = roi or (0, 0, 0, 0)
        return self.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(ns, OPTICAL), height=H, width=W, distortion_model=model, binning_x=0, binning_y=0,
            roi=region(x_offset=x, y_offset=y, height=h, width=w, do_rectify=False),
            **{name if self.first else name.lower(): value for name, value in fields.items()},
        )  # fmt: skip

    def cloud(
        self,
        ns: int,
        columns: dict[str, np.ndarray],
        frame: str = LIDAR,
        height: int = 1,
        big: bool = False,
        pad: int = 0,
    ) -> Any:
        """Fields by name, in this order, each after a byte that is in no field; rows are `pad` bytes longer."""
        order, (count, *_) = ">" if big else "<", next(iter(columns.values())).shape
        kinds = [(name, values.dtype.newbyteorder(order)) for name, values in columns.items()]
        layout = np.dtype([part for k, kind in enumerate(kinds) for part in ((f"gap{k}", "u1"), kind)])
        points = np.zeros(count, layout)
        for name, values in columns.items():
            points[name] = values
        rows = np.pad(points.view(np.uint8).reshape(height, -1), ((0, 0), (0, pad)))
        field = self.types["sensor_msgs/msg/PointField"]
        return self.types["sensor_msgs/msg/PointCloud2"](
            header=self.header(ns, frame), height=height, width=count // height, is_bigendian=big,
            fields=[field(name, layout.fields[name][1], DATATYPES[kind.str[1:]], 1) for name, kind in kinds],
            point_step=layout.itemsize, row_step=rows.shape[1], data=rows.ravel(), is_dense=False,
        )  # fmt: skip

    def pose(self, T: np.ndarray) -> Any:
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        point, turn = self.types["geometry_msgs/msg/Point"], self.types["geometry_msgs/msg/Quaternion"]
        return self.types["geometry_msgs/msg/Pose"](point(*T[:3, 3].tolist()), turn(*map(float, (x, y, z, w))))

    def posed(self, ns: int, T: np.ndarray, frame: str = MAP) -> Any:
        return self.types["geometry_msgs/msg/PoseStamped"](self.header(ns, frame), self.pose(T))

    def odometry(self, ns: int, T: np.ndarray, child: str, frame: str = ODOM) -> Any:
        vector, t = self.types["geometry_msgs/msg/Vector3"], self.types
        still = t["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return t["nav_msgs/msg/Odometry"](
            self.header(ns, frame), child,
            t["geometry_msgs/msg/PoseWithCovariance"](self.pose(T), np.zeros(36)),
            t["geometry_msgs/msg/TwistWithCovariance"](still, np.zeros(36)),
        )  # fmt: skip

    def transforms(self, *edges: tuple[int, str, str, np.ndarray]) -> Any:
        """Of stamps, parents, children, and poses of the children in their parents."""
        t, all_ = self.types, []
        for ns, parent, child, T in edges:
            pose = self.pose(T)
            at = t["geometry_msgs/msg/Vector3"](pose.position.x, pose.position.y, pose.position.z)
            moved = t["geometry_msgs/msg/Transform"](at, pose.orientation)
            all_.append(t["geometry_msgs/msg/TransformStamped"](self.header(ns, parent), child, moved))
        return t["tf2_msgs/msg/TFMessage"](all_)


def records(ros: Ros, frames: Sequence[Frame]) -> Iterable[Entry]:
    """What a robot records: base_link moves in odom, the camera is mounted on it."""
    start = START - STEP // 2
    camera_in_base = LINK_IN_BASE @ OPTICAL_IN_LINK
    mounted = ((start, BASE, LINK, LINK_IN_BASE), (start, LINK, OPTICAL, OPTICAL_IN_LINK))
    yield "/tf_static", start, ros.transforms(*mounted)
    for k, frame in enumerate(frames):
        t = START + k * STEP
        base_in_odom = np.linalg.inv(ODOM_IN_MAP) @ frame.T_wc @ np.linalg.inv(camera_in_base)
        for at in (t, t + STEP // 2):
            yield "/tf", at, ros.transforms((at, MAP, ODOM, ODOM_IN_MAP), (at, ODOM, BASE, base_in_odom))
        depth = np.rint(frame.depth.astype(np.float64) * 1000).astype(np.uint16)
        yield DEPTH, t + 1, ros.image(t, depth, "16UC1")
        yield COLOR, t + 3, ros.image(t + LATER, frame.color, "rgb8")
        for name in (DEPTH_INFO, COLOR_INFO):
            yield name, t, ros.info(t, frame)


def cloud_records(
    ros: Ros, scans: Sequence[Scan], *, tf: bool = True, dtype: Any = np.float32, **layout
) -> Iterable[Entry]:
    """What a robot with a LiDAR records: poses by /tf, or Odometry of base_link; the wall of each point as `label`."""
    start = START - STEP // 2
    yield "/tf_static", start, ros.transforms((start, BASE, LIDAR, LIDAR_IN_BASE))
    for k, scan in enumerate(scans):
        t = START + k * STEP
        base = scan.T @ np.linalg.inv(LIDAR_IN_BASE)
        for at in (t, t + STEP // 2):
            if tf:
                in_odom = np.linalg.inv(ODOM_IN_MAP) @ base
                yield "/tf", at, ros.transforms((at, MAP, ODOM, ODOM_IN_MAP), (at, ODOM, BASE, in_odom))
            else:
                yield "/odometry", at, ros.odometry(at, base, BASE)
        yield CLOUDS, t + 1, ros.cloud(t, columns_of(scan, dtype), **layout)


def columns_of(scan: Scan, dtype: Any = np.float32) -> dict[str, np.ndarray]:
    """The fields of a cloud: some that nothing reads, among them."""
    axes = dict(zip("xyz", scan.points.T.astype(dtype), strict=True))
    return {"intensity": np.ones(len(scan.points), np.float32), **axes, "label": scan.walls, "t": scan.walls}


def clouds_of(count: int) -> list[str]:
    """The names of the scans that `cloud_records` makes."""
    return [str(START + k * STEP) for k in range(count)]


def names_of(count: int) -> list[str]:
    """The names of the frames that `records` makes."""
    return [f"{ns // 10**9}.{ns % 10**9:09d}" for ns in (START + k * STEP + LATER for k in range(count))]


def write_bag(path: Path, container: str, entries: Callable[[Ros], Iterable[Entry]]) -> Path:
    """Write messages in the order in which they come: RUN.bag, or RUN/ of a rosbag2. The folder may be there."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    ros = Ros(container)
    path.parent.mkdir(parents=True, exist_ok=True)
    if ros.first:
        path, folder = path.with_name(f"{path.name}.bag"), None
        writer: Any = Writer1(path)
    else:
        folder = path.parent / f"{path.name}-new"
        plugin = StoragePlugin.MCAP if container == "MCAP" else StoragePlugin.SQLITE3
        writer = Writer2(folder, version=9, storage_plugin=plugin)
    with writer:
        connections: dict[str, Any] = {}
        for topic, time, message in entries(ros):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros.store)
            serialize = ros.store.serialize_ros1 if ros.first else ros.store.serialize_cdr
            writer.write(connections[topic], time, serialize(message, kind))
    if folder is not None:
        path.mkdir(exist_ok=True)
        for file in folder.iterdir():
            shutil.move(file, path / file.name)
        folder.rmdir()
    return path


def png(image: np.ndarray) -> bytes:
    """Of grey or RGB samples."""
    done, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    assert done
    return data.tobytes()
