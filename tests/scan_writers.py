"""Small files in the true format of every dataset of scans, from scans of a room by a sensor that moves and turns."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bag_writer as bags
import numpy as np
from dataset_writers import numbers, write_lines
from scipy.spatial.transform import Rotation

from semstab.datasets import open_dataset

COUNT, POINTS = 4, 400
SIDE = np.array([8.0, 6.0, 3.0])
"""The room, metres; its floor is z = 0."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (N, 3) float32 in the sensor's coordinates, the wall of each (N,), 0 to 5, and the sensor's pose."""

    points: np.ndarray
    walls: np.ndarray
    T: np.ndarray


def rigid(angles: Sequence[float], t: Sequence[float]) -> np.ndarray:
    """A pose from angles about x, y, z in degrees, and a translation."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    T[:3, 3] = t
    return T


def room(k: int, count: int) -> Scan:
    """Scan k of the six walls of a room, whose points are on them in the world."""
    rng = np.random.default_rng((5, k))
    T = rigid((2 * k, -3, 25 * k), (2 + k, 3 + 0.2 * k, 1.5))
    walls = rng.integers(0, 6, count)
    world = rng.uniform(0, SIDE, (count, 3))
    world[np.arange(count), walls // 2] = np.where(walls % 2, SIDE[walls // 2], 0.0)
    return Scan(((world - T[:3, 3]) @ T[:3, :3]).astype(np.float32), walls.astype(np.uint16), T)


@functools.cache
def scans() -> tuple[Scan, ...]:
    """The scans that are written."""
    return tuple(room(k, POINTS) for k in range(COUNT))


def save_bytes(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


# --- SemanticKITTI

TR = rigid((-90, 90, 0), (0.1, -0.2, -0.3))
"""From the LiDAR to camera 0: its axes are others."""

KITTI_IDS = np.array([40, 48, 50, 70, 10, 252], np.uint32)
"""The stored id of each wall; the last one is a moving car."""


def write_semantickitti(
    folder: Path, wanted: Sequence[Scan], ids: np.ndarray = KITTI_IDS, to_camera: np.ndarray = TR
) -> list[str]:
    """Points with remission, true labels with an instance in the upper half, and poses of camera 0."""
    names = [f"{k:06d}" for k in range(len(wanted))]
    for name, scan in zip(names, wanted, strict=True):
        rows = np.column_stack([scan.points, np.full(len(scan.points), 0.5, np.float32)])
        save_bytes(folder / f"velodyne/{name}.bin", rows.astype("<f4").tobytes())
        save_bytes(folder / f"labels/{name}.label", (ids[scan.walls] | 7 << 16).astype("<u4").tobytes())
    poses = [to_camera @ scan.T @ np.linalg.inv(to_camera) for scan in wanted]
    write_lines(folder / "poses.txt", [numbers(T[:3]) for T in poses])
    write_lines(folder / "calib.txt", [f"P0: {numbers(np.eye(4)[:3])}", f"Tr: {numbers(to_camera[:3])}"])
    write_lines(folder / "times.txt", [numbers(0.1 * k) for k in range(len(wanted))])
    return names


def predict_semantickitti(
    folder: Path, name: str, walls: np.ndarray, model: str = "net", ids: np.ndarray = KITTI_IDS
) -> None:
    save_bytes(folder / f"predictions/{model}/{name}.label", ids[walls].astype("<u4").tobytes())


# --- nuScenes

MOUNTED = rigid((1, 2, -90), (0.9, 0, 1.8))
"""The pose of the LiDAR on the vehicle."""

CATEGORIES = (
    "noise",
    "flat.other",
    "flat.sidewalk",
    "static.manmade",
    "vehicle.car",
    "vehicle.ego",
    "vehicle.bus.rigid",
)
WALLS = np.array([1, 2, 3, 4, 6, 5], np.uint8)
"""The category of each wall; the last one is the vehicle itself, which the challenge ignores."""

COARSE = np.array([12, 13, 15, 4, 3, 0], np.uint8)
"""The same as the challenge's classes."""


def quaternion_first(T: np.ndarray) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {"translation": T[:3, 3].tolist(), "rotation": [w, x, y, z]}


