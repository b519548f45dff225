"""The files of a work: written into the folder of the run, or returned as bytes if a worker does not see it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from semstab.core.background import Background
from semstab.core.files import ScratchFolder, file_digest
from semstab.engine.work import Start

Savers = dict[str, Callable[[Path], None]]
"""A function that writes each file of a unit, by the file's path in the folder."""


class Files:
    """The files of a work, written by one thread.

    Attributes:
        digests: Their digests by their path in the folder.
        returned: Their bytes, where the folder is not shared.
    """

    def __init__(self, start: Start) -> None:
        self._start, self.digests, self.returned = start, dict[str, str](), dict[str, bytes]()
        self._writer = Background("semstab-files", 1)

    def write_ahead(self, savers: Savers) -> None:
        """Begin to write some of them; an error is raised by `write`."""
        self._writer.submit(partial(self._write, savers))

    def write(self, savers: Savers) -> None:
        """Write some of them, after those that were begun."""
        self._writer.drain()
        self._write(savers)

    def _write(self, savers: Savers) -> None:
        digests, returned = written(self._start, savers)
        self.digests |= digests
        self.returned |= returned

    def close(self) -> None:
        """Finish those that were begun."""
        self._writer.close()


def written(start: Start, savers: Savers) -> tuple[dict[str, str], dict[str, bytes]]:
    """Write files into a shared folder, and return their digests; without a shared folder, also return their bytes."""
    if start.marker.exists():
        for name, save in savers.items():
            save(start.folder / name)
        return {name: file_digest(start.folder / name).hex() for name in savers}, {}
    digests, returned = {}, {}
    with ScratchFolder() as elsewhere:
        for name, save in savers.items():
            path = elsewhere / name
            save(path)
            digests[name], returned[name] = file_digest(path).hex(), path.read_bytes()
    return digests, returned
