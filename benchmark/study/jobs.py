"""The work of a study: units that read the same sequence are one job, which decodes each frame once for all of them."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semstab.config import Config
from semstab.datasets import Dataset, open_dataset
from semstab.errors import SemstabError, one_line


@dataclass(frozen=True)
class Request:
    """A unit to compute, and what is wanted of it; see `semstab.study.grid.Cell`.

    regions  whether it is the flicker of regions without classes, and nothing is fused
    """

    identity: str
    config: Config
    image_space: bool = False
    voxels: bool = False
    regions: bool = False


@dataclass(frozen=True)
class Job:
    """Units of one scene and backbone, small enough to send to another process or machine.

    start         names this start of the study: a worker opens the dataset once for it
    folder        of the study
    threads       that decode frames ahead
    memory_bytes  that maps may take before some are put off to another pass over the frames; None: half of what is free
    """

    scene: str
    backbone: str
    requests: tuple[Request, ...]
    start: str
    folder: Path
    threads: int | None = None
    memory_bytes: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of a unit: the content of its file, or the one line that says why there is none.

    files  further files of it by their path in the study's folder, where the worker does not see that folder
    """

    identity: str
    content: Mapping[str, Any] | None = None
    error: str | None = None
    files: Mapping[str, bytes] = field(default_factory=dict)


def run_job(job: Job) -> tuple[Outcome, ...]:
    """Compute the units of a job. One that fails does not keep the others from finishing."""
    from semstab.study.passes import Pass
    from semstab.study.regions import measure_regions

    outcomes: list[Outcome] = []
    requests = job.requests
    try:
        dataset = requests[0].config.dataset
        scene = _dataset(job.start, dataset.name, json.dumps(dataset.options)).scene(job.scene)
        if requests[0].regions:
            return (measure_regions(job, scene, requests[0]),)
        while requests:
            fused = Pass(job, scene, requests)
            outcomes += fused.run()
            requests = tuple(fused.put_off)
    except Exception as error:  # noqa: BLE001 - whatever happens to a job is reported, and the other jobs go on
        outcomes += failed(requests, message(error))
    return tuple(outcomes)


def failed(requests: Iterable[Request], text: str) -> tuple[Outcome, ...]:
    """The outcomes of units that could not be computed."""
    return tuple(Outcome(request.identity, error=text) for request in requests)


def message(error: Exception) -> str:
    """One line; an error that is not semstab's own says its type."""
    return str(error) if isinstance(error, SemstabError) else f"{type(error).__name__}: {one_line(error)}"


def shared_marker(folder: Path, start: str) -> Path:
    """The file by which a worker knows that it sees the study's own folder, not one of the same name elsewhere."""
    return folder / f".shared-{start}"


def close_dataset() -> None:
    """Let go of the dataset that a job opened in this process."""
    _dataset.cache_clear()


@functools.lru_cache(maxsize=1)
def _dataset(_start: str, name: str, options: str) -> Dataset:
    """The dataset, opened once for a start of a study: its scenes share what they read or render."""
    return open_dataset(name, json.loads(options))
