"""A tilted plane that cameras look down at: its depth is known, whatever file holds it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from semstab import Frame, Intrinsics

W, H = 24, 16
K = Intrinsics(20, 20, 11.5, 7.5)
SLOPE = (0.2, 0.1)
"""The plane is z = 0.2 x + 0.1 y, metres."""

HALF = 12
OFFSET = (576714.0, 5188162.0, 0.0)
UTM = "EPSG:32615"


def pose(k: int) -> np.ndarray:
    """Ten metres above, tilted by some degrees, a metre further each frame."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [180 + 4 * k, 3, 20], degrees=True).as_matrix()
    T[:3, 3] = [k, 0.5 * k, 10]
    return T


def plane_depth(T: np.ndarray, K: Intrinsics = K, shape: tuple[int, int] = (H, W)) -> np.ndarray:
    """Depth (H, W) of the plane: where the ray through each pixel meets it."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(shape)], axis=-1) @ T[:3, :3].T
    normal = np.array([*SLOPE, -1.0])
    return -(T[:3, 3] @ normal) / (rays @ normal)


def frame(k: int, K: Intrinsics = K, shape: tuple[int, int] = (H, W), detail: float = 1.0) -> Frame:
    """What a camera sees of the plane, on which there are spots, metres large where detail is 1."""
    T, depth = pose(k), plane_depth(pose(k), K, shape)
    v, u = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(shape)], axis=-1)
    x, y, _ = np.moveaxis((rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3], -1, 0)
    x, y = detail * x, detail * y
    spots = sum(np.sin(a * x + b * y + c) for a, b, c in ((1.1, 0.3, 0), (-0.4, 1.7, 1), (2.3, 1.1, 2), (0.9, -2.1, 3)))
    grey = (128 + 30 * spots).astype(np.uint8)
    ids = ((np.arange(shape[1]) + 3 * np.arange(shape[0])[:, None] + k) // 4 % 3).astype(np.uint8)
    return Frame(k, depth.astype(np.float32), K, T, labels=ids, color=np.stack([grey, grey // 2, 255 - grey], axis=-1))


def height(x, y):
    return SLOPE[0] * x + SLOPE[1] * y


def grid(step: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and height of points on the plane."""
    at = np.arange(-HALF, HALF + step / 2, step)
    x, y = np.meshgrid(at, at)
    return x, y, height(x, y)


def write_mesh(path: Path, shift=(0.0, 0.0, 0.0)) -> Path:
    x, y, z = grid()
    n = len(x)
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    path.parent.mkdir(parents=True, exist_ok=True)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) + shift
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


def write_points(path: Path) -> Path:
    points = np.stack(grid(0.25), axis=-1).reshape(-1, 3)
    trimesh.PointCloud(points).export(path)
    return path


def write_laz(path: Path) -> Path:
    """In the projection."""
    import laspy

    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales = [0.001] * 3
    las.header.offsets = OFFSET
    las.x, las.y, las.z = (part.ravel() + shift for part, shift in zip(grid(0.25), OFFSET, strict=True))
    las.write(path)
    return path


def write_raster(path: Path, crs: str = UTM, hole: bool = False, **more) -> Path:
    """In the projection; north up, so the first row is the northernmost."""
    import rasterio

    x, y, z = (part[::-1] for part in grid(0.5))
    z = z.astype(np.float32)
    if hole:
        z[len(z) // 2 - 3 : len(z) // 2 + 3] = -9999
    place = rasterio.transform.from_origin(x[0, 0] - 0.25 + OFFSET[0], y[0, 0] + 0.25 + OFFSET[1], 0.5, 0.5)
    about = {"driver": "GTiff", "height": len(z), "width": len(z), "count": 1, "dtype": "float32", "nodata": -9999}
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(path, "w", **about | {"crs": crs, "transform": place} | more) as file:
        file.write(z, 1)
    return path
