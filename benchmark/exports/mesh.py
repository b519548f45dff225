"""GLB: the voxels as cubes in the colours of their classes, for a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semstab.core.files import atomic_path
from semstab.core.types import Float64, Int64
from semstab.errors import ConfigError
from semstab.exports.voxels import Chosen, crs_name
from semstab.model.tiles import Place
from semstab.report.figures.topdown import level_axes

SIDES = np.array([
    [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]], [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
    [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
    [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
])  # fmt: skip
"""(6, 4, 3) corners of a cube's sides, seen from outside against the clock: +x, -x, +y, -y, +z, -z."""

NEIGHBOURS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
LARGEST = 2**40
"""Cells that the voxels of a tile may span: corners are packed into one number."""

MOST_BYTES = 2**31
"""Of the meshes of a file: glTF counts in 32 bits, and trimesh makes a file in memory."""


def write(chosen: Chosen, path: Path) -> int:
    """Write the sides of voxels that no other voxel hides, a mesh for each tile; return the number of voxels.

    glTF is in single precision: coordinates count from `origin`, and the scene's extras say where that is. glTF's y is
    up, where the scene's up axis is known.
    Raises ConfigError where the voxels span too much, or are too many for a file.
    """
    import trimesh

    corners = {place: chosen[place].table.index.min(axis=0).astype(np.int64) for place in chosen.places()}
    some, low = chosen.first, np.min([*corners.values()], axis=0)
    extras = {
        "origin": (low * some.table.voxel_size + some.offset).tolist(),
        "coordinates": "the scene" if some.georeference is None else crs_name(some.georeference),
        "voxel_size": some.table.voxel_size,
        "classes": list(some.classes),
    }
    scene = trimesh.Scene(metadata=extras)
    voxels, size, to_gltf = 0, 0, some.table.voxel_size * _to_gltf(some.up).T
    for place in corners:
        part = chosen[place]
        voxels += len(part.table)
        corner, label, quads = _sides(
            part.table.index - low, part.classified.astype(np.int64) - 1, _adjacent(chosen, place) - low
        )
        if not len(quads):
            continue
        size += 16 * len(corner) + 24 * len(quads)
        if size > MOST_BYTES:
            raise ConfigError("the mesh would be larger than 2 GB; choose with --class, --min-op")
        scene.add_geometry(
            trimesh.Trimesh(
                (corner @ to_gltf).astype(np.float32),
                np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint32),
                vertex_colors=some.colors[label],
                process=False,
            )
        )
    with atomic_path(path) as temporary:
        temporary.write_bytes(trimesh.exchange.gltf.export_glb(scene))  # type: ignore[no-untyped-call]
    return voxels


def _adjacent(chosen: Chosen, place: Place) -> Int64:
    """The voxels (n, 3) of the tiles around one that may touch it."""
    found, size = [np.zeros((0, 3), np.int64)], chosen.size
    for (dx, dy), axis, at in (((1, 0), 0, 0), ((-1, 0), 0, -1), ((0, 1), 1, 0), ((0, -1), 1, -1)):
        other = place[0] + dx, place[1] + dy
        if size is not None and other in chosen:
            index = chosen[other].table.index.astype(np.int64)
            found.append(index[index[:, axis] % size == at % size])
    return np.concatenate(found)


def _sides(index: Int64, label: Int64, adjacent: Int64) -> tuple[Int64, Int64, Int64]:
    """Corners (v, 3) with their class (v,), and the sides (m, 4) between them, that are not between two voxels.

    adjacent  (b, 3) voxels that hide sides, and have none here
    """
    low = index.min(axis=0) - 1
    size = index.max(axis=0) - low + 3  # a cell more on each side: every neighbour has a key
    if int(np.prod(size.astype(object))) >= LARGEST:
        raise ConfigError(
            f"the voxels span {' x '.join(map(str, size))}: too much for a mesh; choose with --class, --min-op"
        )
    step = np.array([size[1] * size[2], size[2], 1])
    near = adjacent[((adjacent >= low) & (adjacent < low + size)).all(axis=1)]
    keys, hiding = (index - low) @ step, (np.concatenate([index, near]) - low) @ step
    K, parts = int(label.max()) + 1, []
    for side, neighbour in zip(SIDES, NEIGHBOURS, strict=True):
        open_ = ~np.isin(keys + neighbour @ step, hiding)
        corner = (index[open_][:, None] - low + side) @ step
        parts.append(corner * K + label[open_][:, None])
    found, quads = np.unique(np.concatenate(parts), return_inverse=True)
    return np.stack(np.unravel_index(found // K, tuple(size)), axis=1) + low, found % K, quads.reshape(-1, 4)


def _to_gltf(up: tuple[float, float, float] | None) -> Float64:
    """(3, 3) from the scene's axes to glTF's: x right, y up, z towards the viewer."""
    if up is None:
        return np.eye(3)
    right, ahead, above = level_axes(up)
    return np.stack([right, above, -ahead])
