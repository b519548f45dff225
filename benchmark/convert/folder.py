"""A posed folder that is being written: each file whole or not there, what is there already kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from semstab.check.conventions import KNOWN_SCALES
from semstab.datasets.files.label_source import LABEL_SPACE_FILE
from semstab.datasets.formats.images import MILLIMETRES
from semstab.datasets.formats.text_files import read_intrinsics
from semstab.datasets.posed_folder import SETTINGS_FILE
from semstab.errors import ConfigError, DataError
from semstab.model.frames import Frame, Intrinsics
from semstab.model.labels import LabelSpace
from semstab.model.results import slug
from semstab.runtime.files import (
    FolderLock,
    atomic_path,
    content_key,
    read_json,
    remove_leftovers,
    write_json,
    write_png,
    write_text,
)
from semstab.runtime.json_form import from_json

SCHEMA = 1
"""Version of conversion.json."""

CONVERSION_FILE = "conversion.json"
SCORES_SUFFIX = "-scores"
"""What posed_folder adds to the name of a folder of scores."""

MAX_UINT16 = 65535
LONGEST_NAME = 200
"""Bytes of a folder's name."""


@dataclass(frozen=True)
class DepthFormat:
    """16-bit PNG, `scale` units in a metre; or where scale is None .npy files of float32 metres."""

    scale: float | None

    @property
    def suffix(self) -> str:
        """Of its files."""
        return ".npy" if self.scale is None else ".png"

    def __str__(self) -> str:
        return "float32 .npy" if self.scale is None else f"16-bit PNG, {self.scale:g} units a metre"

    def stored(self, depth: npt.NDArray[np.float32], tolerance: float) -> npt.NDArray[Any] | None:
        """What a file of this format holds; None where a pixel would be off by more than `tolerance` metres."""
        if self.scale is None:
            return depth
        units, error = quantised(depth, self.scale)
        return units if error <= tolerance else None


def quantised(depth: npt.NDArray[np.float32], scale: float) -> tuple[npt.NDArray[np.uint16], float]:
    """Depth in whole units of 1 / scale metres, invalid pixels 0, and by how many metres the worst pixel is off.

    The error is infinite where depth does not fit into 16 bits, or a valid pixel would become invalid.
    """
    valid = (depth > 0) & (depth < np.inf)
    units = np.rint(depth.astype(np.float64) * scale, where=valid, out=np.zeros(depth.shape))
    if not valid.any():
        return units.astype(np.uint16), 0.0
    if units[valid].min() < 1 or units.max() > MAX_UINT16:
        return np.zeros(depth.shape, dtype=np.uint16), np.inf
    back = np.divide(units.astype(np.uint16), scale, dtype=np.float32, casting="same_kind")  # as it is read
    return units.astype(np.uint16), float(np.abs(back.astype(np.float64) - depth)[valid].max())


def depth_format(depths: Sequence[npt.NDArray[np.float32]], tolerance: float) -> DepthFormat:
    """The 16-bit format that holds these images best, exactly if there is one; floats where none is good enough."""
    scales = sorted(KNOWN_SCALES, key=lambda scale: (scale != MILLIMETRES, scale))
    errors = {scale: max(quantised(depth, scale)[1] for depth in depths) for scale in scales}
    best = min(scales, key=lambda scale: errors[scale])
    return DepthFormat(best if errors[best] <= tolerance else None)


@dataclass(frozen=True)
class _Conversion:
    """What conversion.json says that a later start needs."""

    key: str
    depth_scale: float | None

    def __post_init__(self) -> None:
        if self.depth_scale is not None and not 0 < self.depth_scale < math.inf:
            raise ValueError(f"depth_scale is {self.depth_scale}")


class DepthFormatError(Exception):
    """A depth image that the folder's 16-bit format cannot hold."""


