"""What `eager` does, with the same results, in fewer passes: by Triton kernels on a CUDA device.

Multiplications and additions stay apart (`enable_fp_fusion=False`): fused, they would round otherwise at voxel faces.
"""

from __future__ import annotations

import os

import torch
import triton

from semstab.backends import torch_eager
from semstab.backends import triton_kernels as kernels
from semstab.backends.torch_eager import SUMS, Association, ViewEvidence, camera_terms, camera_terms_single, score_scale
from semstab.backends.torch_storage import EMPTY, Columns, DepthView, Labels, MapGrid, Scores, VoxelHash

FIRST_SLOTS = 1 << 19
"""Slots of a view's hash at first: a quarter of them in use with 131,072 voxels."""

PROBES = 128
"""A key that finds no slot in so many steps shows that the hash is too small."""

ROWS = 16
"""Rows of the image that a program goes down where it sums scores; 2^25 units a pixel and row fit 32 bits."""

MOST_CLASSES = 256
"""Scores of more classes do not fit a program's registers, and go through plain torch."""

SEPARATE = {"enable_fp_fusion": False}


def runs_on(device: torch.device) -> bool:
    """Whether the kernels can run there: on a CUDA device, or anywhere in Triton's interpreter (TRITON_INTERPRET=1)."""
    return device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"


# --- Pixels to voxels -------------------------------------------------------------------------------------------------


class Associator:
    """Finds the voxels of views; keeps the size of their hash, which follows the voxels of a view."""

    def __init__(self) -> None:
        self.slots = FIRST_SLOTS

    def __call__(self, view: DepthView, grid: MapGrid) -> Association:
        """The voxels of a view, in the order of the hash's slots, and the one of each pixel."""
        while True:
            key, table, overflow = self._insert(view, grid)
            place = torch.ne(table, EMPTY).cumsum(dim=0, dtype=torch.int32)
            voxels, lacks_room = torch.cat([place[-1:], overflow]).tolist()
            if not lacks_room:
                break
            self.slots *= 4
        self.slots = max(FIRST_SLOTS, 1 << (4 * voxels - 1).bit_length())
        return self._numbered(key, table, place, voxels)

    def _insert(self, view: DepthView, grid: MapGrid) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Each pixel's key, the hash of all keys, and whether that was too small."""
        H, W = view.depth.shape
        device = view.depth.device
        key = torch.empty((H, W), dtype=torch.int64, device=device)
        table = torch.full((self.slots,), EMPTY, dtype=torch.int64, device=device)
        overflow = torch.zeros(1, dtype=torch.int32, device=device)
        block = 256
        double = grid.dtype == torch.float64
        terms = camera_terms(view, grid) if double else camera_terms_single(view, grid)
        insert_pixels = kernels.insert_pixels if double else kernels.insert_pixels_single
        insert_pixels[(triton.cdiv(W, block), H)](
            view.depth, *terms[:3], key, table, self.slots - 1, overflow, W, PROBES, block, **SEPARATE
        )
        return key, table, overflow

    def _numbered(self, key: torch.Tensor, table: torch.Tensor, place: torch.Tensor, voxels: int) -> Association:
        keys = table.new_empty(voxels)
        slots = len(table)
        kernels.list_keys[(triton.cdiv(slots, 1024),)](table, place, keys, slots, 1024, **SEPARATE)
        voxel = torch.empty(key.shape, dtype=torch.int32, device=key.device)
        pixels = key.numel()
        kernels.number_pixels[(triton.cdiv(pixels, 512),)](key, table, place, voxel, slots - 1, pixels, 512, **SEPARATE)
        return Association(keys, voxel)


# --- Evidence ---------------------------------------------------------------------------------------------------------


def count_labels(seen: Association, said: Labels, num_classes: int) -> ViewEvidence:
    """Pixels of each class in each voxel."""
    n, P, block = len(seen.keys), seen.voxel.numel(), 512
    sums, flags = seen.voxel.new_zeros((num_classes, n)), seen.keys.new_zeros(3)
    kernels.add_labels[(triton.cdiv(P, block),)](
        seen.voxel, said.ids, sums, flags, P, n, said.ignore, num_classes, block, **SEPARATE
    )
    return ViewEvidence(sums, sums.sum(dim=0), 1.0, flags)


def sum_scores(seen: Association, said: Scores, num_classes: int) -> ViewEvidence:
    """Sums of the normalised scores in each voxel."""
    if num_classes > MOST_CLASSES:
        return torch_eager.sum_scores(seen, said, num_classes)
    n, (H, W) = len(seen.keys), seen.voxel.shape
    double = said.values.dtype == torch.float64 or not said.softmax
    scale = score_scale(H * W, double)
    sums, pixels = seen.keys.new_zeros((num_classes, n)), seen.keys.new_zeros(n)
    flags = seen.keys.new_zeros(3)
    classes = triton.next_power_of_2(num_classes)
    columns = max(32, min(128, 4096 // classes))
    warps = 4 if classes <= 32 else classes * columns // 512  # so that a thread holds one pixel, 32 classes at most
    kernels.add_scores[(triton.cdiv(W, columns), triton.cdiv(H, ROWS))](
        seen.voxel, said.values, said.values.stride(0), said.values.stride(1), sums, pixels, flags, H, W,
        n, scale, num_classes, said.softmax, double, ROWS, columns, classes, num_warps=warps, **SEPARATE,
    )  # fmt: skip
    return ViewEvidence(sums, pixels, scale, flags)


# --- The map ----------------------------------------------------------------------------------------------------------


def find(table: VoxelHash, keys: torch.Tensor) -> torch.Tensor:
    """Rows (n,) int64 of keys (n,), EMPTY for those that the hash does not hold."""
    rows = torch.empty_like(keys)
    n = len(keys)
    if n:
        kernels.find_rows[(triton.cdiv(n, 128),)](
            table.keys, table.rows, keys, rows, len(table.keys) - 1, n, 128, **SEPARATE
        )
    return rows


def insert(table: VoxelHash, keys: torch.Tensor, rows: torch.Tensor, first: int = 0) -> None:
    """Add distinct keys (n,) which the hash does not hold and has slots for, with their rows (n,).

    EMPTY keys are left out, and those whose row is below `first`.
    """
    n = len(keys)
    if n:
        kernels.insert_rows[(triton.cdiv(n, 128),)](
            table.keys, table.rows, keys, rows, first, len(table.keys) - 1, n, 128, **SEPARATE
        )


def update(columns: Columns, rows: torch.Tensor, evidence: ViewEvidence, frame: int) -> torch.Tensor:
    """Add one observation to the rows (n,) of the voxels that the evidence sees; returns a `Change` in float64."""
    n, K = len(rows), columns.num_classes
    classes = min(triton.next_power_of_2(K), 256)
    block = max(1, 256 // classes)
    programs = triton.cdiv(n, block)
    sums = torch.zeros((programs, SUMS), dtype=torch.float64, device=rows.device)
    if n:
        kernels.observe[(programs,)](
            rows, evidence.sums, evidence.pixels, evidence.scale, columns.evidence, columns.op, columns.pixels,
            columns.drift_sum, columns.self_sum, columns.frame_entropy_sum, columns.first_frame, columns.last_frame,
            sums, frame, n, K, block, classes, SUMS, **SEPARATE,
        )  # fmt: skip
    return sums.sum(dim=0)
