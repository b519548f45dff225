"""Results that are handed in: a run of a benchmark as one small file, with sums from which all numbers follow."""

from __future__ import annotations

import dataclasses
import math
import os
import platform
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from semstab.comparison.entries import Entry, RunHandle
from semstab.comparison.opening import open_run
from semstab.comparison.small_summary import save_summary
from semstab.config import Config, Settings, read_yaml, validated
from semstab.core.code import only_named
from semstab.core.json_form import from_json, to_json
from semstab.core.versions import version_of
from semstab.data.digests import require_unchanged
from semstab.data.records import Result
from semstab.data.results import slug
from semstab.datasets import GROUND_TRUTH
from semstab.engine.folder import load_result
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.definition import Benchmark, load_benchmark
from semstab.leaderboard.geometry import Spots
from semstab.leaderboard.sums import LARGEST_SHIFT, SPARSE_SHIFT, checked
from semstab.predict.dataset import NAME as PREDICTED

SUFFIX = ".semstab"
"""Suffix of the files."""

LARGEST, LARGEST_OF_SCENE = 1_500_000, 200_000
"""Bytes of a file at most, or of a scene in the mean if that is more: sums of the map are made coarser until they fit,
which changes no number, but the ends of intervals. Alpha and ranks are of spots, whose cubes are the definition's."""

LONGEST_LINE = 500
"""Most characters of a line that is told of a model or a machine."""

PACKAGES = ("numpy", "numba", "open3d", "torch", "transformers", "tflite-runtime", "ai-edge-litert")
"""Packages whose versions are told, where they are installed."""


def _one_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("write one line, without control characters and marks of direction")
    return text


Line = Annotated[str, Field(max_length=LONGEST_LINE), AfterValidator(_one_line)]


class ModelCard(Settings):
    """Description of a model by the people who submit its result."""

    name: Line = Field("", description="its name in the table; by default the name of the label source")
    by: Line = Field("", description="who made it")
    url: Line = Field("", pattern=r"^(https?://\S+)?$", description="its web page")
    license: Line = Field("", description="licence of the weights")
    parameters: float | None = Field(None, gt=0, description="number of its parameters, millions")
    trained_on: Line = Field("", description="training data")
    notes: Line = Field("", description="anything else, in a few words")

    @classmethod
    def load(cls, path: Path) -> ModelCard:
        """Read a YAML file. Raises ConfigError in one line."""
        return validated(cls, read_yaml(path), f"{path}: ")


@dataclass(frozen=True)
class Submission:
    """Description of a submitted result, in addition to its sums.

    Attributes:
        benchmark: NAME@VERSION; `digest` is the digest of its definition.
        made: Day, year first.
        semstab, python, platform, processor, cores, packages: Software and machine of the computation.
        predicted: Whether the model predicted in this very run, so that milliseconds are its own.
        milliseconds: Time of the model for a frame, on this machine; NaN if label maps were read.
    """

    benchmark: str
    digest: str
    card: Mapping[str, Any]
    made: str
    semstab: str
    python: str
    platform: str
    processor: str
    cores: int
    packages: Mapping[str, str] = field(default_factory=dict)
    predicted: bool = False
    milliseconds: float = math.nan


def submissions(run: Path, path: Path, card: ModelCard | None = None) -> Iterator[tuple[Path, RunHandle]]:
    """Write the result of each model of a finished run of a benchmark into a file; yield the file and what it holds.

    Args:
        run: Folder of the run.
        path: File of the only model; or a folder, which gets a file for each model.
        card: What is said of the only model.

    Raises:
        ConfigError: If the run is not of a benchmark, its settings are others, or there are several models for a file.
        DataError: If the run is damaged.
    """
    result, file = load_result(run), run / "config.yaml"
    with only_named(file, ()):
        config = Config.build(read_yaml(file), str(file))
    benchmark = _benchmark_of(run, config)
    require_unchanged(file)
    models = [name for name in result.models if name != GROUND_TRUTH]
    most = max(LARGEST, LARGEST_OF_SCENE * len(benchmark.geometry))
    if len(models) > 1 and (path.suffix or card is not None):
        what = path if path.suffix else "--card"
        raise ConfigError(f"{what}: the run has several models ({', '.join(models)}); choose one with --model")
    for model in models:
        handle = open_run(f"{run}:{model}")
        handle.require_labels()
        require_whole(benchmark, handle)
        about = _about(benchmark, result, config, handle, card or ModelCard())
        scenes = {scene: _in_cubes(entry, benchmark.geometry[scene]) for scene, entry in handle.scenes.items()}
        handle = dataclasses.replace(handle, about=to_json(about), scenes=scenes)
        file = path if path.suffix else path / f"{benchmark.id}__{slug(model)}{SUFFIX}"
        file.parent.mkdir(parents=True, exist_ok=True)
        save_summary(handle, file, most, single=True, keep_spots=True)
        yield file, handle


