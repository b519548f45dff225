"""Label maps and scores of a scene: the label sources that there are, and the file of each frame."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from semstab.config import nearest
from semstab.core.types import Mask, UInt16
from semstab.data.features import OF_FEATURES
from semstab.data.labels import IGNORE_16BIT, LabelSpace, ignore_id
from semstab.datasets.files.options import (
    NO_TRUTH,
    Folders,
    FrameSource,
    LabelOptions,
    Template,
    TruthSource,
    inside,
    matching_folders,
)
from semstab.datasets.formats import images
from semstab.datasets.formats.disk import natural, subfolders
from semstab.datasets.formats.image_sizes import ANY_SIZE, FrameSize, Size
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.lenses import Labels, Scores
from semstab.datasets.scene import GROUND_TRUTH, listed
from semstab.errors import ConfigError, DataError

logger = logging.getLogger("semstab")

Kind = Literal["labels", "scores", "features", "masks", "points", "truth"]
KINDS: tuple[Kind, ...] = ("labels", "scores")
SUFFIXES: Mapping[Kind, tuple[str, ...]] = {
    "labels": images.LABEL_SUFFIXES,
    "scores": images.SCORE_SUFFIXES,
    "features": images.SCORE_SUFFIXES,
    "masks": images.MASK_SUFFIXES,
    "points": (".label", ".bin", ".npy", ".las", ".laz", ".ply"),
    "truth": (*images.LABEL_SUFFIXES, ".label", ".hdf5"),
}
LOSSY_SUFFIXES = (".jpg", ".jpeg")
DEFAULTS: Mapping[Kind, str] = {"labels": "labels/{model}/{name}", "scores": "scores/{model}/{name}"}
REGIONS, FEATURES = "regions/{model}/{name}", "features/{model}/{name}"
LABEL_SPACE_FILE = "label_space.yaml"
"""A taxonomy file in a folder of label maps or scores: their classes, where they are not the scene's."""

SEPARATE = "{scene}/{model}/{name}"
"""The template of label maps in a folder of their own."""


@dataclass(frozen=True)
class SceneEntry:
    """A scene's name, its folder, and its path below root, which {scene} in templates stands for."""

    name: str
    folder: Path
    below_root: str


class Named(Protocol):
    """A frame or a scan, by the names that its files have."""

    @property
    def name(self) -> str:
        """Return its name in path templates."""

    @property
    def aliases(self) -> tuple[str, ...]:
        """Return other names that its files may have."""


@dataclass(frozen=True)
class LabelSource:
    """One label source of a scene, with the path of each frame's file.

    Attributes:
        folders: The listed content of folders.
        first: The first frame that has a file, and the file; None if no frame has a file.
    """

    kind: Kind
    base: Path
    template: str
    folders: Folders
    first: tuple[str, Path] | None = None

    @classmethod
    def with_first_file(
        cls, kind: Kind, base: Path, template: str, frames: Sequence[Named], folders: Folders
    ) -> LabelSource:
        """Return one source, with the first frame that has a file."""
        source = cls(kind, base, template, folders)
        files = ((frame.name, file) for frame in frames if (file := source.file(frame)) is not None)
        return replace(source, first=next(files, None))

    def file(self, frame: Named) -> Path | None:
        """Return the file of a frame, under its own name or another that it has."""
        for name in (frame.name, *frame.aliases):
            path = inside(self.base, self.base, self.template.replace("{name}", name), str(self.base))
            if (file := self.folders.one_of(path, SUFFIXES[self.kind])) is not None:
                return file
        return None

    def lossy(self, frames: Sequence[Named]) -> Path | None:
        """Return the JPEG of the first frame that has one in the place of a label map."""
        bare = self.template.removesuffix(".png")
        places = (self.base / bare.replace("{name}", frame.name) for frame in frames)
        paths = (self.folders.one_of(place, LOSSY_SUFFIXES) for place in places)
        return next((path for path in paths if path is not None), None)

    def why_none(self, frames: Sequence[Named]) -> str:
        """Return why no frame has a file."""
        if self.kind == "labels" and (lossy := self.lossy(frames)) is not None:
            return f"{lossy} is a JPEG, which changes class ids; write label maps as PNG"
        return f"no file of any frame, such as {self.missing(frames[0])[0]}"

    def missing(self, frame: Named) -> list[str]:
        """Return nothing, or the path that the file of that frame would have."""
        if self.file(frame) is not None:
            return []
        return [_with_suffix(self.base / self.template.replace("{name}", frame.name), self.kind)]


