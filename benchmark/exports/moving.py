"""Masks of what moves in the frames of a unit, as `exclude.masks` takes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from semstab.core.files import write_image
from semstab.errors import ConfigError, DataError
from semstab.statistics import Sampler
from semstab.task import Task, read

MOVING = "moving"
"""The name of a folder that gets masks."""

MOVES, STAYS = 0, 255
"""Values of a mask's pixels."""


def holds_masks(file: Path) -> bool:
    """Return whether masks are to be written there: a folder of the name MOVING."""
    return file.name == MOVING


def write_masks(task: Task, folder: Path, progress: Callable[[], None] = lambda: None) -> tuple[int, float]:
    """Write NAME.png of each frame: MOVES where its surface moved, by the depth of all frames.

    Args:
        task: The unit as it was fused.
        folder: Folder of the masks, which need not be there.
        progress: Called after each frame of both passes.

    Returns:
        Number of masks, and the share of the pixels with depth that move.

    Raises:
        ConfigError: If the frames are scans, or their depth is cast at a surface.
        DataError: If no frame has depth.
    """
    if task.scene.of_scans:
        raise ConfigError(f"{task.scene.name}: masks are of images, and its frames are scans")
    if task.scene.surface is not None:
        raise ConfigError(
            f"{task.scene.name}: depth is cast at {task.scene.surface.name}, which has no movers in it; what moves"
            " cannot be told"
        )
    sampler = Sampler(len(task.mapping.target))
    for index in task.indices:
        sampler.add(read(task, index))
        progress()
    if (votes := sampler.sample().votes) is None or not len(votes.misplaced):
        raise DataError(f"{task.scene.name}: no frame has depth and labels")
    folder.mkdir(parents=True, exist_ok=True)
    moving = pixels = 0
    for index in task.indices:
        frame = read(task, index)
        mask = sampler.moving_pixels(votes, frame)
        moving, pixels = moving + int(mask.sum()), pixels + int(np.count_nonzero(frame.depth > 0))
        image = np.where(mask, MOVES, STAYS).astype(np.uint8)
        write_image(folder / f"{task.scene.frame_name(index)}.png", image)
        progress()
    return len(task.indices), moving / max(pixels, 1)
