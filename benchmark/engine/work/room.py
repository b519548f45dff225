"""While maps grow: is the memory that is left enough for what their end will take?"""

from __future__ import annotations

from collections.abc import Sequence

from semstab.backends import expected_bytes
from semstab.engine.work.memory import GB, log_bytes, result_bytes
from semstab.engine.work.stream import UnitMap
from semstab.errors import OutgrownError
from semstab.runtime.memory import available_bytes, resident_bytes
from semstab.runtime.process import give_back

STEP = 32e6
"""Bytes by which the process may grow before it is looked at closer."""

AMPLE = 4
"""Where that many times what maps take is left, freed memory is kept: the next images need not clear theirs again."""


class Room:
    """Watches the memory of a pass, frame by frame, in a time that does not grow with the maps.

    memory_gb  that all maps and what comes of them may take; None: what is free
    width      processes that share it
    """

    def __init__(self, memory_gb: float | None, width: int) -> None:
        self._limit = None if memory_gb is None else memory_gb * GB / width
        self._width = width
        self._before: int | None = None  # memory of this process without maps; what is loaded at the first frame stays
        self._seen = self._largest_step = 0
        self._left = 0.0

    def lacking(self, maps: Sequence[UnitMap]) -> UnitMap | None:
        """The largest of the maps where the memory left would not do for the end of each; None where it does.

        A hash map that is full doubles: the next step may be twice the largest one so far.
        """
        expected = sum(map(_bytes, maps))
        if self._before is None:
            self._before = resident_bytes() - expected
        taken = self._taken(expected)
        if taken - self._seen < min(STEP, (self._limit or STEP) / 8):
            return None
        end = max(map(end_bytes, maps))
        if self._beyond(taken) >= AMPLE * (taken + end):
            self._seen = taken
            return None
        give_back()  # else what was freed would count
        taken = self._taken(expected)
        self._seen, self._largest_step = taken, max(self._largest_step, taken - self._seen)
        self._left = self._beyond(taken)
        return None if self._left >= end + 2 * self._largest_step else max(maps, key=_bytes)

    def _beyond(self, taken: int) -> float:
        """What is left for maps that take so much."""
        free = available_bytes() / self._width
        return free if self._limit is None else min(free, self._limit - taken)

    def _taken(self, expected: int) -> int:
        """By the maps; one may take what was freed before."""
        return max(resident_bytes() - (self._before or 0), expected)

    def outgrown(self, one: UnitMap) -> OutgrownError:
        """Why a map is given up."""
        unit, config = one.task.units[0], one.request.config
        voxels = one.rows[-1].report.map_voxels
        which = "are free" if self._limit is None else "is left of memory_gb"
        return OutgrownError(
            f"{unit.scene}, {unit.backbone}, {unit.backend}: after {len(one.rows)} of {len(one.task.indices)} frames"
            f" the map has {voxels / 1e6:.2g} million voxels of {config.voxel_size:g} m, of which its table"
            f" {'and statistics' if config.statistics else 'alone'} would take {end_bytes(one) / GB:.2g} GB, and"
            f" {max(0, self._left) / GB:.2g} GB {which}; use larger voxels (voxel_size), fewer frames (frames),"
            " or a larger pixel_stride"
        )


def end_bytes(one: UnitMap) -> int:
    """What measuring and writing a map takes beside what it takes already."""
    config, K = one.request.config, len(one.task.mapping.target)
    voxels = one.rows[-1].report.map_voxels
    tables = (1 + (one.truth is not None)) * result_bytes(voxels, K, soft=one.soft)
    return tables + (log_bytes(one.observations, K, soft=one.soft) if config.statistics or config.events else 0)


def _bytes(one: UnitMap) -> int:
    (backend,) = one.task.backends
    K, voxels = len(one.task.mapping.target), one.rows[-1].report.map_voxels
    return expected_bytes(backend, voxels, one.observations, K, soft=one.soft)
