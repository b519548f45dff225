"""Scenes and datasets: a scene names the parts that it has; by default it has no others."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel

from semstab.config import FrameSelection
from semstab.core.types import Float32, Float64, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.georeference import Georeference
from semstab.data.labels import LabelSpace
from semstab.datasets.geometry.lenses import Labels, Scores, at_image, fitted
from semstab.errors import DataError

GROUND_TRUTH = "gt"
"""The name under which a scene's ground truth labels are selected like a model's."""


@dataclasses.dataclass(frozen=True)
class Filtering:
    """Filters between a model and a label source.

    Attributes:
        model: The label source without filters, or the source itself if the scene has no source without filters.
        filters: 'ema:0.6+guided:8'; '' without filters.
        milliseconds: Median CPU time of the filters for a frame so far.
    """

    model: str
    filters: str = ""
    milliseconds: float = 0.0


class Scene(ABC):
    """One sequence. Opening it reads no image; what reads one may be called from several threads at once.

    A dataset has to give `name`, `models`, and the four methods that are abstract; the rest are defaults for
    missing parts, or slower ways to get the content of `frame`.

    Attributes:
        name: The scene's name, usable in a file name.
        models: Names of the label sources, without the ground truth.
        ground_truth: Whether `frame(i, "gt")` works too.
        further: Label sources that are read by name only, none of 'all'.
        regions: Maps of regions without classes, which `frame` reads by name and nothing fuses.
        up: (3,) unit vector of the world's up axis, or None if unknown.
        georeference: Georeference, or None if unknown.
        placed: The source of the georeference and its fit, in words, or None.
        folder: Folder of its files, where label maps are looked for, or None for a scene without a folder.
        label_paths: Paths where the first frame's label maps are looked for, with MODEL for any name.
        settings_file: The file with further settings, or None without such a file.
        labels_like_depth: Whether its label maps have the pixels of the depth, not the pixels of the colour images.
        surface: The file of the surface from which depth is cast, or None without casting.
        depth_from: Source of depth, in words, if depth does not come from one file a frame.
        sources: Sources of its parts that were chosen among several, in words, a line each.
        on_photographs: Whether `image` is a distorted photograph, which `color` shows undistorted.
        skips_incomplete: Whether selected frames without a file are left out; else they are an error.
        images_elsewhere: Whether option images may name another folder of images, and does not.
        of_scans: Whether its frames are scans of points, not images.
        made: Whether it is simulated, so that each frame has the pose that it was rendered from.
        posed: Whether its frames have depth and a pose, so that they can be fused.
        replaced: Label sources in its files that predictions stand for, and that are not read.
        unread: The images in a folder of label maps that nothing reads, and the setting that reads them; None without.
        in_program: Whether its frames come from a program, and not from files.
        with_features: Models whose frames have features.
        usual: Default values of options for the format's own data, as they are typed.
    """

    name: str
    models: tuple[str, ...]
    ground_truth: bool = False
    further: Sequence[str] = ()
    regions: tuple[str, ...] = ()
    unread: str | None = None
    up: Float64 | None = None
    georeference: Georeference | None = None
    placed: str | None = None
    folder: Path | None = None
    label_paths: tuple[str, ...] = ()
    settings_file: Path | None = None
    labels_like_depth: bool = True
    surface: Path | None = None
    depth_from: str | None = None
    sources: tuple[str, ...] = ()
    on_photographs: bool = False
    skips_incomplete: bool = False
    images_elsewhere: bool = False
    of_scans: bool = False
    made: bool = False
    posed: bool = True
    replaced: Sequence[str] = ()
    in_program: bool = False
    with_features: tuple[str, ...] = ()
    usual: Mapping[str, str] = MappingProxyType({})

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of frames of the sequence, those without a file or a pose among them."""

    @abstractmethod
    def label_space(self, model: str) -> LabelSpace:
        """Return the classes of that model's label maps or scores."""

    @abstractmethod
    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return frame 0 <= index < len, with that model's labels or scores in its own label space.

        Without `color` a scene may leave colour out, where that saves time.

        Raises:
            DataError: If that fails; the message names the file.
        """

    @abstractmethod
    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of the content behind those frames: the same digest means the same numbers."""

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return a short hash of the frame's depth, and of its pose and camera, by the name of what holds it.

        They are equal where the geometry is; labels and images do not count.
        """
        frame = self.geometry(index)
        name = self.frame_name(index)
        return {
            f"depth of {name}": fingerprint(frame.depth.tobytes()),
            f"pose of {name}": view_fingerprint(frame.T_wc, frame.intrinsics, frame.shape),
        }

    def distances(self, model: str) -> Float64 | None:
        """Return distances (K, K) between the classes of a model, by their meaning; None if there are none."""
        return None

    @property
    def by_name(self) -> tuple[str, ...]:
        """Return the label sources that are read only if they are named: the ground truth, and `further` ones."""
        return (*((GROUND_TRUTH,) if self.ground_truth else ()), *self.further)

    @property
    def timestamps(self) -> Float64 | None:
        """Return (len,) seconds on the scene's own clock, ascending, or None without a clock. Reads no image."""
        return None

    def require_one_size(self, indices: Sequence[int]) -> None:  # noqa: B027  of files only
        """Raise DataError where depth images of these frames are of a size that the intrinsics are not for."""

    def tracked(self, index: int) -> bool:
        """Return whether the frame has a pose, which tracking may have lost. Reads no image."""
        return True

    def missing(self, index: int, sources: Sequence[str] = (), *, color: bool = False) -> list[str]:
        """Return the missing files of the frame, among labels of these sources, and its colour. Reads no image."""
        return []

    @property
    def settings(self) -> Mapping[str, Any]:
        """The conventions by which its files are read, by name of option; a check may advise to change them."""
        return {}

    @property
    def depth_scale(self) -> float | None:
        """Return units of stored depth in a metre, or None if depth is not stored."""
        return None

    def frame_name(self, index: int) -> str:
        """Return the name of a frame for people: its files' name, else its index."""
        return str(index)

    def filtering(self, model: str) -> Filtering:
        """Return the filters of a label source."""
        return Filtering(model)

    def prediction_seconds(self, index: int, model: str) -> float:
        """Return the seconds of a model's prediction on a frame, or NaN if labels are read from files."""
        return math.nan

    def reading(self, indices: Sequence[int], model: str) -> contextlib.AbstractContextManager[None]:
        """Return a block in which these frames are going to be read, with that model's labels."""
        return contextlib.nullcontext()

    def geometry(self, index: int, *, color: bool = False) -> Frame:
        """Return the frame but for its labels: all pixels are of class 0.

        Raises:
            DataError: If that fails; the message names the file.
        """
        sources = (*((GROUND_TRUTH,) if self.ground_truth else ()), *self.models[:1])
        for source in sources:  # the ground truth is the cheapest, but may be sparse
            try:
                frame = self.frame(index, source, color=color)
            except DataError:
                if source == sources[-1]:
                    raise
            else:
                return dataclasses.replace(frame, labels=np.zeros(frame.shape, dtype=np.uint8), scores=None)
        raise DataError(f"{self.name}: there are no labels, and without any this dataset yields no depth")

    def depth(self, index: int) -> Float32:
        """Return depth (H, W) float32 in metres along the optical axis."""
        return self.geometry(index).depth

    def T_wc(self, index: int) -> Float64:
        """Return pose (4, 4) camera-to-world in metres, OpenCV camera axes."""
        return self.geometry(index).T_wc

    def intrinsics(self, index: int, shape: tuple[int, ...]) -> Intrinsics:
        """Return the intrinsics of the frame's depth image, of shape (H, W); pixels."""
        return self.geometry(index).intrinsics

    def color(self, index: int) -> UInt8 | None:
        """Return the colour (H, W, 3) uint8 RGB, or None for a frame without colour."""
        return self.geometry(index, color=True).color

    def image(self, index: int) -> UInt8:
        """Return the colour (H, W, 3) uint8 RGB.

        Raises:
            DataError: If the frame has none.
        """
        color = self.color(index)
        if color is None:
            raise DataError(f"{self.name}, {self.image_name(index)}: the frame has no colour image to predict on")
        return color

    def image_name(self, index: int) -> str:
        """Return the name of the frame's files, without suffix."""
        return f"{index:06d}"

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """Return the frame with labels (H, W) or scores (H, W, K) that were predicted on its colour image; no colour.

        They are brought to the depth's pixels.

        Raises:
            DataError: If image and depth do not show the same view.
        """
        frame = self.geometry(index)
        where = f"{self.name}, {self.image_name(index)}"
        labels = None if labels is None else fitted(labels, frame.shape, where)
        scores = None if scores is None else fitted(scores, frame.shape, where)
        return dataclasses.replace(frame, labels=labels, scores=scores, color=None)

    def view(self, index: int, shape: tuple[int, int]) -> Frame:
        """Return depth and pose of the frame at the pixels of its colour image, of shape (H, W); all labels are 0.

        Raises:
            DataError: If image and depth do not show the same view.
        """
        return at_image(self.geometry(index), shape, f"{self.name}, {self.image_name(index)}")