def find_sources(
    options: LabelOptions,
    entry: SceneEntry,
    frames: Sequence[Named],
    folders: Folders,
    given: Mapping[str, Path],
) -> dict[str, LabelSource]:
    """Return the label sources of a scene with these frames, `given` folders of labels first; `gt` is the truth.

    labels of X are the model X, scores of X found by a template are X-scores, so that neither name depends on
    other folders. A folder without a file of any frame is left out with a warning.

    Raises:
        ConfigError: For a template that cannot be used, or a labels_root that is not there.
        DataError: For a folder that cannot be listed.
    """
    sources: dict[str, LabelSource] = {}
    notes: list[str] = []
    base = options.labels_root or entry.folder
    if options.labels_root is not None and not os.path.isdir(base):  # noqa: PTH112  Path.is_dir raises where the name is too long
        raise ConfigError(f"{base}: there is no such folder; correct labels_root")
    for name, folder in given.items():
        sources[name] = LabelSource.with_first_file("labels", folder, "{name}", frames, folders)
    for kind in KINDS:
        templates: dict[str, str] = {}
        for model, template in _stated(kind, options).items():
            if model is not None:
                templates[model] = template.filled(scene=entry.below_root)
                continue
            suffix = "-scores" if kind == "scores" else ""
            folders_of = matching_folders(base, template, "model", scene=entry.below_root)
            templates |= {f"{name}{suffix}": filled for name, filled in folders_of.items()}
        for name, filled in templates.items():
            source = LabelSource.with_first_file(kind, base, filled, frames, folders)
            if name in sources:
                raise ConfigError(f"{entry.folder}: two label sources are called '{name}'; rename one")
            if source.first is not None:
                sources[name] = source
            elif frames:
                notes.append(f"{name}: {source.why_none(frames)}; left out")
    for line in notes if sources or unread_labels(options, entry, frames) is None else ():
        logger.warning("%s", line)
    if not sources and (options.labels or options.scores or options.labels_root):
        logger.warning(
            "%s: no label maps in %s fit the options labels and scores; expected %s",
            entry.name, base, ", ".join(label_paths(options, entry, frames)),
        )  # fmt: skip
    if options.ground_truth and GROUND_TRUTH not in sources:
        truth = Template("ground_truth", options.ground_truth, ("scene", "name"), ("name",))
        source = LabelSource.with_first_file(
            "truth", entry.folder, truth.filled(scene=entry.below_root), frames, folders
        )
        sources |= {GROUND_TRUTH: source} if source.first is not None else {}
    return sources


MOST_FRAMES = 50
"""Names of frames that are looked for in names of files."""


