"""Compare two runs of one place at other times: what another light, weather or day costs, and what has changed."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.comparison.entries import RunHandle
from semstab.comparison.opening import open_runs
from semstab.core.files import only_writer
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64
from semstab.data.frames import Frame
from semstab.data.georeference import Georeference
from semstab.data.statistics import TwoVisits
from semstab.errors import ConfigError
from semstab.exports.relabel import task_of
from semstab.statistics.visit_agreement import two_visits
from semstab.statistics.visits import VisitedSpots, VisitSampler, by_turns
from semstab.task import Task, read
from semstab.two_visits.alignment import Alignment, between
from semstab.two_visits.places import ChangedPlace, changed_places

__all__ = ["Alignment", "ChangedPlace", "VisitComparison", "VisitedScene", "compare_visits"]

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Visit:
    """A run as one of two visits: its name in print, its folder, and its label source."""

    name: str
    source: str
    model: str


@dataclass(frozen=True)
class VisitedScene:
    """A scene in two visits.

    Attributes:
        scene: Its name in the first run.
        other: Its name in the second run.
        visits: Agreement within the visits and across, and how many spots changed.
        places: Where neighbouring spots changed, the largest first; coordinates as in the exports of the first run.
        crs: The projection of these coordinates; '' for those of the scene.
    """

    scene: str
    other: str
    visits: TwoVisits
    places: tuple[ChangedPlace, ...]
    crs: str = ""


@dataclass(frozen=True)
class VisitComparison:
    """Two visits of one place.

    Attributes:
        visits: The first and the second run.
        scenes: Each scene that both visited.
        residual: Root mean square of what is left between the points of `align`, metres; None without them.
        points: Number of these points.
    """

    visits: tuple[Visit, Visit]
    scenes: tuple[VisitedScene, ...]
    residual: float | None = None
    points: int = 0

    def __repr__(self) -> str:
        from semstab.two_visits.tables import sentences

        names = " and ".join(visit.name for visit in self.visits)
        return "\n".join([f"<VisitComparison of {names}>", *(f"  {text}" for text in sentences(self))])


@dataclass(frozen=True, eq=False)
class Visited:
    """The spots of a scene for its map, which way is up, and the georeference of the first run."""

    spots: VisitedSpots
    up: tuple[float, float, float]
    georeference: Georeference | None


def compare_visits(
    first: str | Path,
    second: str | Path,
    *,
    align: str | Path | None = None,
    out: str | Path | None = None,
    code: Sequence[str] = (),
    progress: Progress = lambda what: None,
) -> VisitComparison:
    """Compare two runs of one place: agreement within each, and of a view of one with a view of the other.

    The frames of both are read again, by turns, and asked at the same spots. Which spots have lost their surface, or
    have a new one, is told by depth; agreement is of the others.

    Args:
        first: Folder of a run, or FOLDER:MODEL.
        second: The same of the other visit, with the same classes.
        align: File of points that both visits know: x y z of the first one, then x y z of the second one, a row each.
            The second visit is turned and moved by them; without it both must be in one frame of reference.
        out: A folder for report.html, tables, a map and visits.json.
        code: Code that the runs' settings name and that may run, FILE.py:NAME each; other code is refused.
        progress: Function that is called with each scene.

    Raises:
        ConfigError, DataError: For runs that cannot be opened or read again, or have no scene or other classes, in one
            line.

    Examples:
        >>> semstab.compare_visits("run:sim-steady", "run:sim-flicker").scenes[0].visits.gone
        0
    """
    handles = open_runs([first, second])
    alignment = None if align is None else Alignment.read(Path(align))
    visits, scenes, visited_by_scene = [], list[VisitedScene](), dict[str, Visited]()
    for handle in handles:
        handle.require_labels()
        if handle.source is None or not handle.source.is_dir():
            raise ConfigError(f"{handle.where}: two visits are read again frame by frame; give the folder of a run")
        visits.append(Visit(handle.name, str(handle.source), handle.model))
    for names in _scenes(handles):
        progress(names[0])
        scene, visited = _scene(handles, names, alignment, code)
        scenes.append(scene)
        visited_by_scene[scene.scene] = visited
    fitted = (None, 0) if alignment is None else (alignment.residual, alignment.points)
    comparison = VisitComparison((visits[0], visits[1]), tuple(scenes), *fitted)
    if out is not None:
        from semstab.two_visits.written import write

        with only_writer(Path(out) / "visits"):
            write(comparison, visited_by_scene, Path(out))
    return comparison


def _scenes(handles: Sequence[RunHandle]) -> list[tuple[str, str]]:
    """Return the scenes of the same name, or the only one of each run."""
    names = [list(handle.scenes) for handle in handles]
    if all(len(scene_names) == 1 for scene_names in names):
        return [(names[0][0], names[1][0])]
    if common := [name for name in names[0] if name in names[1]]:
        return [(name, name) for name in common]
    listed = " and ".join(", ".join(scene_names) for scene_names in names)
    raise ConfigError(f"{handles[0].where} and {handles[1].where} have no scene in common: {listed}")


def _scene(
    handles: Sequence[RunHandle], names: tuple[str, str], alignment: Alignment | None, code: Sequence[str]
) -> tuple[VisitedScene, Visited]:
    entries = [handle.scenes[name] for handle, name in zip(handles, names, strict=True)]
    to_first = between(entries[0].georeference, entries[1].georeference, alignment, handles[1].where)
    with contextlib.ExitStack() as held:
        tasks = []
        for handle, entry in zip(handles, entries, strict=True):
            assert handle.source is not None
            manifest = _manifest(handle)
            tasks.append(held.enter_context(task_of(handle.source, entry.record, manifest, code)))
        visited = _asked(tasks, to_first, handles)
    georeference = entries[0].georeference
    up = entries[0].up or (0.0, 0.0, 1.0)
    places = changed_places(visited, georeference)
    crs = "" if georeference is None else georeference.name
    return VisitedScene(*names, two_visits(visited), places, crs), Visited(visited, up, georeference)


def _manifest(handle: RunHandle) -> dict[str, str]:
    """Return the digests of the inputs of a run, by scene and model."""
    from semstab.engine.folder import load_result

    assert handle.source is not None
    inputs: dict[str, str] = load_result(handle.source).manifest["inputs"]
    return inputs


def _asked(tasks: Sequence[tuple[Task, int]], to_first: Float64, handles: Sequence[RunHandle]) -> VisitedSpots:
    """Return what the views of both visits say of the same spots.

    Raises:
        ConfigError: If their classes differ.
    """
    targets = [task.mapping.target for task, _ in tasks]
    if targets[0].classes != targets[1].classes:
        raise ConfigError(
            f"{handles[0].where} and {handles[1].where} have other classes; fuse both into one taxonomy (--taxonomy)"
        )
    sampler = VisitSampler(len(targets[0].classes))
    counts = len(tasks[0][0].indices), len(tasks[1][0].indices)
    matrices = np.eye(4), to_first
    for visit, frame in by_turns(_frames(*tasks[0]), _frames(*tasks[1]), counts):
        T_wc = np.ascontiguousarray(matrices[visit] @ frame.T_wc)
        sampler.add_of(visit, dataclasses.replace(frame, T_wc=T_wc))
    return sampler.visits(targets[0].classes)


def _frames(task: Task, pixel_stride: int) -> Iterator[Frame]:
    """Yield the frames of a visit as they were fused."""
    return (result.item for result in prefetch(lambda index: read(task, index, pixel_stride), task.indices))
