"""What a map of the torch backend keeps on its device: a hash from voxel keys to rows, and columns of these rows.

Voxel indices are packed into a key with 21 bits an axis, as they count from the map's origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from semstab.errors import DataError, one_line

GB = 1e9

EMPTY = -1
"""The key of a free slot."""

FULL = 0.5
"""Largest share of the hash's slots in use."""

SLOT_BYTES = 8 + 4

MOVED_SLOTS = 1 << 20
"""Slots that move at a time when the hash grows."""


@dataclass(frozen=True)
class MapGrid:
    """The voxels of a map: edge in metres, the voxel index from which keys count, and the type that points are in."""

    voxel_size: float
    origin: tuple[int, int, int]
    dtype: torch.dtype


class VoxelHash:
    """Open addressing with linear probing: keys (S,) int64 and the rows (S,) int32 of those that are not EMPTY."""

    def __init__(self, slots: int, device: torch.device) -> None:
        self.keys = torch.full((slots,), EMPTY, dtype=torch.int64, device=device)
        self.rows = torch.zeros(slots, dtype=torch.int32, device=device)

    @property
    def capacity(self) -> int:
        """How many voxels it takes."""
        return int(FULL * len(self.keys))

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return SLOT_BYTES * len(self.keys)


def slots_for(voxels: int) -> int:
    """Slots of a hash for that many voxels: a power of 2."""
    return 1 << max(10, (int(voxels / FULL) - 1).bit_length())


class Columns:
    """One backbone's columns of a VoxelTable, (N,) or (N, K), with room for rows to come; all 0 where never seen."""

    NAMES = ("evidence", "op", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum", "frame_entropy_sum")

    def __init__(self, num_classes: int, evidence: torch.dtype, device: torch.device) -> None:
        def column(dtype: torch.dtype, *width: int) -> torch.Tensor:
            return torch.zeros((0, *width), dtype=dtype, device=device)

        self.num_classes = num_classes
        self.evidence = column(evidence, num_classes)
        self.op = column(torch.int32)
        self.drift_sum = column(torch.float64)
        self.pixels = column(torch.int64)
        self.first_frame = column(torch.int32)
        self.last_frame = column(torch.int32)
        self.self_sum = column(torch.float64)
        self.frame_entropy_sum = column(torch.float64)

    @property
    def capacity(self) -> int:
        """Rows that there is room for in every column."""
        return min(len(getattr(self, name)) for name in self.NAMES)

    @property
    def row_bytes(self) -> int:
        """Memory of a row."""
        columns = [getattr(self, name) for name in self.NAMES]
        return sum(column.element_size() * math.prod(column.shape[1:]) for column in columns)

    def grow(self, capacity: int) -> None:
        """Make room for that many rows. One column is copied at a time, and its old copy freed before the next."""
        for name in self.NAMES:
            old = getattr(self, name)
            if len(old) < capacity:
                new = torch.zeros((capacity, *old.shape[1:]), dtype=old.dtype, device=old.device)
                new[: len(old)] = old
                setattr(self, name, new)


class Storage:
    """The hash, and the columns of each backbone, which share its rows; both grow within a bound on their memory."""

    def __init__(
        self,
        num_classes: Mapping[str, int],
        evidence: torch.dtype,
        device: torch.device,
        insert: Callable[[VoxelHash, torch.Tensor, torch.Tensor, int], None],
        memory_gb: float | None,
    ) -> None:
        self.voxels = 0
        self.hash = VoxelHash(slots_for(0), device)
        self.columns = {name: Columns(K, evidence, device) for name, K in num_classes.items()}
        self.memory_gb = memory_gb
        self._insert = insert

    @property
    def capacity(self) -> int:
        """Voxels that there is room for."""
        return min(self.hash.capacity, *(columns.capacity for columns in self.columns.values()))

    @property
    def bytes(self) -> int:
        """Memory that it takes on the device."""
        return self.hash.bytes + sum(columns.capacity * columns.row_bytes for columns in self.columns.values())

    def add(self, keys: torch.Tensor, rows: torch.Tensor, voxels: int) -> None:
        """Enter those keys (n,) whose row is a new one; with them there are so many voxels."""
        if voxels > self.voxels:
            self._insert(self.hash, keys, rows, self.voxels)
            self.voxels = voxels

    def make_room(self, needed: int, where: str, wanted: int = 0) -> None:
        """Make room for that many voxels, and for half as many again as there was if there is memory for them.

        Raises DataError, with the maps unchanged, where they would outgrow `memory_gb`, or the device.
        """
        if needed <= self.capacity:
            return
        limit = math.inf if self.memory_gb is None else self.memory_gb * GB
        wanted = max(needed, wanted, self.capacity + self.capacity // 2)
        if self._bytes_to_grow(wanted) > limit:
            wanted = needed
        if self._bytes_to_grow(wanted) > limit:
            raise DataError(
                f"{where}: to hold {needed:,} voxels the map would take {self._bytes_to_grow(needed) / GB:.3g} GB while"
                f" it grows, and memory_gb is {self.memory_gb:g}; use larger voxels, raise memory_gb, or make room at"
                " once (reserve), which takes less"
            )
        try:
            self._grow(wanted)
        except RuntimeError as error:  # torch.OutOfMemoryError is one; on a CPU it is plain
            device = self.hash.keys.device
            raise DataError(
                f"{where}: the device {device} has no room for {wanted:,} voxels ({one_line(error)}); use larger voxels"
            ) from error

    def _bytes_to_grow(self, voxels: int) -> int:
        """The most memory taken while it grows: what it is then, and the column or hash that is copied."""
        columns = self.columns.values()
        then = SLOT_BYTES * slots_for(voxels) + voxels * sum(c.row_bytes for c in columns)
        copied = max(self.hash.bytes, *(c.evidence.element_size() * c.evidence.numel() for c in columns))
        return then + copied

    def _grow(self, voxels: int) -> None:
        for columns in self.columns.values():
            columns.grow(voxels)
        slots = slots_for(voxels)
        if slots > len(self.hash.keys):
            grown = VoxelHash(slots, self.hash.keys.device)
            for start in range(0, len(self.hash.keys), MOVED_SLOTS):
                part = slice(start, start + MOVED_SLOTS)
                self._insert(grown, self.hash.keys[part], self.hash.rows[part], 0)
            self.hash = grown
