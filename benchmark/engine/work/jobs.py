"""The work of a plan: units that read the same sequence are one job, small enough to send to another machine."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from semstab.check.reprojection import evenly
from semstab.config import Config, FrameSelection, as_range
from semstab.core.files import TEMPORARY
from semstab.engine.tiling.again import Again, SeenAgain
from semstab.engine.tiling.partition import Part, Tiling
from semstab.engine.tiling.portion import SIZES, Portion
from semstab.engine.tiling.sights import Looking
from semstab.engine.tiling.stretches import Stretch, stretches_of
from semstab.engine.units import Planned, PlannedUnit
from semstab.engine.work.image_space import CLIPS
from semstab.engine.work.sizes import FRAMES
from semstab.errors import OUT_OF_MEMORY, OutgrownError, SemstabError, one_line
from semstab.model.records import UnitContent
from semstab.model.voxels import Extent, VoxelTable


@dataclass(frozen=True)
class Request:
    """A unit to compute, and what is wanted of it; see `semstab.engine.units.PlannedUnit`.

    config    with its frames one by one: those of its sequence that all label sources of the plan have
    left_out  how many selected frames lack a file or a pose
    regions   whether it is the flicker of regions without classes, and nothing is fused
    portion   what of a unit in tiles is wanted; None for all of a unit
    looking   where only what its frames see is wanted
    again     where a part of its map is looked at for the second time
    """

    identity: str
    config: Config
    image_space: bool = False
    kept: bool = False
    judged: bool = True
    sampled: bool = False
    left_out: int = 0
    regions: bool = False
    portion: Portion | None = None
    looking: Looking | None = None
    again: Again | None = None

    @property
    def reads_frames(self) -> bool:
        """Whether a pass over its frames is wanted."""
        return not self.regions and self.looking is None and self.again is None

    @property
    def within(self) -> Extent | None:
        """The voxels that its map is restricted to."""
        return None if self.portion is None or self.portion.part is None else self.portion.part.extent

    @property
    def fuses(self) -> bool:
        """Whether there is a map."""
        return self.portion is None or self.portion.part is not None

    @property
    def shown(self) -> bool:
        """Whether observers are shown its frames, though there is no map."""
        return self.stretch is not None and self.portion is not None and self.portion.kept

    @property
    def part(self) -> Part | None:
        """The part of the map in tiles that is fused, where observers are told of it."""
        return self.portion.part if self.portion is not None and self.portion.kept else None

    @property
    def stretch(self) -> Stretch | None:
        """The frames that are looked at without a map."""
        return None if self.portion is None else self.portion.stretch

    @property
    def sized(self) -> bool:
        """Whether some frames are fused at other voxel sizes; filters share those of what they are put over."""
        if self.portion is not None:
            return self.portion.kind == SIZES
        return self.image_space and self.judged and not self.config.frame_quality

    @property
    def reduces(self) -> bool:
        """Whether soft scores are also fused as labels."""
        return self.image_space if self.portion is None else self.portion.reduces

    @classmethod
    def portions(cls, planned: PlannedUnit, key: str, tiling: Tiling, width: int = 1) -> list[Request]:
        """Those of a unit in tiles, for so many tasks at once: of its frames, and of each part of its map."""
        whole = replace(cls.of(planned), kept=False)
        frames, origin = planned.task.indices, tiling.origin
        first = replace(whole, sampled=False)
        lead = max(CLIPS) - 1
        stretches = stretches_of(frames, origin, lead=lead, width=width, whole=whole.config.frame_quality)
        found = [first._of(Portion(key, stretch=stretch, kept=planned.kept), stretch.frames) for stretch in stretches]
        if first.sized:
            some = [frames[k] for k in evenly(len(frames), FRAMES)]
            found.append(replace(first, image_space=False, judged=False)._of(Portion(key), some))
        fused = replace(whole, image_space=False, judged=False)
        for part in tiling.parts:
            portion = Portion(key, part, None, planned.kept, planned.judged, planned.image_space)
            found.append(fused._of(portion, part.frames))
        return found

    def of_part(self, part: Part) -> Request:
        """Another part of the same unit."""
        assert self.portion is not None
        return self._of(replace(self.portion, part=part), part.frames)

    def looking_at(self, frames: Sequence[int], looking: Looking) -> Request:
        """What these frames see."""
        return replace(self._of(None, frames), looking=looking)

    def looking_again(self, looks: Iterable[Again]) -> list[Request]:
        """Second looks at parts, for which no frame is read."""
        short = self._of(None, (self.config.frames.list or (0,))[:1])
        return [replace(short, again=each) for each in looks]

    def _of(self, portion: Portion | None, frames: Sequence[int]) -> Request:
        """The same, of these frames and that portion alone."""
        config = self.config.model_copy(update={"frames": FrameSelection.of(as_range(frames))})
        return replace(self, config=config, portion=portion)

    @classmethod
    def of(cls, planned: Planned) -> Request:
        """What a job is told of it."""
        if not isinstance(planned, PlannedUnit):
            return cls(planned.identity, planned.config, regions=True)
        frames = FrameSelection.of(planned.task.indices)
        config = planned.config.model_copy(update={"frames": frames})
        wanted = (planned.image_space, planned.kept, planned.judged, planned.sampled)
        return cls(planned.identity, config, *wanted, planned.task.left_out)


@dataclass(frozen=True)
class Job:
    """Units of one scene and backbone.

    start         names this start: a worker opens the dataset once for it
    folder        of the run or study
    threads       that decode frames ahead; 0: each when it is wanted, None: as many as the machine has for it
    memory_bytes  that maps may take before some are put off to another pass over the frames; None: half of what is free
    width         how many jobs share the machine's memory
    """

    scene: str
    backbone: str
    requests: tuple[Request, ...]
    start: str
    folder: Path
    threads: int | None = None
    memory_bytes: float | None = None
    width: int = 1


@dataclass(frozen=True)
class Outcome:
    """What became of a unit: what its file holds, or the one line that says why there is none.

    portion  the name of what was computed of it, or could not be, where that is not all
    outgrown whether it failed for want of memory
    files    further files of it by their path in the folder, where the worker does not see that folder
    cause    the exception, where the unit failed in this very process
    trace    where it was raised, if it is not semstab's own
    seconds  that its pass took, by stage; of the first outcome of a pass only
    table    its voxels, where observers see them
    again    what a second look found; None where the voxels are not to be seen from there
    """

    identity: str
    content: UnitContent | None = None
    portion: str | None = None
    error: str | None = None
    outgrown: bool = False
    files: Mapping[str, bytes] = field(default_factory=dict)
    cause: BaseException | None = field(default=None, compare=False)
    trace: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    again: SeenAgain | None = None
    table: VoxelTable | None = None

    def __getstate__(self) -> dict[str, object]:
        """Without the exception, which may not travel."""
        return {**self.__dict__, "cause": None, "table": None}


def failed(requests: Iterable[Request], error: str | Exception, *, outgrown: bool = False) -> list[Outcome]:
    """The outcomes of units, or portions of them, that could not be computed."""
    if isinstance(error, str):
        return [Outcome(each.identity, portion=_portion(each), error=error, outgrown=outgrown) for each in requests]
    trace = "" if isinstance(error, SemstabError) else "".join(traceback.format_exception(error))
    if outgrown := isinstance(error, (OutgrownError, MemoryError)):
        error = error.with_traceback(None)  # it would keep the map, and what halves of it take comes on top
    return [
        Outcome(
            each.identity,
            portion=_portion(each),
            error=message(error),
            outgrown=outgrown,
            cause=error,
            trace=trace,
        )
        for each in requests
    ]


def _portion(request: Request) -> str | None:
    if request.again is not None:
        return request.again.name
    return None if request.portion is None else request.portion.name


def message(error: Exception) -> str:
    """One line; an error that is not semstab's own says its type."""
    if isinstance(error, MemoryError):
        return OUT_OF_MEMORY
    return str(error) if isinstance(error, SemstabError) else f"{type(error).__name__}: {one_line(error)}"


def shared_marker(folder: Path, start: str) -> Path:
    """The file by which a worker knows that it sees the folder itself, not one of the same name elsewhere."""
    return folder / f"{TEMPORARY}{start}"


def split(jobs: Sequence[Job], width: int) -> list[Job]:
    """As many jobs as can run at once, if there are that many units: the largest ones are halved.

    What is kept of one sequence stays together, for it is watched together.
    """
    jobs = list(jobs)
    while len(jobs) < width:
        divisible = [k for k, job in enumerate(jobs) if all(_halves(job.requests))]
        if not divisible:
            break
        k = max(divisible, key=lambda k: len(jobs[k].requests))
        jobs[k : k + 1] = [replace(jobs[k], requests=half) for half in _halves(jobs[k].requests)]
    return jobs


def _halves(requests: tuple[Request, ...]) -> tuple[tuple[Request, ...], tuple[Request, ...]]:
    ordered = sorted(requests, key=lambda request: not request.kept)
    together = sum(request.kept for request in ordered)
    half = max(together, len(ordered) // 2)
    return tuple(ordered[:half]), tuple(ordered[half:])