def fingerprint(content: bytes) -> str:
    """Return a short hash, of 8 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=4).hexdigest()


def view_fingerprint(T_wc: Float64, intrinsics: Intrinsics, shape: tuple[int, ...]) -> str:
    """Return a short hash of a pose and a camera, to a micrometre and a millionth of a pixel."""
    numbers = [*np.ravel(T_wc).tolist(), *dataclasses.astuple(intrinsics), *shape]
    return fingerprint(" ".join(f"{round(number, 6) + 0.0:.6f}" for number in numbers).encode())


class Dataset(ABC):
    """A set of scenes. Its class has `Options`, a pydantic model, and is made with an instance of it.

    Attributes:
        depth_is_sparse: Whether its images have depth at the points of a LiDAR alone.
        run_folder: Folder of the run that reads it, for files that it writes meanwhile; None without a run.
    """

    Options: type[BaseModel]
    depth_is_sparse: ClassVar[bool] = False
    run_folder: Path | None = None

    @property
    @abstractmethod
    def scenes(self) -> tuple[str, ...]:
        """Return the names of the scenes, in order."""

    @abstractmethod
    def scene(self, name: str) -> Scene:
        """Open one.

        Raises:
            DataError: If its files are missing or contradict each other.
        """


# Names and paths as error messages list them.

MAX_LISTED = 5

PHOTOGRAPHS = (".jpg", ".jpeg", ".tif", ".tiff")
"""Suffixes of images that hold no labels."""


def listed(missing: Sequence[str], folder: str = "") -> str:
    """Return the number of missing files and the first of them, as they are called in the folder."""
    missing = [path.removeprefix(f"{folder}{os.sep}") for path in missing]
    more = f", ... ({len(missing) - MAX_LISTED} more)" if len(missing) > MAX_LISTED else ""
    return f"{len(missing)} missing: {', '.join(missing[:MAX_LISTED])}{more}"


# The frames of a scene that a selection picks, without those that have no file or whose pose was lost.

logger = logging.getLogger("semstab")


@dataclass(frozen=True)
class Selected:
    """Indices of frames, in order.

    Attributes:
        indices: Indices of the frames to read.
        incomplete: Selected ones that were left out because a file is missing.
        lost: Selected ones that were left out because tracking was lost.
    """

    indices: list[int]
    incomplete: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()

    @property
    def left_out(self) -> int:
        """Return how many frames were selected, but left out."""
        return len(self.incomplete) + len(self.lost)


def select_frames(
    scene: Scene, selection: FrameSelection, sources: Sequence[str] = (), *, color: bool = False
) -> Selected:
    """Return the selected frames of a sequence, to be read with the labels of these sources, or its colour.

    A warning names the frames that are left out. Reads no image.

    Raises:
        ConfigError: For a frame or a time that the scene does not have.
        DataError: If files of selected frames are missing and the scene does not leave such frames out.
    """
    times = scene.timestamps
    chosen = selection.indices(len(scene), None if times is None else times.tolist())
    missing = {index: paths for index in chosen if (paths := scene.missing(index, sources, color=color))}
    complete = [index for index in chosen if index not in missing]
    if len(complete) < len(chosen):
        needs = ("depth", "pose", *(("labels",) if sources else ()), *(("colour",) if color else ()))
        paths = [path for paths in missing.values() for path in paths]
        photographs = any(path.lower().endswith(PHOTOGRAPHS) for path in paths)
        images = photographs or (
            color and any(len(lacking) > len(scene.missing(k, sources)) for k, lacking in missing.items())
        )
        _tell_missing(scene, paths, len(complete), len(chosen), needs, images=images)
    lost = {index for index in complete if not scene.tracked(index)}
    if lost:
        more = ", ..." if len(lost) > MAX_LISTED else ""
        logger.warning(
            "%s: %d of %d selected frames have no pose (tracking was lost) and are left out: %s%s",
            scene.name, len(lost), len(chosen), ", ".join(map(str, sorted(lost)[:MAX_LISTED])), more,
        )  # fmt: skip
    return Selected(
        indices=[index for index in complete if index not in lost], incomplete=tuple(missing), lost=tuple(sorted(lost))
    )


def _tell_missing(
    scene: Scene, paths: list[str], complete: int, selected: int, needs: Sequence[str], *, images: bool
) -> None:
    where = str(scene.folder or scene.name)
    if not scene.skips_incomplete:
        skip = "set incomplete: skip (--option incomplete=skip) to leave such frames out"
        remedies = ["add them"]
        if images and scene.images_elsewhere:
            remedies.append("name their folder (--option images=FOLDER)")
        if complete:
            remedies.append(skip)
        raise DataError(f"{where}: {listed(paths, where)}; {', or '.join(remedies)}")
    if not complete:
        raise DataError(
            f"{where}: no selected frame has {', '.join(needs[:-1])} and {needs[-1]} ({listed(paths, where)})"
        )
    logger.warning("%s: %d of %d frames left out: %s", where, selected - complete, selected, listed(paths, where))
