"""Small summaries: all data of a later comparison except voxels, in one file that a repository can store."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semstab.comparison.entries import Entry, RunHandle, valid_flicker
from semstab.core.files import ScratchFolder, atomic_path, parse_json, read_limited
from semstab.core.json_form import from_json, to_json
from semstab.core.sealed_zip import packed, unpacked
from semstab.data import parquet
from semstab.data.georeference import Georeference
from semstab.data.image_measures import ImageSpace
from semstab.data.records import Record
from semstab.errors import DataError, sanitize, summarize_error
from semstab.statistics.cluster_sums import ClusterSums

SCHEMA, KIND = 1, "semstab small summary"
CONTENT = "summary.json"
LARGEST = 100_000_000
"""Most bytes of a file, of its unpacked content, and of the numbers in it."""

LONGEST_NAME = 255
"""The largest number of characters of a name in an archive: file systems allow a file's name as many."""

LONGEST_CONTENT = 2**23
"""Most bytes of its text: of ten models in a hundred scenes it has a tenth."""

MANY_GROUPS = 32
"""Number of groups of frames above which these are joined, before cubes are."""


@dataclass(frozen=True, kw_only=True)
class _Scene:
    summary: Record
    image_space: ImageSpace
    georeference: Georeference | None
    up: tuple[float, float, float] | None
    seed: int | None
    name: str
    frames: tuple[int, ...]
    flicker: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.flicker) or not valid_flicker(self.frames, self.flicker):
            raise DataError("percentages of flicker, or the frames they are of, are out of range")


@dataclass(frozen=True)
class _Content:
    model: str
    scenes: tuple[_Scene, ...] = field(default=())
    about: dict[str, Any] = field(default_factory=dict)


def save_summary(
    run: RunHandle, path: str | Path, most: int = 1_000_000, *, single: bool = False, keep_spots: bool = False
) -> None:
    """Write all data of a later comparison except voxels into one file.

    Its cubes of space and groups of frames are as fine as `most` bytes allow; sums are rounded to single precision on
    request, which halves the file; `keep_spots` makes sums of the map coarser alone.

    Raises:
        DataError: If even the coarsest sums need more, or a scene is a video: it has no sums.
    """
    if video := next((name for name, entry in run.scenes.items() if not entry.sums.layout), None):
        raise DataError(f"{path}: {video} is a video, without a map to summarise; compare the folder of the run")
    scenes = tuple(
        _Scene(
            summary=entry.record.without_files(),
            image_space=entry.record.image_space,
            georeference=entry.georeference,
            up=entry.up,
            seed=entry.seed,
            name=name,
            frames=(*entry.flicker,),
            flicker=(*entry.flicker.values(),),
        )
        for name, entry in run.scenes.items()
    )
    content = json.dumps({"kind": KIND, "schema": SCHEMA, **to_json(_Content(run.model, scenes, {**run.about}))})
    sums = [entry.sums for entry in run.scenes.values()]
    while len(data := _archive(content, sums, single=single)) > most:
        coarser = [_coarser(part, keep_spots=keep_spots) for part in sums]
        if all(np.array_equal(a.cell, b.cell) and a.step == b.step for a, b in zip(coarser, sums, strict=True)):
            raise DataError(f"{path}: a summary of {len(sums)} scenes takes {len(data)} bytes; use fewer scenes")
        sums = coarser
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def load_summary(path: str | Path) -> RunHandle:
    """Return what `save_summary` wrote.

    Raises:
        DataError: For any other file.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(io.BytesIO(read_limited(path, LARGEST))) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST:
                raise DataError(f"{path}: it unpacks to more than {LARGEST // 10**6} MB; write the summary again")
            if archive.getinfo(CONTENT).file_size > LONGEST_CONTENT:
                raise DataError(f"{path}: its text has more than {LONGEST_CONTENT} bytes; write the summary again")
            members = unpacked(archive)
            text = parse_json(members[CONTENT])
            if not isinstance(text, dict) or (text.get("kind"), text.get("schema")) != (KIND, SCHEMA):
                raise DataError("it is of another kind or version")
            content = from_json(_Content, text, path)
            for name in (content.model, *(scene.name for scene in content.scenes)):
                _require_name(path, name)
            files = [members[f"{i}.parquet"] for i in range(len(content.scenes))]
    except (OSError, zipfile.BadZipFile, zlib.error, LookupError, ValueError, RuntimeError, EOFError) as error:
        if isinstance(error, DataError) and str(path) in str(error):
            raise
        raise DataError(
            f"{path}: it is neither a run's folder nor a small summary ({summarize_error(error)})"
        ) from error
    scenes, room = {}, LARGEST
    with ScratchFolder() as folder:
        part = folder / "sums.parquet"
        for numbers, data in zip(content.scenes, files, strict=True):
            part.write_bytes(data)
            try:
                room -= parquet.unpacked_bytes(part)
                if room < 0:
                    raise DataError(f"{part}: its sums take more than {LARGEST} bytes")
                sums = ClusterSums.load(part)
            except DataError as error:
                raise DataError(f"{path}: the sums of {numbers.name} are damaged; write the summary again") from error
            flicker = dict(zip(numbers.frames, numbers.flicker, strict=True))
            scenes[numbers.name] = Entry(
                record=dataclasses.replace(numbers.summary.without_files(), image_space=numbers.image_space),
                georeference=numbers.georeference, up=numbers.up, seed=numbers.seed,
                where=str(path), is_small=True, small=(sums, flicker),
            )  # fmt: skip
    return RunHandle(content.model, path, content.model, scenes, content.about)


def _require_name(path: Path, name: str) -> None:
    """Raise DataError for a name that no folder of a scene or model has."""
    if not name or len(name) > LONGEST_NAME or not name.isprintable():
        raise DataError(f"{path}: {sanitize(repr(name))[:80]} is no name of a scene or model; write the summary again")


def _archive(content: str, sums: list[ClusterSums], *, single: bool) -> bytes:
    """Return the file, byte for byte the same for the same content."""
    members = {CONTENT: content.encode()}
    with ScratchFolder() as folder:
        for i, scene_sums in enumerate(sums):
            part = folder / "sums.parquet"
            scene_sums.save(part, single=single)
            members[f"{i}.parquet"] = part.read_bytes()
    return packed(members)


def _coarser(sums: ClusterSums, *, keep_spots: bool) -> ClusterSums:
    """Join pairs of groups of frames if the sums have more than MANY_GROUPS groups, else join cubes."""
    coarsened = sums.map_coarsened if keep_spots else sums.coarsened
    if sums.step and sums.frames > MANY_GROUPS:
        return coarsened(sums.edge, 2 * sums.step)
    return coarsened(2 * sums.edge, sums.step)
