"""Work: a unit, or a tile of one, as a worker gets it and gives it back; small enough for another machine."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from semstab.config import as_range
from semstab.core.files import TEMPORARY
from semstab.data.parquet import Tile
from semstab.data.records import Record, RegionFlicker
from semstab.data.voxels import Extent, VoxelTable
from semstab.engine.units import Unit
from semstab.errors import OUT_OF_MEMORY, OutgrownError, SemstabError, summarize_error

TILES = "tiles"
"""Folder of the results of single tiles, unit by unit, until the unit is whole."""

FRAMES = "frames"
"""Name of the pass over the frames of a unit in tiles that fuses nothing."""


@dataclass(frozen=True)
class Start:
    """A start of a run: its name, the run's folder, the processes that share the machine (width).

    Attributes:
        threads: Threads that decode frames ahead; 0: each when it is wanted, None: as many as the machine has for it.
    """

    name: str
    folder: Path
    threads: int | None = None
    width: int = 1

    @property
    def marker(self) -> Path:
        """The file by which a worker knows that it sees the folder itself, not one of the same name elsewhere."""
        return self.folder / f"{TEMPORARY}{self.name}"


@dataclass(frozen=True)
class UnitTile:
    """One tile of the map of a unit; without an index, the pass over all frames that fuses nothing.

    Attributes:
        key: Key of the unit, under which results are stored.
        size: Voxels along the edge of a tile.
        index: (x, y) of the tile: ix // size, iy // size.
        origin: Voxel of the first camera, if known.
        bound: Highest hash in the sample of the tiles before, if the sample is full: the map's sample will have no
            voxel above it.
    """

    key: str
    size: int
    index: tuple[int, int] | None = None
    origin: tuple[int, int, int] | None = None
    bound: int | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        """The name of its result."""
        return f"{self.size}_{FRAMES}" if self.index is None else f"{self.size}_{self.index[0]}_{self.index[1]}"

    @property
    def folder(self) -> str:
        """The folder of the unit's results, in the folder of the run."""
        return f"{TILES}/{self.key}"

    @property
    def extent(self) -> Extent | None:
        """The voxels of the tile."""
        if self.index is None:
            return None
        x, y = (corner * self.size for corner in self.index)
        return Extent((x, y), (x + self.size, y + self.size), self.origin)


@dataclass(frozen=True, eq=False)
class Work:
    """A unit, or a tile of one, as a worker gets it and gives it back.

    A worker gets a start, a unit, the frames and the tile. It gives the same back with a record, or with files of a
    tile, or with the one line that says why there is neither.

    Attributes:
        frames: Indices of the frames to read.
        tile: The tile of a unit in tiles; None for all of a unit.
        record: What is kept of the unit.
        error: The reason why the work failed, in one line.
        files: Further files by their path in the folder, if the worker does not see the folder.
        cause: The exception, if the work failed in this very process; `trace` has its traceback.
        table: The voxels of a unit that observers watch, if it was fused in this process.
        seconds: Seconds that its pass took, by stage; of the last work of a pass only.
    """

    start: Start
    unit: Unit
    frames: Sequence[int]
    tile: UnitTile | None = None
    record: Record | RegionFlicker | None = None
    error: str | None = None
    files: Mapping[str, bytes] = field(default_factory=dict)
    cause: BaseException | None = None
    trace: str = ""
    table: VoxelTable | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def from_unit(cls, unit: Unit, start: Start) -> Work:
        """Return the whole of a unit as work."""
        return cls(start, unit, as_range(unit.task.indices))

    def in_tile(self, tile: UnitTile, frames: Sequence[int] | None = None) -> Work:
        """Return the same of one tile and these frames alone."""
        return replace(self, tile=tile, frames=self.frames if frames is None else as_range(frames))

    def bounded(self, bound: int | None) -> Work:
        """Return the same of its tile, with the bound of a sample of voxels."""
        return self if self.tile is None else replace(self, tile=replace(self.tile, bound=bound))

    def failed(self, error: str | Exception) -> Work:
        """Return it with the line of an error; one that is not semstab's own says its type."""
        if isinstance(error, str):
            return replace(self, error=error)
        trace = "" if isinstance(error, SemstabError) else "".join(traceback.format_exception(error))
        if isinstance(error, (OutgrownError, MemoryError)):
            error = error.with_traceback(None)  # its frames would keep the map in memory
        return replace(self, error=_one_line(error), cause=error, trace=trace)

    def __getstate__(self) -> dict[str, object]:
        """Leave out the exception, which may not travel, and the voxels, which are in the folder."""
        return {**self.__dict__, "cause": None, "table": None}

    @property
    def fuses(self) -> bool:
        """Return whether there is a map."""
        return self.unit.fuses and (self.tile is None or self.tile.index is not None)

    @property
    def watched(self) -> bool:
        """Return whether observers see its frames and its map: it is stored, and fused whole."""
        return self.unit.stored and self.tile is None

    @property
    def measures_images(self) -> bool:
        """Return whether it takes the frames in sequence, to measure them in image coordinates."""
        return self.tile is None or self.tile.index is None

    @property
    def map_tile(self) -> Tile | None:
        """The tile of its map, as files of voxels name it; None for a whole map."""
        tile = self.tile
        return None if tile is None or tile.index is None else Tile(*tile.index, tile.size, tile.key)

    @property
    def within(self) -> Extent | None:
        """The voxels that its map is restricted to."""
        return None if self.tile is None else self.tile.extent


Job = tuple[Work, ...]
"""Works that read the same sequence, in one pass over its frames if the memory allows."""


def _one_line(error: Exception) -> str:
    if isinstance(error, SemstabError):
        return str(error)
    if isinstance(error, MemoryError):
        return OUT_OF_MEMORY
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {summarize_error(error)}{where}"


def jobs_of(works: Iterable[Work], width: int) -> list[Job]:
    """Return work by the sequence that it reads, in as many jobs as can run at once: the largest ones are halved.

    Works that observers watch stay together: they are shown a frame once it went into all of these maps. The models of
    a video stay together, too: the motion between two images is found once.
    """
    sequences: dict[tuple[str, str], list[Work]] = {}
    for work in works:
        name, together = work.unit.name, not (work.unit.fuses or work.unit.regions)
        sequences.setdefault((name.scene, "" if together else name.model), []).append(work)
    jobs: list[Job] = [tuple(sequence) for sequence in sequences.values()]
    while len(jobs) < width:
        divisible = [k for k, job in enumerate(jobs) if all(_halves(job))]
        if not divisible:
            break
        k = max(divisible, key=lambda k: len(jobs[k]))
        jobs[k : k + 1] = _halves(jobs[k])
    return jobs


def _halves(job: Job) -> tuple[Job, Job]:
    ordered = sorted(job, key=lambda work: not work.watched)
    half = max(sum(work.watched for work in job), len(job) // 2)
    return tuple(ordered[:half]), tuple(ordered[half:])
