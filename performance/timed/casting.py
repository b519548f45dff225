"""CPU time of depth that is cast at a surface: of embree, of Open3D, and of a frame as a scene yields it.

A camera looks down at hills. 'frame' is what reading it costs beside the tree, which is built once: rays, cast, and
writing it to the folder of casts; 'again' is reading that file. Seconds are CPU time of all threads, medians.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import measuring
import numpy as np
import open3d as o3d
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from semstab.data.frames import Intrinsics
from semstab.datasets.files.surfaces import CameraView, Surface

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


def main(size: str = "4000x2250", triangles: int = 400_000, rounds: int = 3) -> Any:
    W, H = measuring.sides(size)
    vertices, faces = hills(triangles)
    K = Intrinsics(0.745 * W, 0.745 * W, (W - 1) / 2, (H - 1) / 2)
    T_wc = np.diag([1.0, -1, -1, 1])
    T_wc[2, 3] = HEIGHT
    views = [CameraView(K, T_wc + 0.1 * k * np.eye(4)[:, 3:] * [[0, 0, 0, 1]], (H, W)) for k in range(rounds)]
    v, u = np.mgrid[:H, :W]
    rays = np.stack([(u - K.cx) / K.fx, -(v - K.cy) / K.fy, np.full((H, W), -1.0)], axis=-1).astype(np.float32)
    rays = rays.reshape(-1, 3)
    origins = np.broadcast_to(np.float32([0, 0, HEIGHT]), rays.shape)
    embree = EmbreeScene(robust=True)
    TriangleMesh(embree, vertices.astype(np.float32), faces.astype(np.int32))
    embree.run(origins[:1], rays[:1], query="DISTANCE")
    theirs = o3d.t.geometry.RaycastingScene()
    theirs.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32)))
    both = o3d.core.Tensor(np.concatenate([origins, rays], axis=1))
    theirs.cast_rays(both[:1])

    table = measuring.MarkdownTable(step="", CPU_s=".2f", of_the_bare_cast=".2f")

    def say(step: str, *ms: float) -> None:
        seconds = median(ms) / 1e3
        table.add(
            step=step,
            CPU_s=seconds,
            of_the_bare_cast=seconds / max(table.rows[0]["CPU_s"] if table.rows else seconds, 1e-9),
        )

    def timed(work: Callable[[], object]) -> list[float]:
        return [measuring.cpu_ms(work) for _ in range(rounds)]

    say("embree, bare", *timed(lambda: embree.run(origins, rays, query="DISTANCE")))
    say("Open3D, bare", *timed(lambda: theirs.cast_rays(both)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hills.ply"
        trimesh.Trimesh(vertices, faces, process=False).export(path)

        def built() -> Surface:
            surface = Surface(path, casts=Path(folder))
            surface.depth(CameraView(K, T_wc, (2, 2)))
            return surface

        say("reading the mesh, building the tree", measuring.cpu_ms(built))
        surface = built()
        for step in ("frame", "again"):
            say(step, *(measuring.cpu_ms(surface.depth, view) for view in views))
        bytes_of_cast = max(file.stat().st_size for file in Path(folder).rglob("*.cast"))
    print(f"\n{size}, {len(faces):,} triangles; {bytes_of_cast / 1e6:.1f} MB a kept cast")
    return table.rows
