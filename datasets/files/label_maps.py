"""The label maps, scores and masks of a scene's frames, read into the ids of its taxonomies, in their own pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.files.frame_source import FrameSource
from semstab.datasets.files.label_ids import translated, without_labels, without_scores
from semstab.datasets.files.label_source import (
    LABEL_SPACE_FILE,
    LabelSource,
    ScenePlace,
    find_masks,
    find_regions,
    find_sources,
    label_space,
)
from semstab.datasets.files.messages import listed, nearest
from semstab.datasets.files.options import FileOptions
from semstab.datasets.files.templates import Folders
from semstab.datasets.formats.images import Read, Size, read_labels, read_mask, read_scores
from semstab.datasets.scene import GROUND_TRUTH
from semstab.datasets.views.resampling import Labels, Scores
from semstab.errors import ConfigError, DataError
from semstab.model.labels import LabelSpace


class LabelMaps:
    """What was predicted of the frames of a scene: which sources there are, their classes, and the maps themselves.

    class_ids  by label source a table from the ids of its files to those of its taxonomy, where they differ
    folders    what lies where maps may be

    Raises ConfigError for options that cannot be used.
    """

    def __init__(
        self,
        options: FileOptions,
        place: ScenePlace,
        frames: Sequence[FrameSource],
        class_ids: Mapping[str, npt.NDArray[np.uint16]],
        folders: Folders,
    ) -> None:
        labels = find_sources(options, place, frames, folders)
        regions = find_regions(options, place, frames, folders, labels)
        self.backbones = tuple(name for name in labels if name != GROUND_TRUTH)
        self.ground_truth = GROUND_TRUTH in labels
        self.regions = tuple(regions)
        self._options = options
        self._folder = place.folder
        self._frames = frames
        self._sources = {**labels, **regions}
        self._masks = find_masks(options, place, folders)
        self._class_ids = class_ids
        self._spaces: dict[str, LabelSpace | None] = {}

    def source(self, backbone: str) -> LabelSource:
        """The files of a label source. Raises ConfigError where there is none of that name."""
        known = self._sources
        if backbone not in known:
            hint = nearest(backbone, known) if known else "put its label maps into labels/NAME/, or set option labels"
            raise ConfigError(f"{self._folder}: backbone '{backbone}' is not there; {hint}")
        return known[backbone]

    def file(self, frame: FrameSource, backbone: str) -> Path:
        """The file of a frame. Raises DataError where it is not there."""
        source = self.source(backbone)
        if (file := source.file(frame)) is None:
            lost = [path for each in self._frames for path in source.missing(each)]
            raise DataError(
                f"{self._folder}: {listed(lost, str(self._folder))}; choose frames that have them, or add them"
            )
        return Path(file)

    def space(self, backbone: str) -> LabelSpace | None:
        """The classes of a label source, None where nothing says them; what says them is read once."""
        if backbone not in self._spaces:
            source, none = self.source(backbone), backbone in self.regions
            self._spaces[backbone] = None if none else label_space(self._options, self._folder, backbone, source)
        return self._spaces[backbone]

    def label_space(self, backbone: str, where: Path) -> LabelSpace:
        """The same; raises DataError with `where` where nothing says them, ConfigError where it has none."""
        source = self.source(backbone)
        if backbone in self.regions:
            raise ConfigError(f"{self._folder}: '{backbone}' holds regions without classes, which cannot be fused")
        space = self.space(backbone)
        if space is None:
            assert source.first is not None
            beside = Path(source.first[1]).parent
            raise DataError(
                f"{where}: the classes of '{backbone}' are not known; set classes: [name, ...] in id order, taxonomy:"
                f" NAME, or taxonomies: {{{backbone}: NAME}}, or put a {LABEL_SPACE_FILE} into {beside}"
            )
        return space

    def labels(self, backbone: str, path: Path, read: Read) -> Labels:
        """Ids (H, W) of one file, whose bytes `read` gives. Raises DataError that names it."""
        labels = read_labels(path, self.space(backbone), read)
        if backbone in self._class_ids:
            labels = translated(labels, self._class_ids[backbone], path)
        void = self._options.void_ids.get(backbone)
        return without_labels(labels, void) if void else labels

    def scores(self, backbone: str, path: Path, size: Size, read: Read) -> Scores:
        """Scores (H, W, K) of one file; `size` is (H, W) of the depth. Raises DataError that names it."""
        scores = read_scores(path, self._options.scores_layout or "KHW", size, read)
        if void := self._options.void_ids.get(backbone):
            space = self.space(backbone)
            scores = without_scores(scores, range(scores.shape[2]) if space is None else space.ids, void)
        return scores

    def mask_file(self, frame: FrameSource) -> Path | None:
        """The mask of a frame, where it has one."""
        file = None if self._masks is None else self._masks.file(frame)
        return None if file is None else Path(file)

    def mask(self, path: Path, read: Read) -> npt.NDArray[np.uint8]:
        """(H, W): 1 where a mask leaves out. Raises DataError that names it."""
        return read_mask(path, read).astype(np.uint8)

    def table_bytes(self, backbone: str) -> bytes:
        """The table of its ids, as bytes that are equal where it is."""
        return self._class_ids[backbone].tobytes() if backbone in self._class_ids else b""
