"""Read posed label maps of a program as frames, and as the dataset `frames` of a run."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from semstab.core.files import ScratchFolder
from semstab.core.types import Float64
from semstab.data.features import OF_FEATURES, Features
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets.scene import GROUND_TRUTH, Dataset, Scene
from semstab.errors import DataError

FIELDS = (
    "labels", "scores", "depth", "intrinsics", "T_wc", "color", "mask", "timestamp", "truth", "points",
    "features",
)  # fmt: skip
"""The fields of a posed label map that is given as a mapping; see `Frame`. truth (H, W) has the true labels."""


def as_array(value: Any) -> npt.NDArray[Any]:
    """Return an array of numpy, of a torch tensor on any device, or of nested lists."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return np.asarray(value)


def as_frame(given: Frame | Mapping[str, Any], index: int) -> tuple[Frame, Frame | None]:
    """Return frame `index` of a sequence, and the same with its true labels where they are given.

    Raises:
        DataError: If a field is missing, unknown, or not valid for `Frame`.
    """
    if isinstance(given, Frame):
        return dataclasses.replace(given, index=index), None
    fields = dict(given)
    for name in fields:
        if name not in FIELDS:
            raise DataError(f"frame {index}: no field '{name}'; the fields are {', '.join(FIELDS)}")
    for name in ("T_wc",) if "points" in fields else ("depth", "intrinsics", "T_wc"):
        if name not in fields:
            raise DataError(
                f"frame {index}: '{name}' is missing; a posed label map has labels, depth, intrinsics, T_wc, and a scan"
                " labels, points, T_wc"
            )
    for name in fields.keys() - {"intrinsics", "timestamp"}:
        if not (fields[name] is None or isinstance(fields[name], Features)):
            fields[name] = as_array(fields[name])
    if hasattr(fields.get("intrinsics"), "detach"):
        fields["intrinsics"] = as_array(fields["intrinsics"])
    truth = fields.pop("truth", None)
    frame = Frame(index, **fields)
    if truth is None:
        return frame, None
    return frame, dataclasses.replace(frame, labels=truth, scores=None, color=None, mask=None, features=None)


class Sequence:
    """The frames of a program on disk, in a temporary folder that is removed with the last reference to them.

    Attributes:
        classes: The number of classes by the largest label, or by the scores.
        timestamps: (n,) seconds, where all frames have one and they ascend.
        of_scans: Whether one of them is a scan.
        has_features: Whether all of them have features.
        of_features: Whether they have no labels, too, which are of class 0 then.
    """

    def __init__(self, frames: Iterable[Frame | Mapping[str, Any]]) -> None:
        self._folder = ScratchFolder()
        self.count, self.classes, self.of_scans = 0, 0, False
        self.of_features = self.has_features = True
        self.has_truth, times, digest = True, list[float | None](), hashlib.blake2b(digest_size=16)
        for item in frames:
            frame, truth = as_frame(item, self.count)
            with self._file(self.count).open("wb") as file:
                pickle.dump((frame, truth), file, protocol=5)
            true = None if truth is None else truth.labels
            for image in (frame.depth, frame.points, frame.labels, frame.scores, frame.T_wc, true):
                digest.update(b"" if image is None else np.ascontiguousarray(image).data)
            if frame.features is not None:
                digest.update(np.ascontiguousarray(frame.features.vectors).data)
                digest.update(repr((frame.features.first, frame.features.step)).encode())
            self.has_features = self.has_features and frame.features is not None
            self.of_features = self.of_features and frame.features is not None and _classes(frame) <= 1
            digest.update(repr((frame.intrinsics, frame.timestamp)).encode())
            self.classes = max(self.classes, _classes(frame), 0 if truth is None else _classes(truth))
            self.has_truth = self.has_truth and truth is not None
            times.append(frame.timestamp)
            self.of_scans = self.of_scans or frame.is_scan
            self.count += 1
        if not self.count:
            raise DataError("there are no frames to fuse; give posed label maps: labels, depth, intrinsics, T_wc")
        seconds = [time for time in times if time is not None]
        ascending = len(seconds) == self.count and seconds == sorted(seconds)
        self.timestamps: Float64 | None = np.array(seconds) if ascending else None
        self.digest = digest.hexdigest()

    def frame(self, index: int) -> tuple[Frame, Frame | None]:
        """Return a frame, and the same with its true labels where they are given."""
        with self._file(index).open("rb") as file:
            frames: tuple[Frame, Frame | None] = pickle.load(file)
        return frames

    def _file(self, index: int) -> Path:
        return self._folder.path / f"{index:06d}"


def _classes(frame: Frame) -> int:
    if frame.scores is not None:
        return int(frame.scores.shape[2])
    assert frame.labels is not None
    return int(frame.labels.max(initial=0, where=frame.labels != frame.ignore_id)) + 1


class FramesOptions(BaseModel):
    """The options of frames of this process: the token of their sequence, and the names of scene, model and classes."""

    token: str
    scene: str = "frames"
    model: str = "model"
    classes: tuple[str, ...] = ()


class Frames(Dataset):
    """A dataset of one scene: the frames that `semstab.fuse` was given. Only the process that has them reads it."""

    Options: type[BaseModel] = FramesOptions
    sequences: ClassVar[weakref.WeakValueDictionary[str, Sequence]] = weakref.WeakValueDictionary()

    def __init__(self, options: FramesOptions) -> None:
        self._options = options

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return the name of the one scene."""
        return (self._options.scene,)

    def scene(self, name: str) -> Scene:
        """Return the scene of the frames.

        Raises:
            DataError: If the frames no longer exist.
        """
        sequence = self.sequences.get(self._options.token)
        if sequence is None:
            raise DataError(
                f"{name}: a program gave these frames to semstab.fuse, and they no longer exist; fuse them again"
            )
        return FramesScene(sequence, self._options)


class FramesScene(Scene):
    """The frames of a program, with the labels of one model, and the truth where every frame has it."""

    in_program = True

    def __init__(self, sequence: Sequence, options: FramesOptions) -> None:
        self._sequence = sequence
        self.name, self.models, self.ground_truth = options.scene, (options.model,), sequence.has_truth
        self.of_scans = sequence.of_scans
        self.with_features = (options.model,) if sequence.has_features else ()
        classes = options.classes or tuple(f"class {k}" for k in range(max(2, sequence.classes)))
        if sequence.of_features:
            self._space = OF_FEATURES
            return
        if len(classes) < sequence.classes:
            raise DataError(f"{self.name}: there are labels up to {sequence.classes - 1}, but {len(classes)} classes")
        self._space = LabelSpace(options.scene, classes)

    def __len__(self) -> int:
        return self._sequence.count

    def label_space(self, model: str) -> LabelSpace:
        """Return the label space, which model and truth share."""
        return self._space

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Return a frame with the model's labels, or with the true ones."""
        frame, truth = self._sequence.frame(index)
        return frame if model != GROUND_TRUTH or truth is None else truth

    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of all frames and of the selection."""
        return f"{self._sequence.digest}-{model}-{hashlib.blake2b(repr(indices).encode(), digest_size=8).hexdigest()}"

    @property
    def timestamps(self) -> Float64 | None:
        """Return the seconds of each frame, where all have one and they ascend."""
        return self._sequence.timestamps
