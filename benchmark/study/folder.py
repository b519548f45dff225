"""The study folder: what a study leaves on disk, unit by unit, so that a killed one goes on where it was."""

from __future__ import annotations

import contextlib
import hashlib
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from semstab.datasets.disk import file_digest
from semstab.errors import ConfigError, DataError
from semstab.files import atomic_path, read_json, write_json, write_text
from semstab.json_form import from_json
from semstab.results import Unit, UnitSummary, slug
from semstab.study.config import StudyConfig
from semstab.study.grid import Cell, RegionCell
from semstab.study.jobs import Outcome, shared_marker
from semstab.study.results import OVERVIEW, VOXELS, ImageSpace, Record, StudyResult

UNITS = "units"
SETTINGS = "study.yaml"
LEFTOVERS = (".shared-*", f"{UNITS}/.*.json", f"{VOXELS}/.*.parquet", f"{OVERVIEW}/.*.npz")
"""What a start that was killed may have left half-written."""


class StudyFolder:
    """STUDY/: of one study or of changed versions of it; what was computed with the same settings is kept.

    Raises ConfigError where the folder holds something else than a study.
    """

    def __init__(self, path: str | Path, config: StudyConfig) -> None:
        self.path = Path(path).absolute()
        self._claim()
        (self.path / UNITS).mkdir(parents=True, exist_ok=True)
        write_text(self.path / SETTINGS, config.to_yaml())
        self._files = {file.stem: file for file in (self.path / UNITS).glob("*.json")}

    def kept(self, cell: Cell | RegionCell) -> Mapping[str, Any] | None:
        """What an earlier start left of a cell's unit, if its input is the same and nothing that is wanted is missing.

        The input is read to compare it only where there is such a unit at all.
        """
        if not any(name.startswith(cell.identity) for name in self._files):
            return None
        try:
            file = self._files.get(unit_key(cell.identity, cell.digest))
        except DataError:
            return None  # the input cannot be read: computing the unit will say so
        content = None if file is None else read_json(file)
        return content if isinstance(content, dict) and self._is_whole(cell, content) else None

    def save(self, outcome: Outcome) -> None:
        """Keep a finished unit."""
        assert outcome.content is not None
        for name, file in outcome.files.items():
            with atomic_path(self.path / name) as temporary:
                temporary.write_bytes(file)
        key = unit_key(outcome.identity, outcome.content["input"])
        write_json(self.path / UNITS / f"{key}.json", outcome.content)

    def record(self, cell: Cell, content: Mapping[str, Any]) -> Record:
        """A cell's record from the content of its unit's file. Raises DataError where that is damaged."""
        key = unit_key(cell.identity, content["input"])
        path = self.path / UNITS / f"{key}.json"
        try:
            return Record(
                key=key,
                variation=cell.variation,
                summary=from_json(UnitSummary, content["summary"], path),
                image_space=from_json(ImageSpace, content["image_space"], path) if cell.image_space else ImageSpace(),
                voxels=self._voxels(cell.unit) if cell.voxels else None,
            )
        except KeyError as error:
            raise DataError(f"{path}: damaged ({error!r}); delete it, and the unit is computed again") from error

    def save_result(self, result: StudyResult) -> None:
        """Write summary.json and manifest.json."""
        write_json(self.path / "summary.json", result.to_dict())
        write_json(self.path / "manifest.json", result.manifest)

    @contextlib.contextmanager
    def started(self) -> Iterator[str]:
        """A name for this start of the study, by which workers know its folder while the block lasts."""
        start = uuid.uuid4().hex
        for leftover in (name for pattern in LEFTOVERS for name in self.path.glob(pattern)):
            leftover.unlink()
        marker = shared_marker(self.path, start)
        marker.touch()
        try:
            yield start
        finally:
            marker.unlink(missing_ok=True)

    def _is_whole(self, cell: Cell | RegionCell, content: Mapping[str, Any]) -> bool:
        """Whether the unit's file has what is wanted of the cell, and its other files are there as they were."""
        if not all(name in content for name in cell.parts()):
            return False
        unit, digests = cell.unit, content.get("files", {})
        wanted = [f"{VOXELS}/{unit.slug}.parquet"] if cell.voxels else []
        wanted += [f"{OVERVIEW}/{slug(unit.scene, unit.backbone)}.npz"] if cell.image_space else []
        paths = {name: self.path / name for name in wanted}
        return all(path.exists() and file_digest(path).hex() == digests.get(name) for name, path in paths.items())

    def _voxels(self, unit: Unit) -> Path:
        return self.path / VOXELS / f"{unit.slug}.parquet"

    def _claim(self) -> None:
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise ConfigError(f"{self.path}: is a file; name a folder for the study")
        if not (self.path / SETTINGS).exists() and any(self.path.iterdir()):
            raise ConfigError(f"{self.path}: is not empty and holds no study; choose another folder")


def unit_key(identity: str, digest: str) -> str:
    """Under which a unit is kept: the hash of its settings, then one of its input."""
    return identity + hashlib.blake2b(digest.encode(), digest_size=8).hexdigest()


def load_study_result(folder: str | Path) -> StudyResult:
    """What a finished study found, from its folder. Raises DataError where it is not there or damaged."""
    folder = Path(folder)
    content = read_json(folder / "summary.json")
    try:
        return StudyResult.from_dict(content, folder, read_json(folder / "manifest.json"))
    except (KeyError, TypeError) as error:
        raise DataError(f"{folder / 'summary.json'}: not the summary of a study ({error!r})") from error
