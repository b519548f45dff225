"""Small files in the true format of every dataset, from frames of the built-in city shrunk to the size of a room."""

from __future__ import annotations

import dataclasses
import functools
import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import bag_writer as bags
import cv2
import numpy as np
from posed_writer import write_posed
from scipy.spatial.transform import Rotation

from semstab import Frame, VoxelTable
from semstab.backends import create
from semstab.datasets import open_dataset

W, H, COUNT, SHRUNK = 48, 32, 4, 10
BITS_24 = (2**24 - 1) / 1000
"""Units in a metre of depth in the three channels of an image."""

CLASSES = ["clutter", "building", "road", "static car", "tree", "low vegetation", "human", "moving car"]
SIDES = {"opencv": ([0, 1, 2], [1, 1, 1]), "opengl": ([0, 1, 2], [1, -1, -1]), "ned": ([2, 0, 1], [1, 1, 1])}
"""For each convention of camera axes, which OpenCV axis each of its axes is, and with which sign."""


@functools.cache
def city() -> tuple[Frame, ...]:
    """Neighbouring frames of the city, a tenth of its size, with labels of a model that errs, and colour."""
    scene = open_dataset("city", {"width": W, "height": H, "frames": 15 * COUNT}).scene("scene0")
    return tuple(shrunk(scene.frame(index, "sim-flicker")) for index in range(COUNT))


def shrunk(frame: Frame) -> Frame:
    T = frame.T_wc.copy()
    T[:3, 3] /= SHRUNK
    return dataclasses.replace(frame, depth=frame.depth / SHRUNK, T_wc=T, files={})


def stored(frame: Frame, scale: float) -> np.ndarray:
    """Depth (H, W) as an image of 16 bits holds it, or one of 24, whose scale is larger."""
    return np.rint(frame.depth.astype(np.float64) * scale).astype(np.uint16 if scale < BITS_24 else np.uint32)


def source(scale: float | None = None) -> list[Frame]:
    """The frames, with the depth that 16-bit images of that scale can hold."""
    if scale is None:
        return list(city())
    return [dataclasses.replace(f, depth=np.float32(stored(f, scale)) / np.float32(scale)) for f in city()]


def fused(frames: Sequence[Frame]) -> VoxelTable:
    backend = create("numpy", voxel_size=0.1, num_classes=len(CLASSES))
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def assert_same_voxels(found: Sequence[Frame], expected: Sequence[Frame]) -> None:
    """The same voxels with the same evidence, up to the last digits of poses."""
    ours, theirs = fused(found), fused(expected)
    assert len(ours) == len(theirs) > 500
    for column in ("ix", "iy", "iz", "op", "pixels", "first_frame", "last_frame"):
        np.testing.assert_array_equal(getattr(ours, column), getattr(theirs, column), err_msg=column)
    for column in ("evidence", "drift_sum"):
        np.testing.assert_allclose(getattr(ours, column), getattr(theirs, column), rtol=0, atol=1e-12)


# --- parts of every format ------------------------------------------------------------------------------------------


def save(path: Path, image: np.ndarray) -> None:
    """PNG or JPEG of grey or RGB samples, or .npy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def write_lines(path: Path, lines) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def matrix_text(matrix) -> list[str]:
    return [numbers(row) for row in matrix]


def with_axes(T_wc: np.ndarray, axes: str) -> np.ndarray:
    """A camera-to-world pose whose columns are the axes of a camera of another convention."""
    columns, signs = SIDES[axes]
    T = T_wc.copy()
    T[:3, :3] = T_wc[:3, columns] * signs
    return T


def quaternion(R) -> np.ndarray:
    """Return x y z w."""
    return Rotation.from_matrix(R).as_quat()


def four(frame: Frame) -> list[float]:
    K = frame.intrinsics
    return [K.fx, K.fy, K.cx, K.cy]


def write_labels(folder: Path, names: Sequence[str], frames: Sequence[Frame], template="labels/net/{}.png") -> None:
    for name, frame in zip(names, frames, strict=True):
        save(folder / template.format(name), frame.labels)


# --- formats --------------------------------------------------------------------------------------------------------


def write_posed_folder(folder: Path, frames: Sequence[Frame]) -> list[str]:
    names = [f"{k:04d}" for k in range(len(frames))]
    write_posed(folder, names, {"": frames})
    return names


def write_hololens(folder: Path, frames: Sequence[Frame]) -> list[str]:
    names = [f"{3 + k:05d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.png", stored(frame, 1000))
        save(folder / f"images/{name}.png", frame.color)
    write_lines(folder / "poses.txt", [numbers(frame.T_wc) for frame in frames])
    write_lines(folder / "K.txt", matrix_text(frames[0].intrinsics.matrix))
    return names


def write_seven_scenes(folder: Path, frames: Sequence[Frame]) -> list[str]:
    names = [f"frame-{k:06d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        depth = stored(frame, 1000)
        save(folder / f"{name}.depth.png", np.where(depth == 0, 65535, depth).astype(np.uint16))
        save(folder / f"{name}.color.png", frame.color)
        write_lines(folder / f"{name}.pose.txt", matrix_text(frame.T_wc))
    return names


def square(K: np.ndarray) -> np.ndarray:
    """A 3x3 camera matrix as ScanNet's 4x4."""
    padded = np.eye(4)
    padded[:3, :3] = K
    return padded


