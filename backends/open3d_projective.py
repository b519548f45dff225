"""Backend `open3d-projective`: voxels look up their pixel, as Open3D's own integration does, instead of pixels theirs.

Each voxel near the surface is projected into the image, and where its centre lies within a band of the depth there, its
pixel is its one observation of the frame. An observation is no mean over pixels then, a pixel may speak for many
voxels, and voxels before and behind the surface take part: the map disagrees with those of the other backends by
design, and is compared with them, not checked against them.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import open3d.core as o3c
from open3d.t.geometry import PointCloud, VoxelBlockGrid

from semstab.backends.open3d_blocks import Open3DBlocks
from semstab.backends.shared.aggregator import Aggregator
from semstab.backends.shared.association import check_depth, check_frame
from semstab.backends.shared.keys import PARTITIONS
from semstab.backends.shared.observations import Observed
from semstab.core.types import Int64
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT
from semstab.errors import ConfigError, DataError

MARGIN = 1.25
"""Voxels beyond the band in which blocks are visited, from the centres of the voxels that hold a pixel's point: half a
voxel to the point, half a pixel from its ray to a voxel's centre, and what the ray's slant adds to the band."""

CHUNK = 2**20
"""Voxels projected at a time."""


class Open3DProjective(Open3DBlocks):
    """Projective association on the hashed voxel blocks of backend `open3d`.

    Visited are the blocks that come, along each axis, within band + 1.25 voxels of the centre of a voxel with a valid
    pixel's point in it: all that matter, where a pixel is no wider than a voxel. `pixels` counts the look-ups, one a
    voxel and frame, and so do the points that are reported.

    Attributes:
        band: half-width of the band around the surface, in voxels along the optical axis.
        device: As in Open3DBlocks.
        block_resolution: Likewise; between wider pixels it decides which voxels are visited.
    """

    pointwise = False
    """Pixels are not associated one by one: no agreement with the other backends is to be expected."""

    def __init__(
        self, voxel_size: float, num_classes: int, device: str = "CPU:0", block_resolution: int = 4, band: float = 1.0
    ) -> None:
        self.check_options(voxel_size, num_classes, device, block_resolution, band)
        super().__init__(voxel_size, num_classes, device, block_resolution)
        self._pixels = Projector(voxel_size, num_classes, block_resolution, band)

    @staticmethod
    def check_options(
        voxel_size: float, num_classes: int, device: str = "CPU:0", block_resolution: int = 4, band: float = 1.0
    ) -> None:
        """Raise ConfigError for settings that no map can have."""
        Open3DBlocks.check_options(voxel_size, num_classes, device, block_resolution)
        if not (math.isfinite(band) and band > 0):
            raise ConfigError(f"band = {band:g}: it must be positive, in voxels")


class Projector(Aggregator):
    """A projection of voxels that turns frames into observations; a key is the number of the voxel within the frame."""

    def __init__(self, voxel_size: float, num_classes: int, block_resolution: int, band: float) -> None:
        super().__init__(voxel_size, num_classes)
        self.block_resolution = block_resolution
        self.band = band
        self._index: Int64 = np.zeros((0, 3), dtype=np.int64)
        r = range(block_resolution)
        self._local = np.array([(x, y, z) for z in r for y in r for x in r], dtype=np.int64)
        self._blocks = VoxelBlockGrid(  # holds nothing: it knows which blocks points touch
            ("op",), (o3c.int32,), ((1,),), voxel_size, block_resolution, block_count=1, device=o3c.Device("CPU:0")
        )

    def observe(self, frame: Frame) -> Observed:
        """Return the frame's observations, one pixel each; the first frame's camera sets the origin.

        Raises:
            DataError: For a label outside the classes, or a point more than 2^20 voxels from the origin.
        """
        if frame.is_scan:
            raise DataError(
                f"{frame.where('points')}: backend 'open3d-projective' looks voxels up in an image, and a scan is"
                " none; fuse scans with numba, open3d, torch or numpy"
            )
        check_depth(frame)
        check_frame(frame, self.num_classes)
        blocks = self._touched(frame)
        step = max(1, CHUNK // len(self._local))
        parts = [self._in_band(frame, blocks[start : start + step]) for start in range(0, len(blocks), step)]
        self._index = np.concatenate([index for index, _ in parts] or [self._index[:0]])
        return self._observed(frame, np.concatenate([pixel for _, pixel in parts] or [np.zeros(0, dtype=np.int64)]))

    def index_of(self, key: Int64) -> Int64:
        """Return voxel indices (n, 3) of the last frame's keys."""
        return self._index[key]

    def _touched(self, frame: Frame) -> Int64:
        """Return blocks (n, 3) near the voxels that hold a point of a valid pixel, sorted.

        Open3D's own search among the pixels' points takes seconds for millions of points, or looks at each fourth
        pixel only. It computes in float32, so the voxels count from a block near the camera.
        """
        valid = np.where(frame.valid, np.uint8(0), np.uint8(IGNORE_8BIT))
        holding = super().index_of(super().observe(dataclasses.replace(frame, labels=valid, scores=None)).key)
        if not len(holding):
            return holding
        corner = np.floor(frame.T_wc[:3, 3] / (self.block_resolution * self.voxel_size)).astype(np.int64)
        centers = (holding - corner * self.block_resolution + 0.5) * self.voxel_size
        cloud = PointCloud(o3c.Tensor.from_numpy(centers.astype(np.float32)))
        reach = self.band + MARGIN
        touched = self._blocks.compute_unique_block_coordinates(cloud, trunc_voxel_multiplier=reach)
        blocks: Int64 = touched.numpy().astype(np.int64)
        return blocks[np.lexsort(blocks.T[::-1])] + corner

    def _in_band(self, frame: Frame, blocks: Int64) -> tuple[Int64, Int64]:
        """Return the blocks' voxels in the band: their indices (n, 3), and the flat index of the pixel of each."""
        H, W = frame.shape
        K, R_cw = frame.intrinsics, np.linalg.inv(frame.T_wc[:3, :3])
        corner = (blocks * self.block_resolution * self.voxel_size - frame.T_wc[:3, 3]) @ R_cw.T
        center = (self._local + 0.5) * self.voxel_size @ R_cw.T
        x, y, z = (np.add.outer(corner[:, i], center[:, i]) for i in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.floor(K.fx * (x / z) + (K.cx + 0.5))
            v = np.floor(K.fy * (y / z) + (K.cy + 0.5))
        inside = np.nonzero((z > 0) & (u >= 0) & (u < W) & (v >= 0) & (v < H))
        pixel = (v[inside] * W + u[inside]).astype(np.int64)
        sdf = frame.depth.reshape(-1)[pixel] - z[inside]
        near = frame.valid.reshape(-1)[pixel] & (np.abs(sdf) <= self.band * self.voxel_size)
        block, local = (positions[near] for positions in inside)
        return blocks[block] * self.block_resolution + self._local[local], pixel[near]

    def _observed(self, frame: Frame, pixel: Int64) -> Observed:
        """Return the evidence of the pixels (n,), each for its voxel: one label each, or K normalised scores."""
        n = len(pixel)
        if frame.labels is not None:
            labels, weights = frame.labels.reshape(-1)[pixel].astype(np.uint16), np.ones(n)
        else:
            scores: Any = frame.scores
            s = scores.reshape(-1, self.num_classes)[pixel].astype(np.float64)
            weights = (s / s.sum(axis=1, keepdims=True)).reshape(-1)
            labels = np.tile(np.arange(self.num_classes, dtype=np.uint16), n)
        start = np.arange(n + 1, dtype=np.int64) * (len(labels) // max(n, 1))
        bounds = np.linspace(0, n, PARTITIONS + 1).astype(np.int64)
        return Observed(np.arange(n), np.ones(n, dtype=np.int64), start, labels, weights, bounds)
