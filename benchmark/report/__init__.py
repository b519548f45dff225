"""report.html and the tables of a finished run."""

from __future__ import annotations

from pathlib import Path

from semstab.core.files import write_text
from semstab.engine.observer import Observer
from semstab.model.records import Result
from semstab.report.tables import write_tables

__all__ = ["Reporting", "write_report"]


class Reporting(Observer):
    """Writes tables and report.html into the folder when all has been computed."""

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder)

    def run_finished(self, result: Result) -> None:
        """Write them; nothing where every unit failed."""
        if result.select():
            write_tables(result, self._folder)
            write_report(result, self._folder)


def write_report(result: Result, folder: str | Path) -> Path:
    """Write FOLDER/report.html, from the result and the files that its run left in the folder; return its path."""
    from semstab.report.page import render

    path = Path(folder) / "report.html"
    write_text(path, render(result, Path(folder)))
    return path