def write_scannet(folder: Path, frames: Sequence[Frame]) -> list[str]:
    names = [str(k) for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.png", stored(frame, 1000))
        save(folder / f"color/{name}.jpg", frame.color)
        write_lines(folder / f"pose/{name}.txt", matrix_text(frame.T_wc))
    K = frames[0].intrinsics
    write_lines(folder / "intrinsic/intrinsic_depth.txt", matrix_text(square(K.matrix)))
    write_lines(folder / "intrinsic/intrinsic_color.txt", matrix_text(square(K.resized((W, H), (2 * W, 2 * H)).matrix)))
    return names


def write_replica(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """The export of NICE-SLAM."""
    names = [f"{k:06d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"results/depth{name}.png", stored(frame, 6553.5))
        save(folder / f"results/frame{name}.jpg", frame.color)
    write_lines(folder / "traj.txt", [numbers(frame.T_wc) for frame in frames])
    fx, fy, cx, cy = four(frames[0])
    camera = {"w": W, "h": H, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return names


def write_semantic_nerf(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """Replica in the export of Semantic-NeRF; numbers are not padded, class 0 is void."""
    names = [str(k) for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/depth_{name}.png", stored(frame, 1000))
        save(folder / f"rgb/rgb_{name}.png", frame.color)
        save(folder / f"semantic_class/semantic_class_{name}.png", frame.labels)
    write_lines(folder / "traj_w_c.txt", [numbers(frame.T_wc) for frame in frames])
    return names


def write_tum(folder: Path, frames: Sequence[Frame], start: float = 1305031102.0) -> list[str]:
    """Colour 4 ms after depth; a pose at the time of each depth image and between them."""
    depth_times = [start + 0.1 * k for k in range(len(frames))]
    names = [f"{t + 0.004:.6f}" for t in depth_times]
    trajectory = []
    for t, name, frame in zip(depth_times, names, frames, strict=True):
        save(folder / f"depth/{t:.6f}.png", stored(frame, 5000))
        save(folder / f"rgb/{name}.png", frame.color)
        pose = [*frame.T_wc[:3, 3], *quaternion(frame.T_wc[:3, :3])]
        trajectory += [f"{t:.6f} {numbers(pose)}", f"{t + 0.05:.6f} {numbers(pose)}"]
    write_lines(folder / "depth.txt", ["# depth maps", *(f"{t:.6f} depth/{t:.6f}.png" for t in depth_times)])
    write_lines(folder / "rgb.txt", ["# color images", *(f"{name} rgb/{name}.png" for name in names)])
    write_lines(folder / "groundtruth.txt", ["# timestamp tx ty tz qx qy qz qw", *trajectory])
    return names


def write_transforms(folder: Path, frames: Sequence[Frame], *, program: str = "nerfstudio") -> list[str]:
    """OpenGL axes, principal point from the corner; of instant-ngp with its names and one camera a frame."""
    ours = program == "nerfstudio"
    names = [f"frame_{k:05d}" for k in range(len(frames))]
    entries = []
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"images/{name}.png", frame.color)
        save(folder / f"depths/{name}.png", stored(frame, 1000 if ours else 4000))
        entry = {
            "file_path": f"images/{name}.png" if ours else f"./images/{name}",
            "depth_file_path" if ours else "depth_path": f"depths/{name}.png",
            "transform_matrix": with_axes(frame.T_wc, "opengl").tolist(),
        }
        entries.append(entry if ours else entry | camera_json(frame))
    shared = (
        {"camera_model": "OPENCV", "k1": 0.0} | camera_json(frames[0]) if ours else {"integer_depth_scale": 1 / 4000}
    )
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": entries[::-1]}))
    return names


def camera_json(frame: Frame) -> dict[str, float]:
    fx, fy, cx, cy = four(frame)
    return {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": W, "h": H}


def write_tartanair(folder: Path, frames: Sequence[Frame], side: str = "left") -> list[str]:
    """NED axes; pixels far away are sky. Depth in metres, .npy, or of V2 packed into the four channels of a PNG."""
    names = [f"{k:06d}" for k in range(len(frames))]
    suffix = "png" if "cam" in side else "npy"
    lines = []
    for name, frame in zip(names, frames, strict=True):
        depth = np.where(frame.depth > 0, frame.depth, np.float32(1e4)).astype("<f4")
        stored = folder / f"depth_{side}/{name}_{side}_depth.{suffix}"
        if suffix == "npy":
            save(stored, depth)
        else:
            stored.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(stored), depth[..., None].view(np.uint8))
        save(folder / f"seg_{side}/{name}_{side}_seg.{suffix}", frame.labels)
        save(folder / f"image_{side}/{name}_{side}.png", frame.color)
        T = with_axes(frame.T_wc, "ned")
        lines.append(numbers([*T[:3, 3], *quaternion(T[:3, :3])]))
    write_lines(folder / f"pose_{side}.txt", lines)
    return names


def write_syndrone(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """As its generator writes it: depth of 16 bits up to 1000 m, which is sky, and poses of CARLA, left-handed."""
    names = [f"{k:05d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        metres = np.where(frame.depth > 0, frame.depth.astype(float), 1000.0)
        save(folder / f"depth/{name}.png", np.round(metres * 65535 / 1000).astype(np.uint16))
        save(folder / f"rgb/{name}.png", frame.color)
        save(folder / f"semantic/{name}.png", frame.labels)
        write_carla_pose(folder / f"camera/{name}.json", frame.T_wc)
    return names


def write_carla_pose(path: Path, T_wc: np.ndarray) -> None:
    """Position and angles in CARLA's left-handed axes: x forward, y right, z up."""
    R, (x, y, z) = T_wc[:3, :3] * [[1], [-1], [1]], T_wc[:3, 3]
    right, down, forward = R.T
    angles = {
        "pitch": np.arcsin(forward[2]), "yaw": np.arctan2(forward[1], forward[0]),
        "roll": np.arctan2(-right[2], -down[2]),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    degrees = {key: float(np.degrees(value)) for key, value in angles.items()}
    path.write_text(json.dumps({"x": float(x), "y": float(-y), "z": float(z)} | degrees))


def packed(frame: Frame) -> np.ndarray:
    """Depth as CARLA's camera saves it, RGBA (H, W, 4); the sky, which has none, is 1000 m."""
    units = np.where(frame.depth > 0, stored(frame, BITS_24), 2**24 - 1)
    return np.stack([units & 255, units >> 8 & 255, units >> 16, np.full_like(units, 255)], axis=2).astype(np.uint8)


def write_carla(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A dump of cameras that save images as they are, with a file of a pose beside."""
    names = [f"{k:06d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save_rgba(folder / f"depth/{name}.png", packed(frame))
        save(folder / f"rgb/{name}.png", frame.color)
        write_carla_pose(folder / f"camera/{name}.json", frame.T_wc)
    return names


def write_kitti_carla(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A pose of the LiDAR each millisecond, of which those of the camera's times are meant; right-handed axes."""
    names = [f"{k:04d}" for k in range(len(frames))]
    mount = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, -0.3], [0, 0, 1, -0.1], [0, 0, 0, 1]])
    forward = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    lines = ["# R(0,0) R(0,1) R(0,2) t(0) R(1,0) ... timestamp"]
    for k, (name, frame) in enumerate(zip(names, frames, strict=True)):
        save_rgba(folder / f"images_depth/{name}_20.png", packed(frame))
        save(folder / f"images_rgb/{name}_0.png", frame.color)
        T = frame.T_wc @ forward @ mount
        lines += [f"{numbers(T[:3])} {0.1 * k}", f"{numbers(np.eye(4)[:3])} {0.1 * k + 0.05}"]
    write_lines(folder / "full_poses_lidar.txt", lines)
    write_lines(folder / "full_ts_camera.txt", ["# frame_id timestamp", *(f"{k} {0.1 * k}" for k in range(len(names)))])
    write_lines(folder / "lidar_to_cam0.txt", ["#R(0,0) R(0,1) ...", numbers(mount[:3])])
    return names


def write_airsim(folder: Path, frames: Sequence[Frame], kind: int = 1) -> list[str]:
    """A recording of a multirotor, whose depth in .pfm begins with the top row; times of images differ by some ns."""
    start, names = 1_530_000_000_000_000_000, []
    lines = ["VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile"]
    for k, frame in enumerate(frames):
        names.append(f"img_Drone_0_0_{start + 100 * k}")
        save(folder / f"images/{names[-1]}.png", frame.color)
        depth = f"img_Drone_0_{kind}_{start + 100 * k + 7}.pfm"
        metres = np.where(frame.depth > 0, frame.depth, np.float32(65504)).astype("<f4")
        (folder / f"images/{depth}").write_bytes(b"Pf\n%d %d\n-1\n" % metres.shape[::-1] + metres.tobytes())
        T = with_axes(frame.T_wc, "ned")
        pose = [*T[:3, 3], *np.roll(quaternion(T[:3, :3]), 1)]
        columns = "\t".join(repr(float(value)) for value in pose)
        lines.append(f"Drone\t{1000 + 50 * k}\t{columns}\t{names[-1]}.png;{depth}")
    write_lines(folder / "airsim_rec.txt", lines)
    return names


def save_rgba(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., [2, 1, 0, 3]])


def write_hypersim(folder: Path, frames: Sequence[Frame], unit: float = 1.0) -> list[str]:
    """Depth in half floats, poses in a unit of metres, OpenGL axes; frame 0 was left out, and has a pose alone."""
    names, images = [f"{k + 1:04d}" for k in range(len(frames))], folder / "images/scene_cam_00_geometry_hdf5"
    for name, frame in zip(names, frames, strict=True):
        save_hdf5(images / f"frame.{name}.depth_meters.hdf5", frame.depth.astype(np.float16))
        save(folder / f"images/scene_cam_00_final_preview/frame.{name}.color.jpg", frame.color)
    poses = np.array([np.eye(4), *(with_axes(frame.T_wc, "opengl") for frame in frames)])
    save_hdf5(folder / "_detail/cam_00/camera_keyframe_positions.hdf5", poses[:, :3, 3] / unit)
    save_hdf5(folder / "_detail/cam_00/camera_keyframe_orientations.hdf5", poses[:, :3, :3])
    write_lines(
        folder / "_detail/metadata_scene.csv", ["parameter_name,parameter_value", f"meters_per_asset_unit,{unit}"]
    )
    return names


def save_hdf5(path: Path, array: np.ndarray) -> None:
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["dataset"] = array


def write_habitat(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """OpenGL axes, quaternions w x y z; numbers are not padded."""
    names, poses = [str(k) for k in range(len(frames))], []
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.png", stored(frame, 1000))
        save(folder / f"rgb/{name}.png", frame.color)
        T = with_axes(frame.T_wc, "opengl")
        poses.append(numbers([*T[:3, 3], *np.roll(quaternion(T[:3, :3]), 1)]))
    write_lines(folder / "GT_Pose.txt", poses)
    return names


def write_virtual_kitti(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """Depth in centimetres, the sky at its end; poses and intrinsics of both cameras, world to camera, in one table."""
    names = [f"{k:05d}" for k in range(len(frames))]
    poses, cameras = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 ..."], ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    for k, (name, frame) in enumerate(zip(names, frames, strict=True)):
        depth = stored(frame, 100)
        save(folder / f"frames/depth/Camera_0/depth_{name}.png", np.where(depth == 0, 65535, depth).astype(np.uint16))
        save(folder / f"frames/rgb/Camera_0/rgb_{name}.jpg", frame.color)
        for camera in (0, 1):
            poses.append(f"{k} {camera} {numbers(np.linalg.inv(frame.T_wc) + camera * 0.5)}")
            cameras.append(f"{k} {camera} {numbers(np.add(four(frame), camera))}")
    write_lines(folder / "extrinsic.txt", poses)
    write_lines(folder / "intrinsic.txt", cameras)
    return names


def write_midair(folder: Path, frames: Sequence[Frame], flight: str = "trajectory_0000") -> list[str]:
    """A flight, with planar depth in half floats, and records of which each fourth is that of an image."""
    import h5py

    names = [f"{flight}/{k:06d}" for k in range(len(frames))]
    poses = np.full((4 * len(frames), 7), 0.5)
    for k, (name, frame) in enumerate(zip(names, frames, strict=True)):
        save(folder / f"depth/{name}.PNG", frame.depth.astype(np.float16).view(np.uint16))
        save(folder / f"color_left/{name}.JPEG", frame.color)
        T = with_axes(frame.T_wc, "ned")
        poses[4 * k] = [*T[:3, 3], *np.roll(quaternion(T[:3, :3]), 1)]
    with h5py.File(folder / "sensor_records.hdf5", "a") as records:
        truth = records.create_group(f"{flight}/groundtruth")
        truth["position"], truth["attitude"] = poses[:, :3], poses[:, 3:]
    return names


def write_colmap(folder: Path, frames: Sequence[Frame], *, binary: bool = False, model: str = "sparse") -> list[str]:
    """A dense workspace with a PINHOLE camera, and images whose points are there, or not."""
    names = [f"cam 0/{k:04d}" for k in range(len(frames))]
    poses = []
    for name, frame in zip(names, frames, strict=True):
        save_depth_map(folder / f"stereo/depth_maps/{name}.png.geometric.bin", frame.depth)
        save(folder / f"images/{name}.png", frame.color)
        T_cw = np.linalg.inv(frame.T_wc)
        x, y, z, w = quaternion(T_cw[:3, :3])
        poses.append([w, x, y, z, *T_cw[:3, 3]])
    fx, fy, cx, cy = four(frames[0])
    write = write_model_binary if binary else write_model_text
    write(folder / model, [fx, fy, cx + 0.5, cy + 0.5], poses, [f"{name}.png" for name in names])
    return names


def save_depth_map(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = f"{depth.shape[1]}&{depth.shape[0]}&1&".encode()
    path.write_bytes(header + np.asfortranarray(depth.T.astype("<f4")).tobytes(order="F"))


def write_model_text(folder: Path, camera, poses, names) -> None:
    write_lines(folder / "cameras.txt", ["# Camera list", f"7 PINHOLE {W} {H} {numbers(camera)}"])
    lines = ["# Image list", "# Number of images: 4"]
    for k, (pose, name) in enumerate(zip(poses, names, strict=True)):
        lines += [f"{100 + k} {numbers(pose)} 7 {name}", "1.5 2.5 -1 3.5 4.5 12" if k % 2 else ""]
    write_lines(folder / "images.txt", lines)


def write_model_binary(folder: Path, camera, poses, names) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, W, H, *camera))
    content = struct.pack("<Q", len(poses))
    for k, (pose, name) in enumerate(zip(poses, names, strict=True)):
        content += struct.pack("<I7dI", 100 + k, *pose, 7) + name.encode() + b"\0"
        content += struct.pack("<Q", k) + struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) * k
    (folder / "images.bin").write_bytes(content)


def write_odm(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """OpenDroneMap with undistorted images and depth files."""
    names = [f"DJI_{k:04d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.npy", frame.depth)
        save(folder / f"opensfm/undistorted/images/{name}.JPG.tif", frame.color)
    shots = {f"{name}.JPG.tif": shot(frame, "c") for name, frame in zip(names, frames, strict=True)}
    fx, fy, cx, cy = four(frames[0])
    lens = {"focal_x": fx / W, "focal_y": fy / W, "c_x": (cx - (W - 1) / 2) / W, "c_y": (cy - (H - 1) / 2) / W}
    write_reconstruction(folder / "opensfm/undistorted", [({"c": {"projection_type": "brown"} | lens}, shots)])
    return names


def write_exported(folder: Path, frames: Sequence[Frame], kind: str) -> list[str]:
    """The same with the export of OpenSfM in place of its reconstruction: 'nvm' or 'bundle'."""
    names = write_odm(folder, frames)
    (folder / "opensfm/undistorted/reconstruction.json").unlink()
    poses = {f"{name}.JPG.tif": np.linalg.inv(frame.T_wc) for name, frame in zip(names, frames, strict=True)}
    write = {"nvm": write_nvm, "bundle": write_bundle}[kind]
    write(folder / "opensfm", poses, frames[0].intrinsics.fx)
    return names


def write_nvm(opensfm: Path, poses: dict[str, np.ndarray], focal: float) -> Path:
    """What export_visualsfm writes of world-to-camera poses, with one point."""
    lines = ["NVM_V3", "", len(poses)]
    for name, T in poses.items():
        x, y, z, w = quaternion(T[:3, :3])
        lines.append(f"images/{name} {numbers([focal, w, x, y, z, *(-T[:3, :3].T @ T[:3, 3])])} 0 0")
    return write_lines(
        opensfm / "undistorted/reconstruction.nvm", [*lines, "", 1, "1.5 2.5 3.5 9 8 7 2 0 3 1 1 1 4 2 2"]
    )


def write_bundle(
    opensfm: Path,
    poses: dict[str, np.ndarray],
    focal: float,
    radial=(0.0, 0.0),
    number: int = 0,
    lost: str = "lost.JPG",
) -> Path:
    """What export_bundler writes, with an image that was not reconstructed, and one point."""
    lines = ["# Bundle file v0.3", f"{len(poses) + 1} 1"]
    for T in poses.values():
        flipped = np.diag([1.0, -1.0, -1.0]) @ T[:3]
        lines += [numbers([focal, *radial]), *matrix_text(flipped[:, :3]), numbers(flipped[:, 3])]
    lines += ["0 0 0"] * 5 + ["1.5 2.5 3.5", "9 8 7", "1 0 3 4.5 -5.5"]
    write_lines(opensfm / f"bundler/list_r{number:03d}.out", [*poses, lost])
    return write_lines(opensfm / f"bundler/bundle_r{number:03d}.out", lines)


def write_photographs(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """The images and depth files of photographs, in images/ and depth/."""
    names = [f"DJI_{k:04d}" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.npy", frame.depth)
        save(folder / f"images/{name}.png", frame.color)
    return names


def write_metashape(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A local chunk of Metashape whose component is turned, moved and scaled."""
    names = write_photographs(folder, frames)
    write_metashape_xml(
        folder / "cameras.xml",
        {f"{name}.png": frame.T_wc for name, frame in zip(names, frames, strict=True)},
        four(frames[0]),
        (W, H),
    )
    return names


def write_metashape_xml(
    path: Path,
    poses: dict[str, np.ndarray],
    camera: Sequence[float],
    size: tuple[int, int],
    *,
    reference: str = "LOCAL_CS[]",
    scale: float = 2.5,
    **more: float,
) -> None:
    """Poses camera to world, fx, fy, cx, cy with the first pixel at 0, and coefficients by Metashape's names."""
    turn, move = Rotation.from_euler("xyz", [20, -30, 40], degrees=True).as_matrix(), np.array([5.0, -7.0, 3.0])
    fx, fy, cx, cy = camera
    values = {"f": fy, "cx": cx - (size[0] - 1) / 2, "cy": cy - (size[1] - 1) / 2, "b1": fx - fy} | more
    cameras = []
    for k, (name, T) in enumerate(poses.items()):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turn.T @ T[:3, :3], turn.T @ (T[:3, 3] - move) / scale
        head = f'<camera id="{k}" sensor_id="0" component_id="0" label="{name}">'
        cameras.append(f"{head}<transform>{numbers(local)}</transform></camera>")
    wrong = "<calibration class='initial'><f>1</f></calibration>"
    adjusted = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors><sensor id="0" label="FC6310" type="frame"><resolution width="{size[0]}" height="{size[1]}"/>{wrong}
<calibration type="frame" class="adjusted"><resolution width="{size[0]}" height="{size[1]}"/>{adjusted}</calibration>
</sensor></sensors>
<components><component id="0"><transform><rotation>{numbers(turn)}</rotation><translation>{numbers(move)}</translation>
<scale>{scale!r}</scale></transform></component></components>
<cameras><group id="0" label="all">{"".join(cameras[::2])}</group>{"".join(cameras[1::2])}
<camera id="99" sensor_id="0" label="lost"/></cameras>
<reference>{reference}</reference></chunk></document>
""")


def write_pix4d(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """The folder params of a project of Pix4D, without a projection."""
    names = write_photographs(folder, frames)
    poses = {f"{name}.png": frame.T_wc for name, frame in zip(names, frames, strict=True)}
    write_pix4d_parameters(folder / "1_initial/params", poses, four(frames[0]), (W, H))
    return names


def write_pix4d_parameters(
    folder: Path,
    poses: dict[str, np.ndarray],
    camera: Sequence[float],
    size: tuple[int, int],
    radial=(0.0, 0.0, 0.0),
    tangential=(0.0, 0.0),
) -> None:
    fx, fy, cx, cy = camera
    lines = [
        "fileName imageWidth imageHeight", "camera matrix K [3x3]", "radial distortion [3x1]",
        "tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]",
        "camera model m = K [R|-Rt] X", "",
    ]  # fmt: skip
    for name, T in poses.items():
        lines += [f"{name} {size[0]} {size[1]}", numbers([fx, 0, cx + 0.5]), numbers([0, fy, cy + 0.5]), "0 0 1"]
        lines += [numbers(radial), numbers(tangential), numbers(T[:3, 3]), *matrix_text(T[:3, :3].T)]
    write_lines(folder / "flight_calibrated_camera_parameters.txt", lines)


def write_realitycapture(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """The CSV of RealityCapture."""
    names = write_photographs(folder, frames)
    write_realitycapture_csv(
        folder / "registration.csv",
        {f"{n}.png": f.T_wc for n, f in zip(names, frames, strict=True)},
        four(frames[0]),
        (W, H),
    )
    return names


def write_realitycapture_csv(
    path: Path, poses: dict[str, np.ndarray], camera: Sequence[float], size: tuple[int, int], k1: float = 0.0
) -> None:
    """Angles of a camera that looks down with the top of its image to the north where they are 0."""
    fx, fy, cx, cy = camera
    assert fx == fy
    unit = 36 / max(size)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, T in poses.items():
        yaw, pitch, roll = Rotation.from_matrix(with_axes(T, "opengl")[:3, :3]).as_euler("ZXY", degrees=True)
        offset = [(cx - (size[0] - 1) / 2) * unit, (cy - (size[1] - 1) / 2) * unit]
        values = [*T[:3, 3], -yaw, pitch, roll, fx * unit, *offset, k1, 0, 0, 0, 0, 0]
        lines.append(",".join([name, *(repr(float(value)) for value in values)]))
    write_lines(path, lines)


def write_uavscenes(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A flight of UAVScenes, with depth images: the poses of ten times as many frames as have a photograph."""
    names = [f"{1658137057 + k // 2}.{k % 2}41204937" for k in range(len(frames))]
    cameras = []
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"interval5_CAM/{name}.jpg", frame.color)
        save(folder / f"depth/{name}.npy", frame.depth)
        cameras += [uavscenes_camera(f"{name}.jpg", frame), uavscenes_camera(f"{name}5.jpg", frame)]
    (folder / "sampleinfos_interpolated.json").write_text(json.dumps(cameras))
    return names


def uavscenes_camera(name: str, frame: Frame, lens=(0.0, 0.0, 0.0, 0.0, 0.0)) -> dict[str, object]:
    """A camera of sampleinfos_interpolated.json; the lens is k1, k2, p1, p2, k3."""
    distortion = dict(zip(("K1", "K2", "P1", "P2", "K3"), lens, strict=True))
    return {
        "OriginalImageName": name, "T4x4": frame.T_wc.tolist(), "P3x3": frame.intrinsics.matrix.tolist(),
        "Width": frame.shape[1], "Height": frame.shape[0], **distortion,
    }  # fmt: skip


def write_stray_scanner(folder: Path, frames: Sequence[Frame], *, own_intrinsics: bool = True) -> list[str]:
    """With intrinsics of each frame, or with those of the file alone; the images of the video in rgb/."""
    names = [f"{k:06d}" for k in range(len(frames))]
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy" * own_intrinsics]
    for k, (name, frame) in enumerate(zip(names, frames, strict=True)):
        save(folder / f"depth/{name}.png", stored(frame, 1000))
        save(folder / f"confidence/{name}.png", np.full(frame.depth.shape, 1 + k % 2, np.uint8))
        save(folder / f"rgb/{name}.png", frame.color)
        values = [*frame.T_wc[:3, 3], *quaternion(frame.T_wc[:3, :3]), *(four(frame) if own_intrinsics else ())]
        lines.append(", ".join([repr(k / 60), name, *(repr(float(value)) for value in values)]))
    write_lines(folder / "odometry.csv", lines)
    matrix = frames[0].intrinsics.matrix * (
        np.ones((3, 3)) if not own_intrinsics else [[2, 1, 2], [1, 2, 2], [1, 1, 1]]
    )
    write_lines(folder / "camera_matrix.csv", [", ".join(map(repr, map(float, row))) for row in matrix])
    return names


def write_polycam(folder: Path, frames: Sequence[Frame], *, corrected: bool = True) -> list[str]:
    """OpenGL axes, principal point from the corner."""
    names, kind = [f"{9380 + 77 * k}" for k in range(len(frames))], "corrected_" * corrected
    for name, frame in zip(names, frames, strict=True):
        T, (fx, fy, cx, cy) = with_axes(frame.T_wc, "opengl"), four(frame)
        content = {f"t_{i}{j}": T[i, j] for i in range(3) for j in range(4)} | {"blur_score": 92.1, "timestamp": name}
        content |= {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5, "width": W, "height": H}
        save(folder / f"keyframes/depth/{name}.png", stored(frame, 1000))
        save(folder / f"keyframes/confidence/{name}.png", np.full(frame.depth.shape, 255, np.uint8))
        save(folder / f"keyframes/{kind}images/{name}.jpg", frame.color)
        cameras = folder / f"keyframes/{kind}cameras"
        cameras.mkdir(parents=True, exist_ok=True)
        (cameras / f"{name}.json").write_text(json.dumps(content))
    return names


def write_record3d(folder: Path, frames: Sequence[Frame], *, own_intrinsics: bool = False) -> list[str]:
    """OpenGL axes, K column by column; depth in metres."""
    names = [str(k) for k in range(len(frames))]
    poses = [with_axes(frame.T_wc, "opengl") for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        save(folder / f"depth/{name}.npy", frame.depth)  # converted, as not every OpenCV reads the app's EXR
        save(folder / f"rgb/{name}.jpg", frame.color)
    K = np.add(frames[0].intrinsics.matrix, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    content = {
        "K": (K * (2 if own_intrinsics else 1)).T.ravel().tolist(), "w": W, "h": H, "dw": W, "dh": H, "fps": 60,
        "poses": [[*quaternion(T[:3, :3]).tolist(), *T[:3, 3].tolist()] for T in poses],
    }  # fmt: skip
    if own_intrinsics:
        content["perFrameIntrinsicCoeffs"] = [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]] * len(frames)
    (folder / "metadata.json").write_text(json.dumps(content))
    return names


def write_arkitscenes(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """A pose of the world to the camera before and after each image, of the image's; intrinsics of each."""
    names = [f"41069021_{305.377 + 0.5 * k:.3f}" for k in range(len(frames))]
    trajectory = []
    for k, (name, frame) in enumerate(zip(names, frames, strict=True)):
        save(folder / f"lowres_depth/{name}.png", stored(frame, 1000))
        save(folder / f"confidence/{name}.png", np.full(frame.depth.shape, 2, np.uint8))
        save(folder / f"lowres_wide/{name}.png", frame.color)
        write_lines(folder / f"lowres_wide_intrinsics/{name}.pincam", [f"{W} {H} {numbers(four(frame))}"])
        T_cw = np.linalg.inv(frame.T_wc)
        pose = numbers([*Rotation.from_matrix(T_cw[:3, :3]).as_rotvec(), *T_cw[:3, 3]])
        trajectory += [f"{305.377 + 0.5 * k + apart:.4f} {pose}" for apart in (-0.05, 0.05)]
    write_lines(folder / "lowres_wide.traj", trajectory)
    return names


def shot(frame: Frame, camera: str) -> dict[str, object]:
    T_cw = np.linalg.inv(frame.T_wc)
    rotation = Rotation.from_matrix(T_cw[:3, :3]).as_rotvec().tolist()
    return {"camera": camera, "rotation": rotation, "translation": T_cw[:3, 3].tolist()}


def write_reconstruction(folder: Path, parts: Sequence[tuple[dict[str, dict], dict]], size=(W, H)) -> Path:
    """OpenSfM's, of cameras and shots; cameras have that size."""
    sized = [
        ({name: {"width": size[0], "height": size[1]} | values for name, values in c.items()}, s) for c, s in parts
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": c, "shots": s, "points": {}} for c, s in sized]))
    return path


def write_rosbag2(folder: Path, frames: Sequence[Frame], container: str = "sqlite3") -> list[str]:
    """A rosbag2, depth and colour as raw images, poses on /tf; the folder may be there."""
    bags.write_bag(folder, container, lambda ros: bags.records(ros, frames))
    return bags.names_of(len(frames))


Writer = Callable[[Path, Sequence[Frame]], list[str]]


@dataclasses.dataclass(frozen=True)
class Format:
    """A dataset: its name, its writer, the depth scale that it stores (None: floats), and options that it needs.

    `sizes_in_images`: the size of an image stands in no other file. `floats`: it stores floats, which hold what the
    scale says. `within`: what the name of a scene has after those of its folders.
    """

    dataset: str
    write: Writer
    scale: float | None
    options: dict[str, object] = dataclasses.field(default_factory=dict)
    sizes_in_images: bool = False
    floats: bool = False
    within: str = ""


def camera_option() -> list[float]:
    return four(city()[0])


FORMATS = {
    "posed_folder": Format("posed_folder", write_posed_folder, 1000),
    "hololens": Format("hololens", write_hololens, 1000),
    "seven_scenes": Format("seven_scenes", write_seven_scenes, 1000, {"intrinsics": camera_option}),
    "scannet": Format("scannet", write_scannet, 1000, {"color_size": (2 * W, 2 * H)}),
    "replica, NICE-SLAM": Format("replica", write_replica, 6553.5),
    "replica, Semantic-NeRF": Format("replica", write_semantic_nerf, 1000, {"intrinsics": camera_option}),
    "tum": Format("tum", write_tum, 5000, {"intrinsics": camera_option}),
    "transforms_json, nerfstudio": Format("transforms_json", write_transforms, 1000),
    "transforms_json, instant-ngp": Format(
        "transforms_json", functools.partial(write_transforms, program="instant-ngp"), 4000
    ),
    "colmap, text": Format("colmap", write_colmap, None),
    "colmap, binary": Format("colmap", functools.partial(write_colmap, binary=True, model="sparse/0"), None),
    "odm": Format("odm", write_odm, None),
    "odm, NVM": Format("odm", functools.partial(write_exported, kind="nvm"), None, sizes_in_images=True),
    "odm, Bundler": Format("odm", functools.partial(write_exported, kind="bundle"), None, sizes_in_images=True),
    "metashape": Format("metashape", write_metashape, None),
    "pix4d": Format("pix4d", write_pix4d, None),
    "realitycapture": Format("realitycapture", write_realitycapture, None, {"image_size": (W, H)}),
    "uavscenes": Format("uavscenes", write_uavscenes, None),
    "stray_scanner": Format("stray_scanner", write_stray_scanner, 1000, {"image_size": (W, H)}),
    "polycam": Format("polycam", write_polycam, 1000),
    "record3d": Format("record3d", write_record3d, None),
    "arkitscenes": Format("arkitscenes", write_arkitscenes, 1000),
    "bag, sqlite3": Format("bag", write_rosbag2, 1000),
    "bag, MCAP": Format("bag", functools.partial(write_rosbag2, container="MCAP"), 1000),
    "midair": Format(
        "midair",
        write_midair,
        256,
        {"intrinsics": camera_option, "depth_kind": "planar"},
        floats=True,
        within="-trajectory_0000",
    ),
    "hypersim": Format(
        "hypersim", write_hypersim, 256, {"intrinsics": camera_option, "depth_kind": "planar"}, floats=True
    ),
    "habitat": Format("habitat", write_habitat, 1000, {"intrinsics": camera_option}),
    "virtual_kitti": Format("virtual_kitti", write_virtual_kitti, 100),
    "airsim": Format("airsim", write_airsim, None, {"intrinsics": camera_option}, sizes_in_images=True),
    "carla": Format("carla", write_carla, BITS_24, {"intrinsics": camera_option}, sizes_in_images=True),
    "carla, KITTI-CARLA": Format(
        "carla", write_kitti_carla, BITS_24, {"intrinsics": camera_option}, sizes_in_images=True
    ),
    "syndrone": Format("syndrone", write_syndrone, 65.535, {"intrinsics": camera_option}),
    "tartanair": Format("tartanair", write_tartanair, None, {"intrinsics": camera_option}),
    "tartanair, V2": Format(
        "tartanair", functools.partial(write_tartanair, side="lcam_front"), None, {"intrinsics": camera_option}
    ),
}


def opened(form: Format, root: Path, **options):
    """The only scene of a dataset that was written, with the options that its format needs."""
    needed = {key: value() if callable(value) else value for key, value in form.options.items()}
    dataset = open_dataset(form.dataset, {"root": root, "classes": CLASSES} | needed | options)
    (name,) = dataset.scenes
    return dataset.scene(name)


def write_labelled(form: Format, folder: Path) -> tuple[list[str], list[Frame]]:
    """Names and frames of a scene that is written with its label maps."""
    frames = source(form.scale)
    names = form.write(folder, frames)
    write_labels(folder, names, frames)
    return names, frames
