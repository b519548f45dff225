"""Which files of a scene folder belong to which frame, and which frames are complete."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semstab.datasets import GROUND_TRUTH
from semstab.datasets.disk import files_by_stem, natural, subfolders
from semstab.datasets.images import COLOR_SUFFIXES, DEPTH_SUFFIXES, LABEL_SUFFIXES, MASK_SUFFIXES, SCORE_SUFFIXES
from semstab.errors import ConfigError, DataError

logger = logging.getLogger("semstab")

MAX_LISTED = 5

LABEL_SPACE_FILE = "label_space.yaml"
"""In a folder of label maps or scores: their classes, where they are not the scene's; a taxonomy file."""

Kind = Literal["depth", "pose", "color", "mask", "labels", "scores"]

SUFFIXES: Mapping[Kind, tuple[str, ...]] = {
    "depth": DEPTH_SUFFIXES,
    "pose": (".txt",),
    "color": COLOR_SUFFIXES,
    "mask": MASK_SUFFIXES,
    "labels": LABEL_SUFFIXES,
    "scores": SCORE_SUFFIXES,
}
"""Of each kind of file, the usual suffix first."""


@dataclass(frozen=True)
class FrameFiles:
    """The files of one folder by frame name."""

    kind: Kind
    folder: Path
    files: Mapping[str, Path]

    @classmethod
    def of(cls, kind: Kind, folder: Path) -> FrameFiles:
        """List a folder; one that is not there has no files. Raises DataError for two files of one frame."""
        return cls(kind, folder, files_by_stem(folder, SUFFIXES[kind]))

    def missing(self, name: str) -> list[str]:
        """Nothing, or the path that the file of that frame would have."""
        suffix = next((path.suffix for path in self.files.values()), SUFFIXES[self.kind][0])
        return [] if name in self.files else [str(self.folder / f"{name}{suffix}")]


class SceneFiles:
    """The files of one scene folder; making it lists folders and opens nothing.

    Raises DataError for two files of one frame, or two label sources of one name.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.depth = FrameFiles.of("depth", folder / "depth")
        self.pose = FrameFiles.of("pose", folder / "pose")
        self.color = FrameFiles.of("color", folder / "color")
        self.mask = FrameFiles.of("mask", folder / "mask")
        self.sources = _sources(folder)
        self.regions = _regions(folder, self.sources)
        truth = folder / "labels" / GROUND_TRUTH
        self.ground_truth = FrameFiles.of("labels", truth) if truth.is_dir() else None

    def source(self, backbone: str) -> FrameFiles:
        """The label maps, scores or regions of a backbone. Raises ConfigError where there is none of that name."""
        known = {**self.sources, **self.regions}
        if self.ground_truth is not None:
            known[GROUND_TRUTH] = self.ground_truth
        if backbone not in known:
            hint = nearest(backbone, known) if known else "put its label maps into labels/NAME/ or scores/NAME/"
            raise ConfigError(f"{self.folder}: backbone '{backbone}' is not there; {hint}")
        return known[backbone]

    def complete(self, incomplete: Literal["error", "skip"], needs: Literal["labels", "color"] = "labels") -> list[str]:
        """Names of the frames with depth, a pose and labels of every backbone (or colour), in natural order.

        Raises DataError that lists missing files, unless such frames are to be skipped, or where no frame is complete.
        """
        needed = [self.depth, self.pose, *(self.sources.values() if needs == "labels" else [self.color])]
        names = sorted({name for part in needed for name in part.files}, key=natural)
        missing = {name: [path for part in needed for path in part.missing(name)] for name in names}
        complete = [name for name in names if not missing[name]]
        lost = [path for paths in missing.values() for path in paths]
        if lost and incomplete == "error":
            raise DataError(
                f"{self.folder}: {listed(lost)}; add them, or set incomplete: skip to leave such frames out"
            )
        if not complete:
            raise DataError(f"{self.folder}: no frame has depth, pose and {needs} ({listed(lost)})")
        if lost:
            logger.warning(
                "%s: %d of %d frames left out: %s", self.folder, len(names) - len(complete), len(names), listed(lost)
            )
        return complete


def scene_folders(root: Path) -> dict[str, Path]:
    """Name to folder of the scenes in a folder, or of the one that it is. Raises DataError where there is none."""
    if not root.is_dir():
        raise DataError(f"{root}: there is no such folder; set root to a scene or to the folder above scenes")
    if (root / "depth").is_dir():
        return {root.resolve().name or "scene": root}
    scenes = {name: root / name for name in subfolders(root) if (root / name / "depth").is_dir()}
    if not scenes:
        raise DataError(f"{root}: no scene here; looked for {root / 'depth'} and for {root / '*' / 'depth'}")
    return scenes


def _sources(folder: Path) -> dict[str, FrameFiles]:
    """labels/X is backbone 'X', scores/X is 'X-scores', so that neither name depends on what else is there."""
    labels, scores = folder / "labels", folder / "scores"
    sources = {name: FrameFiles.of("labels", labels / name) for name in subfolders(labels) if name != GROUND_TRUTH}
    for name in subfolders(scores):
        backbone = f"{name}-scores"
        if backbone in sources:
            raise DataError(f"{labels / backbone}: {scores / name} is called '{backbone}' too; rename one")
        if name != GROUND_TRUTH:
            sources[backbone] = FrameFiles.of("scores", scores / name)
    return sources


def _regions(folder: Path, sources: Mapping[str, FrameFiles]) -> dict[str, FrameFiles]:
    """regions/X is read under the name 'X'."""
    regions = folder / "regions"
    found = {name: FrameFiles.of("labels", regions / name) for name in subfolders(regions)}
    if both := sorted({*found} & {*sources}):
        raise DataError(f"{regions / both[0]}: {sources[both[0]].folder} is called '{both[0]}' too; rename one")
    return found


def listed(missing: list[str]) -> str:
    """The number of missing files and the first of them."""
    more = f", ... ({len(missing) - MAX_LISTED} more)" if len(missing) > MAX_LISTED else ""
    return f"{len(missing)} missing: {', '.join(missing[:MAX_LISTED])}{more}"


def nearest(name: str, known: Iterable[str]) -> str:
    """The known names, those most like `name` first."""
    names = list(known)
    return f"there are {', '.join(difflib.get_close_matches(name, names, n=len(names), cutoff=0))}"