def unread_labels(options: LabelOptions, entry: SceneEntry, frames: Sequence[Named]) -> str | None:
    """Return the images of a folder labels/ from which no image is read, and the setting that reads the images.

    Returns None if options name the label maps, or without such images.
    """
    folder = entry.folder / "labels"
    if options.labels is not None or options.labels_root is not None or not folder.is_dir() or not frames:
        return None
    for place, template in (
        (folder, "labels"),
        *((folder / name, "labels/{model}") for name in subfolders(folder) if name != GROUND_TRUTH),
    ):
        suffixes = (*images.LABEL_SUFFIXES, *LOSSY_SUFFIXES, *OTHER_SUFFIXES)
        files = sorted(
            (path for path in place.iterdir() if path.suffix.lower() in suffixes), key=lambda p: natural(p.name)
        )
        if not files:
            continue
        frame_names = [frame.name.rpartition("/")[2] for frame in frames[:MOST_FRAMES]]
        first, pattern = (
            files[0],
            next(filter(None, (_pattern(path, frame_names) for path in files[:MOST_FRAMES])), None),
        )
        if pattern is None:
            return (
                f"{first}: is of no frame (these are called {', '.join(frame_names[:2])}, ...), nor is another image in"
                f" {place.relative_to(entry.folder)}; call them as the frames, {template}/{{name}}.png"
            )
        if first.suffix.lower() in LOSSY_SUFFIXES:
            return f"{first} is a JPEG, which changes class ids; write label maps as PNG"
        if first.suffix.lower() in OTHER_SUFFIXES:
            return f"{first}: label maps are read as {', '.join(images.LABEL_SUFFIXES)}; write them as PNG"
        setting = f"{template}/{pattern}"
        text = f"{{net: '{setting}'}}" if template == "labels" else f"'{setting}'"
        return (
            f"{first}: is read as the label map of no frame, nor is another of the {len(files)} images in"
            f' {place.relative_to(entry.folder)}; set labels: {text} (--option "labels={text}")'
        )
    return None


OTHER_SUFFIXES = (".tif", ".tiff", ".bmp", ".webp", ".gif")
"""Images that hold no label maps which are read."""


def _pattern(path: Path, names: Sequence[str]) -> str | None:
    """Return the name of a file with {name} for the longest name of a frame in it, or None without such a name."""
    contained = [name for name in names if name in path.stem]
    return path.stem.replace(max(contained, key=len), "{name}", 1) if contained else None


def label_paths(options: LabelOptions, entry: SceneEntry, frames: Sequence[Named]) -> list[str]:
    """Return the paths of label maps and scores of the first frame, with MODEL for any name."""
    values = {"scene": entry.below_root, "model": "MODEL", "name": frames[0].name if frames else "NAME"}
    base = options.labels_root or entry.folder
    return [
        _with_suffix(base / template.filled(**values), kind)
        for kind in KINDS
        for template in _stated(kind, options).values()
    ]


def _stated(kind: Kind, options: LabelOptions) -> dict[str | None, Template]:
    """Return the template of each model that has one of its own, or that of all, under None."""
    stated = options.labels if kind == "labels" else options.scores
    if isinstance(stated, dict):
        return {key: Template(f"{kind}.{key}", text, ("scene", "name"), ("name",)) for key, text in stated.items()}
    if stated is None and options.labels_root is not None and kind == "scores":
        return {}
    if stated is None:
        stated = DEFAULTS[kind] if options.labels_root is None else SEPARATE
    return {None: Template(kind, stated, ("scene", "model", "name"), ("model", "name"))}


def _with_suffix(path: Path, kind: Kind) -> str:
    return str(path if path.suffix.lower() in SUFFIXES[kind] else f"{path}{SUFFIXES[kind][0]}")


NO_ID = IGNORE_16BIT - 1
"""The mark in a table of class ids for an id that is not in it."""