def write_nuscenes(folder: Path, wanted: Sequence[Scan], scene: str = "scene-0061") -> list[str]:
    """Tables of one scene, with a camera and a sweep between key frames; categories have an order of their own."""
    names = [f"{k:032x}" for k in range(len(wanted), 0, -1)]
    tables: dict[str, list[dict[str, object]]] = {
        "scene": [{"token": "s", "name": scene, "first_sample_token": "s0"}],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP"}, {"token": "cam", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {"token": "c-cam", "sensor_token": "cam"} | quaternion_first(np.eye(4)),
            {"token": "c-lidar", "sensor_token": "lidar"} | quaternion_first(MOUNTED),
        ],
        "category": [{"token": f"k{k}", "name": name, "index": k} for k, name in enumerate(CATEGORIES)],
        "sample": [{"token": f"s{k}", "scene_token": "s"} for k in range(len(wanted))],
        "sample_data": [], "ego_pose": [], "lidarseg": [],
    }  # fmt: skip
    for k, (name, scan) in enumerate(zip(names, wanted, strict=True)):
        rows = np.column_stack([scan.points, np.full((len(scan.points), 2), 9, np.float32)])
        file, labels = f"samples/LIDAR_TOP/{k}.pcd.bin", f"lidarseg/v1.0-mini/{name}_lidarseg.bin"
        save_bytes(folder / file, rows.astype("<f4").tobytes())
        save_bytes(folder / labels, WALLS[scan.walls].tobytes())
        tables["ego_pose"].append({"token": f"e{k}"} | quaternion_first(scan.T @ np.linalg.inv(MOUNTED)))
        tables["lidarseg"].append({"token": name, "sample_data_token": name, "filename": labels})
        shared = {"sample_token": f"s{k}", "ego_pose_token": f"e{k}", "timestamp": 1_532_402_927_000_000 + 500_000 * k}
        key = {"filename": file, "calibrated_sensor_token": "c-lidar", "is_key_frame": True}
        tables["sample_data"] += [
            shared | key | {"token": name},
            shared | key | {"token": f"sweep{k}", "is_key_frame": False},
            shared | key | {"token": f"cam{k}", "calibrated_sensor_token": "c-cam"},
        ]
    tables["sample_data"].reverse()
    for table, content in tables.items():
        save_bytes(folder / f"v1.0-mini/{table}.json", json.dumps(content).encode())
    return names


def predict_nuscenes(folder: Path, name: str, walls: np.ndarray) -> None:
    save_bytes(folder / f"predictions/net/{name}_lidarseg.bin", COARSE[walls].tobytes())


# --- KITTI-360

DRIVE = "2013_05_28_drive_0000_sync"
IMU_FROM_CAMERA = rigid((90, 0, 90), (1.6, 0.1, -0.6))
LIDAR_FROM_CAMERA = rigid((-88, 3, -91), (0.3, -0.1, -0.7))


def write_kitti360(folder: Path, wanted: Sequence[Scan]) -> list[str]:
    """Raw scans from frame 7 on, and poses of the IMU, also of other frames."""
    names = [f"{7 + k:010d}" for k in range(len(wanted))]
    lidar_in_imu, lines = IMU_FROM_CAMERA @ np.linalg.inv(LIDAR_FROM_CAMERA), [f"1 {numbers(np.eye(4)[:3])}"]
    for k, (name, scan) in enumerate(zip(names, wanted, strict=True)):
        rows = np.column_stack([scan.points, np.full(len(scan.points), 0.5, np.float32)])
        save_bytes(folder / f"data_3d_raw/{DRIVE}/velodyne_points/data/{name}.bin", rows.astype("<f4").tobytes())
        lines.append(f"{7 + k} {numbers((scan.T @ np.linalg.inv(lidar_in_imu))[:3])}")
    write_lines(folder / f"data_poses/{DRIVE}/poses.txt", lines)
    cameras = [f"image_0{k}: {numbers((IMU_FROM_CAMERA @ rigid((0, 0, k), (k, 0, 0)))[:3])}" for k in range(4)]
    write_lines(folder / "calibration/calib_cam_to_pose.txt", cameras)
    write_lines(folder / "calibration/calib_cam_to_velo.txt", [numbers(LIDAR_FROM_CAMERA[:3])])
    return names


def predict_kitti360(folder: Path, name: str, walls: np.ndarray) -> None:
    path = folder / f"data_3d_raw/{DRIVE}/predictions/net/{name}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, walls.astype(np.uint8))


# --- points_folder

EAST = rigid((0, 0, 0), (400_000, 5_000_000, 30))
"""The origin of the room on Earth, for clouds that are in the world."""


def write_points(folder: Path, wanted: Sequence[Scan], suffix: str = ".npy", *, in_world: bool = False) -> list[str]:
    names = [f"scan {k}" for k in range(8, 8 + len(wanted))]
    for name, scan in zip(names, wanted, strict=True):
        T = EAST @ scan.T if in_world else scan.T
        points = scan.points @ T[:3, :3].T + T[:3, 3] if in_world else scan.points
        write_cloud(folder / f"points/{name}{suffix}", points, scan.walls)
        write_lines(folder / f"pose/{name}.txt", [numbers(row) for row in T])
    return names


