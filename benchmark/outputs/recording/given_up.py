"""A recording without what was logged of a map that was given up."""

from __future__ import annotations

import warnings
from pathlib import Path

import rerun as rr
from rerun.error_utils import RerunWarning

from semstab.model.results import Unit
from semstab.outputs.recording import series
from semstab.outputs.recording.entities import path
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
    with warnings.catch_warnings():  # while it is served a recording has no end
        warnings.simplefilter("ignore", RerunWarning)
        reader = rr.chunk.RrdReader(file)
    for store in reader.recordings():
        kept = (
            chunk
            for chunk in reader.stream(store=store)
            if not f"{chunk.entity_path}/".startswith(f"{rr.RECORDING_PROPERTIES_PATH}/" if chunk.is_static else below)
        )
        rr.send_chunks(kept, recording=stream)
