"""Fuse the frames of a program into a `Result` with all numbers of a run; no file stays unless it is saved."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from semstab.api import run
from semstab.config import BackendConfig
from semstab.configure import as_config
from semstab.core.files import ScratchFolder
from semstab.data.frames import Frame
from semstab.data.records import Result
from semstab.engine import Observer
from semstab.errors import ConfigError
from semstab.online.frames import Frames, Sequence
from semstab.online.summary import Summary
from semstab.report import Reporting, write_report


@dataclasses.dataclass(frozen=True, repr=False)
class FusedResult(Result):
    """A result whose files lie in a temporary folder until `save`; `compare`, `gate` and `export` take it as a run.

    Examples:
        >>> result = semstab.fuse(frames, voxel_size=0.5, model="net")
        >>> result.summary.frames, result.record().unit.model
        (6, 'net')
        >>> result.save("saved").name
        'saved'
    """

    _folder: Any = None

    @property
    def summary(self) -> Summary:
        """Return the numbers of the map in a row."""
        record = self.record()
        assert record.statistics is not None
        flicker = record.image_space.compensated_flicker_percent
        return Summary.from_statistics(record.frames, record.map_summary, record.statistics, flicker)

    def report(self, path: str | Path) -> Path:
        """Write report.html, one file without a network; return its path."""
        page = write_report(self, self.__fspath__())
        return Path(shutil.copyfile(page, path))

    def save(self, folder: str | Path) -> Path:
        """Write the run's folder: summary, voxels, series, tables and report.

        Raises:
            ConfigError: If the folder is not empty.
        """
        if Path(folder).exists() and (not Path(folder).is_dir() or any(Path(folder).iterdir())):
            raise ConfigError(f"{folder}: the folder is not empty; choose another folder")
        Reporting(self.__fspath__()).run_finished(self)
        return Path(shutil.copytree(self.__fspath__(), folder, dirs_exist_ok=True))

    def __fspath__(self) -> str:
        """Return the folder of its files, which is removed with the result."""
        return str(self._folder.path)


def fuse(
    frames: Iterable[Frame | Mapping[str, Any]],
    *,
    voxel_size: float | None = None,
    backend: str = "numba",
    rule: str = "mean",
    classes: Iterable[str] = (),
    scene: str = "frames",
    model: str = "model",
    recording: str | Path | None = None,
    observers: Iterable[Observer] = (),
    **settings: Any,
) -> FusedResult:
    """Fuse posed label maps, and return all numbers of a run: measures, strata, alpha, verdict, intervals.

    Args:
        frames: `Frame`s, or mappings with labels (H, W) or scores (H, W, K), depth (H, W) in metres, intrinsics (3, 3),
            T_wc (4, 4) or (3, 4) camera to world; color, mask, timestamp and truth (H, W) are optional. NumPy or
            torch. A generator is read once; its frames wait on disk, in a temporary folder.
        voxel_size: Edge of a voxel, metres; by default the size that `check` suggests for the data.
        backend: Name of the backend that fuses.
        rule: Rule by which it fuses: votes, bayes, weighted, recent, ..., or FILE.py:NAME; docs/fusion-rules.md.
        classes: Names, in the order of the labels.
        scene: Name of the scene.
        model: Name of the model.
        recording: A file for the rerun viewer.
        observers: Objects that are notified of each step.
        settings: Further settings of `Config`: statistics=True, scope='these frames', events=True, ...

    Returns:
        The result, whose `summary` has the numbers of the map.

    Raises:
        DataError: For a frame that cannot be fused, with its number.
        ConfigError: For a setting that is not valid.

    Examples:
        >>> result = semstab.fuse(frames, voxel_size=0.5)
        >>> result.summary.frames, round(result.summary.recurrent_share, 1)
        (6, 1.0)
    """
    sequence, token = Sequence(frames), uuid.uuid4().hex
    Frames.sequences[token] = sequence
    options = {"token": token, "scene": scene, "model": model, "classes": tuple(classes)}
    fused_by = BackendConfig.parse(backend).fusing_by(rule)
    content = {"name": scene, "dataset": {"name": "frames", "options": options}, "backends": [fused_by], **settings}
    config = as_config(content if voxel_size is None else {**content, "voxel_size": voxel_size})
    folder = ScratchFolder()
    with contextlib.ExitStack() as stack:
        watching = list(observers)
        if recording is not None:
            from semstab.recording import Recording, Target

            watching.append(stack.enter_context(contextlib.closing(Recording(Target.parse(str(recording), Path())))))
        result = run(config, out=folder.path, observers=watching, report=False)
    return FusedResult(**{name: getattr(result, name) for name in vars(result)}, _folder=folder)