def load_submission(
    path: Path, definitions: Mapping[str, Benchmark] | None = None
) -> tuple[Benchmark, Submission, RunHandle]:
    """Return the benchmark, what is said of the model, and the numbers of a file, checked.

    Args:
        path: The file.
        definitions: Benchmarks that do not ship with semstab, by NAME@VERSION.

    Raises:
        ConfigError, DataError: If it is no result of a benchmark that is known, or its sums cannot be.
    """
    if path.is_dir():
        raise DataError(f"{path}: it is a folder; results are files that --submit wrote")
    handle = open_run(path)
    if not handle.about:
        raise DataError(f"{path}: it is a small summary, but of no benchmark; write it with benchmark ... --submit")
    about = from_json(Submission, handle.about, path)
    try:
        benchmark = (definitions or {}).get(about.benchmark) or load_benchmark(about.benchmark)
        validated(ModelCard, dict(about.card), "card: ")
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error
    if about.digest != benchmark.digest:
        raise DataError(
            f"{path}: it is of another definition of {benchmark.id} ({about.digest}; this semstab has"
            f" {benchmark.digest}); run the benchmark again"
        )
    _require_statement(path, about)
    require_whole(benchmark, handle)
    return benchmark, about, dataclasses.replace(handle, scenes=_checked(path, benchmark, handle))


def _checked(path: Path, benchmark: Benchmark, handle: RunHandle) -> dict[str, Entry]:
    """Return the scenes with their sums as the definition has them; flicker, which nothing vouches for, is left out."""
    made = {}
    for scene in benchmark.scenes:
        entry = handle.scenes[scene]
        sums = checked(
            f"{path}: {scene}", entry.sums, benchmark.geometry[scene], truth=benchmark.statistics,
            voxel_size=benchmark.voxel_size, shift=SPARSE_SHIFT if benchmark.is_sparse else LARGEST_SHIFT,
        )  # fmt: skip
        made[scene] = dataclasses.replace(entry, small=(sums, {}))
    return made


def _in_cubes(entry: Entry, spots: Spots) -> Entry:
    """Return a scene with the sums of its spots in the cubes of the definition."""
    answers = tuple(part.coarsened(spots.edge, spots.step) for part in entry.sums.answers)
    sums = dataclasses.replace(entry.sums, answers=answers, features=None)
    return dataclasses.replace(entry, small=(sums, entry.flicker))


def require_whole(benchmark: Benchmark, handle: RunHandle) -> None:
    """Raise DataError where scenes, frames or voxels are not those of the definition."""
    for scene in benchmark.scenes:
        if (entry := handle.scenes.get(scene)) is None:
            raise DataError(f"{handle.where}: {scene} of {benchmark.id} is missing; run all of its scenes")
        record, digests = entry.record, (benchmark.digests or {}).get(scene)
        if digests is not None and record.frames != len(digests.split()):
            raise DataError(
                f"{handle.where}: {scene} has {record.frames} frames, but {len(digests.split())} in {benchmark.id};"
                " run it again"
            )
        if not math.isclose(record.map_summary.voxel_size, benchmark.voxel_size):
            raise DataError(f"{handle.where}: its voxels are not those of {benchmark.id}; run it again")
        if record.statistics is None or (benchmark.statistics and not entry.sums.truth):
            lacking = "statistics" if record.statistics is None else "ground truth"
            raise DataError(f"{handle.where}: {scene} has no {lacking}; run it again")
    if more := [scene for scene in handle.scenes if scene not in benchmark.scenes]:
        raise DataError(f"{handle.where}: {more[0]} is no scene of {benchmark.id}; run it again")


def _benchmark_of(run: Path, config: Config) -> Benchmark:
    if config.benchmark is None:
        raise ConfigError(f"{run}: it is a run of no benchmark; start it with semstab-bench benchmark NAME")
    benchmark = load_benchmark(config.benchmark.file or config.benchmark.id)
    if benchmark.digest != config.benchmark.digest:
        raise ConfigError(f"{run}: {benchmark.id} has changed since; run it again")
    changed = benchmark.changed(config)
    if changed:
        raise ConfigError(f"{run}: {changed[0]} is not that of {benchmark.id}; run it again")
    return benchmark


def _about(benchmark: Benchmark, result: Result, config: Config, handle: RunHandle, card: ModelCard) -> Submission:
    network = [entry.record.stages_ms.get("network", math.nan) for entry in handle.scenes.values()]
    predicted = config.dataset.name == PREDICTED and not np.isnan(network).all()
    versions = {name: version for name in PACKAGES if (version := version_of(name))}
    return Submission(
        benchmark.id,
        benchmark.digest,
        card.model_dump(mode="json", exclude_defaults=True),
        datetime.now(UTC).date().isoformat(),
        str(result.manifest.get("semstab")),
        platform.python_version(),
        f"{platform.system()} {platform.machine()}",
        _processor(),
        os.cpu_count() or 1,
        versions,
        predicted,
        float(np.nanmean(network)) if predicted else math.nan,
    )


def _require_statement(path: Path, about: Submission) -> None:
    """Raise DataError if a field next to the sums is not valid: a line of text, a day, a time."""
    texts = {name: getattr(about, name) for name in ("made", "semstab", "python", "platform", "processor")}
    texts |= {f"packages.{name}": f"{name} {version}" for name, version in about.packages.items()}
    for name, text in texts.items():
        if len(text) > LONGEST_LINE or not text.isprintable():
            raise DataError(f"{path}: about.{name}: is no line of at most {LONGEST_LINE} characters; write it again")
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", about.made):
        raise DataError(f"{path}: about.made: is no day such as 2026-11-29; write it again")
    if about.milliseconds < 0 or about.cores < 1:
        raise DataError(f"{path}: about: milliseconds or cores are negative; write it again")


def _processor() -> str:
    """Return the name of the processor, as far as the system tells it."""
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            key, _, name = line.partition(":")
            if key.strip() == "model name":
                return name.strip()
    return platform.processor() or platform.machine()
