"""Rays cast at triangles with embree: the depth of each pixel of a camera.

Measured against Open3D's RaycastingScene, 4000x2250 pixels on 397,832 triangles, CPU time in one run: embree 1.02 s,
Open3D 1.23 s; and embree lets other threads work meanwhile, which Open3D's binding does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.datasets.surfaces.triangles import Triangles
from semstab.model.frames import Intrinsics

Float32 = npt.NDArray[np.float32]

RAYS_AT_ONCE = 2**18
"""What bounds the memory of a large image."""

FAR = 1e30
"""Beyond it is what embree says of a ray that hits nothing."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera at a place: T_wc (4, 4) camera-to-world, and its image of shape (H, W)."""

    intrinsics: Intrinsics
    T_wc: npt.NDArray[np.float64]
    shape: tuple[int, int]


class Caster:
    """Triangles to cast rays at, from several threads at once."""

    def __init__(self, triangles: Triangles) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._centre = triangles.bounds.mean(axis=0)  # embree counts in float32
        self._scene: Any = EmbreeScene(robust=True)
        TriangleMesh(self._scene, (triangles.vertices - self._centre).astype(np.float32), triangles.faces)
        nothing = np.zeros((1, 3), dtype=np.float32)
        self._scene.run(nothing, nothing + 1, query="DISTANCE")  # builds the tree, which one thread must do

    def depth(self, view: View) -> Float32:
        """Depth (H, W) along the optical axis in metres, 0 where a ray hits nothing."""
        (H, W), K, R = view.shape, view.intrinsics, view.T_wc[:3, :3]
        x = (np.arange(W) - K.cx) / K.fx
        y = (np.arange(H) - K.cy) / K.fy
        along_row = [(R[axis, 0] * x).astype(np.float32) for axis in range(3)]
        along_column = [(R[axis, 1] * y + R[axis, 2]).astype(np.float32) for axis in range(3)]
        rows = max(1, RAYS_AT_ONCE // W)
        origins = np.broadcast_to((view.T_wc[:3, 3] - self._centre).astype(np.float32), (rows * W, 3))
        depth = np.empty((H, W), dtype=np.float32)
        directions = np.empty((rows, W, 3), dtype=np.float32)
        for top in range(0, H, rows):
            count = min(rows, H - top)
            for axis in range(3):
                np.add(along_row[axis], along_column[axis][top : top + count, None], out=directions[:count, :, axis])
            rays = directions[:count].reshape(-1, 3)  # of length 1 along the optical axis: distances are depth
            depth[top : top + count] = self._scene.run(origins[: len(rays)], rays, query="DISTANCE").reshape(-1, W)
        depth[depth > FAR] = 0
        return depth
