"""What goes from an earlier recording into another one: all but a map that was given up, or pictures of frames."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.error_utils import RerunWarning

from semstab.model.results import Unit
from semstab.recording import series
from semstab.recording.entities import path
from semstab.task import Task


def entities_of(unit: Unit, task: Task, *, pictures: bool) -> tuple[str, ...]:
    """What shows how a unit's map grew; pictures: also what shows what its frames did to it."""
    scene, backbone = unit.scene, unit.backbone
    names = [name for name in series.columns(unit, task) if pictures or name != "compensated_flicker"]
    of_frames = [path(scene, what, backbone) for what in ("camera", "flips")] if pictures else []
    return path(scene, "map", backbone, unit.backend), *(series.entity(name, unit) for name in names), *of_frames


def copy(file: Path, stream: rr.RecordingStream, without: tuple[str, ...]) -> None:
    """Send a recording to another one, but for what these entities, and those below them, show in its course."""
    below = tuple(f"/{entity.lstrip('/')}/" for entity in without)
    kept = (
        chunk
        for chunk in _chunks(file)
        if not f"{chunk.entity_path}/".startswith(f"{rr.RECORDING_PROPERTIES_PATH}/" if chunk.is_static else below)
    )
    rr.send_chunks(kept, recording=stream)


def pictures_of(task: Task) -> tuple[str, ...]:
    """What shows the frames of a task, whatever becomes of them: the first is the scene's, the last the task's own."""
    scene, backbone = task.scene.name, task.backbone
    shared = path(scene, "depth"), path(scene, "camera"), path(scene, "camera", "color"), path(scene, "trajectory")
    return *shared, series.entity("compensated_flicker", task.units[0]), path(scene, "camera", backbone, "labels")


def take(file: Path, stream: rr.RecordingStream, entities: Collection[str]) -> dict[str, set[int]]:
    """Send what these entities show in the course of a recording to another one; the frames of each."""
    names = {f"/{entity.lstrip('/')}": entity for entity in entities}
    frames: dict[str, set[int]] = {entity: set() for entity in entities}

    def taken() -> Iterator[Any]:
        for chunk in _chunks(file):
            if not chunk.is_static and chunk.entity_path in names:
                frames[names[chunk.entity_path]] |= {*chunk.to_record_batch().column("frame").to_pylist()}
                yield chunk

    rr.send_chunks(taken(), recording=stream)
    return frames


def identity_of(file: Path) -> str:
    """Of the recording in a file; '' where there is none."""
    if not file.is_file():
        return ""
    return next((store.recording_id for store in _reader(file).recordings()), "")


def _chunks(file: Path) -> Iterator[Any]:
    reader = _reader(file)
    return itertools.chain.from_iterable(reader.stream(store=store) for store in reader.recordings())


def _reader(file: Path) -> Any:
    with warnings.catch_warnings():  # one that is served, or was cut by a kill, has no end
        warnings.simplefilter("ignore", RerunWarning)
        return rr.chunk.RrdReader(file)
