"""Write report.html and the tables of a finished run."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from semstab.core.background import Background
from semstab.core.files import write_text
from semstab.data.records import Record, RegionFlicker, Result
from semstab.engine.observer import Observer
from semstab.report.tables import write_run_tables

if TYPE_CHECKING:
    from semstab.backends import FusionBackend
    from semstab.config import Config
    from semstab.data.results import UnitName
    from semstab.data.voxels import VoxelTable
    from semstab.engine.units import Unit
    from semstab.report.places import ShownMap
    from semstab.task import Task

__all__ = ["Reporting", "write_report"]


class Reporting(Observer):
    """Writes tables and report.html into the folder at the end of a run, unless they show the same result already."""

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)
        self._beside = Background("semstab-report", 0)
        self._shown: dict[str, Future[ShownMap]] = {}
        self._loads = False

    def group_started(self, task: Task, config: Config, backends: Mapping[UnitName, FusionBackend]) -> None:
        """Load what writes the page, once, while frames are fused."""
        if not self._loads:
            self._loads = True
            self._beside.submit(_load)

    def unit_finished(
        self, unit: Unit, record: Record | RegionFlicker | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Find what the page shows of a map beside the run, while the table is in memory."""
        if table is not None and isinstance(record, Record) and record.up is not None and unit.image_space:
            from semstab.report.places import ShownMap

            self._shown[unit.name.slug] = self._beside.submit(partial(ShownMap.from_record, record, table))

    def run_finished(self, result: Result) -> None:
        """Write tables and report, or nothing where every unit failed."""
        self._beside.close()
        report = self._folder / "report.html"
        if report.exists() and (self._folder / "tables").exists() and not result.manifest["units"]["computed"]:
            with report.open(encoding="utf-8", errors="replace") as page:
                if digest_of(self._folder) in page.read(HEAD):
                    return
        if result.select():
            write_run_tables(result, self._folder)
            write_report(result, self._folder, {unit: future.result() for unit, future in self._shown.items()})


HEAD = 1000
"""The first characters of the page, which contain its digest."""


def digest_of(folder: Path) -> str:
    """Return the digest of the version and the summary that a page is made from."""
    summary = folder / "summary.json"
    return hashlib.sha256(version("semstab").encode() + (summary.read_bytes() if summary.exists() else b"")).hexdigest()


def _load() -> None:
    """Load the modules and the templates that a page is made with."""
    from semstab.report.page import load_templates

    load_templates()


def write_report(result: Result, folder: str | Path, maps: Mapping[str, ShownMap] = MappingProxyType({})) -> Path:
    """Write FOLDER/report.html, from the result and the files that its run left in the folder; return its path.

    Args:
        result: The result of the run or study.
        folder: Its folder.
        maps: What is shown of a map, by the unit's slug; the voxels of other units are read.
    """
    from semstab.report.page import render

    path = Path(folder) / "report.html"
    write_text(path, render(result, Path(folder), digest_of(Path(folder)), maps))
    return path
