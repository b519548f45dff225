"""Path templates such as 'labels/{backbone}/{name}.png', and paths that stay inside a folder."""

from __future__ import annotations

import os
import re
from bisect import bisect_left
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import natural, subfolders
from semstab.errors import ConfigError, DataError

LONGEST = 400
"""Characters of a path inside a dataset."""
PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
UNSAFE = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029\ud800-\udfff]")


@dataclass(frozen=True)
class Template:
    """A path, relative to a folder and inside it, with {placeholders}.

    Raises ConfigError, which names the option, for an absolute path, '..', or a placeholder that is not known.
    """

    option: str
    text: str
    known: tuple[str, ...]
    required: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = PLACEHOLDER.findall(self.text)
        for name in names:
            if name not in self.known:
                raise ConfigError(f"{self._says}: unknown {{{name}}}; known: {_listed(self.known)}")
        for name in self.required:
            if name not in names:
                raise ConfigError(f"{self._says}: needs {{{name}}}")
        if any(brace in PLACEHOLDER.sub("", self.text) for brace in "{}"):
            raise ConfigError(f"{self._says}: a brace is not closed; placeholders are {_listed(self.known)}")
        path = PurePosixPath(self.text)
        if path.is_absolute() or ".." in path.parts or UNSAFE.search(self.text) or not path.parts:
            raise ConfigError(
                f"{self._says}: leaves its folder; write a path inside it, and set root, or labels_root for labels that"
                " stand elsewhere"
            )

    def filled(self, **values: str) -> str:
        """The path with the placeholders that are given replaced."""
        return PLACEHOLDER.sub(lambda match: values.get(match[1], match[0]), self.text)

    @property
    def _says(self) -> str:
        return f"{self.option}: {self.text[:200]!r}"


def _listed(names: Collection[str]) -> str:
    return ", ".join(f"{{{name}}}" for name in names) or "none"


def matching_folders(base: Path, template: Template, placeholder: str, **values: str) -> dict[str, str]:
    """The folders on disk that fit the part of a template with `placeholder`: its value to the template with it.

    Raises ConfigError where the placeholder is not in the name of a folder, or after one that is still open.
    """
    parts = PurePosixPath(template.filled(**values)).parts
    hole = f"{{{placeholder}}}"
    k = next(k for k, part in enumerate(parts) if hole in part)
    if k == len(parts) - 1 or any(PLACEHOLDER.search(part) for part in parts[:k]):
        raise ConfigError(f"{template.option}: {hole} must be in the name of a folder, before the other placeholders")
    before, _, after = parts[k].partition(hole)
    pattern = re.compile(f"{re.escape(before)}(?P<value>.+){re.escape(after.replace(hole, ''))}", re.DOTALL)
    matches = (pattern.fullmatch(name) for name in subfolders(base.joinpath(*parts[:k])))
    found = sorted((match["value"] for match in matches if match), key=natural)
    return {value: "/".join(parts).replace(hole, value) for value in found}


def inside(root: Path, folder: Path, relative: str, where: str) -> Path:
    """`folder / relative`, which must lie in `root`, as `folder` does.

    Raises DataError with `where` (the file that names the path) where it does not, or no path can be called so.
    """
    _require_path(relative, where)
    path = folder / relative
    if ".." not in relative and not relative.startswith("/"):
        return path
    if not Path(os.path.abspath(path)).is_relative_to(os.path.abspath(root)):  # noqa: PTH100  symlinks may lead out
        raise DataError(
            f"{where}: the path {relative[:200]!r} leaves {root}; set root to the folder that holds all files"
        )
    return path if ".." not in path.parts else Path(os.path.normpath(path))


def inside_text(root: Path, relative: str, where: str) -> str:
    """The same of a path relative to the root, as text, which may have more dots and slashes than it needs."""
    if ".." in relative or relative.startswith("/"):
        return str(inside(root, root, relative, where))
    _require_path(relative, where)
    return f"{root}/{relative}"


def _require_path(relative: str, where: str) -> None:
    if UNSAFE.search(relative) or len(relative) > LONGEST:
        raise DataError(f"{where}: {relative[:40]!r} cannot be the path of a file")


class Folders:
    """What lies in folders, each listed when it is first asked for: names as bytes in order, a fifth of a set's memory.

    Several threads may ask.
    """

    def __init__(self) -> None:
        self._names: dict[str, npt.NDArray[np.bytes_]] = {}

    def has(self, path: Path) -> bool:
        """Whether there is a file or folder of that path."""
        return self._has(*os.path.split(path))

    def one_of(self, path: Path, suffixes: Collection[str]) -> Path | None:
        """The path where it has one of the suffixes, else that with the first suffix there is a file of."""
        file = self.file(str(path), suffixes)
        return None if file is None else Path(file)

    def file(self, path: str, suffixes: Collection[str]) -> str | None:
        """The same as text."""
        parent, name = os.path.split(path)
        if os.path.splitext(name)[1].lower() in suffixes:  # noqa: PTH122  of ten thousand names
            return path if self._has(parent, name) else None
        suffix = next((suffix for suffix in suffixes if self._has(parent, name + suffix)), None)
        return None if suffix is None else path + suffix

    def _has(self, folder: str, name: str) -> bool:
        listed, wanted = self._listed(folder), os.fsencode(name)
        at = bisect_left(listed, wanted)
        return at < len(listed) and bool(listed[at] == wanted)

    def _listed(self, folder: str) -> npt.NDArray[np.bytes_]:
        if folder not in self._names:
            try:
                names = os.listdir(os.fsencode(folder or "."))  # noqa: PTH208  names, not paths
            except OSError:
                names = []
            self._names[folder] = np.sort(np.array(names, dtype=np.bytes_))
        return self._names[folder]
