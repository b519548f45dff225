"""GLB: the voxels as cubes in the colours of their classes, for a browser."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import atomic_path
from semstab.core.types import Float64, Int64, UInt8
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

MOST_BYTES = 2**32 - 2**20
"""Of the meshes in a GLB file."""


def write(chosen: Chosen, path: Path) -> int:
    """The sides of voxels that no other voxel hides, a mesh for each tile; how many voxels there are.

    glTF is in single precision: coordinates count from `origin`, and the scene's extras say where that is. glTF's y is
    up, where the scene's up axis is known.
    Raises ConfigError where the voxels span too much, or are too many for a file.
    """
    corners = {place: chosen[place].table.index.min(axis=0).astype(np.int64) for place in chosen.places()}
    some, low = chosen.first, np.min([*corners.values()], axis=0)
    where = "the scene" if some.georeference is None else crs_name(some.georeference)
    extras = {
        "origin": (low * some.table.voxel_size + some.offset).tolist(),
        "coordinates": where,
        "voxel_size": some.table.voxel_size,
        "classes": list(some.classes),
    }
    written, to_gltf = 0, some.table.voxel_size * _to_gltf(some.up).T
    with atomic_path(path) as temporary, Glb(temporary, extras) as file:
        for place in corners:
            voxels = chosen[place]
            corner, label, quads = _sides(
                voxels.table.index - low, voxels.classified.astype(np.int64) - 1, _beside(chosen, place) - low
            )
            colors = np.concatenate([some.colors[label], np.full((len(label), 1), 255, np.uint8)], axis=1)
            if len(quads):
                file.add(corner @ to_gltf, colors, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
            written += len(voxels.table)
    return written


def _beside(chosen: Chosen, place: Place) -> Int64:
    """The voxels (n, 3) of the tiles around one that may touch it."""
    found, size = [np.zeros((0, 3), np.int64)], chosen.size
    for (dx, dy), axis, at in (((1, 0), 0, 0), ((-1, 0), 0, -1), ((0, 1), 1, 0), ((0, -1), 1, -1)):
        other = place[0] + dx, place[1] + dy
        if size is not None and other in chosen:
            index = chosen[other].table.index.astype(np.int64)
            found.append(index[index[:, axis] % size == at % size])
    return np.concatenate(found)


def _sides(index: Int64, label: Int64, beside: Int64) -> tuple[Int64, Int64, Int64]:
    """Corners (v, 3) with their class (v,), and the sides (m, 4) between them, that are not between two voxels.

    beside  (b, 3) voxels that hide sides, and have none here
    """
    low = index.min(axis=0) - 1
    size = index.max(axis=0) - low + 3  # a cell more on each side: every neighbour has a key
    if int(np.prod(size.astype(object))) >= LARGEST:
        raise ConfigError(
            f"the voxels span {' x '.join(map(str, size))}: too much for a mesh; choose with --class, --min-op"
        )
    step = np.array([size[1] * size[2], size[2], 1])
    near = beside[((beside >= low) & (beside < low + size)).all(axis=1)]
    keys, hiding = (index - low) @ step, (np.concatenate([index, near]) - low) @ step
    K, parts = int(label.max()) + 1, []
    for side, neighbour in zip(SIDES, NEIGHBOURS, strict=True):
        open_ = ~np.isin(keys + neighbour @ step, hiding)
        corner = (index[open_][:, None] - low + side) @ step
        parts.append(corner * K + label[open_][:, None])
    found, quads = np.unique(np.concatenate(parts), return_inverse=True)
    return np.stack(np.unravel_index(found // K, tuple(size)), axis=1) + low, found % K, quads.reshape(-1, 4)


class Glb:
    """A binary glTF file that takes meshes one after the other; none is kept in memory."""

    def __init__(self, path: Path, extras: Mapping[str, Any]) -> None:
        self._path, self._extras = path, extras
        self._binary = path.with_name(f"{path.name}.bin")
        self._file = self._binary.open("wb")
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []

    def __enter__(self) -> Glb:
        return self

    def __exit__(self, kind: object, *further: object) -> None:
        self._file.close()
        try:
            if kind is None:
                self._join()
        finally:
            self._binary.unlink()

    def add(self, vertices: Float64, colors: UInt8, faces: Int64) -> None:
        """A mesh of vertices (v, 3) with colours (v, 4) and triangles (f, 3)."""
        points = vertices.astype("<f4")
        box = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        primitive = {
            "attributes": {
                "POSITION": self._array(points, 5126, "VEC3", 34962, box),
                "COLOR_0": self._array(colors, 5121, "VEC4", 34962, {"normalized": True}),
            },
            "indices": self._array(faces.astype("<u4").reshape(-1, 1), 5125, "SCALAR", 34963, {}),
        }
        self._meshes.append({"primitives": [primitive]})

    def _array(self, values: npt.NDArray[Any], component: int, kind: str, target: int, more: dict[str, Any]) -> int:
        start = self._file.tell()
        if start + values.nbytes >= MOST_BYTES:
            raise ConfigError("the mesh would be larger than a GLB file may be, 4 GB; choose with --class, --min-op")
        self._file.write(values.tobytes())
        self._views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": target})
        self._accessors.append(
            {"bufferView": len(self._views) - 1, "componentType": component, "count": len(values), "type": kind, **more}
        )
        return len(self._accessors) - 1

    def _join(self) -> None:
        numbers = list(range(len(self._meshes)))
        content = {
            "asset": {"version": "2.0", "generator": "semstab"},
            "scene": 0,
            "scenes": [{"nodes": numbers, "extras": self._extras}],
            "nodes": [{"mesh": number} for number in numbers],
            "meshes": self._meshes,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._binary.stat().st_size}],
        }
        text = json.dumps(content).encode()
        text += b" " * (-len(text) % 4)
        size = self._binary.stat().st_size
        with self._path.open("wb") as file, self._binary.open("rb") as binary:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + size))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", size, b"BIN\0"))
            shutil.copyfileobj(binary, file)


def _to_gltf(up: tuple[float, float, float] | None) -> Float64:
    """(3, 3) from the scene's axes to glTF's: x right, y up, z towards the viewer."""
    if up is None:
        return np.eye(3)
    right, ahead, above = level_axes(up)
    return np.stack([right, above, -ahead])
