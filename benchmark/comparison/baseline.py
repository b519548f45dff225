"""A small summary: what a later comparison needs but voxels, in one file that a repository can keep."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from semstab.core.files import atomic_path, parse_json, read_limited
from semstab.core.json_form import from_json, to_json
from semstab.errors import DataError, one_line
from semstab.model.georeference import Georeference
from semstab.model.records import ImageSpace
from semstab.model.results import UnitSummary
from semstab.statistics.cluster_sums import ClusterSums

SCHEMA, KIND = 1, "semstab small summary"
CONTENT = "summary.json"
LARGEST = 100_000_000
"""Bytes of a file that is looked into, and of all that is packed in it."""

MANY_GROUPS = 32
"""Groups of frames down to which these are joined, before cubes are."""


def valid_flicker(frames: Iterable[int], percents: Iterable[float]) -> bool:
    """Whether these are percentages, of frames that have an index."""
    return all(0 <= frame < 2**31 for frame in frames) and all(0 <= percent <= 100 for percent in percents)


@dataclass(frozen=True)
class Kept:
    """What is kept of a scene beside its sums; flicker in percent by frame."""

    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    flicker: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class Baseline:
    """A label source with its scenes, and the sums of each."""

    backbone: str
    scenes: Mapping[str, Kept]
    sums: Mapping[str, ClusterSums]


@dataclass(frozen=True)
class _Scene:
    """As it stands in the file: JSON has no numbers for keys."""

    name: str
    summary: UnitSummary
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    frames: tuple[int, ...]
    flicker: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.flicker) or not valid_flicker(self.frames, self.flicker):
            raise DataError("percentages of flicker, or the frames they are of, are out of range")


@dataclass(frozen=True)
class _Content:
    backbone: str
    scenes: tuple[_Scene, ...] = field(default=())


def save_baseline(baseline: Baseline, path: str | Path, most: int) -> None:
    """Write the file, with cubes of space and groups of frames as fine as `most` bytes allow.

    Raises DataError where even the coarsest are too many.
    """
    scenes = tuple(
        _Scene(
            name,
            own.summary,
            own.image_space,
            own.georeference,
            own.up,
            own.seed,
            (*own.flicker,),
            (*own.flicker.values(),),
        )
        for name, own in baseline.scenes.items()
    )
    content = {"kind": KIND, "schema": SCHEMA, **to_json(_Content(baseline.backbone, scenes))}
    sums = list(baseline.sums.values())
    while len(data := _archive(json.dumps(content), sums)) > most:
        coarser = [_coarser(own) for own in sums]
        if all(
            np.array_equal(new.cell, old.cell) and new.step == old.step for new, old in zip(coarser, sums, strict=True)
        ):
            raise DataError(f"{path}: a summary of {len(sums)} scenes takes {len(data)} bytes; keep fewer scenes")
        sums = coarser
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def load_baseline(path: str | Path) -> Baseline:
    """Read what `save_baseline` wrote. Raises DataError where it is damaged, or something else."""
    try:
        with zipfile.ZipFile(io.BytesIO(read_limited(path, LARGEST))) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST:
                raise DataError(f"{path}: unpacks to more than {LARGEST // 10**6} MB; write the summary again")
            text = parse_json(archive.read(CONTENT))
            if not isinstance(text, dict) or (text.get("kind"), text.get("schema")) != (KIND, SCHEMA):
                raise DataError("of another kind or version")
            content = from_json(_Content, text, path)
            files = [archive.read(f"{i}.parquet") for i in range(len(content.scenes))]
    except (OSError, zipfile.BadZipFile, zlib.error, LookupError, ValueError, RuntimeError, EOFError) as error:
        if isinstance(error, DataError) and str(path) in str(error):
            raise
        raise DataError(f"{path}: neither a run's folder nor a small summary ({one_line(error)})") from error
    with tempfile.TemporaryDirectory() as folder:
        sums = {}
        for scene, data in zip(content.scenes, files, strict=True):
            part = Path(folder) / "sums.parquet"
            part.write_bytes(data)
            try:
                sums[scene.name] = ClusterSums.load(part)
            except DataError as error:
                raise DataError(f"{path}: the sums of {scene.name} are damaged; write the summary again") from error
    kept = {
        own.name: Kept(
            own.summary,
            own.image_space,
            own.georeference,
            own.up,
            own.seed,
            dict(zip(own.frames, own.flicker, strict=True)),
        )
        for own in content.scenes
    }
    return Baseline(content.backbone, kept, sums)


def _archive(content: str, sums: list[ClusterSums]) -> bytes:
    """The file, byte for byte the same for the same content."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive, tempfile.TemporaryDirectory() as folder:
        archive.writestr(zipfile.ZipInfo(CONTENT), content, zipfile.ZIP_DEFLATED)
        for i, own in enumerate(sums):
            part = Path(folder) / "sums.parquet"
            own.save(part)
            archive.writestr(zipfile.ZipInfo(f"{i}.parquet"), part.read_bytes())
    return data.getvalue()


def _coarser(sums: ClusterSums) -> ClusterSums:
    """With half as many groups of frames where there are many, else with larger cubes."""
    if sums.step and sums.frames > MANY_GROUPS:
        return sums.coarsened(sums.edge, 2 * sums.step)
    return sums.coarsened(2 * sums.edge, sums.step)
