"""The bags below a folder, each of which is a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from semstab.datasets.bag.reading import SUFFIXES, OpenBag, is_bag, recordings
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.reader import DEEPEST
from semstab.datasets.formats.disk import files_named, natural, subfolders
from semstab.errors import DataError

CONTENTS = f"a ROS bag ({', '.join(SUFFIXES)}, or a folder of a rosbag2)"
"""Description of a scene, for error messages."""


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
        self.bags = {entry.folder: paths[0] for entry, paths in entries}
        self._parts = {entry.folder: paths if len(paths) > 1 else () for entry, paths in entries}
        return [entry for entry, _ in entries]

    def open_bag(self, folder: Path) -> OpenBag:
        """Open the bag of a scene's folder. Raises what `OpenBag` raises."""
        return OpenBag(self.bags[folder], self._parts[folder])

    def is_scene(self, folder: Path) -> bool:
        """Return whether a path is a bag."""
        return is_bag(folder)


def find_bags(root: Path) -> list[tuple[SceneEntry, tuple[Path, ...]]]:
    """Return the bag that the root is, else the bags below it in natural order, each with the scene that it is.

    A bag is a file, or a folder; or the files of a recording that was split.

    Raises:
        DataError: If there is none, or two would have one name.
    """
    if not root.exists():
        raise DataError(f"{root}: there is no such bag or folder; set root to a bag, or to the folder above bags")
    groups = [[root]] if is_bag(root) else [*_bags_below(root, DEEPEST)]
    groups.sort(key=lambda paths: natural(str(paths[0])))
    if not groups:
        raise DataError(f"{root}: no bag here, nor {DEEPEST} folders deep; expected {CONTENTS}")
    bags, entries = dict[Path, Path](), []
    alone = Counter(paths[0].parent for paths in groups)
    for path, *further in groups:
        folder = path if path.is_dir() else path.with_suffix("")
        if further:  # a rosbag2 whose metadata.yaml is lost is its folder, as with it
            folder = path.parent if alone[path.parent] == 1 else path.with_name(path.stem.rpartition("_")[0])
        if folder in bags:
            raise DataError(f"{path}: {bags[folder].name} would be a scene of the same name; rename one")
        bags[folder] = path
        parts = (folder.resolve().name or "scene",) if root in (folder, path) else folder.relative_to(root).parts
        entries.append((SceneEntry("-".join(parts), folder, "/".join(parts)), (path, *further)))
    return entries


def _bags_below(folder: Path, levels: int) -> Iterator[list[Path]]:
    """Yield the bags in a folder and in the folders up to `levels` levels below it, each with its parts."""
    if not folder.is_dir():
        return
    for suffix in SUFFIXES:
        yield from recordings([path for path in files_named(folder, "", suffix).values() if is_bag(path)])
    for name in subfolders(folder) if levels else ():
        yield from [[folder / name]] if is_bag(folder / name) else _bags_below(folder / name, levels - 1)
