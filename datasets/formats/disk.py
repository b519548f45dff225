"""Files and folders of a dataset as they lie on disk: read whole, or one DataError with the path."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Container, Iterable, Iterator
from pathlib import Path

from semstab.errors import DataError
from semstab.runtime.files import open_file, read_limited

AGAIN = "copy or export it again"
MAX_BYTES = 2**32
DIGEST = "sha256"
"""Processors have instructions for it: there it takes half of blake2b's time."""


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """The content of a file of at most `limit` bytes.

    Raises DataError where it cannot be read, is no file, too large or empty, or is a Git LFS pointer.
    """
    try:
        data = read_limited(path, limit)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise DataError(f"{path}: the file is empty; {AGAIN}")
    if data.startswith(b"version https://git-lfs"):
        raise DataError(f"{path}: a Git LFS pointer, not the file itself; run 'git lfs pull'")
    return data


def digest(data: bytes) -> bytes:
    """A hash of a file's content."""
    return hashlib.new(DIGEST, data).digest()


def file_digest(path: Path) -> bytes:
    """The same of a file that was not read. Raises DataError where it cannot be."""
    try:
        with open_file(path) as file:
            return hashlib.file_digest(file, DIGEST).digest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def natural(name: str) -> tuple[list[str | int], str]:
    """Sort key with numbers by value: frame2 before frame10."""
    # a number has as many digits as Python turns into one; names of more are told apart by the whole
    return [int(part[:4000]) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def naturally(names: Iterable[str]) -> list[str]:
    """The names in natural order; of names alike but for their digits, as of a camera, that is the usual order."""
    listed = sorted(names)
    alike = len({re.sub("[0-9]", "0", name) for name in listed}) < 2
    return listed if alike else sorted(listed, key=natural)


def subfolders(folder: Path) -> list[str]:
    """Names in natural order. Raises DataError where the folder cannot be listed."""
    return sorted((entry.name for entry in _entries(folder) if entry.is_dir()), key=natural)


def files_by_stem(folder: Path, suffixes: Container[str]) -> dict[str, str]:
    """Names of the files with one of these suffixes.

    Raises DataError for two of one stem, or a folder that cannot be listed.
    """
    files: dict[str, str] = {}
    for entry in _entries(folder):
        stem, suffix = os.path.splitext(entry.name)  # noqa: PTH122  of a hundred thousand names
        if suffix.lower() not in suffixes or not entry.is_file():
            continue
        if stem in files:
            raise DataError(f"{folder / entry.name}: {files[stem]} is the same frame; keep one of the two")
        files[stem] = entry.name
    return files


def _entries(folder: Path) -> Iterator[os.DirEntry[str]]:
    """What is in a folder, but for hidden entries; nothing where there is no folder."""
    try:
        with os.scandir(folder) as entries:
            yield from (entry for entry in entries if not entry.name.startswith("."))
    except FileNotFoundError:
        return
    except OSError as error:
        raise DataError(f"{folder}: the folder cannot be listed ({error.strerror})") from error
