"""A folder of predictions: the maps, their classes, and what they depend on, so that others never mix with them."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from semstab.core.files import FolderLock, atomic_path, content_key, read_json, write_image, write_json, write_stack
from semstab.core.json_form import from_json
from semstab.core.types import Float32
from semstab.data.features import Features
from semstab.data.labels import LabelSpace
from semstab.datasets.files.labels import LABEL_SPACE_FILE, SUFFIXES
from semstab.datasets.files.options import inside
from semstab.datasets.geometry.lenses import fitted
from semstab.datasets.scene import GROUND_TRUTH
from semstab.errors import ConfigError, DataError

SCHEMA = 1
"""Version of predictions.json."""

MANIFEST_FILE = "predictions.json"
SAVE_SECONDS = 5.0
"""Seconds of work that a killed process may lose at most."""

Kind = Literal["labels", "scores", "features", "regions", "points"]
WRITTEN: Mapping[Kind, str] = {
    "labels": ".png", "scores": ".npz", "features": ".npy", "regions": ".png", "points": ".label"
}  # fmt: skip
"""The suffix of the files that are written."""

ScoreType = Literal["float16", "float32"]


NO_FOLDER_NAME = "it names a folder; use letters, digits, '-' and '_'"


def names_a_folder(name: str) -> bool:
    """Return whether the maps of a label source can lie in a folder of its name, which is not the ground truth's."""
    return name not in ("", ".", "..", GROUND_TRUTH) and not set(name) & set("/\\") and name.isprintable()


@dataclass(frozen=True)
class _Predicted:
    """A frame's map: the digest of its image, and how long the model took for it."""

    image: str
    seconds: float


@dataclass(frozen=True)
class _Manifest:
    """The content of predictions.json that a later start needs."""

    key: str
    settings: Mapping[str, Any]
    frames: Mapping[str, _Predicted]