class LabelMaps:
    """The predictions for the frames of a scene: the label sources, their classes, and the maps in their own pixels.

    Attributes:
        truth: What the format says of its ground truth.
        folders: The listed content of the folders where maps may be.
        given: Folders of label maps by the label source that they are, besides those that templates find.

    Raises:
        ConfigError: For options that cannot be used.
    """

    def __init__(
        self,
        options: LabelOptions,
        entry: SceneEntry,
        frames: Sequence[Named],
        folders: Folders,
        given: Mapping[str, Path],
        truth: TruthSource = NO_TRUTH,
    ) -> None:
        labels, base = find_sources(options, entry, frames, folders, given), options.labels_root or entry.folder
        template = Template("regions", REGIONS, ("model", "name"), ("model", "name"))
        regions = {
            name: LabelSource.with_first_file("labels", base, filled, frames, folders)
            for name, filled in matching_folders(base, template, "model", scene=entry.below_root).items()
        }
        if duplicate := next((name for name in regions if name in labels), None):
            raise DataError(
                f"{base / 'regions' / duplicate}: labels/{duplicate} is called '{duplicate}' too; rename one"
            )
        regions = {name: source for name, source in regions.items() if source.first is not None}
        template = Template("features", FEATURES, ("model", "name"), ("model", "name"))
        features = {
            name: LabelSource.with_first_file("features", base, filled, frames, folders)
            for name, filled in matching_folders(base, template, "model", scene=entry.below_root).items()
        }
        self._features = {name: source for name, source in features.items() if source.first is not None}
        self.with_features = tuple(self._features)
        labels |= {name: source for name, source in self._features.items() if name not in (*labels, *regions)}
        self.models = tuple(name for name in labels if name != GROUND_TRUTH)
        self.ground_truth = GROUND_TRUTH in labels
        self.regions = tuple(regions)
        self.truth = truth
        self.unread = None if self.models else unread_labels(options, entry, frames)
        self._options = options
        self._folder = entry.folder
        self._frames = frames
        self._sources = {**labels, **regions}
        self._masks: LabelSource | None = None
        if options.masks is not None:
            masks = Template("masks", options.masks, ("scene", "name"), ("name",)).filled(scene=entry.below_root)
            self._masks = LabelSource("masks", entry.folder, masks, folders)
        self._spaces: dict[str, LabelSpace | None] = {}

    def source(self, model: str) -> LabelSource:
        """Return the files of a label source.

        Raises:
            ConfigError: If no label source has this name.
        """
        sources = self._sources
        if model not in sources:
            hint = (
                nearest(model, [*sources]) if sources else "put its label maps into labels/NAME/, or set option labels"
            )
            raise ConfigError(f"{self._folder}: model '{model}' is not there; {hint}")
        return sources[model]

    def file(self, frame: Named, model: str) -> Path:
        """Return the file of a frame.

        Raises:
            DataError: If it is not there.
        """
        source = self.source(model)
        if (file := source.file(frame)) is None:
            lost = [path for other in self._frames for path in source.missing(other)]
            raise DataError(
                f"{self._folder}: {listed(lost, str(self._folder))}; choose frames that have them, or add them"
            )
        return file

    def features_file(self, frame: Named, model: str) -> Path | None:
        """Return the file of a frame's features; None for a model without features.

        Raises:
            DataError: If the model has features, but not of this frame.
        """
        source = self._features.get(model)
        if source is not None and (lost := source.missing(frame)):
            raise DataError(f"{self._folder}: {listed(lost, str(self._folder))}; add it, or choose other frames")
        return None if source is None else source.file(frame)

    def missing(self, frame: Named, model: str) -> list[str]:
        """Return the paths that the files of that frame would have which are not there: labels, features."""
        features = self._features.get(model)
        lost = [*self.source(model).missing(frame), *([] if features is None else features.missing(frame))]
        return [*dict.fromkeys(lost)]

    def space(self, model: str) -> LabelSpace | None:
        """Return the classes of a label source, read once; None for regions, and if no file or option has the classes.

        The classes come from option taxonomies, else from a label_space.yaml next to its maps, else from the scene.

        Raises:
            ConfigError: For one that cannot be used.
        """
        if model not in self._spaces:
            source = self.source(model)
            classless = model in self.regions or source.kind == "features"
            self._spaces[model] = None if classless else self._stated_space(model, source)
        return self._spaces[model]

    def _stated_space(self, model: str, source: LabelSource) -> LabelSpace | None:
        options = self._options
        if model in options.taxonomies:
            return LabelSpace.load(options.taxonomies[model])
        assert source.first is not None
        frame, file = source.first
        for parent in file.parents[: 1 + frame.count("/")]:  # a frame's name may be a path: cam0/0001
            if (classes := parent / LABEL_SPACE_FILE).is_file():
                return LabelSpace.load(classes)
        if model == GROUND_TRUTH and self.truth.space is not None:
            return self.truth.space
        try:
            if options.classes is not None:
                return LabelSpace(name="classes of the scene", classes=options.classes)
            return None if options.taxonomy is None else LabelSpace.load(options.taxonomy)
        except ConfigError as error:
            raise ConfigError(f"{self._folder}: {error}") from error

    def label_space(self, model: str, where: Path) -> LabelSpace:
        """Return the classes of a label source.

        Raises:
            ConfigError: For regions without classes.
            DataError: If the classes are unknown; the message begins with `where`.
        """
        source = self.source(model)
        if source.kind == "features":
            return OF_FEATURES
        if model in self.regions:
            raise ConfigError(f"{self._folder}: '{model}' holds regions without classes, which cannot be fused")
        space = self.space(model)
        if space is None:
            assert source.first is not None
            folder = source.first[1].parent
            hint = f", or put a {LABEL_SPACE_FILE} into {folder}" if folder.is_dir() else ""
            settings = "set" if where.exists() else f"write {where.name} with"
            raise DataError(
                f"{where if where.exists() else where.parent}: the classes of '{model}' are not known; {settings}"
                f" classes: [name, ...] in id order, taxonomy: NAME, or taxonomies: {{{model}: NAME}}"
                f" (--option 'classes=[name, ...]' and so on){hint}"
            )
        return space

    def class_ids(self, model: str) -> UInt16 | None:
        """Return the table from the ids of the files of a label source to those of its taxonomy, where they differ."""
        return self.truth.ids if model == GROUND_TRUTH else None

    def labels(
        self, model: str, path: Path, read: Read, allowed_sizes: FrameSize = ANY_SIZE, frame: FrameSource | None = None
    ) -> Labels:
        """Return ids (H, W) of one file of a frame, whose bytes `read` gives, in one of `allowed_sizes`.

        Raises:
            DataError: If that fails; the message names it.
        """
        void = self._options.void_ids.get(model, ())
        if model == GROUND_TRUTH and self.truth.read is not None and frame is not None:
            labels = self.truth.read(frame, path, read)
        else:
            labels = images.read_labels(path, self.space(model), read, allowed_sizes, void)
        if (table := self.class_ids(model)) is not None:
            ids: Labels = table[labels]
            if (unknown := ids == NO_ID).any():
                raise DataError(
                    f"{path}: the id {labels[unknown][0]} is not in the table of classes; is it the right table?"
                )
            labels = ids
        if void:
            labels = np.where(np.isin(labels, void), labels.dtype.type(ignore_id(labels)), labels)
        return labels

    def scores(self, model: str, path: Path, size: Size, read: Read, allowed_sizes: FrameSize = ANY_SIZE) -> Scores:
        """Return scores (H, W, K) of one file; `size` is (H, W) of the depth.

        Raises:
            DataError: If that fails; the message names it.
        """
        label_space = self.space(model)
        classes = None if label_space is None else len(label_space)
        scores = images.read_scores(path, self._options.scores_layout or "KHW", size, read, allowed_sizes, classes)
        if void := self._options.void_ids.get(model):
            space = self.space(model)
            ids = range(scores.shape[2]) if space is None else space.ids
            ignored = np.isin(scores.argmax(axis=2), [row for row, class_id in enumerate(ids) if class_id in void])
            scores = np.where(ignored[..., None], scores.dtype.type(0), scores)
        return scores

    def mask_file(self, frame: Named) -> Path | None:
        """Return the file of a frame's mask, or of the ground truth with the moving classes, or None."""
        if self._masks is None and self.truth.moving and self.ground_truth:
            return self._sources[GROUND_TRUTH].file(frame)
        return None if self._masks is None else self._masks.file(frame)

    def mask(self, frame: FrameSource, path: Path, read: Read, allowed_sizes: FrameSize = ANY_SIZE) -> Mask:
        """Return (H, W) True where a frame is left out by that file; raises DataError with the file."""
        if self._masks is not None:
            return images.read_mask(path, read, allowed_sizes)
        if self.truth.read is None:
            stored = images.read_labels(path, self.space(GROUND_TRUTH), read, allowed_sizes)
        else:
            stored = self.truth.read(frame, path, read)
        return np.isin(stored, list(self.truth.moving))
