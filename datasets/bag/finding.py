"""The bags below a folder, each of which is a scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from semstab.datasets.bag.reading import SUFFIXES, is_bag
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.reader import DEEPEST
from semstab.datasets.formats.disk import files_named, natural, subfolders
from semstab.errors import DataError

CONTENTS = f"a ROS bag ({', '.join(SUFFIXES)}, or a folder of a rosbag2)"
"""What a scene is, for error messages."""


class OfBags:
    """The part of a dataset that finds its scenes, which are bags.

    Attributes:
        bags: The bag of each scene, by the scene's folder.
    """

    contents = CONTENTS
    bags: dict[Path, Path]

    def find_scenes(self, root: Path) -> list[SceneEntry]:
        """Return the bag that the root is, else the bags below it in natural order.

        Raises:
            DataError: If there is none, or two would have one name.
        """
        entries = find_bags(root)
        self.bags = {entry.folder: path for entry, path in entries}
        return [entry for entry, _ in entries]

    def is_scene(self, folder: Path) -> bool:
        """Return whether a path is a bag."""
        return is_bag(folder)


def find_bags(root: Path) -> list[tuple[SceneEntry, Path]]:
    """Return the bag that the root is, else the bags below it in natural order, each with the scene that it is.

    Raises:
        DataError: If there is none, or two would have one name.
    """
    if not root.exists():
        raise DataError(f"{root}: there is no such bag or folder; set root to a bag, or to the folder above bags")
    paths = [root] if is_bag(root) else sorted(_bags_below(root, DEEPEST), key=lambda path: natural(str(path)))
    if not paths:
        raise DataError(f"{root}: no bag here, nor {DEEPEST} folders deep; expected {CONTENTS}")
    bags, entries = dict[Path, Path](), []
    for path in paths:
        folder = path if path.is_dir() else path.with_suffix("")
        if folder in bags:
            raise DataError(f"{path}: {bags[folder].name} would be a scene of the same name; rename one")
        bags[folder] = path
        parts = (folder.resolve().name or "scene",) if path == root else folder.relative_to(root).parts
        entries.append((SceneEntry("-".join(parts), folder, "/".join(parts)), path))
    return entries


def _bags_below(folder: Path, levels: int) -> Iterator[Path]:
    """Yield the bags in a folder and, up to so many levels, in the folders below it."""
    if not folder.is_dir():
        return
    for suffix in SUFFIXES:
        yield from (path for path in files_named(folder, "", suffix).values() if is_bag(path))
    for name in subfolders(folder) if levels else ():
        yield from [folder / name] if is_bag(folder / name) else _bags_below(folder / name, levels - 1)