class SceneFolder:
    """The folder of one scene.

    settings   all that its files depend on; a folder of other settings is not touched
    tolerance  metres by which stored depth may be off

    Raises ConfigError where the folder holds something else.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], tolerance: float) -> None:
        self.path = path
        self._tolerance = tolerance
        self._settings = dict(settings)
        self._key = content_key(self._settings)
        self.form = self._claim()
        self._intrinsics: Intrinsics | None = None
        self._lock: FolderLock | None = None

    def begin(self, form: DepthFormat, scene_settings: Mapping[str, Any]) -> None:
        """Say how depth is stored, in scene.yaml and for a later start; depth of another format is removed."""
        if self.form is not None and self.form != form:
            for file in (self.path / "depth").glob(f"*{self.form.suffix}"):
                file.unlink()
        if self._lock is None:
            self._lock = FolderLock(self.path)
            for folder in self.path.glob("**/"):
                remove_leftovers(folder)
        self.form = form
        said = dict(scene_settings) | ({} if form.scale is None else {"depth_scale": form.scale})
        write_json(
            self.path / CONVERSION_FILE,
            {"schema": SCHEMA, "key": self._key, "depth_scale": form.scale, "settings": self._settings},
        )
        write_text(self.path / SETTINGS_FILE, yaml.safe_dump(said, sort_keys=False))

    def close(self) -> None:
        """Let another process have it."""
        if self._lock is not None:
            self._lock.release()

    @property
    def frames(self) -> set[str]:
        """Names of the frames that are there."""
        return {file.stem for file in (self.path / "depth").glob("[!.]*")}

    def has_geometry(self, name: str) -> bool:
        """Whether depth, pose, colour and mask of a frame are there: depth is written last."""
        assert self.form is not None
        return self._depth_path(name, self.form).exists()

    def has_labels(self, name: str, backbone: str) -> bool:
        """Whether a frame's labels or scores are there."""
        return any(self._label_path(name, backbone, soft).exists() for soft in (False, True))

    def is_soft(self, backbone: str) -> bool:
        """Whether the backbone's scores were written, not labels."""
        labels, scores = (self._label_path("", backbone, soft).parent for soft in (False, True))
        return scores.is_dir() and not labels.is_dir()

    def write_geometry(self, name: str, frame: Frame) -> None:
        """Write what a frame shows beside labels.

        Raises DepthFormatError, or DataError where its intrinsics are not those of the frames before.
        """
        assert self.form is not None
        stored = self.form.stored(frame.depth, self._tolerance)
        if stored is None:
            raise DepthFormatError
        self._require_same_camera(frame)
        if frame.color is not None:
            write_png(self.path / "color" / f"{name}.png", np.ascontiguousarray(frame.color[..., ::-1]))
        if frame.mask is not None:
            write_png(self.path / "mask" / f"{name}.png", np.where(frame.mask, 0, 255).astype(np.uint8))
        write_text(self.path / "pose" / f"{name}.txt", matrix_text(frame.T_wc))
        path = self._depth_path(name, self.form)
        if self.form.scale is None:
            with atomic_path(path) as temporary:
                np.save(temporary, stored)
        else:
            write_png(path, stored)

    def write_labels(self, name: str, frame: Frame, backbone: str) -> None:
        """Write a frame's label ids, or its scores."""
        path = self._label_path(name, backbone, frame.scores is not None)
        if frame.scores is None:
            assert frame.labels is not None
            write_png(path, frame.labels)
            return
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, scores=frame.scores.transpose(2, 0, 1))

    def write_classes(self, backbone: str, space: LabelSpace) -> None:
        """Write the classes of a backbone beside its maps."""
        folder = self._label_path("", backbone, self.is_soft(backbone)).parent
        space.save(folder / LABEL_SPACE_FILE)

    def read_as(self, backbone: str) -> str:
        """The name under which the backbone is found in the folder."""
        return f"{_bare(backbone)}{SCORES_SUFFIX}" if self.is_soft(backbone) else folder_name(backbone)

    def _depth_path(self, name: str, form: DepthFormat) -> Path:
        return self.path / "depth" / f"{name}{form.suffix}"

    def _label_path(self, name: str, backbone: str, soft: bool) -> Path:
        if soft:
            return self.path / "scores" / _bare(backbone) / f"{name}.npz"
        return self.path / "labels" / folder_name(backbone) / f"{name}.png"

    def _require_same_camera(self, frame: Frame) -> None:
        """One intrinsics.txt serves all frames."""
        path = self.path / "intrinsics.txt"
        if self._intrinsics is None and not path.exists():
            write_text(path, matrix_text(frame.intrinsics.matrix))
        self._intrinsics = self._intrinsics or read_intrinsics(path)
        if frame.intrinsics != self._intrinsics:
            raise DataError(
                f"{frame.where('depth')}: intrinsics {frame.intrinsics} differ from those of the frames before"
                f" ({self._intrinsics}), and a posed folder has one camera; convert the frames of each by themselves"
            )

    def _claim(self) -> DepthFormat | None:
        """How an earlier start stored depth; None where there was none."""
        manifest = self.path / CONVERSION_FILE
        if not manifest.is_file():
            if self.path.exists() and (not self.path.is_dir() or any(self.path.glob("[!.]*"))):
                raise ConfigError(f"{self.path}: is there already and holds no conversion; choose another --out")
            return None
        try:
            there = from_json(_Conversion, read_json(manifest), manifest)
        except DataError as error:
            raise DataError(f"{manifest}: damaged; delete {self.path}, and the scene is converted again") from error
        if there.key != self._key:
            raise ConfigError(
                f"{self.path}: was converted from other data or with other settings; choose another --out"
            )
        return DepthFormat(there.depth_scale)


def folder_name(name: str) -> str:
    """The name itself where a folder can be called so, or else its `slug`."""
    fits = name.isprintable() and len(name.encode()) <= LONGEST_NAME and not set(name) & set("/\\")
    return name if fits and name[:1] not in ("", ".", "-") else slug(name)


def matrix_text(matrix: npt.NDArray[np.float64]) -> str:
    """A matrix as text, one row a line, that reads back to the same numbers."""
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in matrix)


def _bare(backbone: str) -> str:
    """The folder below scores/: posed_folder adds the suffix to its name."""
    return folder_name(backbone.removesuffix(SCORES_SUFFIX))
