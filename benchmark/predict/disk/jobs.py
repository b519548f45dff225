"""What a prediction command does: which images of which sequence, and where their predictions go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semstab.config import DatasetConfig, FrameSelection
from semstab.datasets import Scene, open_dataset
from semstab.datasets.selection import select_frames
from semstab.errors import ConfigError
from semstab.predict.images import ImageSequence
from semstab.predict.sources import ImageFiles, chosen

IMAGES: Mapping[str, Any] = {"color": True}
"""What of a frame must be there where a model looks at images."""


@dataclass(frozen=True, eq=False)
class Job:
    """One sequence: which of its images, and the folder above labels/, scores/ and regions/."""

    sequence: ImageSequence
    indices: list[int]
    out: Path


def file_job(pattern: str, frames: FrameSelection, out: Path | None) -> Job:
    """Images by a pattern. Raises ConfigError without `out`, or where no image is selected."""
    if out is None:
        raise ConfigError("--images: predictions of single images need a place; name it with --out")
    files = ImageFiles(pattern)
    return Job(files, _some(frames.indices(len(files)), files), out)


def scene_jobs(
    dataset: DatasetConfig,
    scenes: Sequence[str] | None,
    frames: FrameSelection,
    out: Path | None,
    looks_at: Mapping[str, Any] = IMAGES,
) -> list[Job]:
    """The scenes of a dataset; predictions go into the scene's own folder, into `out`, or of several into out/SCENE.

    `looks_at` says what of a frame must be there, as for `select_frames`.

    Raises ConfigError for a dataset without folders of its own where there is no `out`, and for a scene or frames that
    are not there.
    """
    opened = open_dataset(dataset.name, dataset.options)
    names = chosen(scenes, opened.scenes, dataset.name)
    jobs = []
    for name in names:
        scene = opened.scene(name)
        indices = _some(select_frames(scene, frames, **looks_at).indices, scene)
        jobs.append(Job(scene, indices, _place(scene, out if out is None or len(names) == 1 else out / name)))
    return jobs


def _place(scene: Scene, out: Path | None) -> Path:
    place = out or scene.folder
    if place is None:
        raise ConfigError(f"{scene.name}: has no folder of its own; say with --out where its predictions go")
    return place


def _some(indices: list[int], sequence: ImageSequence) -> list[int]:
    if not indices:
        raise ConfigError(f"{sequence.name}: the selection of frames leaves none of its {len(sequence)}; mend --frames")
    return indices
