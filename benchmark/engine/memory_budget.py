"""The memory of maps while they grow, watched frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.backends import expected_bytes
from semstab.core.process import available_bytes, resident_bytes, trim_malloc
from semstab.engine.live_maps import LiveMap
from semstab.engine.memory import GB, log_bytes, table_bytes
from semstab.errors import OutgrownError

STEP = 32e6
"""Bytes by which the process may grow before its maps are measured again."""

AMPLE = 4
"""The free memory, in bytes of the maps, from which on freed memory is retained: the next images need not clear it."""


class MemoryBudget:
    """The memory budget of a pass: `memory_gb` or what is free, shared by `width` processes."""

    def __init__(self, memory_gb: float | None, width: int) -> None:
        self._limit = None if memory_gb is None else memory_gb * GB / width
        self._width = width
        self._before: int | None = None  # memory of this process without maps; code that the first frame loads stays
        self._seen = self._largest_step = 0
        self._left = 0.0

    def lacking(self, maps: Sequence[LiveMap]) -> LiveMap | None:
        """Return the largest map if the memory left does not suffice for the end of each map, else None.

        A hash map that is full doubles: the next step may be twice the largest one so far.
        """
        expected, end = sum(map(_bytes, maps)), max(map(end_bytes, maps))
        if self._before is None:
            self._before = resident_bytes() - expected
        taken = max(resident_bytes() - self._before, expected)  # maps may take memory that was freed before
        if taken - self._seen < min(STEP, (self._limit or STEP) / 8):
            return None
        if self._beyond(taken) < AMPLE * (taken + end):
            trim_malloc()  # else freed memory would count
            taken = max(resident_bytes() - self._before, expected)
            self._largest_step = max(self._largest_step, taken - self._seen)
        self._seen, self._left = taken, self._beyond(taken)
        return None if self._left >= end + 2 * self._largest_step else max(maps, key=_bytes)

    def _beyond(self, taken: int) -> float:
        free = available_bytes() / self._width
        return free if self._limit is None else min(free, self._limit - taken)

    def outgrown(self, live: LiveMap) -> OutgrownError:
        """Return the error of a map that is given up."""
        name, config, tile = live.name, live.config, live.work.tile
        voxels = live.rows[-1].report.map_voxels
        which = "are free" if self._limit is None else "is left of memory_gb"
        size = f"a smaller --tile-size than {tile.size}" if tile is not None else "tiles (--tile-size 256)"
        return OutgrownError(
            f"{name.scene}, {name.model}, {name.backend}: after {len(live.rows)} of {len(live.frames)} frames"
            f" the map has {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m; its table"
            f" {'and statistics' if config.statistics else 'alone'} would take {end_bytes(live) / GB:.2g} GB, and"
            f" {max(0, self._left) / GB:.2g} GB {which}; use {size}, larger voxels (voxel_size), fewer frames (frames),"
            " or a larger pixel_stride"
        )


def end_bytes(live: LiveMap) -> int:
    """Return the bytes that measuring and writing a map takes beyond what it takes already."""
    config, K = live.config, len(live.task.mapping.target)
    voxels = live.rows[-1].report.map_voxels
    tables = (1 + (live.truth is not None)) * table_bytes(voxels, K, soft=live.soft)
    return tables + (log_bytes(live.observations, K, soft=live.soft) if config.statistics or config.events else 0)


def _bytes(live: LiveMap) -> int:
    K, voxels = len(live.task.mapping.target), live.rows[-1].report.map_voxels
    return expected_bytes(live.name.backend, voxels, live.observations, K, soft=live.soft)
