"""A run over videos without depth and poses: flicker in the image alone, with its tables and its page."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from semstab.config import Config
from semstab.configure import as_config, resolve
from semstab.core.files import FolderLock, ScratchFolder, write_json, write_text
from semstab.data.videos import VideoResult
from semstab.engine.folder import SETTINGS, VIDEO_LAYOUT
from semstab.engine.run_result import origin
from semstab.engine.videos import VideoObserver, measured_videos
from semstab.errors import ConfigError
from semstab.predict.dataset import NAME as PREDICTED
from semstab.report.tables import save_tables
from semstab.report.videos import save_series, summary, tables, write_page
from semstab.task import open_scenes

logger = logging.getLogger("semstab")

VIDEO = "video"
"""The dataset of videos."""

OF_MAPS = (
    "voxel_size", "backends", "check", "statistics", "events", "tile_size", "scope", "sweeps", "shared_taxonomy",
    "critical_classes", "region_maps", "frame_quality",
)  # fmt: skip
"""Settings that a video, which has no map, does not use."""


def is_video(config: Config) -> bool:
    """Return whether a configuration reads videos, with labels of their own or predicted ones."""
    dataset = config.dataset
    inner = dataset.options.get("dataset") if dataset.name == PREDICTED else None
    return VIDEO in (dataset.name, inner.get("name") if isinstance(inner, Mapping) else getattr(inner, "name", None))


def run_videos(
    config: Config | Mapping[str, Any] | str | Path,
    *,
    out: str | Path | None = None,
    observers: Sequence[VideoObserver] = (),
    command: Sequence[str] = (),
    report: bool = True,
    overwrite: bool = False,
) -> VideoResult:
    """Measure flicker of the label maps of videos, without depth and poses.

    A folder `out` gets the summary, the series of each model and, unless `report` is False, tables and report.html.
    Each video that is measured is kept there: the same call goes on after it.

    Args:
        config: Settings whose dataset is `video`, or a YAML file with them.
        out: Folder of the results; without it they are in memory alone.
        observers: Objects that are notified of each frame.
        command: The command line, for the manifest.
        report: Whether tables and report.html are written.
        overwrite: Whether the results of another run in the folder may be replaced.

    Returns:
        The flicker of each model on each video, frame by frame.

    Raises:
        ConfigError, DataError: If images, labels or classes are missing or do not fit.

    Examples:
        >>> import pathlib
        >>> import cv2
        >>> for name in ("clip/images", "clip/labels/net"):
        ...     pathlib.Path(name).mkdir(parents=True)
        ...     for k in range(3):
        ...         _ = cv2.imwrite(f"{name}/{k}.png", np.full((48, 64), k % 2, np.uint8))
        >>> clip = {"name": "video", "options": {"root": "clip", "classes": ["wall", "door"]}}
        >>> semstab.run_videos({"dataset": clip}).records[0].image_space.flicker_percent
        100.0
    """
    began, config = time.perf_counter(), resolve(as_config(config))
    if unused := [name for name in OF_MAPS if name in config.model_fields_set]:
        logger.warning("%s: a video has no map, so that this is not used", ", ".join(unused))
    with contextlib.ExitStack() as stack:
        if out is None:
            scratch = ScratchFolder()
            stack.callback(scratch.remove)
        folder = scratch.path if out is None else Path(out)
        scenes = open_scenes(config, folder.absolute(), posed=False)
        if (other := next((name for name, scene in scenes.items() if scene.posed), None)) is not None:
            raise ConfigError(f"{other}: has depth and poses; use semstab.run")
        _claim(folder, config, overwrite=overwrite)
        stack.callback(FolderLock(folder).release)
        records = tuple(measured_videos(config, scenes, observers, None if out is None else folder))
        inputs = {f"{record.scene}/{record.model}": record.input for record in records}
        seconds = {"all": time.perf_counter() - began}
        result = VideoResult(records, origin(config, command) | {"inputs": inputs, "seconds": seconds})
        if out is not None:
            _write(result, folder, report=report)
        for observer in observers:
            observer.run_finished(result)
    return result


def _claim(folder: Path, config: Config, *, overwrite: bool) -> None:
    """Write the settings into the folder of a run; raises ConfigError where it holds something else."""
    path, text = folder / SETTINGS, f"{VIDEO_LAYOUT}\n{config.to_yaml()}"
    before = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else None
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; name a folder")
    if (before is None and folder.is_dir() and any(folder.iterdir())) or not (before or text).startswith(VIDEO_LAYOUT):
        raise ConfigError(f"{folder}: is not empty and holds no run over videos; choose another folder")
    if before not in (None, text) and not overwrite:
        raise ConfigError(f"{folder}: holds another run; choose another --out, or --overwrite to replace it")
    folder.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def _write(result: VideoResult, folder: Path, *, report: bool) -> None:
    for record in result.records:
        save_series(record, folder)
    write_json(folder / "summary.json", summary(result))
    write_json(folder / "manifest.json", result.manifest)
    if report:
        save_tables(tables(result), folder)
        write_page(result, folder)