class PredictionFolder:
    """labels/NAME, scores/NAME or regions/NAME of a scene; maps that an earlier start finished are reused.

    Attributes:
        path: The folder.
        kind: Kind of maps: PNG ids, .npz scores (K, H, W), .npy features (h, w, D), PNG region ids, .label ids of the
            points of a scan.
        settings: All that the maps depend on in addition to the image, for JSON.
        about: The rest of the manifest.
        space: The classes; None for regions.
        score_type: Type of stored scores; None for that of the model's.
        top_k: Number of scores that a pixel keeps; None for all.
        wait: Wait until no other process writes into the folder; else that is an error once a map is written.

    Raises:
        ConfigError: If the folder holds maps of other settings or of other origin.
    """

    def __init__(
        self,
        path: Path,
        kind: Kind,
        settings: Mapping[str, Any],
        about: Mapping[str, Any],
        space: LabelSpace | None,
        *,
        score_type: ScoreType | None = "float16",
        top_k: int | None = None,
        overwrite: bool = False,
        wait: bool = False,
    ) -> None:
        self.path = path
        self.kind = kind
        self._suffix = WRITTEN[kind]
        self._score_type = None if score_type is None else np.dtype(score_type)
        self._compressed = top_k is not None  # most of it is 0
        all_settings = dict(settings) | ({"score_type": score_type} if kind == "scores" else {})
        if top_k is not None and kind == "scores":
            all_settings["top_k"] = top_k
        self._content: dict[str, Any] = {
            "schema": SCHEMA,
            "kind": kind,
            "key": content_key(all_settings),
            "settings": all_settings,
            **about,
        }
        self._lock = FolderLock(path, wait=True) if wait else None
        try:
            self._frames: dict[str, _Predicted] = self._claim(overwrite)
        except BaseException:
            self._release()
            raise
        self._written: set[str] = set()
        self._space = space
        self._saved = -math.inf

    def has(self, name: str, image: str) -> bool:
        """Return whether the map of that frame is there, predicted from an image of that digest."""
        return name in self._frames and self._frames[name].image == image and self.file(name).is_file()

    def file(self, name: str) -> Path:
        """Return the path of a frame's map.

        Raises:
            DataError: For a name that leads out of the folder.
        """
        return inside(self.path, self.path, f"{name}{self._suffix}", f"image {name[:80]!r}")

    def write(self, name: str, image: str, values: npt.NDArray[Any], seconds: float) -> None:
        """Store a frame's map of ids (H, W); of a scan they are little-endian uint32, one after the other."""
        self._claimed()
        if self.kind == "points":
            with atomic_path(self.file(name)) as temporary:
                temporary.write_bytes(values.astype("<u4").tobytes())
        else:
            write_image(self.file(name), values)
        self._done(name, image, seconds)

    def write_features(self, name: str, image: str, vectors: npt.NDArray[Any], seconds: float) -> None:
        """Store a frame's features (h, w, D) of unit length, in half precision."""
        self._claimed()
        unit = Features(vectors, (0.0, 0.0), (1.0, 1.0)).vectors.astype(np.float16)
        with atomic_path(self.file(name)) as temporary, temporary.open("wb") as file:
            np.save(file, unit)
        self._done(name, image, seconds)

    def write_scores(self, name: str, image: str, maps: Iterable[npt.NDArray[Any]], seconds: float) -> None:
        """Store a frame's scores, which come class by class (H, W); one of them is in memory at a time."""
        self._claimed()
        with atomic_path(self.file(name)) as temporary:
            write_stack(temporary, "scores", maps, len(self._space or ()), self._score_type, self._compressed)
        self._done(name, image, seconds)

    def save(self) -> None:
        """Write the classes and the manifest, once there is a map: what is not in the manifest is predicted again."""
        if self._frames:
            self._save()

    def close(self) -> None:
        """Save it, and let another process have it."""
        self.save()
        self._release()

    def require_whole(self) -> None:
        """Require the maps that were written.

        Raises:
            DataError: If one is gone; the next start predicts it again.
        """
        for name in sorted(self._written):
            if not self.file(name).is_file():
                raise DataError(f"{self.file(name)}: was written, and is gone; run the same command again")

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _claimed(self) -> None:
        self._lock = self._lock or FolderLock(self.path)
        if self._saved == -math.inf:
            self._save()  # before the first map: without it, maps are taken for somebody else's

    def _done(self, name: str, image: str, seconds: float) -> None:
        self._written.add(name)
        self._frames[name] = _Predicted(image, round(seconds, 4))
        if time.monotonic() - self._saved > SAVE_SECONDS:
            self.save()

    def _save(self) -> None:
        if self._space is not None:
            self._space.save(self.path / LABEL_SPACE_FILE)
        write_json(self.path / MANIFEST_FILE, self._content | {"frames": self._frames})
        self._saved = time.monotonic()

    def _claim(self, overwrite: bool) -> dict[str, _Predicted]:
        """Return the frames that an earlier start finished."""
        manifest = self.path / MANIFEST_FILE
        if not manifest.is_file():
            suffixes = SUFFIXES["labels" if self.kind == "regions" else self.kind]
            if any(file.suffix.lower() in suffixes for file in _files(self.path)):
                raise ConfigError(f"{self.path}: holds maps that were not predicted here; choose another --name")
            return {}
        try:
            stored = from_json(_Manifest, read_json(manifest), manifest)
        except DataError as error:
            raise DataError(
                f"{manifest}: is no manifest of predictions; delete the folder, or choose another --name"
            ) from error
        if stored.key == self._content["key"]:
            return dict(stored.frames)
        if not overwrite:
            change = _first_change(stored.settings, self._content["settings"])
            raise ConfigError(
                f"{self.path}: holds predictions with other settings ({change}); choose another --name, or --overwrite"
            )
        for file in (*map(self.file, stored.frames), manifest):
            file.unlink(missing_ok=True)
        return {}


def _files(path: Path) -> list[Path]:
    return [file for file in path.iterdir() if not file.name.startswith(".")] if path.is_dir() else []


def _first_change(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return the first setting that differs, with both values, in a few words."""
    for key in [*new, *(key for key in old if key not in new)]:
        if old.get(key) != new.get(key):
            old_value, new_value = (_short(values.get(key)) for values in (old, new))
            return f"{key}: {old_value} there, {new_value} here"
    return "another version"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


# Soft scores class by class, as they go to disk: one map in memory at a time, or few where only the largest are stored.

Maps = Callable[[], Iterator[Float32]]
"""A function that returns a new iterator over the scores (H, W) of each class in order."""


def resized(maps: Maps, shape: tuple[int, ...], where: str) -> Maps:
    """Return the maps at the pixels of an image (H, W) of the same view; linear.

    Raises:
        DataError: For another view.
    """
    return lambda: (fitted(values[..., None], shape, where)[..., 0] for values in maps())


def largest_only(maps: Maps, count: int) -> Maps:
    """Yield the maps with 0 for all but each pixel's largest scores; more than `count` where some are equal."""

    def thinned() -> Iterator[Float32]:
        largest: list[Float32] = []  # in falling order, (H, W) each
        for values in maps():
            rest = values
            for k, value in enumerate(largest):
                largest[k], rest = np.maximum(value, rest), np.minimum(value, rest)
            if len(largest) < count:
                largest.append(rest)
        for values in maps():
            yield np.where(values >= largest[-1], values, np.float32(0))

    return thinned
