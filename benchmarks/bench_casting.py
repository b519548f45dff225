"""CPU time of depth that is cast at a surface: of embree, of Open3D, and of a frame as a scene yields it.

    python benchmarks/bench_casting.py [--json FILE] [--size 4000x2250] [--triangles 400000] [--rounds 3]

A camera looks down at hills. 'frame' is what reading it costs beside the tree, which is built once: rays, cast, and
writing it to the folder of casts; 'again' is reading that file. Seconds are CPU time of all threads, medians.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from semstab.core.files import write_json
from semstab.data.frames import Intrinsics
from semstab.datasets.files.surfaces import Surface, View

HEIGHT = 45.0


def hills(triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces."""
    n = math.isqrt(triangles // 2) + 1
    at = np.linspace(-60, 60, n)
    x, y = np.meshgrid(at, at)
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x, y, 2 * np.sin(x / 5) * np.cos(y / 7)], axis=-1).reshape(-1, 3), faces


def seconds(action: Callable[[], Any], rounds: int) -> float:
    """CPU time of all threads, the median."""
    times = []
    for _ in range(rounds):
        before = os.times()
        action()
        after = os.times()
        times.append(after.user + after.system - before.user - before.system)
    return median(times)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="also write the figures there")
    parser.add_argument("--size", default="4000x2250")
    parser.add_argument("--triangles", type=int, default=400_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    W, H = map(int, arguments.size.split("x"))
    vertices, faces = hills(arguments.triangles)
    K = Intrinsics(0.745 * W, 0.745 * W, (W - 1) / 2, (H - 1) / 2)
    T_wc = np.diag([1.0, -1, -1, 1])
    T_wc[2, 3] = HEIGHT
    views = [View(K, T_wc + 0.1 * k * np.eye(4)[:, 3:] * [[0, 0, 0, 1]], (H, W)) for k in range(arguments.rounds)]
    v, u = np.mgrid[:H, :W]
    rays = np.stack([(u - K.cx) / K.fx, -(v - K.cy) / K.fy, np.full((H, W), -1.0)], axis=-1).astype(np.float32)
    rays = rays.reshape(-1, 3)
    origins = np.broadcast_to(np.float32([0, 0, HEIGHT]), rays.shape)
    rows = {}

    embree = EmbreeScene(robust=True)
    TriangleMesh(embree, vertices.astype(np.float32), faces.astype(np.int32))
    embree.run(origins[:1], rays[:1], query="DISTANCE")
    rows["embree, bare"] = seconds(lambda: embree.run(origins, rays, query="DISTANCE"), arguments.rounds)
    rows["Open3D, bare"] = _open3d(vertices, faces, origins, rays, arguments.rounds)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hills.ply"
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        started = time.process_time()
        surface = Surface(path, casts=Path(folder))
        surface.depth(View(K, T_wc, (2, 2)))
        rows["reading the mesh, building the tree"] = time.process_time() - started
        waiting = iter(views)
        rows["frame"] = seconds(lambda: surface.depth(next(waiting)), arguments.rounds)
        waiting = iter(views)
        rows["again"] = seconds(lambda: surface.depth(next(waiting)), arguments.rounds)
        size = max(file.stat().st_size for file in Path(folder).rglob("*.cast"))
    print(f"{arguments.size}, {len(faces):,} triangles; {size / 1e6:.1f} MB a kept cast")
    for name, value in rows.items():
        print(f"{name:>36} {value:8.2f} s")
    print(f"{'frame over the bare cast':>36} {rows['frame'] / max(rows['embree, bare'], 1e-9):8.2f}")
    if arguments.json:
        write_json(arguments.json, {"size": arguments.size, "triangles": len(faces), "seconds": rows})


def _open3d(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, rays: np.ndarray, rounds: int) -> float:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    both = o3d.core.Tensor(np.concatenate([origins, rays], axis=1))
    scene.cast_rays(both[:1])
    return seconds(lambda: scene.cast_rays(both), rounds)


if __name__ == "__main__":
    main()
