"""Labelled maps as other programs write them: a mesh with colours as Kimera-Semantics, clouds, voxel maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from semstab import VoxelTable
from semstab.metrics import dominant


def cloud(path: Path, points: np.ndarray, label: np.ndarray, name: str = "label") -> Path:
    """Write a PLY cloud with whole numbers as classes, without names, in ASCII as many programs do."""
    rows = [f"{x!r} {y!r} {z!r} {k}" for (x, y, z), k in zip(points.tolist(), label.tolist(), strict=True)]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property double {a}" for a in "xyz")]
    path.write_text("\n".join([*header, f"property int {name}", "end_header", *rows, ""]))
    return path


def kimera_mesh(path: Path, table: VoxelTable, colors: dict[str, tuple[int, int, int]], side: float = 0.98) -> Path:
    """Write the voxels as a mesh of cubes' front faces, whose vertices have the colours of the classes.

    Kimera-Semantics writes such a mesh: triangles, and no field but the colour.
    """
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side * table.voxel_size / 2
    vertices = (table.centers[:, None] + corners).reshape(-1, 3)
    first = 4 * np.arange(len(table))[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    rgb = np.array([colors[table.classes[k]] for k in dominant(table)], np.uint8)
    vertex_colors = np.column_stack([np.repeat(rgb, 4, axis=0), np.full(len(vertices), 255, np.uint8)])
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=vertex_colors, process=False)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh))
    return path