def write_cloud(path: Path, points: np.ndarray, walls: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".ply":
        write_ply(path, points, label=walls.astype(np.uint8))
    else:
        import laspy

        las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
        las.header.scales, las.header.offsets = [0.0001] * 3, points.mean(axis=0).round()
        las.x, las.y, las.z = points.T
        las.classification = walls
        las.write(path)


def write_ply(path: Path, points: np.ndarray, **properties: np.ndarray) -> None:
    """A binary PLY file, with these properties before x, y, z, and one that nothing reads."""
    words = {"uint8": "uchar", "int32": "int", "float32": "float"}
    columns = {"extra": np.zeros(len(points), np.uint8), **properties, **dict(zip("xyz", points.T, strict=True))}
    columns |= {axis: columns[axis].astype(np.float32) for axis in "xyz"}
    rows = np.rec.fromarrays([*columns.values()], names=[*columns])
    head = [f"property {words[values.dtype.name]} {name}" for name, values in columns.items()]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *head, "end_header", ""]
    save_bytes(path, "\n".join(head).encode() + rows.tobytes())


def predict_points(folder: Path, name: str, walls: np.ndarray) -> None:
    path = folder / f"labels/net/{name}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, walls.astype(np.uint8))


# --- bags


def write_cloud_bag(folder: Path, wanted: Sequence[Scan]) -> list[str]:
    """A rosbag2, whose clouds have the true classes in them."""
    bags.write_bag(folder, "MCAP", lambda ros: bags.cloud_records(ros, wanted))
    return bags.clouds_of(len(wanted))


# --- all of them


@dataclass(frozen=True)
class ScanFormat:
    """A dataset: writers of its scans and of predictions, the class that each wall is read as, and needed options.

    Attributes:
        dataset: Its name.
        write: Writes scans into a folder, and returns their names.
        predict: Writes the walls of a scan as predictions into the same folder.
        classes: The class of each wall, in words.
        points: The file of the second scan's points, a template; '' where one file holds all scans.
        predicted: The file of a scan's predictions.
        moves: The wall that moves, by the format's truth.
        truth: Whether it has ground truth of each point.
        options: Options that it needs.
    """

    dataset: str
    write: Callable[[Path, Sequence[Scan]], list[str]]
    predict: Callable[[Path, str, np.ndarray], None]
    classes: tuple[str | None, ...]
    points: str
    predicted: str
    moves: int | None = None
    truth: bool = True
    options: dict[str, object] = field(default_factory=dict)


def of_points(suffix: str, *, in_world: bool = False) -> ScanFormat:
    options: dict[str, object] = {"classes": tuple("abcdef")} | ({"coordinates": "world"} if in_world else {})
    write = functools.partial(write_points, suffix=suffix, in_world=in_world)
    return ScanFormat(
        "points_folder", write, predict_points, tuple("abcdef"), f"points/{{}}{suffix}", "labels/net/{}.npy",
        truth=suffix != ".npy", options=options,
    )  # fmt: skip


SCANS = {
    "semantickitti": ScanFormat(
        "semantickitti", write_semantickitti, predict_semantickitti,
        ("road", "sidewalk", "building", "vegetation", "car", "car"), "velodyne/{}.bin", "predictions/net/{}.label",
        moves=5,
    ),
    "nuscenes": ScanFormat(
        "nuscenes", write_nuscenes, predict_nuscenes,
        ("other_flat", "sidewalk", "manmade", "car", "bus", None), "samples/LIDAR_TOP/1.pcd.bin",
        "predictions/net/{}_lidarseg.bin",
    ),
    "kitti360": ScanFormat(
        "kitti360", write_kitti360, predict_kitti360, tuple("abcdef"),
        f"data_3d_raw/{DRIVE}/velodyne_points/data/{{}}.bin", f"data_3d_raw/{DRIVE}/predictions/net/{{}}.npy",
        truth=False, options={"classes": tuple("abcdef")},
    ),
    "points_folder, NPY": of_points(".npy"),
    "points_folder, PLY": of_points(".ply"),
    "points_folder, LAS": of_points(".las"),
    "points_folder, LAZ in the world": of_points(".laz", in_world=True),
    "bag_scans": ScanFormat(
        "bag_scans", write_cloud_bag, predict_points, tuple("abcdef"), "", "labels/net/{}.npy",
        options={"classes": tuple("abcdef"), "label_source": "gt"},
    ),
}  # fmt: skip


def write_predicted(form: ScanFormat, folder: Path) -> list[str]:
    """Write all scans with predictions that are right but for every tenth point, which is of the first wall."""
    names = form.write(folder, scans())
    for name, scan in zip(names, scans(), strict=True):
        form.predict(folder, name, predicted(scan))
    return names


def predicted(scan: Scan) -> np.ndarray:
    """The walls that the model predicts."""
    return np.where(np.arange(len(scan.walls)) % 10, scan.walls, 0).astype(scan.walls.dtype)


def opened(form: ScanFormat, root: Path, **options):
    """The first scene of a dataset that was written, with the options that its format needs."""
    dataset = open_dataset(form.dataset, {"root": root} | form.options | options)
    return dataset.scene(dataset.scenes[0])
