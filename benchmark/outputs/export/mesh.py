"""GLB: the voxels as cubes in the colours of their classes, for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError
from semstab.outputs.export.voxels import Voxels, crs_name
from semstab.outputs.plots.topdown import level_axes
from semstab.runtime.files import atomic_path

Int64 = npt.NDArray[np.int64]

SIDES = np.array([
    [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]], [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
    [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
    [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
])  # fmt: skip
"""(6, 4, 3) corners of a cube's sides, seen from outside against the clock: +x, -x, +y, -y, +z, -z."""

NEIGHBOURS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
LARGEST = 2**40
"""Cells that the voxels may span: corners are packed into one number."""


def write(voxels: Voxels, path: Path) -> None:
    """The sides of voxels that no other voxel hides. glTF is in single precision: coordinates count from `origin`.

    The scene's extras say where that is. glTF's y is up, where the scene's up axis is known.
    Raises ConfigError where the voxels span too much.
    """
    import trimesh

    index = voxels.table.index.astype(np.int64)
    low = index.min(axis=0)
    corner, label, quads = _sides(index - low, voxels.classified.astype(np.int64) - 1)
    vertices = corner * voxels.table.voxel_size @ _to_gltf(voxels.up).T
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    colors = np.concatenate([voxels.colors[label], np.full((len(label), 1), 255, np.uint8)], axis=1)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    where = "the scene" if voxels.georeference is None else crs_name(voxels.georeference)
    extras = {
        "origin": (low * voxels.table.voxel_size + voxels.offset).tolist(),
        "coordinates": where,
        "voxel_size": voxels.table.voxel_size,
        "classes": list(voxels.classes),
    }
    scene: Any = trimesh.Scene(mesh, metadata=extras)
    with atomic_path(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb"))


def _sides(index: Int64, label: Int64) -> tuple[Int64, Int64, Int64]:
    """Corners (v, 3) with their class (v,), and the sides (m, 4) between them, that are not between two voxels."""
    size = index.max(axis=0) + 3  # a cell more on each side: every neighbour has a key
    if int(np.prod(size.astype(object))) >= LARGEST:
        raise ConfigError(
            f"the voxels span {' x '.join(map(str, size))}: too much for a mesh; choose with --class, --min-op"
        )
    step = np.array([size[1] * size[2], size[2], 1])
    keys = (index + 1) @ step
    K, parts = int(label.max()) + 1, []
    for side, neighbour in zip(SIDES, NEIGHBOURS, strict=True):
        open_ = ~np.isin(keys + neighbour @ step, keys, assume_unique=True)
        corner = (index[open_][:, None] + side) @ step
        parts.append(corner * K + label[open_][:, None])
    found, quads = np.unique(np.concatenate(parts), return_inverse=True)
    return np.stack(np.unravel_index(found // K, tuple(size)), axis=1), found % K, quads.reshape(-1, 4)


def _to_gltf(up: tuple[float, float, float] | None) -> npt.NDArray[np.float64]:
    """(3, 3) from the scene's axes to glTF's: x right, y up, z towards the viewer."""
    if up is None:
        return np.eye(3)
    right, ahead, above = level_axes(up)
    return np.stack([right, above, -ahead])
